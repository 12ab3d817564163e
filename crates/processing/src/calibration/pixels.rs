//! What the images of the boards say of each pixel.

use ndarray::{Array2, Array3, Axis};
use raysweep_core::{PROJECTOR_COLUMNS, Shutter};
use raysweep_pipeline::SeenLight;
use raysweep_session::ledger::PointEntry;
use raysweep_transport::plane::NoiseModel;
use raysweep_transport::plane::board::Estimate;
use raysweep_transport::plane::board::images::{
    Ambient, BlackFrames, CappedFrames, CodedPictures, DarkFit, ImagesError, LightLevel, Phases,
    PhotonTransfer, ResponseComparison, Responses, RowPlaces, SaturationLimit, SensorNoise, WhiteMap,
    ambient, compare_responses, locate_columns, locate_rows, photon_transfer, prnu, steady,
};
use raysweep_transport::plane::board::times::{
    BoardFrame, CoarseSweep, Columns, RollingSweep, RowTimes, TimesError,
};
use raysweep_transport::plane::calibrate::FlyingSpot;

use super::curve::MeasuredCurve;
use super::images::{BoardImages, CalibrationError, MOST_AWAY_ROWS};
use super::median::median;
use super::task::{
    AMBIENT_US, BoardPicture, BoardPurpose, COLUMNS_PER_BLOCK, CalibrationTask, PASSES_GREY, ROWS_PER_BLOCK,
    WHOLE_US, WhichBoard,
};

/// Light of the room, of white in the time of a row, that is not worth subtracting.
const DARK_ROOM: f64 = 2e-5;
/// Flicker by less than this share of a pass of the beam does not bend the curve.
const STEADY_SHARE: f64 = 0.001;
/// Where fewer pixels saturate, as a share of all, it is not known where the others do.
const LEAST_SATURATED: f64 = 0.1;
/// Share of the pixels that may saturate at fewer counts than what is taken for all.
const SATURATED_BEFORE: f64 = 0.01;
/// Fewer frames of an exposure do not show the room's light.
const LEAST_AMBIENT_FRAMES: usize = 8;

/// Mean pictures of a board, `[n, t, s]` in counts: those of sparse rows above black, and those of the rows' Gray code.
struct RowPictures {
    sparse: Array3<f32>,
    coded: Array3<f32>,
}

impl RowPictures {
    /// The pictures of a board above its black, with `straight` as the camera's curve.
    fn of(
        images: &BoardImages<'_>,
        board: WhichBoard,
        black: &Array3<f32>,
        straight: impl Fn(Array3<f32>) -> Array3<f32>,
    ) -> Result<Self, CalibrationError> {
        let black_dn = black.mean_axis(Axis(0)).unwrap_or_default();
        let sparse = straight(images.means(CalibrationTask::phases(board))?) - &black_dn;
        Ok(Self { sparse, coded: images.means(images.task.row_codes(board))? })
    }

    /// Where each pixel of the board looks, and how it responds.
    fn responses(
        &self,
        task: &CalibrationTask,
        white: &WhiteMap,
    ) -> Result<(RowPlaces, Responses), ImagesError> {
        let projector_rows = task.task.geometry.raster.rows;
        let phases = Phases { images: self.sparse.view(), frames: task.calibration.picture_frames as usize };
        let code = CodedPictures { images: self.coded.view(), lines_per_block: ROWS_PER_BLOCK };
        let places = locate_rows(&phases, &code, white.lit().view(), projector_rows)?;
        let responses = Responses::new(&phases, white, &places, projector_rows)?;
        responses.checks.check()?;
        Ok((places, responses))
    }
}

/// What the images of the second board say.
pub struct SecondBoard {
    /// Place and response.
    pub responses: Responses,
    /// Its responses against those of the first.
    pub comparison: ResponseComparison,
}

