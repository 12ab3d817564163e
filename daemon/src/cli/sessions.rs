//! Finding, reading and keeping sessions: `sessions`, `show`, `rerun`, `note`, `trash` and `restore`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use jiff::Timestamp;
use jiff::civil::Date;
use jiff::tz::TimeZone;
use raysweep_core::Counts;
use raysweep_processing::ProcessError;
use raysweep_processing::calibration::CalibrationHeader;
use raysweep_proto::{RunParams, SessionInfo};
use raysweep_session::Session;
use raysweep_session::integrity::{Damage, DamagedPart, damaged_files};
use raysweep_session::ledger::{EndState, Remark, State};
use serde::Serialize;
use serde_json::Value;

use super::failure::CommandFailure;
use super::show::{block, duration};

/// Files of a session whose content `show` tells: those of them that are short, so that their checksums cost nothing.
const READ: [&str; 4] = ["plan.toml", "rig.toml", "calibration.toml", "products/transport.json"];
/// Longest metadata of the transport.
const MOST_FINDINGS_BYTES: u64 = 1 << 24;
/// Which sessions to list; those that fit all of it.
#[derive(Debug, Default, clap::Args)]
pub(super) struct SessionFilter {
    /// Only those whose name contains this; the plan gives the name
    #[arg(long, value_name = "NAME")]
    plan: Option<String>,
    /// Only those whose operator's name contains this
    #[arg(long, value_name = "NAME")]
    operator: Option<String>,
    /// Only those whose sample's name contains this
    #[arg(long, value_name = "NAME")]
    sample: Option<String>,
    /// Only those with this tag; may be repeated
    #[arg(long = "tag", value_name = "TAG")]
    tags: Vec<String>,
    /// Only those begun on this day or later, in UTC, such as 2026-11-22
    #[arg(long, value_name = "DATE", value_parser = day)]
    since: Option<Date>,
    /// Only those begun on this day or earlier, in UTC
    #[arg(long, value_name = "DATE", value_parser = day)]
    until: Option<Date>,
    /// Only those in this state
    #[arg(long, value_name = "STATE", value_parser = ["complete", "cancelled", "faulted", "running", "unfinished", "unreadable"])]
    state: Option<String>,
    /// Only those of this kind; without it, all but viewfinders, which hold no images
    #[arg(long, value_name = "KIND", value_parser = KINDS)]
    kind: Option<String>,
}

/// The kinds of plans.
const KINDS: [&str; 8] =
    ["sweep", "film", "batches", "response", "darks", "patterns", "calibration", VIEWFINDER];
const VIEWFINDER: &str = "viewfinder";

fn day(given: &str) -> Result<Date, &'static str> {
    let date = given.parse::<Date>().ok();
    // The parser takes more than days, and would leave a time out without a word.
    date.filter(|date| date.to_string() == given).ok_or("not a day as in 2026-11-22")
}

impl SessionFilter {
    /// Whether a session that fits is shown: viewfinders are only if they are asked for.
    pub fn shows(&self, info: &SessionInfo) -> bool {
        self.kind.is_some() || info.kind != VIEWFINDER
    }

    /// Whether a session is to be listed.
    pub fn keeps(&self, info: &SessionInfo) -> bool {
        let contains = |wanted: &Option<String>, found: Option<&str>| {
            let found = found.unwrap_or_default().to_lowercase();
            wanted.as_ref().is_none_or(|wanted| found.contains(&wanted.to_lowercase()))
        };
        let created = || {
            let created: Timestamp = info.created.parse().ok()?;
            Some(created.to_zoned(TimeZone::UTC).date())
        };
        contains(&self.plan, Some(&info.name))
            && contains(&self.operator, info.operator.as_deref())
            && contains(&self.sample, info.sample.as_deref())
            && self.tags.iter().all(|tag| info.tags.contains(tag))
            && self.since.is_none_or(|since| created().is_some_and(|created| created >= since))
            && self.until.is_none_or(|until| created().is_some_and(|created| created <= until))
            && self.state.as_ref().is_none_or(|state| *state == info.state)
            && self.kind.as_ref().is_none_or(|kind| *kind == info.kind)
    }
}

