//! `raysweep expose`: tries exposures on the scene with a viewfinder, and proposes a plan.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use raysweep_config::plan::{Axis, with_tables};
use raysweep_config::{Plan, Procedure};
use raysweep_proto::{
    CheckReport, Client, ClientError, ErrorCode, Event, ExpectedError, RunParams, Subscription,
    ViewfinderParams, ViewfinderValues,
};
use serde_json::json;

use super::exit::Exit;
use super::failure::CommandFailure;
use super::follow::Interrupts;
use super::plan_file::read_plan;
use super::printer::Printer;
use super::show;

/// Share of the pixels that may be saturated.
const MAX_SATURATED: f64 = 1e-4;
/// Exposures are tried until the longest that suits is known to this factor.
const FACTOR: f64 = 1.02;
/// Pictures by which an exposure is judged: few pixels may saturate, and some do so by noise alone, now and then.
const PICTURES: u64 = 8;
/// So many standard deviations of their number are allowed for.
const CONFIDENCE: f64 = 1.6;
/// A scene that could be this much brighter is worth opening the aperture for, and a board that is as much too bright is
/// worth closing it.
const WORTHWHILE: f64 = 1.1;
/// With a larger expected error nothing is foreseen that frames are counted by, such as where the scenes that it is expected
/// of saturate.
const FORESEEN: f64 = 0.5;
/// Most of a camera's full scale that a calibration takes of a white board.
const MOST_OF_BOARD: f64 = 0.65;
/// Edges nearer to the pixel's own row than this share of the exposure divide the light about it.
const NEAR_EDGES: f64 = 0.15;
/// Averaging over more frames is not proposed.
const MAX_AVERAGE: f64 = 64.0;
/// How long a picture may take to come.
const PATIENCE: Duration = Duration::from_secs(10);
/// The viewfinder ends after this time even if nobody can end it any more.
const VIEWFINDER: &str =
    "kind = \"viewfinder\"\nname = \"expose\"\n[viewfinder]\npictures_per_s = 30\nseconds = 1200\n";

/// Tries exposures for a plan, and prints what it proposes.
pub(super) fn expose(socket: &Path, path: &Path, printer: Printer) -> Result<Exit, CommandFailure> {
    let text = read_plan(path)?;
    let refused = |error| CommandFailure::of_plan(error, path, &text);
    let mut client = Client::connect(socket)?;
    let foreseen = client.check(&text).map_err(refused)?;
    // Settings that the plan leaves to the calibration are stated in what is proposed.
    let text = match foreseen.settings {
        Some(table) => {
            with_tables(&text, &table).map_err(|error| CommandFailure::Exposure(error.to_string()))?
        }
        None => text,
    };
    let asked = Plan::parse(&text).ok();
    let asked = asked.and_then(|plan| Some((exposures(&plan.procedure)?, delays(&plan.procedure))));
    let Some(((shortest_us, longest_us), delays_us)) = asked else {
        let message = "the plan has no exposures to choose: give a plan of kind \"sweep\" or \"film\"";
        return Err(CommandFailure::Exposure(message.into()));
    };
    let tried =
        Trial::begin(socket, foreseen.white_dn, printer)?.longest(shortest_us, longest_us, &delays_us)?;
    let limited = limited(&text, tried.exposure_us)?;
    let foreseen = client.check(&limited).map_err(|error| CommandFailure::of_plan(error, path, &limited))?;
    let (plan, average) = averaged(&limited, &foreseen)?;
    let report = match average {
        Some(_) => client.check(&plan).map_err(|error| CommandFailure::of_plan(error, path, &plan))?,
        None => foreseen,
    };
    let proposal = Proposed { tried, longest_us, average, report, plan };
    printer.print(&proposal.value(), |_| proposal.text())?;
    Ok(Exit::Done)
}

/// The delays of a plan.
fn delays(procedure: &Procedure) -> Vec<f64> {
    let mut delays_us: Vec<f64> = match procedure {
        Procedure::Sweep(sweep) => {
            let extra = sweep.extra.iter().flat_map(|grid| grid.delay_us.values());
            sweep.delay_us.values().into_iter().chain(extra).collect()
        }
        Procedure::Film(film) => film.delay_us.values(),
        _ => Vec::new(),
    };
    delays_us.sort_by(f64::total_cmp);
    delays_us.dedup();
    delays_us
}