/// What the images say of each pixel.
pub struct BoardPixels {
    /// The dark image over exposures.
    pub dark: DarkFit,
    /// Gain and read noise.
    pub transfer: PhotonTransfer,
    /// Non-uniformity of the pixels' sensitivities.
    pub prnu: Estimate,
    /// The camera's curve.
    pub curve: MeasuredCurve,
    /// Counts from which on a pixel is overexposed; `None` if no image fills enough pixels.
    pub saturation_dn: Option<f64>,
    /// White, as all light in counts that are proportional to it.
    pub white: WhiteMap,
    /// The room's light, and the run whose clock its flicker has, or none if it was not looked for; `None` if too few
    /// of its frames have time stamps.
    pub ambient: Option<(Ambient, Option<u32>)>,
    /// The places of single pixels against a smooth map.
    pub places: RowPlaces,
    /// Place and response.
    pub responses: Responses,
    /// The same, averaged over columns.
    pub columns: Columns,
}

impl BoardPixels {
    /// Evaluates the images of cap, black, white, greys, sparse and coded rows.
    ///
    /// # Errors
    /// When an image is missing, or board, light or pictures are of no use.
    pub fn new(images: &BoardImages<'_>) -> Result<Self, CalibrationError> {
        let task = images.task;
        let dark = dark(images)?;
        let [black, white] = images.black_and_white(WhichBoard::First)?;
        let geometry = &task.task.geometry;
        let mean = |frames: &Array3<f32>| frames.mean_axis(Axis(0)).unwrap_or_default();
        match SeenLight::between(
            mean(&white).view(),
            mean(&black).view(),
            geometry.white_dn,
            geometry.saturation_dn,
        ) {
            Some(none) if none.is_surely_none() => return Err(CalibrationError::NoLight(none)),
            _ => {}
        }
        let found_dn = saturation(images, &dark, &white)?;
        let saturation_dn = found_dn.unwrap_or(f64::INFINITY).min(geometry.saturation_dn) as f32;
        let dark_dn = dark.image(WHOLE_US);
        let greys: Vec<(f64, Array3<f32>)> = CalibrationTask::greys()
            .map(|(light, purpose)| Ok((light, images.frames(purpose)?)))
            .collect::<Result<_, CalibrationError>>()?;
        let level = |light, frames| LightLevel { light, frames, dark_dn: dark_dn.view() };
        let levels: Vec<LightLevel<'_>> = greys
            .iter()
            .map(|(light, frames)| level(*light, frames.view()))
            .chain([level(1.0, white.view())])
            .collect();
        let usable = dark.hot.mapv(|hot| !hot);
        let transfer = photon_transfer(&levels, saturation_dn, Some(usable.view()))?;
        let noise = transfer.noise();
        let frames = white.len_of(Axis(0));
        // Whether it saturates is seen in what the camera counts.
        let counted = WhiteMap::new(white.view(), black.view(), saturation_dn, noise)?;
        counted.check(saturation_dn)?;
        let room_dn = room(images, &dark, &MeasuredCurve::NotTaken, noise)?;
        let pass_dn = f64::from(PASSES_GREY) * counted.level_dn.value;
        let curve = match room_dn.as_ref().is_some_and(|(room, _)| flickers(room, pass_dn)) {
            true if task.calibration.passes > 0 => MeasuredCurve::Uncertain,
            _ => MeasuredCurve::of(images, &dark, saturation_dn)?,
        };
        let [black, white] = [black, white].map(|frames| curve.straightened(frames, &dark));
        let white = WhiteMap {
            saturated: counted.saturated,
            ..WhiteMap::new(white.view(), black.view(), saturation_dn, noise)?
        };
        let ambient = match curve.known() {
            Some(_) => room(images, &dark, &curve, noise)?,
            None => room_dn,
        };
        if let Some((ambient, _)) = &ambient {
            ambient.check(white.level_dn.value, task.task.geometry.raster.row_time_us)?;
            // Moments weigh what is left of a lamp far from the place by the square of the distance.
            if ambient.flicker.is_some() && task.has_second_board() {
                return Err(CalibrationError::Lamps);
            }
        }
        let prnu = prnu(white.white_dn.view(), Some(white.lit().view()), frames, noise)?;
        let rows =
            RowPictures::of(images, WhichBoard::First, &black, |frames| curve.straightened(frames, &dark))?;
        let (places, responses) = rows.responses(images.task, &white)?;
        let columns = Columns::new(responses.place.view(), responses.response.view(), None)?
            .with_errors_of(&responses)?;
        Ok(Self {
            dark,
            transfer,
            prnu,
            curve,
            saturation_dn: found_dn,
            white,
            ambient,
            places,
            responses,
            columns,
        })
    }

