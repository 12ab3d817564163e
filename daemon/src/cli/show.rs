//! Formats results as text for people.

use std::path::Path;
use std::time::Duration;

use indicatif::{BinaryBytes, FormattedDuration};
use raysweep_core::{ClockQuality, FilmSummary, Percentiles, PointUnderWay, SettingsLatency};
use raysweep_drivers::mirror::Parked;
use raysweep_proto::{
    BetterPlan, CheckReport, Description, DesignReport, ErrorRange, ExpectedError, MirrorStatus, NoiseSource,
    PlanAdvice, Progress, RigAccuracy, Role, RunState, SessionInfo, Status,
};

use raysweep_processing::Processed;
use raysweep_session::integrity::{Audit, Damage};
use serde::Serialize;

use super::printer::printable;

/// Text of `status`.
pub(super) fn status(status: &Status) -> String {
    let mut rows = vec![
        ("daemon", format!("{}, {} rig", status.version, status.rig)),
        ("state", state(status.state).to_owned()),
    ];
    rows.extend(status.question.iter().map(|question| ("to do", question.to_string())));
    if let Some(session) = &status.session {
        rows.push(("session", session.display().to_string()));
    }
    let is_over = status.state.is_over();
    rows.extend(status.ended.iter().map(|ended| ("ended", ended.clone())));
    if let Some(progress) = &status.progress {
        let (stored, planned) = (progress.points_stored, progress.points_planned);
        rows.push(("stored", format!("{stored} of {planned}, with dark and regular images")));
        if !is_over {
            rows.push(("pace", pace(progress)));
        }
        rows.push(("frames", frames(progress)));
        rows.push(("elapsed", duration(progress.elapsed_s)));
    }
    if let Some(film) = &status.film {
        rows.push(("film", self::film(film)));
    }
    if let Some(values) = &status.viewfinder {
        rows.push(("shows", super::finder_text::line(values)));
        rows.extend(values.alignment.iter().map(|found| ("", super::finder_text::alignment(found))));
        rows.extend(values.problem.iter().map(|problem| ("problem", problem.clone())));
    }
    if let Some(vsync) = &status.vsync {
        rows.push((
            "vsync",
            format!(
                "{:.2} us, jitter {:.2} us (99 % within {:.1} us); {} edges, {} missed, {} false",
                vsync.period_us,
                vsync.jitter_us,
                vsync.jitter_p99_us,
                vsync.edges,
                vsync.missed,
                vsync.false_edges
            ),
        ));
        rows.extend(vsync.allan_1s.map(|allan| ("", format!("Allan deviation over 1 s {allan:.1e}"))));
    }
    if let Some(ClockQuality { residual_us, rate_ppm, .. }) = status.vsync_clock {
        rows.push(("clock", format!("residual {residual_us:.1} us, {rate_ppm:+.2} ppm against the host's")));
    }
    if let Some(SettingsLatency { min_frames, max_frames }) = status.settings_latency {
        rows.push(("settings", settings_latency(min_frames, max_frames)));
    }
    if let Some(mirror) = &status.mirror {
        rows.push(("mirror", self::mirror(mirror)));
    }
    if let Some(error) = &status.error {
        rows.push(("error", error.clone()));
    }
    rows.extend(status.warnings.iter().map(|warning| ("warning", warning.clone())));
    block(&rows)
}

fn settings_latency(min_frames: u32, max_frames: u32) -> String {
    match (min_frames, max_frames) {
        (0, 0) => "take effect with the next frame".into(),
        (min, max) if min == max => format!("take effect {min} frames late"),
        (min, max) => format!("take effect {min} to {max} frames late"),
    }
}

/// Result of `park`, for programs.
pub(super) fn parked_name(parked: Parked) -> serde_json::Value {
    match parked {
        Parked::NeverMoved => serde_json::json!({ "parked": "nothing" }),
        Parked::Already => serde_json::json!({ "parked": "already" }),
        Parked::From(tilt) => serde_json::json!({ "parked": "from", "tilt_deg": tilt.deg() }),
        Parked::ByReset => serde_json::json!({ "parked": "by_reset" }),
    }
}

