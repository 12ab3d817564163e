//! A viewfinder that tries exposures on the scene.

use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

use raysweep_proto::{
    Client, ClientError, Event, RunParams, RunState, Subscription, ViewfinderParams, ViewfinderValues,
};

use crate::cli::failure::CommandFailure;
use crate::cli::follow::Interrupts;
use crate::cli::printer::Printer;

/// Share of the pixels that may be saturated.
pub(super) const MAX_SATURATED: f64 = 1e-4;
/// Exposures are tried until the longest that suits is known to this factor.
const FACTOR: f64 = 1.02;
/// Pictures by which an exposure is judged: few pixels may saturate, and some do so by noise alone, now and then.
const PICTURES: u64 = 8;
/// So many standard deviations of their number are allowed for.
const CONFIDENCE: f64 = 1.6;
/// Most of a camera's full scale that a calibration takes of a white board.
const MOST_OF_BOARD: f64 = 0.65;
/// How long a picture may take to come.
const PATIENCE: Duration = Duration::from_secs(10);
/// The viewfinder ends after this time even if nobody can end it any more.
const VIEWFINDER: &str =
    "kind = \"viewfinder\"\nname = \"expose\"\n[viewfinder]\npictures_per_s = 30\nseconds = 1200\n";

/// A delay of a plan.
pub(super) struct AskedDelay {
    pub delay_us: f64,
    /// The shortest and the longest exposure that the plan takes with it.
    pub shortest_us: f64,
    pub longest_us: f64,
}

/// What was found on the scene.
pub(super) struct Tried {
    /// The longest exposure that suits.
    pub exposure_us: f64,
    /// Share of saturated pixels in it.
    pub saturated: f64,
    /// Whether the share is at most [`MAX_SATURATED`], beyond doubt as far as so many pixels can tell.
    pub suits: bool,
    /// By how much the light could grow until too many pixels saturate.
    pub headroom: f64,
    /// By how much it could grow until a white board has more than a calibration takes.
    pub board_headroom: f64,
}

/// A viewfinder that tries exposures.
pub(super) struct Trial {
    /// The connection that the viewfinder is attached to. Closed before `viewfinder` goes, which waits for the end.
    events: Subscription,
    viewfinder: Attached,
    interrupts: Interrupts,
    pictures: u64,
    /// Counts above black of white, as the plan's run takes them: with the calibration, which a viewfinder does without.
    white_dn: Option<f64>,
    /// Exposure and delay asked for.
    settings_us: Option<(f64, f64)>,
    /// Whether what was tried is told on the way.
    tells: bool,
}

/// A viewfinder that the daemon ends when the connection that began it is closed. It is not cancelled, as somebody else may
/// have ended it and begun a run since.
struct Attached {
    client: Client,
    session: PathBuf,
}

impl Trial {
    pub fn begin(socket: &Path, white_dn: Option<f64>, printer: Printer) -> Result<Self, CommandFailure> {
        let mut events = Client::connect(socket)?.subscribe()?;
        let interrupts = Interrupts::of_any_end().map_err(CommandFailure::Signals)?;
        let client = Client::connect(socket)?;
        let plan = RunParams { plan: VIEWFINDER.into(), attached: true, ..RunParams::default() };
        let session = events.client().run(&plan)?.session;
        let viewfinder = Attached { client, session };
        let (pictures, settings_us, tells) = (0, None, !printer.json && !printer.quiet);
        let mut trial = Self { events, viewfinder, interrupts, pictures, white_dn, settings_us, tells };
        trial.picture()?;
        Ok(trial)
    }

    /// The longest exposure that leaves at most [`MAX_SATURATED`] of the pixels saturated at each delay.
    pub fn longest(mut self, longest_us: f64, delays: &[AskedDelay]) -> Result<Tried, CommandFailure> {
        let mut over_us = longest_us;
        loop {
            // Indirect light may be brightest at any delay.
            let mut brightest = None;
            let mut is_lit = false;
            for asked in delays {
                let values = self.picture_of(over_us.min(asked.longest_us), asked.delay_us)?;
                is_lit |= values.underexposed <= 1.0 - MAX_SATURATED;
                let headroom = headroom_of(&values);
                if brightest.is_none_or(|(least, _)| headroom < least) {
                    brightest = Some((headroom, asked));
                }
            }
            if over_us == longest_us && !is_lit {
                return Err(CommandFailure::Exposure(format!(
                    "the camera sees hardly any light: in the plan's longest exposure, {} us, nearly all pixels are underexposed at every delay; take the cap off the lens, see that the projector is on, open the aperture, or raise the gain",
                    in_hundredths(longest_us)
                )));
            }
            let Some((_, asked)) = brightest else {
                return Err(CommandFailure::Exposure("the plan has no delays".into()));
            };
            let at_most_us = over_us.min(asked.longest_us);
            let found = self.longest_at(asked.delay_us, asked.shortest_us, at_most_us)?;
            // Where another delay is the brightest in that exposure, it is tried again.
            if found.exposure_us == at_most_us {
                return Ok(Tried { exposure_us: over_us, ..found });
            }
            over_us = found.exposure_us;
        }
    }

