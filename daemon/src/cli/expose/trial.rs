//! A viewfinder that tries exposures on the scene.

use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

use raysweep_core::FinderPicture;
use raysweep_proto::{
    Client, ClientError, Event, RunParams, Subscription, ViewfinderParams, ViewfinderValues,
};

use crate::cli::failure::CommandFailure;
use crate::cli::follow::Interrupts;
use crate::cli::printer::Printer;

/// Share of the pixels that may be saturated.
pub(super) const MAX_SATURATED: f64 = 1e-4;
/// PlanExposures are tried until the longest that suits is known to this factor.
const FACTOR: f64 = 1.02;
/// Pictures by which an exposure is judged: few pixels may saturate, and some do so by noise alone, now and then.
const PICTURES: u64 = 8;
/// So many standard deviations of their number are allowed for.
const CONFIDENCE: f64 = 1.6;
/// Most of a camera's full scale that a calibration takes of a white board.
const MOST_OF_BOARD: f64 = 0.65;
/// How long a picture may take to come.
const PATIENCE: Duration = Duration::from_secs(10);
const ENDED: &str = "the viewfinder was ended";
/// The viewfinder ends after this time even if nobody can end it any more.
const VIEWFINDER: &str =
    "kind = \"viewfinder\"\nname = \"expose\"\n[viewfinder]\npictures_per_s = 30\nseconds = 1200\n";

/// The exposures of a plan that are to be chosen.
pub(super) struct PlanExposures {
    pub shortest_us: f64,
    pub longest_us: f64,
    /// The delays, each once, with the longest exposure that the plan takes there.
    pub longest_at: Vec<LongestAt>,
}

pub(super) struct LongestAt {
    pub delay_us: f64,
    pub exposure_us: f64,
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
    /// Rows and columns that the first picture's figures were of: all.
    region: Option<[usize; 4]>,
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
        let (pictures, settings_us, region) = (0, None, None);
        let tells = !printer.json && !printer.quiet;
        let mut trial =
            Self { events, viewfinder, interrupts, pictures, white_dn, settings_us, region, tells };
        trial.picture()?;
        Ok(trial)
    }

    /// The longest exposure that leaves at most [`MAX_SATURATED`] of the pixels saturated at each delay.
    pub fn longest(&mut self, plan: &PlanExposures) -> Result<Tried, CommandFailure> {
        let &PlanExposures { shortest_us, longest_us, ref longest_at } = plan;
        let mut over_us = longest_us;
        if self.tells {
            eprintln!("looking at {} delays in up to {} us", longest_at.len(), in_hundredths(longest_us));
        }
        loop {
            // Indirect light may be brightest at any delay.
            let mut brightest: Option<((f64, f64), &LongestAt)> = None;
            let mut is_lit = false;
            for at in longest_at {
                let values = self.picture_of(over_us.min(at.exposure_us), at.delay_us)?;
                is_lit |= values.underexposed <= 1.0 - MAX_SATURATED;
                // Where there is no headroom, the saturated pixels tell pictures apart.
                let brightness = (-headroom_of(&values), values.saturated);
                if brightest.is_none_or(|(most, _)| brightness > most) {
                    brightest = Some((brightness, at));
                }
            }
            if over_us == longest_us && !is_lit {
                return Err(CommandFailure::Exposure(format!(
                    "the camera sees hardly any light: in the plan's longest exposure, {} us, nearly all pixels are underexposed at every delay; take the cap off the lens, see that the projector is on, open the aperture, or raise the gain",
                    in_hundredths(longest_us)
                )));
            }
            let Some((_, &LongestAt { delay_us, exposure_us })) = brightest else {
                return Err(CommandFailure::Exposure("the plan has no delays".into()));
            };
            let at_most_us = over_us.min(exposure_us);
            let found = self.longest_at(delay_us, shortest_us.min(at_most_us), at_most_us)?;
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
                "{:.3} % of the pixels saturate even in the shortest exposure, {} us, and at most {:.2} % may: shorter exposures do not dim the light of a pixel's own row, which is a flash; close the aperture by a stop (or lower the gain by 2), set camera.white_dn to match, and try again",
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
            self.viewfinder.change(&wanted)?;
            self.settings_us = Some((exposure_us, delay_us));
        }
        self.picture()
    }

    /// The next picture, of the settings asked for.
    fn picture(&mut self) -> Result<ViewfinderValues, CommandFailure> {
        // None while an operator is asked for something, who may take any time.
        let mut began = Some(Instant::now());
        let mut other: Option<Box<ViewfinderValues>> = None;
        while began.is_none_or(|began| began.elapsed() < PATIENCE) {
            if self.interrupts.pending() {
                return Err(CommandFailure::Exposure("interrupted: nothing is proposed".into()));
            }
            match self.events.next_within(Duration::from_millis(100))? {
                Some(Event::Viewfinder(values)) => {
                    if let Some(problem) = values.problem {
                        return Err(CommandFailure::Exposure(problem));
                    }
                    let settings_us = (values.exposure_us, values.delay_us);
                    let is_wanted = self.settings_us.is_none_or(|wanted_us| settings_us == wanted_us)
                        && self.region.is_none_or(|region| values.region == region)
                        && values.picture == FinderPicture::White;
                    if !is_wanted {
                        other = Some(values);
                    } else if values.pictures > self.pictures {
                        self.pictures = values.pictures;
                        self.region = Some(values.region);
                        return Ok(*values);
                    }
                }
                Some(Event::Ask(question)) if question.wants_answer => {
                    eprintln!("{question}");
                    began = None;
                }
                Some(Event::State { .. }) => began = Some(Instant::now()),
                Some(Event::Finished { session, error, .. }) if session == self.viewfinder.session => {
                    return Err(CommandFailure::Exposure(error.unwrap_or_else(|| ENDED.into())));
                }
                _ => {}
            }
        }
        let patience_s = PATIENCE.as_secs();
        Err(CommandFailure::Exposure(match other {
            Some(other) => format!(
                "no white picture of the whole image with the settings tried came for {patience_s} s, but of {}, {} us, a delay of {} us and the region {:?}: does somebody else change the viewfinder? Try again when it is yours alone",
                other.picture.name(),
                in_hundredths(other.exposure_us),
                in_hundredths(other.delay_us),
                other.region
            ),
            None => format!("no picture came for {patience_s} s"),
        }))
    }
}

impl Attached {
    /// Whether it is what the daemon carries out.
    fn runs(&mut self) -> Result<bool, ClientError> {
        let status = self.client.status()?;
        Ok(!status.state.is_over() && status.session.as_ref() == Some(&self.session))
    }

    fn change(&mut self, wanted: &ViewfinderParams) -> Result<(), CommandFailure> {
        if !self.runs()? {
            return Err(CommandFailure::Exposure(ENDED.into()));
        }
        Ok(self.client.viewfinder(wanted)?)
    }
}

impl Drop for Attached {
    fn drop(&mut self) {
        let began = Instant::now();
        let problem = loop {
            match self.runs() {
                Ok(false) | Err(ClientError::Lost { .. }) => return,
                Ok(true) if began.elapsed() < PATIENCE => thread::sleep(Duration::from_millis(20)),
                Ok(true) => break "it still runs".into(),
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
