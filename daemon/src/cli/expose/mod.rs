//! `raysweep expose`: tries exposures on the scene with a viewfinder, and proposes a plan.

mod plan;
mod trial;

use std::path::Path;

use raysweep_config::plan::with_tables;
use raysweep_config::{Plan, Procedure};
use raysweep_proto::{CheckReport, Client};
use serde_json::json;

use self::plan::{BALANCED, MAX_AVERAGE, averaged, limited, noise_ratio, plan_exposures};
use self::trial::{MAX_SATURATED, PlanExposures, Trial, Tried, in_hundredths};
use super::exit::Exit;
use super::failure::CommandFailure;
use super::plan_file::read_plan;
use super::printer::Printer;
use super::show;

/// A scene that could be this much brighter is worth opening the aperture for, and a board that is as much too bright is
/// worth closing it.
const WORTHWHILE: f64 = 1.1;
/// Frames per point are balanced in so many steps at most, each of which is a check; two are the rule.
const STEPS: usize = 4;
/// What begins and ends the comments of a proposal, and what each between them begins with: those of an earlier one are left
/// out.
const PROPOSED: &str = "# Proposed by `raysweep expose`:";
const REMARK: &str = "#   ";
const END: &str = "# End of the proposal.";

/// Tries exposures for a plan, and prints what it proposes.
pub(super) fn expose(socket: &Path, path: &Path, printer: Printer) -> Result<Exit, CommandFailure> {
    let text = read_plan(path)?;
    let mut client = Client::connect(socket)?;
    let foreseen = client.check(&text).map_err(|error| CommandFailure::of_plan(error, path, &text))?;
    let text = without_remarks(&text);
    // Settings that the plan leaves to the calibration are stated in what is proposed.
    let text = match foreseen.settings {
        Some(table) => {
            with_tables(&text, &table).map_err(|error| CommandFailure::Exposure(error.to_string()))?
        }
        None => text,
    };
    let Some(exposures) = Plan::parse(&text).ok().and_then(|plan| plan_exposures(&plan.procedure)) else {
        let message = "the plan has no exposures to choose: give a plan of kind \"sweep\" or \"film\"";
        return Err(CommandFailure::Exposure(message.into()));
    };
    let mut trial = Trial::begin(socket, foreseen.white_dn, printer)?;
    let (tried, mut plan) = fitted(&mut trial, text, &exposures)?;
    drop(trial);
    let mut check =
        |plan: &str| client.check(plan).map_err(|error| CommandFailure::of_plan(error, path, plan));
    let mut report = check(&plan)?;
    for _ in 0..STEPS {
        match averaged(&plan, &report)? {
            Some(other) => (report, plan) = (check(&other)?, other),
            None => break,
        }
    }
    let proposal = Proposed { tried, longest_us: exposures.longest_us, report, plan };
    printer.print(&proposal.value(), |_| proposal.text())?;
    Ok(Exit::Done)
}

/// The plan without exposures that saturate too much, and what was found of it.
fn fitted(
    trial: &mut Trial,
    mut text: String,
    exposures: &PlanExposures,
) -> Result<(Tried, String), CommandFailure> {
    let mut tried = trial.longest(exposures)?;
    loop {
        let plan = limited(&text, tried.exposure_us)?;
        let shorter = Plan::parse(&plan).ok().and_then(|plan| plan_exposures(&plan.procedure));
        // A shorter exposure moves delays, at which nothing has been tried yet.
        let Some(shorter) = shorter.filter(|_| plan != text) else { return Ok((tried, plan)) };
        let shortest_us = exposures.shortest_us.min(shorter.shortest_us);
        tried = trial.longest(&PlanExposures { shortest_us, ..shorter })?;
        text = plan;
    }
}

/// A plan's text without the comments of an earlier proposal.
fn without_remarks(text: &str) -> String {
    let lines: Vec<&str> = text.split_inclusive('\n').collect();
    let find = |wanted: &str| lines.iter().position(|line| line.trim_end() == wanted);
    match find(PROPOSED).zip(find(END)) {
        Some((first, last)) if first < last => [&lines[..first], &lines[last + 1..]].concat().concat(),
        _ => text.to_owned(),
    }
}

/// What is proposed.
struct Proposed {
    tried: Tried,
    /// The plan's longest exposure before.
    longest_us: f64,
    report: CheckReport,
    plan: String,
}

impl Proposed {
    fn value(&self) -> serde_json::Value {
        let Self {
            tried: Tried { exposure_us, saturated, headroom, board_headroom, .. }, report, plan, ..
        } = self;
        let (rig, expected) = report.advice.as_ref().map(|advice| (&advice.rig, &advice.expected)).unzip();
        json!({
            "exposure_us": exposure_us, "saturated": saturated, "headroom": headroom,
            "board_headroom": board_headroom, "gain_factor": self.gain_factor(), "average": self.average(),
            "light_s": report.light_s, "expected": expected, "rig": rig, "plan": plan, "warnings": report.warnings,
        })
    }

    /// Frames per point, if they are counted by what is foreseen.
    fn average(&self) -> Option<u32> {
        self.noise_ratio()?;
        match Plan::parse(&self.plan).ok()?.procedure {
            Procedure::Sweep(sweep) => Some(sweep.average),
            _ => None,
        }
    }

    fn noise_ratio(&self) -> Option<f64> {
        noise_ratio(&self.report.advice.as_ref()?.expected)
    }

