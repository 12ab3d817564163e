//! Calibrates a plane rig from images of a white board.

mod arrays;
mod curve;
mod drawing;
mod file;
mod header;
mod images;
mod median;
mod pixels;
mod report;
mod task;

use std::collections::BTreeMap;

use ndarray::Array1;
use raysweep_config::RigFile;
use raysweep_config::plan::CalibrationPlan;
use raysweep_session::ledger::State;
use raysweep_session::{Result, Session, durable};
use raysweep_transport::plane::board::Estimate;
use raysweep_transport::plane::board::images::{MOST_BEND, Narrower, Responses};
use raysweep_transport::plane::board::times::RowTimes;
use raysweep_transport::plane::calibrate::FlyingSpot;

pub use self::arrays::CalibrationArrays;
pub use self::curve::MeasuredCurve;
pub use self::drawing::{CalibratedDrawing, Scanning};
pub use self::file::{KeptCalibration, current_in};
pub use self::header::{
    CalibratedAmbient, CalibratedFlicker, CalibratedLight, CalibrationHeader, Pair, ResponseOf, ValidFor,
};
use self::header::{CalibratedTiming, SCHEMA};
pub use self::images::{BoardImages, CalibrationError};
pub use self::pixels::{BoardPixels, SecondBoard};
pub use self::task::{BoardPicture, BoardPurpose, BoardView, CalibrationTask, WhichBoard};
use crate::plane::{KnownRig, manifest};
use crate::stored::{Asked, ProcessError, Processed, Stored};

/// What light may spread inside a board of painted metal, which one board cannot tell from the beam: paint of a tenth of
/// a millimetre, under rows of about a millimetre.
const PAINT_ROWS: f64 = 0.1;
/// Latency that is known no better than this is said to be uncertain.
const MOST_LATENCY_SD_US: f64 = 0.5;

/// What a session's images say of the rig.
pub struct BoardFindings {
    /// Of each pixel.
    pub pixels: BoardPixels,
    /// Of the times.
    pub times: RowTimes,
    /// The spot that draws the rows; `None` if they are lit evenly.
    pub spot: Option<FlyingSpot>,
    /// Of each pixel of a second board, or why it is of no use; `None` without one.
    pub second: Option<std::result::Result<SecondBoard, CalibrationError>>,
}

impl BoardFindings {
    /// Evaluates all images.
    ///
    /// # Errors
    /// When an image is missing, or the result is not good enough to be used.
    pub fn new(images: &BoardImages<'_>) -> std::result::Result<Self, CalibrationError> {
        Self::with_pixels(BoardPixels::new(images)?, images)
    }

    /// The same, of which the pixels of the first board are evaluated already.
    ///
    /// # Errors
    /// Those of [`Self::new`].
    pub fn with_pixels(
        pixels: BoardPixels,
        images: &BoardImages<'_>,
    ) -> std::result::Result<Self, CalibrationError> {
        let (times, spot) = pixels.times(images)?;
        let second = match pixels.second_board(images) {
            // What the first board tells is as good without it.
            Err(error @ (CalibrationError::SecondBoard(_) | CalibrationError::Elsewhere { .. })) => {
                Some(Err(error))
            }
            second => second?.map(Ok),
        };
        Ok(Self { pixels, times, spot, second })
    }

    /// The responses that are nearest to those of the beam: the narrower ones.
    fn responses(&self) -> &Responses {
        match &self.second {
            Some(Ok(second)) if second.comparison.narrower == Narrower::Second => &second.responses,
            _ => &self.pixels.responses,
        }
    }

    /// What was found beside the figures, in a sentence each.
    pub fn found(&self) -> Vec<String> {
        self.second.iter().flatten().map(|second| second.comparison.to_string()).collect()
    }

    /// What is worth knowing about a result that is good enough.
    pub fn warnings(&self) -> Vec<String> {
        let RowTimes { latency_sd_us, useful_frames, .. } = self.times;
        let latency = (latency_sd_us > MOST_LATENCY_SD_US).then(|| {
            format!(
                "{useful_frames} useful frames: the latency is known to {latency_sd_us:.2} us only; sweeps, and films of five cycles or more, find the rest from their own light: raise calibration.delays"
            )
        });
        let curve = self.pixels.curve.warning().map(str::to_owned);
        let unseen = matches!(self.pixels.ambient, Some((_, None))).then(|| {
            "whether the room's light flickers was not looked for, because the calibration was interrupted among its black pictures; if lamps are on, calibrate again".to_owned()
        });
        let second = self.second.iter().filter_map(|second| second.as_ref().err());
        let second =
            second.map(|error| format!("{error}; the responses are those of the first, of beam and board"));
        latency.into_iter().chain(curve).chain(unseen).chain(second).collect()
    }