/// Text of `park` with the state file `state`.
pub(super) fn parked(parked: Parked, state: &Path) -> String {
    match parked {
        Parked::NeverMoved => format!(
            "{} does not exist: nothing was parked; give the file mirror.json in the daemon's data folder with --state",
            state.display()
        ),
        Parked::Already => "the mirror was already parked".into(),
        Parked::From(tilt) => {
            let [x, y] = tilt.deg();
            format!("the mirror is parked; it had been at {x:.2}, {y:.2} degrees")
        }
        Parked::ByReset => {
            "the mirror's position was unknown, so its controller was initialised again".into()
        }
    }
}

fn mirror(mirror: &MirrorStatus) -> String {
    let place = if mirror.parked { "parked" } else { "away from the origin" };
    let laser = if mirror.laser { "on" } else { "off" };
    let word = match mirror.light.as_str() {
        "interlock_closed" => "the interlock is closed",
        "interlock_open" => "the interlock is open",
        "armed" => "light is armed",
        _ => "light is not permitted: `raysweep arm-light` permits it until the next boot",
    };
    format!("{place}, light {laser}; {word}")
}

/// What `check` says: rows of a word and a text, and tables of settings with what they are.
#[derive(Serialize)]
pub(super) struct CheckText {
    rows: Vec<(&'static str, String)>,
    tables: Vec<(&'static str, String)>,
}

/// Text of `check`.
pub(super) fn check(report: &CheckReport) -> String {
    let CheckText { rows, tables } = check_text(report);
    tables.iter().fold(block(&rows), |text, (what, table)| format!("{text}\n\n# {what}\n{table}"))
}

/// What `check` says, for the terminal and the page.
pub(super) fn check_text(report: &CheckReport) -> CheckText {
    let mut rows = vec![
        (
            "points",
            match report.extra_points {
                0 => report.points.to_string(),
                extra => format!("{}, and {extra} of dark and regular images", report.points),
            },
        ),
        ("frames", report.frames.to_string()),
        ("time", format!("at least {}", duration(report.light_s))),
        ("memory", BinaryBytes(report.memory_bytes).to_string()),
        (
            "disk",
            format!("{} of {} free", BinaryBytes(report.disk_bytes), BinaryBytes(report.disk_free_bytes)),
        ),
    ];
    if let (Some((first, last)), Some(condition)) = (report.reach_rows, report.condition) {
        rows.push(("reach", format!("relative rows {first} to {last}")));
        rows.push(("condition", format!("{condition:.3e}")));
    }
    if report.settings.is_some() {
        let what = "chosen for the calibration in use, because the plan states none; see below";
        rows.push(("settings", what.into()));
    }
    rows.extend(report.advice.iter().flat_map(advice));
    if let Some(film) = &report.film {
        rows[0] = (
            "cycles",
            format!("{} of {} settings, and {} dark image", film.cycles, film.settings, report.extra_points),
        );
        let pace = format!(
            "{:.2} transports/s, {} VSYNC periods each: {}",
            film.transports_per_s, film.periods_per_cycle, film.reason
        );
        let minute = BinaryBytes(film.disk_bytes_per_minute);
        rows.insert(1, ("pace", pace));
        rows.insert(
            2,
            ("a minute", format!("{minute} on disk, uncompressed; the latency depends on the machine")),
        );
    }
    if let Some(batches) = &report.batches {
        let planes: Vec<String> = batches.planes.iter().map(u32::to_string).collect();
        let planes = if planes.is_empty() { "no".into() } else { planes.join(" and ") };
        rows[0] = (
            "batches",
            format!(
                "{} of the scene and {planes} of calibration planes, {} dots each",
                batches.scene, batches.dots
            ),
        );
        let raw = BinaryBytes(batches.raw_bytes_per_s);
        let pace = format!(
            "{:.2} batches/s, {:.0} frames/s ({raw}/s raw); mirror: {} samples at {:.0} Hz",
            1.0 / batches.batch_s,
            batches.camera_rate_hz,
            batches.samples,
            batches.rate_hz
        );
        rows.insert(1, ("pace", pace));
        rows.insert(2, ("dark", format!("{} frames before the first batch", batches.dark_frames)));
        rows.push(("a batch", format!("about {} on disk", BinaryBytes(batches.disk_bytes_per_batch))));
    }
    if let Some(response) = &report.response {
        let [low_hz, high_hz] = response.band_hz;
        rows[0] = (
            "chirps",
            format!(
                "x, then y: {low_hz} to {high_hz} Hz in {} s, {} degrees to either side, then {} s at rest",
                response.chirp_s, response.amplitude_deg, response.rest_s
            ),
        );
        let pace = format!(
            "{} frames an axis, {:.0} frames/s; mirror: {} samples at {:.0} Hz",
            response.frames, response.camera_rate_hz, response.samples, response.rate_hz
        );
        rows.insert(1, ("pace", pace));
        rows.insert(2, ("dark", format!("{} frames before the first chirp", response.dark_frames)));
    }
    let refused = report.settings_refused.iter();
    rows.extend(refused.chain(&report.warnings).map(|warning| ("warning", warning.clone())));
    let better = report.advice.iter().filter_map(|advice| advice.better.as_ref());
    let chosen = report.settings.iter().map(|table| ("the settings that are taken", table));
    let tables = chosen.chain(better.map(|better| ("better settings", &better.table)));
    let tables = tables.map(|(what, table)| (what, table.trim_end().to_owned())).collect();
    CheckText { rows, tables }
}

/// Expected errors and advice of `check`; the better settings' tables follow the rows.
fn advice(advice: &PlanAdvice) -> Vec<(&'static str, String)> {
    let PlanAdvice { rig, noise, prior, expected, better } = advice;
    let source = match noise.source {
        NoiseSource::Calibrated => "as the calibration measured it",
        NoiseSource::Stated => "as the rig file states it",
        NoiseSource::Simulated => "as simulated",
        NoiseSource::Assumed => {
            "assumed: state camera.electrons_per_dn and camera.read_noise_e in the rig file"
        }
    };
    let (dark, shot) = (short(noise.dark), short(noise.shot));
    let planned = expected;
    let better = better.as_ref().map_or_else(
        || "no clearly better settings of this length found".into(),
        |BetterPlan { points, frames, expected, .. }| {
            let (found, for_which) = (range(&expected.total), better_for(&planned.total, &expected.total));
            format!("{for_which}{found}, with {points} settings and {frames} frames; see below")
        },
    );
    vec![
        ("rig", accuracy(rig)),
        ("noise", format!("{dark} in the dark, {shot} of a white pixel's row, which is 1; {source}")),
        ("error", format!("{}, expected with the prior {prior}", errors(expected))),
        ("better", better),
    ]
}

/// How well the rig is taken to be known.
pub(super) fn accuracy(
    RigAccuracy { calibrated, latency_us, edge_us, place_rows, .. }: &RigAccuracy,
) -> String {
    let source = match calibrated {
        true => "as calibrated; how late light comes in a run, the run finds itself",
        false => {
            "assumed, because the rig is not calibrated: errors may be many times larger; run `raysweep calibrate`"
        }
    };
    let [latency_us, edge_us, place_rows] = [latency_us, edge_us, place_rows].map(|value| short(*value));
    format!("latency to {latency_us} us, edges to {edge_us} us, places to {place_rows} row, {source}")
}

/// For which scenes the proposed settings are better, if not for both those that count: proposals are ranked by the
/// errors of a typical and of a hard scene together, so one of them may even be larger.
fn better_for(planned: &ErrorRange, proposed: &ErrorRange) -> &'static str {
    // As printed: what looks the same is not better.
    let is_smaller =
        |of: fn(&ErrorRange) -> f64| of(proposed) < of(planned) && short(of(proposed)) != short(of(planned));
    match (is_smaller(|range| range.median), is_smaller(|range| range.high)) {
        (false, true) => "for the hardest scenes: ",
        (true, false) => "for typical scenes: ",
        _ => "",
    }
}

/// Text of `design`: a plan file, with what is expected of it as comments.
pub(super) fn design(report: &DesignReport) -> String {
    let DesignReport { points, frames, light_s, expected, plan, warnings } = report;
    let head = [
        format!("{points} settings, {frames} frames, {light_s:.2} s of light"),
        format!("expected error: {}", errors(expected)),
    ];
    let comments = head.into_iter().chain(warnings.iter().map(|warning| format!("warning: {warning}")));
    let comments: String = comments.map(|comment| format!("# {comment}\n")).collect();
    format!("{comments}{}", self::plan(plan))
}

/// A plan's text as it is printed: with the ends of lines of a terminal, whichever its file has.
pub(super) fn plan(text: &str) -> String {
    text.trim_end().replace("\r\n", "\n")
}

pub(super) fn errors(expected: &ExpectedError) -> String {
    let ExpectedError { total, noise, bias, calibration, .. } = expected;
    format!(
        "{}; noise {}, bias {}, calibration {}",
        range(total),
        range(noise),
        range(bias),
        range(calibration)
    )
}

/// Median and 10 to 90 % range.
fn range(range: &ErrorRange) -> String {
    format!("{} ({} to {})", short(range.median), short(range.low), short(range.high))
}

/// Formats a small number with two significant digits.
fn short(value: f64) -> String {
    let decimals = if value > 0.0 { (1.0 - value.log10().floor()).clamp(0.0, 12.0) } else { 0.0 };
    format!("{value:.*}", decimals as usize)
}

/// Text of `sessions`, of which so many are viewfinders that were left out.
pub(super) fn sessions(sessions: &[SessionInfo], left_out: usize) -> String {
    let listed = if sessions.is_empty() { "no sessions".into() } else { table_of(sessions) };
    match left_out {
        0 => listed,
        1 => {
            format!(
                "{listed}\n1 session of a viewfinder, which holds no images, is left out; --kind viewfinder lists it"
            )
        }
        _ => format!(
            "{listed}\n{left_out} sessions of viewfinders (`expose` uses one, too), which hold no images, are left out; --kind viewfinder lists them"
        ),
    }
}

fn table_of(sessions: &[SessionInfo]) -> String {
    let row = |session: &SessionInfo| {
        let points = format!("{}/{}", session.stored, session.points);
        let folder = session.session.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let told = [session.operator.clone(), session.sample.clone(), Some(session.tags.join(", "))];
        let [operator, sample, tags] = told.map(Option::unwrap_or_default);
        let state = match session.warnings.len() {
            0 => session.state.clone(),
            count => format!("{}, {}", session.state, counted(count, "warning")),
        };
        let row = [folder, state, points, session.name.clone(), operator, sample, tags];
        // A line is a session, and columns are counted of what is printed.
        row.map(|cell| printable(&cell).replace('\n', "\\n"))
    };
    // Folders are named after the time at which their session began.
    let heads = ["session (UTC)", "state", "stored", "name", "operator", "sample", "tags"];
    let mut rows = vec![heads.map(str::to_owned)];
    rows.extend(sessions.iter().map(row));
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
    let widths: [usize; 7] = std::array::from_fn(width);
    let line = |[folder, state, points, name, operator, sample, tags]: &[String; 7]| {
        let [w0, w1, w2, w3, w4, w5, _] = widths;
        let line = format!(
            "{folder:w0$}  {state:w1$}  {points:>w2$}  {name:w3$}  {operator:w4$}  {sample:w5$}  {tags}"
        );
        line.trim_end().to_owned()
    };
    rows.iter().map(line).collect::<Vec<_>>().join("\n")
}

/// Text of `describe`.
pub(super) fn description(description: &Description) -> String {
    let mut lines = vec![format!("raysweepd {}", description.version), String::new(), "methods".into()];
    lines.extend(description.methods.iter().map(|method| {
        let role = match method.role {
            Role::Observer => "observer",
            Role::Operator => "operator",
        };
        format!("  {:10} {role:8}  {}", method.name, method.about)
    }));
    lines.extend([String::new(), "errors".into()]);
    lines.extend(description.errors.iter().map(|error| format!("  {:6}  {}", error.code, error.meaning)));
    let limits = &description.limits;
    lines.extend([
        String::new(),
        format!("at most {} clients, requests of {} bytes", limits.clients, limits.message_bytes),
    ]);
    lines.join("\n")
}

/// How a run ended.
pub(super) struct Ending<'a> {
    pub session: &'a Path,
    pub state: &'a str,
    pub report: Option<&'a Path>,
    pub stored: usize,
    pub missing: usize,
    pub is_final: bool,
    pub final_s: Option<f64>,
    pub light_s: Option<f64>,
    pub simulated_time: bool,
}

