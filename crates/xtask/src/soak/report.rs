//! What a soak found: a table for the terminal, and a page with plots.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use super::process::AtRest;
use super::{Findings, Killed, Ran};
use crate::run::Done;

/// Growth of a daemon's memory at rest that is called a leak, from the end of the warm-up to the end.
const MOST_GROWTH_MIB: f64 = 16.0;

/// What has happened so far.
#[derive(Default)]
pub struct SoakReport {
    runs: Vec<Ran>,
    kills: usize,
    killed_runs: usize,
    findings: Findings,
    latencies_ms: Vec<f64>,
    /// The daemons after each round: of the plane rig and of the dot rig.
    rests: Vec<[AtRest; 2]>,
}

impl SoakReport {
    /// A run has ended.
    pub fn ran(&mut self, mut ran: Ran) {
        self.findings.append(&mut ran.findings);
        self.runs.push(ran);
    }

    /// A killed run was completed.
    pub fn killed(&mut self, mut killed: Killed) {
        self.findings.append(&mut killed.findings);
        self.kills += killed.kills;
        self.killed_runs += 1;
    }

    /// Answers took this long.
    pub fn asked(&mut self, latencies_ms: Vec<f64>) {
        self.latencies_ms.extend(latencies_ms);
    }

    /// A round has ended.
    pub fn rested(&mut self, rests: [AtRest; 2]) {
        self.rests.push(rests);
    }

    /// Rounds so far.
    pub fn rounds(&self) -> usize {
        self.rests.len()
    }

    /// A line about the last round.
    pub fn last_round(&self) -> String {
        let rests = self
            .rests
            .last()
            .map(|rests| rests.map(|rest| format!("{:.0} MiB", rest.resident_mib)).join(" and "));
        let findings = self.findings.len();
        format!(
            "round {}: {} at rest, {} kills, {findings} findings",
            self.rounds(),
            rests.unwrap_or_default(),
            self.kills
        )
    }

    /// All that is wrong.
    pub fn findings(&self, warm_up: usize) -> Findings {
        let mut findings = self.findings.clone();
        for (daemon, name) in ["plane", "dots"].into_iter().enumerate() {
            let rests: Vec<AtRest> = self.rests.iter().skip(warm_up).map(|rests| rests[daemon]).collect();
            let memory_mib: Vec<f64> = rests.iter().map(|rest| rest.resident_mib).collect();
            let grown_mib = slope(&memory_mib) * rests.len().saturating_sub(1) as f64;
            if rests.len() > 1 && grown_mib > MOST_GROWTH_MIB {
                findings.push(format!(
                    "{name}: memory at rest has grown by {grown_mib:.0} MiB; {MOST_GROWTH_MIB} are allowed"
                ));
            }
            // Growth is what the later rounds have in common.
            let (early, late) = rests.split_at(rests.len() / 2);
            let most = |of: fn(&AtRest) -> usize| early.iter().map(of).max().unwrap_or(usize::MAX);
            let least = |of: fn(&AtRest) -> usize| late.iter().map(of).min().unwrap_or(0);
            for (what, before, after) in [
                ("descriptors", most(|rest| rest.descriptors), least(|rest| rest.descriptors)),
                ("threads", most(|rest| rest.threads), least(|rest| rest.threads)),
            ] {
                if after > before {
                    findings
                        .push(format!("{name}: at least {after} {what} at rest, at most {before} before"));
                }
            }
        }
        let lost = self.latencies_ms.iter().filter(|latency| latency.is_infinite()).count();
        if lost > 0 {
            findings.push(format!("{lost} requests were not answered"));
        }
        findings
    }

    /// Counts and latencies.
    pub fn table(&self, findings: &Findings) -> String {
        let mut table = String::new();
        let mut kinds: Vec<&str> = self.runs.iter().map(|ran| ran.kind.as_str()).collect();
        kinds.sort_unstable();
        kinds.dedup();
        for kind in kinds {
            let seconds: Vec<f64> =
                self.runs.iter().filter(|ran| ran.kind == kind).map(|ran| ran.seconds).collect();
            let (median_s, longest_s) = (quantile(&seconds, 0.5), quantile(&seconds, 1.0));
            let _ = writeln!(
                table,
                "{kind:<12} {:>5} runs, {median_s:.1} s each, {longest_s:.1} s at most",
                seconds.len()
            );
        }
        let _ =
            writeln!(table, "{:<12} {:>5} runs, killed {} times", "resumed", self.killed_runs, self.kills);
        let [median, p99, longest] = [0.5, 0.99, 1.0].map(|share| quantile(&self.latencies_ms, share));
        let asked = self.latencies_ms.len();
        let _ = writeln!(
            table,
            "{:<12} {asked:>5} answers, {median:.2} ms median, {p99:.2} ms p99, {longest:.1} ms at most",
            "status"
        );
        for (daemon, name) in ["plane", "dots"].into_iter().enumerate() {
            if let (Some(first), Some(last)) = (self.rests.first(), self.rests.last()) {
                let [first, last] = [first[daemon], last[daemon]];
                let _ = writeln!(
                    table,
                    "{name:<12} {:>5.0} MiB at rest ({:.0} after the first round), {} descriptors ({}), {} threads ({})",
                    last.resident_mib,
                    first.resident_mib,
                    last.descriptors,
                    first.descriptors,
                    last.threads,
                    first.threads
                );
            }
        }
        let _ = write!(table, "{:<12} {:>5}", "findings", findings.len());
        table
    }