    /// The longest exposure that leaves at most [`MAX_SATURATED`] of the pixels saturated at a delay.
    fn longest_at(
        &mut self,
        delay_us: f64,
        shortest_us: f64,
        longest_us: f64,
    ) -> Result<Tried, CommandFailure> {
        let longest = self.look(longest_us, delay_us)?;
        if longest.suits {
            return Ok(longest);
        }
        let mut best = self.look(shortest_us, delay_us)?;
        if !best.suits {
            return Err(CommandFailure::Exposure(format!(
                "{:.3} % of the pixels saturate even in the plan's shortest exposure, {} us, and at most {:.2} % may: shorter exposures do not dim the light of a pixel's own row, which is a flash; close the aperture by a stop (or lower the gain by 2), set camera.white_dn to match, and try again",
                100.0 * best.saturated,
                in_hundredths(shortest_us),
                100.0 * MAX_SATURATED
            )));
        }
        let mut over_us = longest_us;
        while over_us / best.exposure_us > FACTOR {
            // Whole steps of a tenth of a microsecond, as plans are read by people.
            let middle_us = ((best.exposure_us * over_us).sqrt() * 10.0).round() / 10.0;
            if middle_us <= best.exposure_us || middle_us >= over_us {
                break;
            }
            let middle = self.look(middle_us, delay_us)?;
            match middle.suits {
                true => best = middle,
                false => over_us = middle_us,
            }
        }
        Ok(best)
    }

    /// Judges an exposure by several pictures.
    fn look(&mut self, exposure_us: f64, delay_us: f64) -> Result<Tried, CommandFailure> {
        let (mut samples, mut saturated, mut headroom) = (0.0, 0.0, f64::INFINITY);
        let mut board_headroom = f64::INFINITY;
        for _ in 0..PICTURES {
            let values = self.picture_of(exposure_us, delay_us)?;
            let pixels = values.histogram.iter().sum::<u64>() as f64;
            samples += pixels;
            saturated += values.saturated * pixels;
            headroom = headroom.min(headroom_of(&values));
            board_headroom =
                board_headroom.min(headroom_of_board(&values, self.white_dn.or(values.white_dn)));
        }
        if self.tells {
            eprintln!(
                "tried {} us at a delay of {} us: {:.3} % saturated",
                in_hundredths(exposure_us),
                in_hundredths(delay_us),
                100.0 * saturated / samples
            );
        }
        let suits =
            saturated == 0.0 || saturated + CONFIDENCE * (saturated + 1.0).sqrt() <= MAX_SATURATED * samples;
        Ok(Tried { exposure_us, saturated: saturated / samples, suits, headroom, board_headroom })
    }

    /// The next picture of this exposure and delay.
    fn picture_of(&mut self, exposure_us: f64, delay_us: f64) -> Result<ViewfinderValues, CommandFailure> {
        if self.settings_us != Some((exposure_us, delay_us)) {
            let (wanted, delay) = (Some(exposure_us), Some(delay_us));
            let wanted = ViewfinderParams { exposure_us: wanted, delay_us: delay, ..Default::default() };
            self.viewfinder.client.viewfinder(&wanted)?;
            self.settings_us = Some((exposure_us, delay_us));
        }
        self.picture()
    }