/// The shortest and the longest exposure of a plan.
fn exposures(procedure: &Procedure) -> Option<(f64, f64)> {
    let values = match procedure {
        Procedure::Sweep(sweep) => {
            let extra = sweep.extra.iter().flat_map(|grid| grid.exposure_us.values());
            sweep.exposure_us.values().into_iter().chain(extra).collect()
        }
        Procedure::Film(film) => vec![film.exposure_us],
        _ => return None,
    };
    Some((values.iter().copied().reduce(f64::min)?, values.iter().copied().reduce(f64::max)?))
}

/// The plan without longer exposures.
fn limited(text: &str, most_us: f64) -> Result<String, CommandFailure> {
    let limit = |axis: &Axis| {
        let mut values: Vec<f64> = axis.values().into_iter().map(|us| us.min(most_us)).collect();
        values.dedup();
        let mut kept: Vec<f64> = Vec::new();
        values.into_iter().for_each(|us| {
            if !kept.contains(&us) {
                kept.push(us)
            }
        });
        Axis::of_values(kept)
    };
    changed(text, |procedure| match procedure {
        Procedure::Sweep(sweep) => {
            sweep.exposure_us = limit(&sweep.exposure_us);
            for grid in &mut sweep.extra {
                if let [exposure_us] = grid.exposure_us.values()[..] {
                    grid.delay_us = with_edges(&grid.delay_us, exposure_us, exposure_us.min(most_us));
                }
                grid.exposure_us = limit(&grid.exposure_us);
            }
        }
        Procedure::Film(film) => {
            let shorter_us = film.exposure_us.min(most_us);
            film.delay_us = with_edges(&film.delay_us, film.exposure_us, shorter_us);
            film.exposure_us = shorter_us;
        }
        _ => {}
    })
}

/// The delays for a shorter exposure. Where an edge lay near the pixel's own row, it stays where it was.
fn with_edges(delays: &Axis, exposure_us: f64, shorter_us: f64) -> Axis {
    let half_us = (exposure_us - shorter_us) / 2.0;
    let moved = |delay_us: f64| {
        let is_near = (delay_us.abs() - exposure_us / 2.0).abs() < NEAR_EDGES * exposure_us;
        let moved_us = if is_near { delay_us - half_us.copysign(delay_us) } else { delay_us };
        (moved_us * 100.0).round() / 100.0
    };
    Axis::of_values(delays.values().into_iter().map(moved).collect())
}

/// The plan with as many frames per point that noise is as large as what averaging does not remove, and that number;
/// `None` where nothing is averaged or foreseen.
fn averaged(text: &str, foreseen: &CheckReport) -> Result<(String, Option<u32>), CommandFailure> {
    let expected = foreseen.advice.as_ref().map(|advice| advice.expected);
    let Some(ExpectedError { noise, bias, calibration, .. }) =
        expected.filter(|expected| expected.total.median < FORESEEN)
    else {
        return Ok((text.to_owned(), None));
    };
    let ratio = noise.median / bias.median.hypot(calibration.median).max(f64::MIN_POSITIVE);
    let mut proposed = None;
    let plan = changed(text, |procedure| {
        if let Procedure::Sweep(sweep) = procedure {
            let frames = (f64::from(sweep.average) * ratio * ratio).ceil();
            sweep.average = frames.clamp(1.0, MAX_AVERAGE) as u32;
            proposed = Some(sweep.average);
        }
    })?;
    Ok((plan, proposed))
}

fn changed(text: &str, change: impl FnOnce(&mut Procedure)) -> Result<String, CommandFailure> {
    let failed = |error: &dyn std::fmt::Display| CommandFailure::Exposure(error.to_string());
    let mut plan = Plan::parse(text).map_err(|error| failed(&error))?;
    let before = plan.procedure.clone();
    change(&mut plan.procedure);
    let table = match &plan.procedure {
        procedure if *procedure == before => return Ok(text.to_owned()),
        Procedure::Sweep(sweep) => sweep.to_toml(),
        Procedure::Film(film) => film.to_toml(),
        _ => return Ok(text.to_owned()),
    };
    with_tables(text, &table).map_err(|error| failed(&error))
}

/// What was found on the scene.
struct Tried {
    /// The longest exposure that suits.
    exposure_us: f64,
    /// Share of saturated pixels in it.
    saturated: f64,
    /// Whether the share is at most [`MAX_SATURATED`], beyond doubt as far as so many pixels can tell.
    suits: bool,
    /// By how much the light could grow until too many pixels saturate, or a white board has more than a calibration takes.
    headroom: f64,
}