    /// Evaluates the images of the second board, if there is one.
    ///
    /// # Errors
    /// When an image is missing, board, light or pictures are of no use, or it stands elsewhere than the first.
    pub fn second_board(&self, images: &BoardImages<'_>) -> Result<Option<SecondBoard>, CalibrationError> {
        if !images.task.has_second_board() {
            return Ok(None);
        }
        let straight = |frames| self.curve.straightened(frames, &self.dark);
        let [black, white] = images.black_and_white(WhichBoard::Second)?;
        let limit_dn = self.saturation_dn.unwrap_or(f64::INFINITY);
        let limit_dn = limit_dn.min(images.task.task.geometry.saturation_dn) as f32;
        let evaluated = |[black, white]: [&Array3<f32>; 2]| {
            WhiteMap::new(white.view(), black.view(), limit_dn, self.transfer.noise())
        };
        evaluated([&black, &white])
            .and_then(|counted| counted.check(limit_dn))
            .map_err(CalibrationError::SecondBoard)?;
        let [black, white] = [black, white].map(straight);
        let map = evaluated([&black, &white]).map_err(CalibrationError::SecondBoard)?;
        let rows = RowPictures::of(images, WhichBoard::Second, &black, straight)?;
        let (_, responses) = rows.responses(images.task, &map).map_err(CalibrationError::SecondBoard)?;
        let pairs = responses.place.iter().zip(&self.responses.place);
        let away_rows = median(pairs.map(|(second, first)| (second - first).abs()));
        // The times are those of the places on the first board.
        if away_rows > MOST_AWAY_ROWS {
            return Err(CalibrationError::Elsewhere { away_rows });
        }
        let comparison =
            compare_responses(&self.responses, &responses).map_err(CalibrationError::SecondBoard)?;
        Ok(Some(SecondBoard { responses, comparison }))
    }

    /// The room's light in an image of a single frame, unless the room is dark.
    fn ambient_dn(
        &self,
        images: &BoardImages<'_>,
        purpose: BoardPurpose,
        entry: &PointEntry,
    ) -> Option<Array2<f32>> {
        let geometry = &images.task.task.geometry;
        let (ambient, run) = self.ambient.as_ref()?;
        if ambient.level_of_white(self.white.level_dn.value, geometry.raster.row_time_us) < DARK_ROOM {
            return None;
        }
        let start = entry.exposed.as_ref().filter(|exposed| Some(exposed.run) == *run);
        let opened_s = start.and_then(|exposed| exposed.starts_ns.first()).map(|&start| start as f64 * 1e-9);
        let row_time_us = match images.task.shutter(purpose) {
            Shutter::Rolling => geometry.camera_row_time_us,
            Shutter::Global => 0.0,
        };
        Some(ambient.light_dn(entry.exposure_us, opened_s, row_time_us))
    }

    /// Frames of the white board, as shares of white averaged over columns.
    fn board_frames(
        &self,
        images: &BoardImages<'_>,
        purpose: BoardPurpose,
    ) -> Result<Vec<BoardFrame>, CalibrationError> {
        self.first_board_frames(images, purpose, usize::MAX)
    }

    /// The first ones of them.
    fn first_board_frames(
        &self,
        images: &BoardImages<'_>,
        purpose: BoardPurpose,
        count: usize,
    ) -> Result<Vec<BoardFrame>, CalibrationError> {
        let frame = |ordinal| {
            let (image, entry) = images.image(ordinal)?;
            let image = self.curve.straightened(image.insert_axis(Axis(0)), &self.dark);
            let mut light = image.index_axis_move(Axis(0), 0) - self.dark.image(entry.exposure_us);
            if let Some(ambient_dn) = self.ambient_dn(images, purpose, entry) {
                light -= &ambient_dn;
            }
            let light = light / &self.white.white_dn;
            let setting = images.task.board_setting(purpose, entry);
            Ok(BoardFrame { setting, light: self.columns.average(light.view())? })
        };
        images.task.ordinals(purpose).take(count).map(frame).collect()
    }

    /// The sweep, to within 10 us.
    ///
    /// # Errors
    /// When an image is missing, or the sweep cannot be seen in them.
    pub fn coarse(&self, images: &BoardImages<'_>) -> Result<CoarseSweep, CalibrationError> {
        let frames = self.board_frames(images, BoardPurpose::SweepTime)?;
        Ok(CoarseSweep::from_borders(&self.columns, &frames, &images.task.nominal())?)
    }