    /// The next picture, of the settings asked for.
    fn picture(&mut self) -> Result<ViewfinderValues, CommandFailure> {
        let began = Instant::now();
        let mut others = None;
        while began.elapsed() < PATIENCE {
            if self.interrupts.pending() {
                return Err(CommandFailure::Exposure("interrupted: nothing is proposed".into()));
            }
            match self.events.next_within(Duration::from_millis(100))? {
                Some(Event::Viewfinder(values)) => {
                    let settings_us = (values.exposure_us, values.delay_us);
                    if let Some(problem) = values.problem {
                        return Err(CommandFailure::Exposure(problem));
                    }
                    if self.settings_us.is_some_and(|wanted_us| settings_us != wanted_us) {
                        others = Some(settings_us);
                    } else if values.pictures > self.pictures {
                        self.pictures = values.pictures;
                        return Ok(*values);
                    }
                }
                Some(Event::Finished { session, error, .. }) if session == self.viewfinder.session => {
                    let why = error.unwrap_or_else(|| "the viewfinder was ended".into());
                    return Err(CommandFailure::Exposure(why));
                }
                _ => {}
            }
        }
        Err(CommandFailure::Exposure(match others {
            Some((exposure_us, delay_us)) => format!(
                "no picture with the settings tried came for 10 s, but pictures of {exposure_us} us at a delay of {delay_us} us: does somebody else change the viewfinder? Try again when it is yours alone"
            ),
            None => "no picture came for 10 s".into(),
        }))
    }
}

impl Drop for Attached {
    fn drop(&mut self) {
        let began = Instant::now();
        let problem = loop {
            match self.client.status() {
                Ok(status)
                    if status.state == RunState::Idle || status.session.as_ref() != Some(&self.session) =>
                {
                    return;
                }
                Ok(_) if began.elapsed() < PATIENCE => thread::sleep(Duration::from_millis(20)),
                Ok(_) => break "it still runs".into(),
                Err(ClientError::Lost { .. }) => return,
                Err(error) => break error.to_string(),
            }
        };
        eprintln!("raysweep: the viewfinder is not known to have ended: {problem}");
    }
}

/// By how much the light of a picture could grow until more than [`MAX_SATURATED`] of the pixels saturate.
fn headroom_of(values: &ViewfinderValues) -> f64 {
    let pixels: u64 = values.histogram.iter().sum();
    let allowed = (MAX_SATURATED * pixels as f64) as u64;
    let mut above = 0;
    let bar = values.histogram.iter().rposition(|bar| {
        above += bar;
        above > allowed
    });
    let upper_dn =
        bar.map_or(0.0, |bar| (bar + 1) as f64 / values.histogram.len() as f64 * f64::from(values.full_dn));
    // The bar's upper end, unless no pixel is as bright.
    let level_dn = upper_dn.min(f64::from(values.brightest_dn));
    (values.saturation_dn - values.black_dn) / (level_dn - values.black_dn).max(1.0)
}

/// By how much the light could grow until a white board, of so many counts above black, has more than a calibration takes.
fn headroom_of_board(values: &ViewfinderValues, white_dn: Option<f64>) -> f64 {
    let most_dn = MOST_OF_BOARD * f64::from(values.full_dn) - values.black_dn;
    white_dn.map_or(f64::INFINITY, |white_dn| most_dn / white_dn)
}

/// As plans are read by people.
pub(super) fn in_hundredths(us: f64) -> f64 {
    (us * 100.0).round() / 100.0
}

#[cfg(test)]
mod tests {
    use raysweep_core::FinderPicture;

    use super::*;

    #[test]
    fn headroom_leaves_out_as_many_pixels_as_may_saturate() {
        let mut values = ViewfinderValues {
            pictures: 1,
            sequence: None,
            picture: FinderPicture::White,
            exposure_us: 1.0,
            delay_us: 0.0,
            region: [0, 100, 0, 200],
            black_dn: 64.0,
            saturation_dn: 3964.0,
            full_dn: 4095,
            white_dn: None,
            saturated: 0.0,
            underexposed: 0.0,
            mean_dn: 0.0,
            brightest_dn: 4000,
            histogram: vec![0; 64],
            row_cut: Vec::new(),
            column_cut: Vec::new(),
            focus: None,
            alignment: None,
            dot: None,
            problem: None,
        };
        values.histogram[30] = 19_998;
        values.histogram[62] = 2;
        let of = |level_dn: f64| 3900.0 / (level_dn - 64.0);
        assert!((headroom_of(&values) - of(31.0 / 64.0 * 4095.0)).abs() < 1e-9, "2 of 20,000 may");
        values.histogram[40] = 1;
        assert!((headroom_of(&values) - of(41.0 / 64.0 * 4095.0)).abs() < 1e-9);
        values.brightest_dn = 2000;
        assert!((headroom_of(&values) - of(2000.0)).abs() < 1e-9);
        // The simulated rig's white board has 58 % of full scale.
        assert_eq!(headroom_of_board(&values, None), f64::INFINITY);
        assert!((headroom_of_board(&values, Some(2300.0)) - 1.1295).abs() < 1e-4);
    }
}