/// A viewfinder that tries exposures. Ends it when it goes out of scope, on every way out.
struct Trial {
    client: Client,
    events: Subscription,
    interrupts: Interrupts,
    pictures: u64,
    /// Counts above black of white, as the plan's run takes them: with the calibration, which a viewfinder does without.
    white_dn: Option<f64>,
    /// Exposure and delay asked for.
    settings_us: Option<(f64, f64)>,
    /// The viewfinder's session.
    session: PathBuf,
    is_over: bool,
    /// Whether what was tried is told on the way.
    tells: bool,
}

impl Trial {
    fn begin(socket: &Path, white_dn: Option<f64>, printer: Printer) -> Result<Self, CommandFailure> {
        let mut events = Client::connect(socket)?.subscribe()?;
        let interrupts = Interrupts::of_any_end().map_err(CommandFailure::Signals)?;
        let client = Client::connect(socket)?;
        let plan = RunParams { plan: VIEWFINDER.into(), attached: true, ..RunParams::default() };
        let session = events.client().run(&plan)?.session;
        let (pictures, settings_us, is_over, tells) = (0, None, false, !printer.json && !printer.quiet);
        let mut trial =
            Self { client, events, interrupts, pictures, white_dn, settings_us, session, is_over, tells };
        trial.picture()?;
        Ok(trial)
    }