/// What `show` tells of a session.
#[derive(Debug, Serialize)]
pub(super) struct SessionView {
    session: PathBuf,
    name: String,
    kind: String,
    created: Timestamp,
    pub operator: Option<String>,
    pub sample: Option<String>,
    note: Option<String>,
    tags: Vec<String>,
    software: String,
    state: String,
    error: Option<String>,
    /// Warnings of its latest run.
    pub warnings: Vec<String>,
    pub stored: usize,
    pub points: usize,
    pub counts: Counts,
    light_s: Option<f64>,
    /// What of the files that this was read from is damaged.
    pub damage: Vec<String>,
    /// `plan.toml`, by key.
    settings: BTreeMap<String, String>,
    /// When the calibration was measured that it uses.
    calibration: Option<Timestamp>,
    findings: BTreeMap<String, String>,
    remarks: Vec<Remark>,
    report: Option<PathBuf>,
    /// The arrays and images of its products.
    pub products: Vec<PathBuf>,
    /// Pictures that any program shows.
    pictures: Vec<PathBuf>,
    /// Videos that any program shows.
    videos: Vec<PathBuf>,
    /// Small pictures, if they were asked for.
    pub thumbnails: Vec<PathBuf>,
}

impl SessionView {
    /// Reads a session.
    pub fn read(dir: &Path) -> Result<Self, CommandFailure> {
        let session = Session::open(dir).map_err(ProcessError::from)?;
        let state = session.state().map_err(ProcessError::from)?;
        let (stored, points) = (state.stored_points(), state.session.shape.points());
        let in_products = session.products().files();
        let with_ending = |ending: &str| -> Vec<PathBuf> {
            in_products
                .iter()
                .filter(|path| path.extension().is_some_and(|found| found == ending))
                // JSON has no other names than UTF-8.
                .map(|path| path.to_string_lossy().into_owned().into())
                .collect()
        };
        let report = session.report_path();
        let damage = damaged(&session, &state, &READ.map(String::from))?;
        let (entry, remarks, end) = (state.session.clone(), state.remarks.clone(), state.end.clone());
        Ok(Self {
            session: dir.to_owned(),
            name: entry.name,
            kind: entry.kind,
            created: entry.created,
            operator: entry.operator,
            sample: entry.sample,
            note: entry.note,
            tags: entry.tags,
            software: entry.software,
            state: end.as_ref().map_or("unfinished", |end| EndState::name(end.state)).to_owned(),
            error: end.as_ref().and_then(|end| end.error.clone()),
            stored,
            points,
            counts: state.counts,
            light_s: end.as_ref().and_then(|end| end.light_s),
            warnings: end.map_or_else(Vec::new, |end| end.warnings),
            // A damaged plan may be none any more.
            settings: match flat(&session, "plan.toml") {
                Err(_) if !damage.is_empty() => BTreeMap::new(),
                settings => settings?,
            },
            damage,
            calibration: calibration_of(dir),
            findings: findings_of(&session),
            remarks,
            report: report.exists().then_some(report),
            products: with_ending("npy"),
            videos: with_ending("mp4"),
            // Of a video or a sequence, the first.
            pictures: with_ending("png").into_iter().filter(|path| path.ends_with("0000.png")).collect(),
            thumbnails: Vec::new(),
        })
    }

    /// Also says which of these products are damaged: those that are shown.
    pub fn check_products(&mut self, session: &Session, names: &[String]) -> Result<(), CommandFailure> {
        let state = session.state().map_err(ProcessError::from)?;
        let files: Vec<String> = names.iter().map(|name| format!("products/{name}.npy")).collect();
        self.damage.extend(damaged(session, &state, &files)?);
        Ok(())
    }