    /// The sweep as rolling frames see it, from the first pass over the arrivals of light.
    ///
    /// # Errors
    /// When an image is missing, or light does not arrive in these frames.
    pub fn rolling(
        &self,
        images: &BoardImages<'_>,
        coarse: &CoarseSweep,
    ) -> Result<RollingSweep, CalibrationError> {
        let first = images.task.calibration.delays as usize;
        let frames = self.first_board_frames(images, BoardPurpose::Arrival, first)?;
        Ok(RollingSweep::from_arrivals(&self.columns, &frames, coarse)?)
    }

    /// When each row is lit, and by which spot unless it is lit evenly.
    ///
    /// # Errors
    /// When an image is missing, or the times cannot be found.
    pub fn times(
        &self,
        images: &BoardImages<'_>,
    ) -> Result<(RowTimes, Option<FlyingSpot>), CalibrationError> {
        let mut frames = Vec::new();
        for purpose in [BoardPurpose::SweepTime, BoardPurpose::Arrival, BoardPurpose::ExposureCheck] {
            frames.extend(self.board_frames(images, purpose)?);
        }
        let (noise, white_dn) = (self.transfer.noise(), self.white.level_dn.value);
        let share = NoiseModel {
            read_variance: (noise.read_noise_e / noise.electrons_per_dn / white_dn).powi(2),
            gain: 1.0 / (noise.electrons_per_dn * white_dn),
        };
        let nominal = images.task.nominal();
        let uneven = match RowTimes::fit(&self.columns, &frames, &nominal, share) {
            Err(error @ (TimesError::Misfit { .. } | TimesError::Jitter { .. })) => error,
            other => return Ok((other?, None)),
        };
        let Some(columns) = self.projector_columns(images)? else { return Err(uneven.into()) };
        match RowTimes::find_spot(&self.responses, columns.view(), &frames, &nominal, share)? {
            Some((times, spot)) => Ok((times, Some(spot))),
            None => Err(uneven.into()),
        }
    }

    /// The projector column that each pixel with a place sees, `[t, s]` in 0..=1 over the projector's width; `None` in
    /// sessions from before the pictures of the columns were taken.
    fn projector_columns(&self, images: &BoardImages<'_>) -> Result<Option<Array2<f32>>, CalibrationError> {
        let pictures: Vec<BoardPurpose> = images.task.column_codes().collect();
        if pictures.is_empty() {
            return Ok(None);
        }
        let coded = images.means(pictures.into_iter())?;
        let code = CodedPictures { images: coded.view(), lines_per_block: COLUMNS_PER_BLOCK };
        let has_place = self.responses.place.mapv(f32::is_finite);
        Ok(Some(locate_columns(&code, has_place.view(), PROJECTOR_COLUMNS)?))
    }
}

/// Whether the room's light flickers by more than a curve is known to, against the light of a pass of the beam: the frames
/// of whole periods see the same phases again and again, so that their scatter does not show it.
fn flickers(room: &Ambient, pass_dn: f64) -> bool {
    let Some(flicker) = &room.flicker else { return false };
    let mut levels: Vec<f32> =
        room.level_dn_per_us.iter().copied().filter(|level| level.is_finite()).collect();
    levels.sort_by(f32::total_cmp);
    let level = levels.get(levels.len() / 2).map_or(0.0, |&level| f64::from(level));
    // The integral of a sinusoid over an exposure is at most its amplitude times this.
    let most_us = 1e6 / (std::f64::consts::PI * flicker.frequency_hz.value);
    level * flicker.share.value * most_us > STEADY_SHARE * pass_dn
}

/// Black pictures of both exposures: frames, the start of each in s, the exposure in us, and its dark image.
type BlackPictures = [((Array3<f32>, Vec<f64>), f64, Array2<f32>); 2];

fn has_enough(taken: &BlackPictures) -> bool {
    taken.iter().all(|((_, opened_s), ..)| opened_s.len() >= LEAST_AMBIENT_FRAMES)
}