impl Ending<'_> {
    /// Text for the end of a run.
    pub(super) fn text(&self) -> String {
        let Self { session, state, report, stored, missing, is_final, final_s, light_s, simulated_time } =
            *self;
        let clock = if simulated_time { " (simulated time)" } else { "" };
        let mut lines = vec![match stored + missing {
            0 => format!("{state}: a viewfinder stores no images"),
            points => format!("{state}: {stored} of {points} points stored, {missing} missing"),
        }];
        if stored + missing > 0 {
            lines.push(format!("session: {}", session.display()));
        }
        lines.extend(
            light_s
                .filter(|_| stored + missing > 0)
                .map(|seconds| format!("{seconds:.2} s from the first to the last frame with light{clock}")),
        );
        lines.extend(final_s.map(|seconds| format!("transport on disk {seconds:.2} s after the last frame")));
        lines.extend(report.map(|report| format!("report: {}", report.display())));
        if missing > 0 && !is_final {
            lines.push(format!("`raysweep resume {}` acquires the missing points", name(session)));
        }
        lines.join("\n")
    }
}

/// Text for the end of a film.
pub(super) fn film_ending(session: &Path, state: &str, report: Option<&Path>, film: &FilmSummary) -> String {
    let mut lines = vec![format!("{state}: {}", self::film(film))];
    lines.push(format!("session: {}", session.display()));
    lines.extend(report.map(|report| format!("report: {}", report.display())));
    lines.join("\n")
}