    /// What the camera's gain is to be multiplied by, unless the aperture is opened by as much.
    fn gain_factor(&self) -> f64 {
        let factor = self.tried.headroom.min(self.tried.board_headroom);
        if (WORTHWHILE.recip()..=WORTHWHILE).contains(&factor) { 1.0 } else { factor }
    }

    /// What the gain is to be, and why.
    fn gain(&self) -> String {
        let Tried { headroom, board_headroom, .. } = self.tried;
        let of_board = "65 % of full scale, which is the most that a calibration takes, as far as the calibration in use or camera.white_dn tells";
        let factor = self.gain_factor();
        let times = format!("gain: {factor:.2} times ({:+.1} dB) as much", 20.0 * factor.log10());
        let again = "The plan below is for the gain as it is: calibrate again, and try this again";
        match factor {
            1.0 if board_headroom < headroom => format!("gain: as it is; a white board has about {of_board}"),
            1.0 => "gain: as it is; more would saturate the scene".to_owned(),
            factor if factor < 1.0 => {
                format!(
                    "{times}: a white board has more than {of_board}. Or close the aperture by as much. {again}"
                )
            }
            _ => {
                let limit = match board_headroom < headroom {
                    true => format!("a white board has {of_board}"),
                    false => "the scene just does not saturate".to_owned(),
                };
                format!(
                    "{times}: {limit}. Better open the aperture by as much: that brings light, and a gain brings counts alone. {again}"
                )
            }
        }
    }

    fn text(&self) -> String {
        let Self { tried: Tried { exposure_us, saturated, .. }, longest_us, report, plan } = self;
        let mut remarks = vec![format!(
            "exposures up to {} us: {:.3} % of the pixels saturate (at most {:.2} % may)",
            in_hundredths(*exposure_us),
            100.0 * saturated,
            100.0 * MAX_SATURATED
        )];
        if exposure_us < longest_us {
            let longest_us = in_hundredths(*longest_us);
            remarks.push(format!("longer ones, up to {longest_us} us, saturate more and are shortened"));
        }
        remarks.push(self.gain());
        if let Some((average, ratio)) = self.average().zip(self.noise_ratio()) {
            let most = match ratio > BALANCED && f64::from(average) >= MAX_AVERAGE {
                true => format!("; more than {MAX_AVERAGE} frames are not proposed"),
                false => String::new(),
            };
            remarks.push(format!(
                "average = {average}: noise is {ratio:.2} times as large as what averaging does not remove{most}"
            ));
        }
        remarks.push(format!("{:.2} s of light", report.light_s));
        if let Some(advice) = &report.advice {
            remarks.push(format!("expected error: {}", show::errors(&advice.expected)));
            remarks.push(format!("the rig is known: {}", show::accuracy(&advice.rig)));
        }
        remarks.extend(report.warnings.iter().map(|warning| format!("warning: {warning}")));
        let remarks: String = remarks.into_iter().map(|remark| format!("{REMARK}{remark}\n")).collect();
        format!("{PROPOSED}\n{remarks}{END}\n{}", show::plan(plan))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gain_is_proposed_where_it_is_worth_a_calibration() {
        let of = |headroom, board_headroom| {
            let tried = Tried { exposure_us: 600.0, saturated: 0.0, suits: true, headroom, board_headroom };
            let report = json!({ "points": 1, "extra_points": 0, "frames": 8, "light_s": 0.1, "memory_bytes": 1,
                "memory_free_bytes": 2, "disk_bytes": 1, "disk_free_bytes": 2, "warnings": [] });
            let (report, plan) =
                (serde_json::from_value(report).unwrap(), "kind = \"sweep\"\r\n[sweep]\r\n".into());
            let proposed = Proposed { tried, longest_us: 600.0, report, plan };
            (proposed.text(), proposed.value()["gain_factor"].as_f64().unwrap())
        };
        for (headroom, board_headroom, factor, said) in [
            (3.0, 1.05, 1.0, "gain: as it is; a white board has about 65 %"),
            (1.05, 3.0, 1.0, "gain: as it is; more would saturate the scene"),
            (2.0, 3.0, 2.0, "gain: 2.00 times (+6.0 dB) as much: the scene just does not saturate"),
            (3.0, 2.0, 2.0, "gain: 2.00 times (+6.0 dB) as much: a white board has 65 %"),
            // A board that is too bright, of which the scene need not show anything.
            (1.5, 0.72, 0.72, "gain: 0.72 times (-2.9 dB) as much: a white board has more than 65 %"),
            (1.5, 0.95, 1.0, "gain: as it is; a white board has about 65 %"),
        ] {
            let (text, proposed) = of(headroom, board_headroom);
            assert!(text.contains(&format!("{REMARK}{said}")), "{text}");
            assert_eq!(proposed, factor);
            assert!(text.ends_with("\nkind = \"sweep\"\n[sweep]") && !text.contains('\r'), "{text:?}");
        }
    }

    #[test]
    fn remarks_of_an_earlier_proposal_are_left_out() {
        let plan = "# Mine.\nkind = \"sweep\"\n";
        let block = format!("{PROPOSED}\n{REMARK}this\n{REMARK}and that\n{END}\n");
        assert_eq!(without_remarks(&format!("{block}#   My own.\n{plan}")), format!("#   My own.\n{plan}"));
        assert_eq!(without_remarks(&block.replace('\n', "\r\n")), "");
        for own in [plan.to_owned(), format!("name = \"{PROPOSED}\n"), format!("{PROPOSED}\n{plan}")] {
            assert_eq!(without_remarks(&own), own);
        }
    }
}