    /// Writes the page; returns its path.
    pub fn write(&self, folder: &Path, findings: &Findings) -> Done<PathBuf> {
        let path = folder.join("report.html");
        let mut page = String::from(
            "<!doctype html><meta charset=utf-8><title>Soak</title><style>body{font:16px sans-serif;max-width:50em;margin:2em auto}svg{width:100%}</style><h1>Soak</h1>\n",
        );
        let _ = writeln!(page, "<pre>{}</pre>", escaped(&self.table(findings)));
        for (daemon, name) in ["plane", "dots"].into_iter().enumerate() {
            let at_rest = |value: fn(&AtRest) -> f64| {
                self.rests.iter().map(|rests| value(&rests[daemon])).collect::<Vec<_>>()
            };
            page += &plot(
                &format!("{name} rig: memory at rest after each round, MiB"),
                &at_rest(|rest| rest.resident_mib),
            );
            page += &plot(
                &format!("{name} rig: threads at rest after each round"),
                &at_rest(|rest| rest.threads as f64),
            );
            page += &plot(
                &format!("{name} rig: descriptors at rest after each round"),
                &at_rest(|rest| rest.descriptors as f64),
            );
        }
        let mut sorted = self.latencies_ms.clone();
        sorted.sort_by(f64::total_cmp);
        let percentiles: Vec<f64> =
            (0..=99).map(|percent| quantile(&sorted, f64::from(percent) / 100.0)).collect();
        page += &plot("answers to status: latency in ms against the percentile, 0 to 99", &percentiles);
        for finding in findings {
            let _ = writeln!(page, "<p>{}</p>", escaped(finding));
        }
        std::fs::write(&path, page).map_err(|error| format!("{}: {error}", path.display()))?;
        Ok(path)
    }
}

/// Least-squares slope per step.
fn slope(values: &[f64]) -> f64 {
    let middle = (values.len() as f64 - 1.0) / 2.0;
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let steps = || (0..values.len()).map(|step| step as f64 - middle);
    let squares: f64 = steps().map(|step| step * step).sum();
    if squares == 0.0 {
        0.0
    } else {
        steps().zip(values).map(|(step, value)| step * (value - mean)).sum::<f64>() / squares
    }
}

fn quantile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().saturating_sub(1);
    sorted.get((share * last as f64).round() as usize).copied().unwrap_or(f64::NAN)
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;")
}

/// A line through values at equal distances, from 0 to a little above the largest.
fn plot(title: &str, values: &[f64]) -> String {
    const SIZE: (f64, f64) = (600.0, 160.0);
    let top = values.iter().copied().filter(|value| value.is_finite()).fold(0.0, f64::max).max(1e-9) * 1.1;
    let last = values.len().saturating_sub(1).max(1) as f64;
    let place = |(step, value): (usize, &f64)| {
        format!(
            "{:.1},{:.1}",
            50.0 + (SIZE.0 - 60.0) * step as f64 / last,
            SIZE.1 * (1.0 - value.min(top) / top)
        )
    };
    let line: Vec<String> = values.iter().enumerate().map(place).collect();
    format!(
        "<h2>{}</h2><svg viewBox='0 -5 {} {}'><path d='M50 0V{y}H{x}' fill=none stroke=gray />\
         <text x=45 y=10 text-anchor=end font-size=11>{top:.3}</text><text x=45 y={y} text-anchor=end font-size=11>0</text>\
         <polyline points='{}' fill=none stroke=steelblue stroke-width=1.5 /></svg>\n",
        escaped(title),
        SIZE.0,
        SIZE.1 + 10.0,
        line.join(" "),
        x = SIZE.0 - 10.0,
        y = SIZE.1,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_slope_is_that_of_a_line() {
        assert!((slope(&[1.0, 3.0, 5.0, 7.0]) - 2.0).abs() < 1e-12);
        assert!(slope(&[4.0]).abs() < 1e-12);
    }

    #[test]
    fn what_grows_is_found() {
        let rest = |mib: f64, descriptors| AtRest { resident_mib: mib, descriptors, threads: 9 };
        let mut report = SoakReport::default();
        for round in 0..6 {
            report.rested([rest(50.0, 20), rest(50.0 + 10.0 * f64::from(round), 20 + round as usize)]);
        }
        let findings = report.findings(2);
        assert_eq!(findings.len(), 2, "{findings:?}");
        assert!(findings.iter().all(|finding| finding.starts_with("dots: ")), "{findings:?}");
    }
}