/// Text for the progress or result of a film.
pub(super) fn film(film: &FilmSummary) -> String {
    let mut parts = vec![format!("{} of {} cycles stored", film.cycles_stored, film.cycles_planned)];
    parts.extend(film.cycles_per_s.map(|pace| format!("{pace:.2} a second")));
    parts.push(format!("{} incomplete", film.cycles_incomplete));
    if film.transports_missing > 0 {
        parts.push(format!("{} without transport", film.transports_missing));
    }
    parts.extend(film.latency_ms.map(|Percentiles { p50, p95, p99, max }| {
        format!("latency {p50:.0} / {p95:.0} / {p99:.0} / {max:.0} ms (p50 / p95 / p99 / max)")
    }));
    parts.join(", ")
}

/// Text of `process`.
pub(super) fn processed(made: &Processed) -> String {
    let mut lines: Vec<_> = made.problems.iter().map(|problem| format!("not made: {problem}")).collect();
    lines.push(format!("made from what is stored: {} of {}", made.stored, made.points));
    lines.push(format!("report: {}", made.report.display()));
    lines.join("\n")
}

/// The result of checking a session with so many stored points of those planned.
pub(super) fn audit(audit: &Audit, stored: usize, points: usize) -> String {
    let Audit { damage, added, torn_bytes, has_manifest } = audit;
    let mut lines: Vec<String> = damage.iter().map(ToString::to_string).collect();
    if *torn_bytes > 0 {
        lines
            .push("the last line of ledger.jsonl was torn by a crash: what it recorded is not stored".into());
    }
    if !has_manifest {
        lines.push("there is no manifest: what results there are were not checked".into());
    }
    lines.extend(added.iter().map(|file| format!("{file} is not in the manifest, so it was not checked")));
    lines.push(match damage.len() {
        0 => format!("nothing is damaged; {stored} of {points} points are stored"),
        count => {
            let what = if damage.iter().all(Damage::is_of_results_only) {
                "results alone: `raysweep process` makes them again"
            } else {
                "`raysweep resume` acquires damaged points again (not those of films and batches, whose moment is over), a backup may have the files, and `raysweep process --accept-damage` goes on without what is damaged"
            };
            format!("{count} damaged: {what}")
        }
    });
    lines.join("\n")
}