fn black_frames(taken: &BlackPictures) -> [BlackFrames<'_>; 2] {
    taken.each_ref().map(|((frames, opened_s), exposure_us, dark_dn)| BlackFrames {
        exposure_us: *exposure_us,
        frames: frames.view(),
        dark_dn: dark_dn.view(),
        opened_s,
    })
}

/// The room's light, from the black pictures of both exposures: its flicker by the clock of one run, and a level
/// without flicker from all frames, however many runs took them.
fn room(
    images: &BoardImages<'_>,
    dark: &DarkFit,
    curve: &MeasuredCurve,
    noise: SensorNoise,
) -> Result<Option<(Ambient, Option<u32>)>, CalibrationError> {
    let Some(run) = images.run_of_ambient() else { return Ok(None) };
    let black = BoardPurpose::Response(WhichBoard::First, BoardPicture::Black);
    let exposures = [(black, WHOLE_US), (BoardPurpose::Ambient, AMBIENT_US)];
    let taken = |run: Option<u32>| {
        let [black, short] = exposures.map(|(purpose, exposure_us)| {
            let (frames, opened_s) = images.timed_frames(purpose, run)?;
            let frames = (curve.straightened(frames, dark), opened_s);
            Ok::<_, CalibrationError>((frames, exposure_us, dark.image(exposure_us)))
        });
        Ok::<_, CalibrationError>([black?, short?])
    };
    let mut looked = None;
    // Dropped before all frames are read.
    if let of_run = taken(Some(run))?
        && has_enough(&of_run)
    {
        let usable = dark.hot.mapv(|hot| !hot);
        let geometry = &images.task.task.geometry;
        let (row_time_us, rate_hz) = (geometry.camera_row_time_us, 1e6 / geometry.raster.period_us);
        let found = ambient(&black_frames(&of_run), row_time_us, rate_hz, noise, Some(usable.view()))?;
        looked = Some(run);
        if found.flicker.is_some() {
            return Ok(Some((found, looked)));
        }
    }
    let of_all = taken(None)?;
    match has_enough(&of_all) {
        true => Ok(Some((steady(&black_frames(&of_all), noise)?, looked))),
        false => Ok(None),
    }
}

/// Counts from which on a pixel is overexposed, if enough pixels saturate in more light than they can count: those of
/// almost all pixels.
fn saturation(
    images: &BoardImages<'_>,
    dark: &DarkFit,
    white: &Array3<f32>,
) -> Result<Option<f64>, CalibrationError> {
    let saturated = images.frames(BoardPurpose::Saturated)?;
    if saturated.is_empty() {
        return Ok(None);
    }
    let geometry = &images.task.task.geometry;
    let passes = f64::from(images.task.calibration.passes);
    let (white_dark, saturated_dark) = (dark.image(WHOLE_US), dark.image(passes * geometry.raster.period_us));
    let level = |light, frames, dark_dn| LightLevel { light, frames, dark_dn };
    let ladder =
        [level(1.0, white.view(), white_dark.view()), level(passes, saturated.view(), saturated_dark.view())];
    let found = SaturationLimit::new(&ladder, geometry.saturation_dn as f32, dark.read_noise_dn.value)?;
    if found.seen < LEAST_SATURATED {
        return Ok(None);
    }
    let usable = found.limit_dn.iter().zip(&dark.hot).filter(|(_, hot)| !**hot);
    let mut limits_dn: Vec<u16> = usable.map(|(limit_dn, _)| *limit_dn).collect();
    limits_dn.sort_unstable();
    Ok(limits_dn.get((SATURATED_BEFORE * limits_dn.len() as f64) as usize).map(|&dn| f64::from(dn)))
}

fn dark(images: &BoardImages<'_>) -> Result<DarkFit, CalibrationError> {
    let exposures_us = images.task.calibration.exposure_us.values();
    let runs: Vec<(f64, Array3<f32>)> = exposures_us
        .into_iter()
        .enumerate()
        .map(|(index, exposure_us)| Ok((exposure_us, images.frames(BoardPurpose::Capped(index))?)))
        .collect::<Result<_, CalibrationError>>()?;
    let runs: Vec<CappedFrames<'_>> = runs
        .iter()
        .map(|(exposure_us, frames)| CappedFrames { exposure_us: *exposure_us, frames: frames.view() })
        .collect();
    Ok(DarkFit::new(&runs)?)
}
