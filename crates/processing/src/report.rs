//! Shared by the reports of all procedures.

use raysweep_core::SettingsLatency;
use raysweep_session::Session;
use raysweep_session::ledger::State;
use raysweep_session::report::{Block, NoteLevel, Report, Section, Table};

/// The page of a session. Warnings of its run that no section says come first.
pub(crate) fn page(
    session: &Session,
    state: &State,
    facts: Vec<(String, String)>,
    sections: Vec<Section>,
) -> Report {
    let sections = warnings(state, &sections).into_iter().chain(sections).collect();
    Report { title: state.session.name.clone(), subtitle: subtitle(state, session), facts, sections }
}

/// What the run warned of, unless the sections say it.
fn warnings(state: &State, sections: &[Section]) -> Option<Section> {
    let is_said = |warning: &str| {
        // The ledger has the beginning of a long one.
        let beginning = warning.trim_end_matches('…');
        let mut blocks = sections.iter().flat_map(|section| &section.blocks);
        blocks.any(|block| matches!(block, Block::Note(_, text) if text.starts_with(beginning)))
    };
    let warnings = state.end.iter().flat_map(|end| &end.warnings).filter(|warning| !is_said(warning));
    let blocks: Vec<_> = warnings.map(|text| Block::Note(NoteLevel::Warning, text.clone())).collect();
    (!blocks.is_empty()).then(|| Section {
        title: "Warnings of the run".into(),
        intro: "What the run warned of when it ended; results that were made again since may be better."
            .into(),
        blocks,
    })
}

/// Facts with fixed names.
pub(crate) fn named<const N: usize>(facts: [(&str, String); N]) -> Vec<(String, String)> {
    facts.map(|(name, fact)| (name.to_owned(), fact)).to_vec()
}

/// What was found, and about what.
pub(crate) fn remark(what: &str, said: &str) -> Block {
    Block::Note(NoteLevel::Info, format!("{what}: {said}"))
}

/// Date, operator, sample, tags, note and folder of a session.
fn subtitle(state: &State, session: &Session) -> String {
    let entry = &state.session;
    let parts = [
        Some(entry.created.strftime("%Y-%m-%d %H:%M UTC").to_string()),
        entry.operator.as_ref().map(|operator| format!("by {operator}")),
        entry.sample.as_ref().map(|sample| format!("sample {sample}")),
        (!entry.tags.is_empty()).then(|| entry.tags.join(", ")),
        entry.note.clone(),
        session.dir().file_name().map(|name| name.to_string_lossy().into_owned()),
    ];
    parts.into_iter().flatten().collect::<Vec<_>>().join(" · ")
}

/// Frame counts, and statistics of the VSYNC line.
pub(crate) fn accounts(state: &State) -> Vec<Block> {
    let counts = &state.counts;
    let row =
        |name: &str, count: u64, means: &str| vec![name.to_owned(), count.to_string(), means.to_owned()];
    let mut rows = vec![
        row("expected triggers", counts.expected, "frames that the camera should have sent"),
        row("averaged", counts.averaged, "in the stored images, black pictures and whole periods included"),
        row("settling", counts.settling, "possibly still taken with the previous settings"),
        row("cancelled", counts.cancelled, "not needed: between passes, or around a pause or an end"),
    ];
    rows.extend(counts.lost.iter().map(|(cause, &frames)| row(&format!("lost: {cause}"), frames, "")));
    let mut blocks = vec![Block::Table(Table {
        headers: ["frames", "count", "meaning"].map(str::to_owned).to_vec(),
        rows,
    })];
    if !counts.balanced() {
        blocks.push(Block::Note(
            NoteLevel::Error,
            "The frames do not add up to the expected triggers: this is a defect.".into(),
        ));
    }
    if let Some(end) = &state.end {
        let clock = if end.simulated_time { " (simulated time)" } else { "" };
        let light = end.light_s.map(|s| ("first to last frame with light", format!("{s:.2} s{clock}")));
        let latency = end.settings_latency.map(|SettingsLatency { min_frames, max_frames }| {
            (
                "camera settings act",
                match (min_frames, max_frames) {
                    (0, 0) => "with the next frame".to_owned(),
                    (min, max) if min == max => format!("{min} frames late"),
                    (min, max) => format!("{min} to {max} frames late"),
                },
            )
        });
        let facts: Vec<_> =
            light.into_iter().chain(latency).map(|(key, value)| (key.to_owned(), value)).collect();
        if !facts.is_empty() {
            blocks.push(Block::Facts(facts));
        }
    }
    if let Some(vsync) = state.end.as_ref().and_then(|end| end.vsync) {
        let allan = vsync.allan_1s.map(|allan| ("Allan deviation over 1 s", format!("{allan:.1e}")));
        let facts = [
            ("VSYNC period", format!("{:.3} µs", vsync.period_us)),
            ("jitter of an edge (standard deviation)", format!("{:.2} µs", vsync.jitter_us)),
            ("99 % of the edges within", format!("{:.1} µs", vsync.jitter_p99_us)),
            (
                "edges seen / missed / false",
                format!("{} / {} / {}", vsync.edges, vsync.missed, vsync.false_edges),
            ),
        ];
        let facts = facts.into_iter().chain(allan);
        blocks.push(Block::Facts(facts.map(|(key, value)| (key.to_owned(), value)).collect()));
    }
    blocks
}