/// Rate and losses.
pub(super) fn frames(progress: &Progress) -> String {
    format!("{:.0} frames/s  {}", progress.frames_per_s, progress.counts.losses())
}

/// Progress within a long point, and remaining time.
pub(super) fn pace(progress: &Progress) -> String {
    let point = progress.under_way.map(|PointUnderWay { frames, of }| format!("frame {frames} of {of}  "));
    let left =
        progress.left_s.map_or_else(|| "time left unknown".into(), |left| format!("{} left", duration(left)));
    format!("{}{left}", point.unwrap_or_default())
}

/// Text for a state.
pub(super) fn state(state: RunState) -> &'static str {
    match state {
        RunState::Idle => "idle",
        RunState::Preparing => "preparing",
        RunState::Armed => "armed",
        RunState::Running => "running",
        RunState::Paused => "paused",
        RunState::Draining => "finishing",
        RunState::Faulted => "faulted",
    }
}

fn name(session: &Path) -> String {
    session.file_name().unwrap_or(session.as_os_str()).to_string_lossy().into_owned()
}

/// A number of things.
pub(super) fn counted(count: usize, what: &str) -> String {
    format!("{count} {what}{}", if count == 1 { "" } else { "s" })
}

/// Seconds as hours, minutes and seconds.
pub(super) fn duration(seconds: f64) -> String {
    match Duration::try_from_secs_f64(seconds.ceil()) {
        Ok(duration) => FormattedDuration(duration).to_string(),
        Err(_) => "unknown".into(),
    }
}