    /// The longest exposure that leaves at most [`MAX_SATURATED`] of the pixels saturated at each delay.
    fn longest(
        mut self,
        shortest_us: f64,
        longest_us: f64,
        delays_us: &[f64],
    ) -> Result<Tried, CommandFailure> {
        let mut over_us = longest_us;
        loop {
            // Indirect light may be brightest at any delay.
            let mut brightest = (f64::INFINITY, 0.0);
            let mut is_lit = false;
            for &delay_us in delays_us {
                let values = self.picture_of(over_us, delay_us)?;
                is_lit |= values.underexposed <= 1.0 - MAX_SATURATED;
                let headroom = headroom_of(&values);
                brightest = if headroom < brightest.0 { (headroom, delay_us) } else { brightest };
            }
            if over_us == longest_us && !is_lit {
                return Err(CommandFailure::Exposure(format!(
                    "the camera sees hardly any light: in the plan's longest exposure, {longest_us} us, nearly all pixels are underexposed at every delay; take the cap off the lens, see that the projector is on, open the aperture, or raise the gain"
                )));
            }
            let (_, delay_us) = brightest;
            let found = self.longest_at(delay_us, shortest_us, over_us)?;
            // Where another delay is the brightest in that exposure, it is tried again.
            if found.exposure_us == over_us {
                return Ok(found);
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
                "{:.3} % of the pixels saturate even in the plan's shortest exposure, {shortest_us} us, and at most {:.2} % may: shorter exposures do not dim the light of a pixel's own row, which is a flash; close the aperture by a stop (or lower the gain by 2), set camera.white_dn to match, and try again",
                100.0 * best.saturated,
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
        for _ in 0..PICTURES {
            let values = self.picture_of(exposure_us, delay_us)?;
            let pixels = values.histogram.iter().sum::<u64>() as f64;
            samples += pixels;
            saturated += values.saturated * pixels;
            let of_board = headroom_of_board(&values, self.white_dn.or(values.white_dn));
            headroom = headroom.min(headroom_of(&values)).min(of_board);
        }
        if self.tells {
            eprintln!(
                "tried {exposure_us} us at a delay of {delay_us} us: {:.3} % saturated",
                100.0 * saturated / samples
            );
        }
        let suits =
            saturated == 0.0 || saturated + CONFIDENCE * (saturated + 1.0).sqrt() <= MAX_SATURATED * samples;
        Ok(Tried { exposure_us, saturated: saturated / samples, suits, headroom })
    }

    /// The next picture of this exposure and delay.
    fn picture_of(&mut self, exposure_us: f64, delay_us: f64) -> Result<ViewfinderValues, CommandFailure> {
        if self.settings_us != Some((exposure_us, delay_us)) {
            let (wanted, delay) = (Some(exposure_us), Some(delay_us));
            let wanted = ViewfinderParams { exposure_us: wanted, delay_us: delay, ..Default::default() };
            self.client.viewfinder(&wanted)?;
            self.settings_us = Some((exposure_us, delay_us));
        }
        self.picture()
    }

    /// The next picture, of the settings asked for.
    fn picture(&mut self) -> Result<ViewfinderValues, CommandFailure> {
        let began = Instant::now();
        loop {
            if self.interrupts.pending() {
                return Err(CommandFailure::Exposure("interrupted: nothing is proposed".into()));
            }
            match self.events.next_within(Duration::from_millis(100))? {
                Some(Event::Viewfinder(values)) => {
                    let settings_us = (values.exposure_us, values.delay_us);
                    let is_wanted = self.settings_us.is_none_or(|wanted_us| settings_us == wanted_us);
                    if let Some(problem) = values.problem {
                        return Err(CommandFailure::Exposure(problem));
                    }
                    if values.pictures > self.pictures && is_wanted {
                        self.pictures = values.pictures;
                        return Ok(*values);
                    }
                }
                Some(Event::Finished { session, error, .. }) if session == self.session => {
                    self.is_over = true;
                    let why = error.unwrap_or_else(|| "the viewfinder was ended".into());
                    return Err(CommandFailure::Exposure(why));
                }
                _ if began.elapsed() > PATIENCE => {
                    return Err(CommandFailure::Exposure("no picture came for 10 s".into()));
                }
                _ => {}
            }
        }
    }
}

impl Drop for Trial {
    fn drop(&mut self) {
        if self.is_over {
            return;
        }
        match self.client.cancel() {
            Ok(()) => {}
            Err(ClientError::Rpc(error)) if error.name() == Some(ErrorCode::NotRunning) => return,
            Err(error) => return eprintln!("raysweep: the viewfinder is not known to have ended: {error}"),
        }
        let began = Instant::now();
        while began.elapsed() < PATIENCE {
            match self.events.next_within(Duration::from_millis(100)) {
                Ok(Some(Event::Finished { session, .. })) if session == self.session => return,
                Err(ClientError::Lost { .. }) => return,
                _ => {}
            }
        }
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

/// What is proposed.
struct Proposed {
    tried: Tried,
    /// The plan's longest exposure before.
    longest_us: f64,
    /// Frames per point, if there is a choice.
    average: Option<u32>,
    report: CheckReport,
    plan: String,
}

impl Proposed {
    fn value(&self) -> serde_json::Value {
        let Self { tried: Tried { exposure_us, saturated, headroom, .. }, average, report, plan, .. } = self;
        let (rig, expected) = report.advice.as_ref().map(|advice| (&advice.rig, &advice.expected)).unzip();
        json!({
            "exposure_us": exposure_us, "saturated": saturated, "headroom": headroom, "gain_factor": self.gain_factor(),
            "average": average,
            "light_s": report.light_s, "expected": expected, "rig": rig, "plan": plan, "warnings": report.warnings,
        })
    }

    /// What the camera's gain is to be multiplied by, unless the aperture is opened by as much.
    fn gain_factor(&self) -> f64 {
        let is_worthwhile = self.tried.headroom > WORTHWHILE || self.tried.headroom < 1.0 / WORTHWHILE;
        if is_worthwhile { self.tried.headroom } else { 1.0 }
    }

    fn text(&self) -> String {
        let Self { tried, longest_us, average, report, plan } = self;
        let Tried { exposure_us, saturated, .. } = tried;
        let mut head = vec![format!(
            "exposures up to {exposure_us} us: {:.3} % of the pixels saturate (at most {:.2} % may)",
            100.0 * saturated,
            100.0 * MAX_SATURATED
        )];
        if exposure_us < longest_us {
            head.push(format!("longer ones, up to {longest_us} us, saturate more and are shortened"));
        }
        head.push(match self.gain_factor() {
            1.0 => "gain: as it is".to_owned(),
            factor if factor < 1.0 => format!(
                "gain: {factor:.2} times ({:+.1} dB) as much: a white board has more than the 65 % of full scale that a calibration needs, as far as the calibration in use or camera.white_dn tells. Or close the aperture by as much. The plan below is for the gain as it is: calibrate again, and try this again",
                20.0 * factor.log10()
            ),
            factor => format!(
                "gain: {factor:.2} times ({:+.1} dB) as much: the scene does not saturate then, and a white board has at most 65 % of full scale, which a calibration needs, as far as the calibration in use or camera.white_dn tells. Better open the aperture by as much: that brings light, and a gain brings counts alone. The plan below is for the gain as it is: calibrate again, and try this again",
                20.0 * factor.log10()
            ),
        });
        if let Some(average) = average {
            head.push(match f64::from(*average) < MAX_AVERAGE {
                true => format!(
                    "average = {average}: with so many frames, the noise foreseen for the plan as it was is as large as what averaging was foreseen not to remove"
                ),
                false => format!("average = {average}, the most that is proposed; more would lower the noise further"),
            });
        }
        head.push(format!("{:.2} s of light", report.light_s));
        if let Some(advice) = &report.advice {
            head.push(format!("expected error: {}", show::errors(&advice.expected)));
            head.push(format!("the rig is known: {}", show::accuracy(&advice.rig)));
        }
        head.extend(report.warnings.iter().map(|warning| format!("warning: {warning}")));
        let comments: String = head.into_iter().map(|comment| format!("# {comment}\n")).collect();
        format!("{comments}{}", plan.trim_end())
    }
}

#[cfg(test)]
mod tests {
    use raysweep_core::FinderPicture;

    use super::*;

    #[test]
    fn a_shorter_exposure_keeps_its_edges_on_the_own_row() {
        let delays = Axis::List(vec![-640.0, -311.0, 0.0, 289.0, 333.0]);
        assert_eq!(with_edges(&delays, 600.0, 430.0).values(), [-640.0, -226.0, 0.0, 204.0, 248.0]);
        assert_eq!(with_edges(&delays, 600.0, 600.0), delays);
    }

    #[test]
    fn longer_exposures_are_shortened_and_the_rest_of_a_plan_stays() {
        let text = "kind = \"sweep\"\nname = \"a\"\n[sweep]\nexposure_us = [100, 400, 800, 1200]\naverage = 3\n\
                    [[sweep.extra]]\ndelay_us = [0]\nexposure_us = [900, 50]\n[[stage]]\nname = \"demux\"\nalpha = 0.5\n";
        let plan = Plan::parse(&limited(text, 500.0).unwrap()).unwrap();
        let Procedure::Sweep(sweep) = &plan.procedure else { panic!("{plan:?}") };
        assert_eq!(sweep.exposure_us.values(), [100.0, 400.0, 500.0]);
        assert_eq!(sweep.extra[0].exposure_us.values(), [500.0, 50.0]);
        assert_eq!((sweep.average, plan.name.as_str(), plan.stages.len()), (3, "a", 1));
        assert_eq!(exposures(&plan.procedure), Some((50.0, 500.0)));
        assert_eq!(limited(text, 1200.0).unwrap(), text, "nothing to change");
        let film = limited("kind = \"film\"\n[film]\nexposure_us = 700\n", 600.5).unwrap();
        assert_eq!(exposures(&Plan::parse(&film).unwrap().procedure), Some((600.5, 600.5)));
        assert_eq!(exposures(&Plan::parse("kind = \"darks\"\n").unwrap().procedure), None);
    }

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

    #[test]
    fn a_gain_is_proposed_where_it_is_worth_a_calibration() {
        let of = |headroom| {
            let tried = Tried { exposure_us: 600.0, saturated: 0.0, suits: true, headroom };
            let report = json!({ "points": 1, "extra_points": 0, "frames": 8, "light_s": 0.1, "memory_bytes": 1,
                "memory_free_bytes": 2, "disk_bytes": 1, "disk_free_bytes": 2, "warnings": [] });
            let (report, plan) = (serde_json::from_value(report).unwrap(), String::new());
            Proposed { tried, longest_us: 600.0, average: Some(8), report, plan }
        };
        assert!(of(1.05).text().contains("# gain: as it is\n"), "{}", of(1.05).text());
        assert_eq!(of(1.05).value()["gain_factor"], 1.0);
        assert!(of(2.0).text().contains("# gain: 2.00 times (+6.0 dB) as much:"), "{}", of(2.0).text());
        assert_eq!(of(2.0).value()["gain_factor"], 2.0);
        // A board that is too bright, of which the scene need not show anything.
        assert!(of(0.72).text().contains("# gain: 0.72 times (-2.9 dB) as much: a white board has more"));
        assert_eq!(of(0.72).value()["gain_factor"], 0.72);
        assert!(of(0.95).text().contains("# gain: as it is\n"));
    }
}