    /// The calibration, in the form in which it is kept.
    ///
    /// # Errors
    /// When it cannot be encoded.
    pub fn keep(&self, session: &Session, state: &State, valid_for: ValidFor) -> Result<KeptCalibration> {
        let Self { pixels, times, spot, second } = self;
        let responses = self.responses();
        // What the responses may contain of a board, as a second moment.
        let (response_of, of_board) = match second {
            Some(Ok(SecondBoard { comparison, .. })) => match comparison.narrower {
                Narrower::First | Narrower::Second => (ResponseOf::Beam, comparison.resolution),
                Narrower::Neither => (ResponseOf::BoardsAlike, comparison.resolution.max(PAINT_ROWS.powi(2))),
            },
            None | Some(Err(_)) => (ResponseOf::BeamAndBoard, PAINT_ROWS.powi(2)),
        };
        let width_sd = responses.width_sd().hypot(responses.widened_by(of_board));
        let name = session.dir().file_name().unwrap_or(session.dir().as_os_str());
        let header = CalibrationHeader {
            schema: SCHEMA,
            made: state.session.created,
            session: name.to_string_lossy().into_owned(),
            arrays_sha256: String::new(),
            valid_for,
            timing: CalibratedTiming {
                row_time_us: pair(times.row_time_us),
                camera_row_time_us: pair(times.camera_row_time_us),
                exposure_offset_us: pair(times.exposure_offset_us),
                latency_sd_us: times.latency_sd_us,
                jitter_us: pair(times.jitter_us),
                seen_rows: [times.seen_rows.start, times.seen_rows.end],
                latency_exposure_covariance_us2: Some(times.covariance[0][1]),
            },
            light: CalibratedLight {
                white_dn: pair(pixels.white.level_dn),
                electrons_per_dn: pair(pixels.transfer.electrons_per_dn),
                read_noise_e: pair(pixels.transfer.read_noise_e),
                prnu: pair(pixels.prnu),
                linearity_per_dn: pixels.curve.known().map(|linearity| pair(linearity.per_dn)),
                saturation_dn: pixels.saturation_dn,
                hot_pixels: pixels.dark.hot.iter().filter(|hot| **hot).count(),
                response_width_sd: Some(width_sd),
                response_of: Some(response_of),
            },
            drawing: Some(CalibratedDrawing::of(spot.as_ref())),
            ambient: self.ambient(),
            checks: self.checks(),
        };
        let unusable = |error: raysweep_transport::plane::PlaneError| raysweep_session::Error::Codec {
            action: "encode",
            what: "the calibration".into(),
            why: error.to_string(),
        };
        let response = responses.pixel_response().map_err(unusable)?;
        let lit = pixels.white.lit();
        let where_lit = |image: &ndarray::Array2<f32>| {
            let mut image = image.clone();
            image.zip_mut_with(&lit, |value, lit| {
                if !lit {
                    *value = f32::NAN;
                }
            });
            image
        };
        let arrays = CalibrationArrays {
            row_starts_us: Array1::from(times.row_starts_us.clone()),
            row_starts_modes: times.row_starts_modes.clone(),
            place: response.places().to_owned(),
            place_sd: responses.place_sd.clone(),
            response: response.shares().to_owned(),
            white_dn: where_lit(&pixels.white.white_dn),
            white_sd: where_lit(&pixels.white.sd_dn),
            dark_offset_dn: pixels.dark.offset_dn.clone(),
            dark_slope_dn_per_us: pixels.dark.slope_dn_per_us.clone(),
            dark_covariance: pixels.dark.covariance.clone(),
            projector_columns: spot.as_ref().map(|spot| spot.columns.clone()),
            ambient_dn_per_us: pixels.ambient.as_ref().map(|(ambient, _)| ambient.level_dn_per_us.clone()),
        };
        KeptCalibration::new(header, arrays)
    }

