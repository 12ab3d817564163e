//! Displays a run: a bar and a line of details on a terminal, lines elsewhere, JSON for programs.

use std::io::{self, IsTerminal, Write};
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use raysweep_core::{PointUnderWay, VsyncStats};
use raysweep_proto::{Event, FilmEstimate, Progress, RunState, ViewfinderValues};

use super::finder_text;
use super::printer::{Printer, json_line, printable};
use super::show::{self, Ending};

/// Interval between progress lines where no bar can be drawn.
const PACE: Duration = Duration::from_secs(5);

/// Fits into 80 columns: the message is cut where the terminal ends, so the line never wraps.
const BAR: &str = "{prefix:>9} [{bar:20}] {wide_msg}";
/// The line below the bar; all that a viewfinder shows, which has no end to count to.
const DETAILS: &str = "{wide_msg}";
/// Parts of a point that the bar can show.
const PARTS: f64 = 1000.0;

/// Interval between a viewfinder's lines where they cannot be overwritten.
const FINDER_PACE: Duration = Duration::from_secs(1);

/// Displays a run's events.
pub(super) struct EventView {
    place: Place,
    /// The newest of what the line of details shows.
    film: Option<String>,
    frames: Option<String>,
    vsync: Option<VsyncStats>,
    /// Points in the newest live estimate.
    live: Option<usize>,
    /// What a viewfinder has advised last of the rows, and its problem.
    said: (Option<Vec<String>>, Option<String>),
}

/// Where the events are displayed.
enum Place {
    /// A progress bar on standard error, and a line of details below it.
    Bars { both: MultiProgress, bar: ProgressBar, details: ProgressBar },
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
        Self {
            place: Place::new(printer),
            film: None,
            frames: None,
            vsync: None,
            live: None,
            said: (None, None),
        }
    }

    /// Displays an event; the result of a run goes to standard output, everything else to standard error.
    pub fn show(&mut self, event: &Event) -> io::Result<()> {
        if let Place::Json = self.place {
            return writeln!(io::stdout(), "{}", json_line(event)?);
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
            Event::Vsync(vsync) => self.vsync = Some(*vsync),
            Event::Batch(_) => {}
            Event::Viewfinder(values) => self.viewfinder(values),
            Event::Ask(question) => self.note(&question.to_string()),
            Event::Live { points, .. } => self.live = Some(*points),
            Event::Finished {
                session,
                state,
                error,
                report,
                stored,
                missing,
                is_final,
                film,
                warnings,
                found,
                final_s,
                light_s,
                simulated_time,
            } => {
                self.clear();
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
                        let (final_s, light_s, simulated_time) = (*final_s, *light_s, *simulated_time);
                        let is_final = *is_final;
                        Ending {
                            session,
                            state,
                            report,
                            stored,
                            missing,
                            is_final,
                            final_s,
                            light_s,
                            simulated_time,
                        }
                        .text()
                    }
                };
                writeln!(io::stdout(), "{}", printable(&summary))?;
            }
            Event::Skipped { events } => {
                self.note(&format!("{events} events were skipped because this client was too slow"))
            }
        }
        Ok(())
    }

    /// Displays a note besides the run's events.
    pub fn note(&mut self, text: &str) {
        let text = printable(text);
        match &self.place {
            Place::Bars { both, .. } => both.suspend(|| eprintln!("{text}")),
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
            Place::Bars { bar, .. } => bar.set_prefix(show::state(state)),
            _ => self.remark(show::state(state)),
        }
    }

    fn viewfinder(&mut self, values: &ViewfinderValues) {
        // The rows are measured again and again; what has been advised already is not repeated.
        let advice = values.alignment.as_ref().map(|found| &found.advice);
        if advice != self.said.0.as_ref() {
            self.said.0 = advice.cloned();
            values.alignment.iter().for_each(|found| self.remark(&finder_text::alignment(found)));
        }
        if values.problem != self.said.1 {
            self.said.1.clone_from(&values.problem);
            values.problem.iter().for_each(|problem| self.note(problem));
        }
        let line = finder_text::line(values);
        match &mut self.place {
            Place::Bars { bar, details, .. } => {
                bar.finish_and_clear();
                details.set_message(line);
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
        self.film = Some(show::film(&estimate.film));
        if let Place::Bars { details, .. } = &self.place {
            details.set_message(self.details());
        }
    }

    fn progress(&mut self, progress: &Progress) {
        let stored = format!("{}/{}", progress.points_stored, progress.points_planned);
        let pace = show::pace(progress);
        self.frames = Some(show::frames(progress));
        let all = self.details();
        match &mut self.place {
            Place::Bars { bar, details, .. } => {
                let parts = progress.under_way.map_or(0.0, PointUnderWay::share) * PARTS;
                bar.set_length(progress.points_planned as u64 * PARTS as u64);
                bar.set_position(progress.points_stored as u64 * PARTS as u64 + parts as u64);
                // Not only points, of which the run's end speaks: dark and regular images too, cycles, batches.
                bar.set_message(format!("{stored} measurements  {pace}"));
                details.set_message(all);
            }
            Place::Lines { told } if told.is_none_or(|told| told.elapsed() >= PACE) => {
                *told = Some(Instant::now());
                eprintln!("{stored} measurements stored  {pace}  {all}");
            }
            Place::Lines { .. } | Place::Quiet | Place::Json => {}
        }
    }

    /// Rate, losses, the film so far, the line's jitter and the live estimate, as far as they are known.
    fn details(&self) -> String {
        let vsync = self.vsync.map(|vsync| format!("VSYNC jitter {:.2} us", vsync.jitter_us));
        let live = self.live.map(|points| format!("live estimate of {points}"));
        [self.frames.clone(), self.film.clone(), vsync, live]
            .into_iter()
            .flatten()
            .collect::<Vec<_>>()
            .join("  ")
    }

    /// Removes what can be overwritten.
    pub fn clear(&self) {
        if let Place::Bars { bar, details, .. } = &self.place {
            bar.finish_and_clear();
            details.finish_and_clear();
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
        let both = MultiProgress::new();
        let [bar, details] = [BAR, DETAILS].map(|template| {
            let bar = both.add(ProgressBar::new(1));
            match ProgressStyle::with_template(template) {
                Ok(style) => bar.with_style(style.progress_chars("=> ")),
                Err(_) => bar,
            }
        });
        Self::Bars { both, bar, details }
    }
}