    /// One screen.
    pub fn text(&self) -> String {
        let made = self.created.strftime("%Y-%m-%d %H:%M:%S UTC").to_string();
        let mut rows = vec![
            ("session", self.session.display().to_string()),
            ("made", format!("{made}, by {}", self.software)),
            ("plan", format!("{} (kind {})", self.name, self.kind)),
        ];
        let told = [("operator", &self.operator), ("sample", &self.sample), ("note", &self.note)];
        rows.extend(told.into_iter().filter_map(|(key, text)| Some((key, text.clone()?))));
        if !self.tags.is_empty() {
            rows.push(("tags", self.tags.join(", ")));
        }
        // The ledger of a run that goes on looks like one that was cut off.
        let state = match self.state.as_str() {
            "unfinished" => "unfinished (it still runs, or was cut off)",
            state => state,
        };
        rows.push(("state", format!("{state}: {} of {} points stored", self.stored, self.points)));
        rows.extend(self.error.iter().map(|error| ("error", error.clone())));
        rows.extend(self.warnings.iter().map(|warning| ("warning", warning.clone())));
        rows.extend(self.damage.iter().map(|damage| ("DAMAGED", damage.clone())));
        let Counts { expected, averaged, settling, cancelled, .. } = self.counts;
        let others = [(settling, "settling"), (cancelled, "not needed")];
        let others = others.into_iter().filter(|(frames, _)| *frames > 0);
        let others: String = others.map(|(frames, why)| format!(", {frames} {why}")).collect();
        rows.push(("frames", format!("{averaged} used of {expected}{others}, {}", self.counts.losses())));
        rows.extend(self.light_s.map(|light_s| ("light", duration(light_s))));
        let calibration = self.calibration.map(|made| made.strftime("%Y-%m-%d %H:%M UTC").to_string());
        let is_calibrated = ["sweep", "film", "patterns"].contains(&self.kind.as_str());
        let without = is_calibrated.then(|| "no: times and levels are those of the rig file".into());
        rows.extend(calibration.or(without).map(|made| ("calibrated", made)));
        let settings = self.settings.iter().filter(|(key, _)| !["kind", "name"].contains(&key.as_str()));
        let mut title = "settings";
        for (key, value) in settings {
            rows.push((title, format!("{key} = {value}")));
            title = "";
        }
        title = "findings";
        for (key, said) in &self.findings {
            rows.push((title, format!("{key}: {said}")));
            title = "";
        }
        title = "remarks";
        for Remark { at, by, text } in &self.remarks {
            let by = by.as_ref().map_or_else(String::new, |by| format!(", {by}"));
            rows.push((title, format!("{}{by}: {text}", at.strftime("%Y-%m-%d %H:%M UTC"))));
            title = "";
        }
        rows.extend(self.report.iter().map(|report| ("report", report.display().to_string())));
        let files = [
            ("products", &self.products),
            ("pictures", &self.pictures),
            ("videos", &self.videos),
            ("thumbnails", &self.thumbnails),
        ];
        for (key, paths) in files {
            title = key;
            for path in paths {
                rows.push((title, path.display().to_string()));
                title = "";
            }
        }
        block(&rows)
    }
}

/// The plan of a session and what is known of it, for the same run again.
pub(super) fn run_again(dir: &Path) -> Result<RunParams, CommandFailure> {
    let session = Session::open(dir).map_err(ProcessError::from)?;
    let state = session.state().map_err(ProcessError::from)?;
    let plan = session.plan_path();
    let of_plan = ["plan.toml".to_owned()];
    let damaged = damaged_files(&session, &state, &of_plan).map_err(ProcessError::from)?;
    // Light would be turned on for what nobody has planned.
    let is_of_plan =
        |damage: &&Damage| matches!(&damage.part, DamagedPart::Input { file } if of_plan.contains(file));
    if let Some(damage) = damaged.iter().find(is_of_plan) {
        let advice = format!("if it is what you want, `raysweep run {}`", plan.display());
        return Err(CommandFailure::Sessions(format!("{}: {damage}; {advice}", session.dir().display())));
    }
    let plan = session.read_text(&plan).map_err(ProcessError::from)?;
    let entry = state.session;
    Ok(RunParams {
        plan,
        operator: entry.operator,
        sample: entry.sample,
        note: entry.note,
        tags: entry.tags,
        attached: false,
    })
}

/// The values of a TOML file of a session by their keys, such as `sweep.delay_us`.
pub(super) fn flat(session: &Session, file: &str) -> Result<BTreeMap<String, String>, CommandFailure> {
    let path = session.dir().join(file);
    let text = session.read_text(&path).map_err(ProcessError::from)?;
    flat_text(&text, &path)
}