    /// The room's light, in the form in which it is kept.
    fn ambient(&self) -> Option<CalibratedAmbient> {
        let Self { pixels, times, .. } = self;
        let (ambient, _) = pixels.ambient.as_ref()?;
        let white_dn = pixels.white.level_dn.value;
        let flicker = ambient.flicker.as_ref().map(|flicker| CalibratedFlicker {
            frequency_hz: pair(flicker.frequency_hz),
            share: pair(flicker.share),
        });
        let mut black: Vec<f32> =
            ambient.projector_black_dn.iter().copied().filter(|dn| dn.is_finite()).collect();
        black.sort_by(f32::total_cmp);
        let black_dn = black.get(black.len() / 2).map_or(0.0, |&dn| f64::from(dn));
        Some(CalibratedAmbient {
            level: ambient.level_of_white(white_dn, times.row_time_us.value),
            projector_black: black_dn / white_dn,
            flicker,
        })
    }

    /// Figures of the calibration's checks, each with its limit.
    fn checks(&self) -> BTreeMap<String, Pair> {
        let checks = &self.pixels.responses.checks;
        let chi2 = self.times.residuals.iter().map(|residual| residual.chi2_per_sample).fold(0.0, f64::max);
        let figures = [
            ("coverage", [self.pixels.white.coverage, 0.6]),
            ("saturated", [self.pixels.white.saturated, 0.001]),
            ("sum_of_phases", [checks.sum_of_phases, 0.02]),
            ("two_peaks", [checks.two_peaks, 0.05]),
            ("far_light", [checks.far_light, 0.01]),
            ("place_rms_rows", [checks.place_rms_rows, 0.1]),
            ("misread", [self.pixels.places.misread, 1.0]),
            ("chi2_per_sample", [chi2, 3.0]),
        ];
        let bend = self.pixels.curve.known().map(|linearity| ("bend", [linearity.bend.abs(), MOST_BEND]));
        figures.into_iter().chain(bend).map(|(name, figure)| (name.to_owned(), figure)).collect()
    }

    /// Writes calibration, report and manifest into the session's folder.
    ///
    /// # Errors
    /// When the session cannot be written.
    pub fn write(
        &self,
        kept: &KeptCalibration,
        session: &Session,
        state: &State,
        task: &CalibrationTask,
        rig: &RigFile,
    ) -> Result<()> {
        kept.write(session.dir())?;
        let page = report::make(session, state, task, self, kept).to_html()?;
        durable::write(&session.report_path(), page.as_bytes())?;
        manifest::write(session, state, &task.task, rig)
    }
}

fn pair(Estimate { value, sd }: Estimate) -> Pair {
    [value, sd]
}

/// Evaluates stored images again. The calibration in use is left alone: `raysweep calibration use` changes it.
///
/// # Errors
/// When products are asked for, an image is missing, or the session cannot be written.
pub fn process(
    stored: &Stored<'_>,
    calibration: CalibrationPlan,
    asked: &Asked,
) -> std::result::Result<Processed, ProcessError> {
    let Stored { session, state, plan, .. } = stored;
    if !asked.products.is_empty() {
        let message = "a session of kind \"calibration\" has no products: leave --product out";
        return Err(ProcessError::Product(message.into()));
    }
    let rig = stored.plane_rig()?;
    let shape = state.session.shape;
    let size = (shape.rows, shape.columns);
    let first_row = state.session.first_row;
    let known = KnownRig { file: &rig, first_row, size, calibration: None };
    let task = CalibrationTask::stored(plan, calibration, &known, shape.contents);
    stored.check_contents(task.contents())?;
    let before = KeptCalibration::read(session.dir()).map_err(ProcessError::Config)?;
    let refused = |error: CalibrationError| ProcessError::Config(error.to_string());
    let stack = session.stack()?;
    let findings = BoardFindings::new(&BoardImages { task: &task, state, stack: &stack }).map_err(refused)?;
    let rig_text = session.read_text(&session.rig_path())?;
    // Only a run knows the camera itself.
    let camera = before.map_or_else(String::new, |before| before.header.valid_for.camera);
    let kept = findings.keep(session, state, ValidFor::new(&rig, &rig_text, &camera, size))?;
    findings.write(&kept, session, state, &task, &rig)?;
    let problems = findings.warnings();
    Ok(Processed {
        report: session.report_path(),
        stored: state.stored_points(),
        points: shape.points(),
        problems,
    })
}