/// Formats rows of a label and its value.
pub(super) fn block(rows: &[(&str, String)]) -> String {
    // The further lines of a text are no rows.
    let row = |(word, text): &(&str, String)| format!("{word:10} {}", text.replace('\n', "\n           "));
    rows.iter().map(row).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {

    use super::*;

    #[test]
    fn a_proposal_says_for_which_scenes_it_is_better() {
        let range = |median, high| ErrorRange { low: 0.01, median, high };
        let planned = range(0.040, 0.44);
        assert_eq!(better_for(&planned, &range(0.046, 0.13)), "for the hardest scenes: ");
        assert_eq!(
            better_for(&planned, &range(0.0399, 0.13)),
            "for the hardest scenes: ",
            "printed as 0.040"
        );
        assert_eq!(better_for(&planned, &range(0.030, 0.50)), "for typical scenes: ");
        assert_eq!(better_for(&planned, &range(0.030, 0.13)), "");
    }

    #[test]
    fn no_time_is_too_strange_to_be_told() {
        assert_eq!(duration(61.2), "00:01:02");
        for strange in [-1.0, f64::NAN, f64::INFINITY, 1e300] {
            assert_eq!(duration(strange), "unknown");
        }
    }

    #[test]
    fn an_unfinished_session_is_told_how_to_go_on() {
        let folder = Path::new("/data/20260101-000000_corner");
        let unfinished = Ending {
            session: folder,
            state: "cancelled",
            report: None,
            stored: 40,
            missing: 35,
            is_final: false,
            final_s: None,
            light_s: None,
            simulated_time: false,
        };
        let report = folder.join("report.html");
        let complete = Ending {
            state: "complete",
            report: Some(&report),
            stored: 75,
            missing: 0,
            final_s: Some(0.25),
            light_s: Some(10.5),
            ..unfinished
        };
        let simulated = Ending { simulated_time: true, ..complete }.text();
        assert!(!Ending { is_final: true, ..unfinished }.text().contains("resume"));
        let (unfinished, complete) = (unfinished.text(), complete.text());
        assert!(unfinished.contains("35 missing") && unfinished.contains("resume 20260101-000000_corner"));
        assert!(
            complete.contains("0.25 s after the last frame") && complete.contains("10.50 s from the first")
        );
        assert!(!complete.contains("simulated"));
        assert!(simulated.contains("10.50 s from the first to the last frame with light (simulated time)"));
        assert!(complete.ends_with("report.html") && !complete.contains("resume"), "{complete}");
    }
}