/// The same of a text that stands for the file.
pub(super) fn flat_text(text: &str, path: &Path) -> Result<BTreeMap<String, String>, CommandFailure> {
    fn walk(prefix: &str, value: &toml::Value, found: &mut BTreeMap<String, String>) {
        let below = |key: &str| if prefix.is_empty() { key.to_owned() } else { format!("{prefix}.{key}") };
        match value {
            toml::Value::Table(table) => {
                table.iter().for_each(|(key, value)| walk(&below(key), value, found))
            }
            toml::Value::Array(tables) if tables.iter().any(toml::Value::is_table) => {
                (0..)
                    .zip(tables)
                    .for_each(|(index, value): (usize, _)| walk(&below(&index.to_string()), value, found));
            }
            value => drop(found.insert(prefix.to_owned(), value.to_string())),
        }
    }
    let table: toml::Table = toml::from_str(text).map_err(|error| {
        CommandFailure::Sessions(format!("{} cannot be read: {}", path.display(), error.message()))
    })?;
    let mut found = BTreeMap::new();
    walk("", &toml::Value::Table(table), &mut found);
    Ok(found)
}

/// When the calibration that a session was taken with was made.
pub(super) fn calibration_of(dir: &Path) -> Option<Timestamp> {
    CalibrationHeader::read(dir).ok().flatten().map(|header| header.made)
}

/// What the transport's metadata tell of how it was made.
fn findings_of(session: &Session) -> BTreeMap<String, String> {
    let path = session.products_path().join("transport.json");
    let text = session.read(&path, MOST_FINDINGS_BYTES).unwrap_or_default();
    let metadata: Value = serde_json::from_slice(&text).unwrap_or_default();
    let findings = metadata.get("findings").and_then(Value::as_object).into_iter().flatten();
    findings.map(|(key, said)| (key.clone(), said.as_str().unwrap_or_default().to_owned())).collect()
}

/// What is damaged of these files of a session, in a sentence each.
fn damaged(session: &Session, state: &State, files: &[String]) -> Result<Vec<String>, CommandFailure> {
    let damage = damaged_files(session, state, files).map_err(ProcessError::from)?;
    Ok(damage.iter().map(ToString::to_string).collect())
}

#[cfg(test)]
mod tests {

    use super::*;

    fn info() -> SessionInfo {
        SessionInfo {
            session: "/data/20261122-235900_paper".into(),
            name: "paper".into(),
            created: "2026-11-22T23:59:00Z".into(),
            stored: 1,
            points: 2,
            can_resume: false,
            state: "complete".into(),
            kind: "sweep".into(),
            operator: Some("Ada Lovelace".into()),
            sample: None,
            tags: vec!["a".into(), "b".into()],
            warnings: Vec::new(),
        }
    }

    #[test]
    fn a_session_is_listed_if_it_fits_every_word_of_the_filter() {
        use clap::Parser;

        #[derive(clap::Parser)]
        struct Line {
            #[command(flatten)]
            filter: SessionFilter,
        }
        let keeps = |line: &str| {
            let words = std::iter::once("sessions").chain(line.split_whitespace());
            Line::try_parse_from(words).unwrap().filter.keeps(&info())
        };
        for line in [
            "",
            "--plan PAP --operator lovelace --tag b --tag a --state complete --kind sweep",
            "--since 2026-11-22 --until 2026-11-22",
        ] {
            assert!(keeps(line), "{line}");
        }
        for line in [
            "--plan film",
            "--operator Grace",
            "--sample candle",
            "--tag a --tag c",
            "--state faulted",
            "--kind viewfinder",
            "--since 2026-11-23",
            "--until 2026-11-21",
        ] {
            assert!(!keeps(line), "{line}");
        }
        assert!(Line::try_parse_from(["sessions", "--since", "yesterday"]).is_err());
        let viewfinder = SessionInfo { kind: VIEWFINDER.into(), ..info() };
        let shows = |words: &[&str]| Line::try_parse_from(words).unwrap().filter.shows(&viewfinder);
        assert!(!shows(&["sessions"]) && shows(&["sessions", "--kind", "viewfinder"]));
    }
}
