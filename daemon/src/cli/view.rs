//! Displays a run: a bar on a terminal, lines elsewhere, JSON for programs.

use std::io::{self, IsTerminal, Write};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use raysweep_proto::{Event, FilmEstimate, Progress, RunState, ViewfinderValues};

use super::finder_text;
use super::printer::Printer;
use super::show::{self, Ending};

/// Interval between progress lines where no bar can be drawn.
const PACE: Duration = Duration::from_secs(5);

/// Fits into 80 columns: the message is cut where the terminal ends, so the line never wraps.
const BAR: &str = "{prefix:>9} [{bar:20}] {pos}/{len}  {wide_msg}";

/// A viewfinder has no end to count to.
const FINDER: &str = "{wide_msg}";
/// Interval between a viewfinder's lines where they cannot be overwritten.
const FINDER_PACE: Duration = Duration::from_secs(1);

/// Displays a run's events.
pub(super) struct EventView {
    place: Place,
    /// Points in the newest live estimate.
    live: Option<usize>,
    /// What a viewfinder has said of the rows, how often, and of its problem.
    said: (u64, Option<String>),
}

/// Where the events are displayed.
enum Place {
    /// A progress bar on standard error.
    Bar(ProgressBar),
    /// Occasional lines on standard error.
    Lines {
        /// When progress was last printed.
        told: Option<Instant>,
    },
    /// Nowhere, except for questions, warnings and errors.
    Quiet,
    /// Each event as a line on standard output.
    Json,
}

impl EventView {
    /// The view that suits our output.
    pub fn new(printer: Printer) -> Self {
        Self { place: Place::new(printer), live: None, said: (0, None) }
    }

    /// Displays an event; the result of a run goes to standard output, everything else to standard error.
    pub fn show(&mut self, event: &Event) -> io::Result<()> {
        if let Place::Json = self.place {
            return writeln!(io::stdout(), "{}", serde_json::to_string(event)?);
        }
        match event {
            // The result of the run is displayed in a moment.
            Event::State { state: RunState::Idle | RunState::Faulted, .. } => {}
            Event::State { state, .. } => self.state(*state),
            Event::Progress(progress) => self.progress(progress),
            Event::Lost { point, attempt, counts } => {
                let lost = counts.losses();
                self.remark(&format!("point {point}, attempt {attempt}: {lost}; the point is taken again"));
            }
            Event::Film(estimate) => self.film(estimate),
            Event::Vsync(_) | Event::Batch(_) => {}
            Event::Viewfinder(values) => self.viewfinder(values),
            Event::Ask { text } => self.note(text),
            Event::Live { points, .. } => self.live = Some(*points),
            Event::Finished {
                session,
                state,
                error,
                report,
                stored,
                missing,
                film,
                warnings,
                found,
                final_s,
                light_s,
            } => {
                if let Place::Bar(bar) = &self.place {
                    bar.finish_and_clear();
                }
                if let Some(error) = error {
                    self.note(error);
                }
                for warning in warnings {
                    self.note(&format!("warning: {warning}"));
                }
                for found in found {
                    self.remark(found);
                }
                let summary = match film {
                    Some(film) => show::film_ending(session, state, report.as_deref(), film),
                    None => {
                        let (report, stored, missing) = (report.as_deref(), *stored, *missing);
                        let (final_s, light_s) = (*final_s, *light_s);
                        Ending { session, state, report, stored, missing, final_s, light_s }.text()
                    }
                };
                writeln!(io::stdout(), "{summary}")?;
            }
            Event::Skipped { events } => {
                self.note(&format!("{events} events were skipped because this client was too slow"))
            }
        }
        Ok(())
    }

    /// Displays a note besides the run's events.
    pub fn note(&mut self, text: &str) {
        match &self.place {
            Place::Bar(bar) => bar.suspend(|| eprintln!("{text}")),
            Place::Lines { .. } | Place::Quiet | Place::Json => eprintln!("{text}"),
        }
    }

    /// Displays a note that a quiet view leaves out.
    fn remark(&mut self, text: &str) {
        if !matches!(self.place, Place::Quiet) {
            self.note(text);
        }
    }

    fn state(&mut self, state: RunState) {
        match &self.place {
            Place::Bar(bar) => bar.set_prefix(show::state(state)),
            _ => self.remark(show::state(state)),
        }
    }

    fn viewfinder(&mut self, values: &ViewfinderValues) {
        if let Some(alignment) = values.alignment.as_ref().filter(|found| found.measured != self.said.0) {
            self.said.0 = alignment.measured;
            self.remark(&finder_text::alignment(alignment));
        }
        if values.problem != self.said.1 {
            self.said.1.clone_from(&values.problem);
            values.problem.iter().for_each(|problem| self.note(problem));
        }
        let line = finder_text::line(values);
        match &mut self.place {
            Place::Bar(bar) => {
                if let Ok(style) = ProgressStyle::with_template(FINDER) {
                    bar.set_style(style);
                }
                bar.set_message(line);
            }
            Place::Lines { told } if told.is_none_or(|told| told.elapsed() >= FINDER_PACE) => {
                *told = Some(Instant::now());
                eprintln!("{line}");
            }
            Place::Lines { .. } | Place::Quiet | Place::Json => {}
        }
    }

    fn film(&mut self, estimate: &FilmEstimate) {
        // Too many for lines; the film's progress is shown in the bar and by `raysweep status`.
        if let Place::Bar(bar) = &self.place {
            bar.set_message(show::film(&estimate.film));
        }
    }

    fn progress(&mut self, progress: &Progress) {
        let mut details = show::pace(progress);
        if let Some(points) = self.live {
            details.push_str(&format!("  live estimate of {points}"));
        }
        match &mut self.place {
            Place::Bar(bar) => {
                bar.set_length(progress.points_planned as u64);
                bar.set_position(progress.points_stored as u64);
                bar.set_message(details);
            }
            Place::Lines { told } if told.is_none_or(|told| told.elapsed() >= PACE) => {
                *told = Some(Instant::now());
                eprintln!("{}/{} stored  {details}", progress.points_stored, progress.points_planned);
            }
            Place::Lines { .. } | Place::Quiet | Place::Json => {}
        }
    }
}

impl Place {
    fn new(printer: Printer) -> Self {
        if printer.json {
            return Self::Json;
        }
        if printer.quiet {
            return Self::Quiet;
        }
        if !io::stderr().is_terminal() {
            return Self::Lines { told: None };
        }
        let bar = ProgressBar::new(0);
        if let Ok(style) = ProgressStyle::with_template(BAR) {
            bar.set_style(style.progress_chars("=> "));
        }
        Self::Bar(bar)
    }
}
