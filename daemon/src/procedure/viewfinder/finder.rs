//! From frames to what is seen in the viewfinder.

use std::sync::Arc;
use std::time::{Duration, Instant};

use ndarray::{Array2, ArrayView2};
use raysweep_config::plan::ViewfinderPlan;
use raysweep_core::{FinderPicture, Mosaic, PixelFormat};
use raysweep_processing::viewfinder::{CountScale, FocusMeter, Levels, LitDot, Tendency, cut, region_of};
use raysweep_proto::{
    Event, FocusScore, FocusTrend, RowAlignment, SeenDot, ViewfinderParams, ViewfinderValues,
};
use serde_json::{Map, Value, json};

use crate::live::{Outlet, VIEWFINDER};
use crate::run::board::StatusBoard;
use crate::run::life::Run;

/// Most values of a line cut.
const CUT_VALUES: usize = 128;

/// Measures pictures and publishes them, no faster than the plan says.
pub struct Finder {
    live: Option<Outlet>,
    board: Arc<StatusBoard>,
    scale: CountScale,
    format: PixelFormat,
    is_dot_rig: bool,
    pixels: Array2<u16>,
    focus: FocusMeter,
    values: ViewfinderValues,
    /// Those of the newest picture, as they were told with it.
    told: Option<ViewfinderValues>,
    rhythm: Rhythm,
    ends: Option<Instant>,
}

/// When the next picture is due.
struct Rhythm {
    /// Time from picture to picture.
    pace: Duration,
    next: Instant,
}

impl Rhythm {
    /// Notes that a picture is shown. The next one is due by the rhythm and not by this picture, or a camera as fast as
    /// the rhythm would lose each frame that jitter makes early; where pictures come late, nothing is made up for.
    fn shown(&mut self, now: Instant) {
        self.next = (self.next + self.pace).max(now);
    }
}

/// What a finder must know of its rig.
pub struct FinderRig {
    /// Rows and columns of the frames.
    pub size: (usize, usize),
    /// Their pixel format.
    pub format: PixelFormat,
    /// The scale of their counts.
    pub scale: CountScale,
    /// Counts above black of a white pixel under its own row.
    pub white_dn: Option<f64>,
    /// Exposure of the first frames.
    pub exposure_us: f64,
    /// Whether there is a dot to be found.
    pub is_dot_rig: bool,
}

impl Finder {
    /// A finder that has shown nothing yet.
    pub fn new(run: &Run, plan: &ViewfinderPlan, seen: &FinderRig) -> Self {
        let &FinderRig { size: (rows, columns), format, scale, white_dn, exposure_us, is_dot_rig } = seen;
        let now = Instant::now();
        Self {
            live: run.live.clone(),
            board: run.board.clone(),
            scale,
            format,
            is_dot_rig,
            pixels: Array2::zeros((rows, columns)),
            focus: FocusMeter::default(),
            values: ViewfinderValues {
                pictures: 0,
                sequence: None,
                picture: plan.picture,
                exposure_us,
                delay_us: 0.0,
                region: plan.region.unwrap_or([0, rows, 0, columns]),
                black_dn: scale.black_dn,
                saturation_dn: scale.saturation_dn,
                full_dn: scale.full_dn,
                white_dn,
                saturated: 0.0,
                underexposed: 0.0,
                mean_dn: 0.0,
                brightest_dn: 0,
                histogram: Vec::new(),
                row_cut: Vec::new(),
                column_cut: Vec::new(),
                focus: None,
                alignment: None,
                dot: None,
                problem: None,
            },
            told: None,
            rhythm: Rhythm { pace: Duration::from_secs_f64(1.0 / plan.pictures_per_s), next: now },
            ends: plan.seconds.map(|seconds| now + Duration::from_secs_f64(seconds)),
        }
    }

    /// When its time is over, if ever.
    pub fn ends(&self) -> Option<Instant> {
        self.ends
    }

    /// Whether its time is over.
    pub fn is_over(&self) -> bool {
        self.ends.is_some_and(|ends| Instant::now() >= ends)
    }

    /// How long it is until the next picture is due.
    pub fn time_to_next(&self) -> Duration {
        self.rhythm.next.saturating_duration_since(Instant::now())
    }

    /// What is shown.
    pub fn picture(&self) -> FinderPicture {
        self.values.picture
    }

    /// Exposure of the frames.
    pub fn exposure_us(&self) -> f64 {
        self.values.exposure_us
    }

    /// Delay of the frames' exposures.
    pub fn delay_us(&self) -> f64 {
        self.values.delay_us
    }

    /// Notes exposure and delay of the frames from now on.
    pub fn expose(&mut self, exposure_us: f64, delay_us: f64) {
        (self.values.exposure_us, self.values.delay_us) = (exposure_us, delay_us);
    }

    /// Takes over what clients have changed, but for exposure and delay, which the camera may refuse.
    pub fn change(&mut self, wanted: &ViewfinderParams) {
        let values = &mut self.values;
        values.picture = wanted.picture.unwrap_or(values.picture);
        values.region = wanted.region.unwrap_or(values.region);
        values.problem = None;
        if values.picture != FinderPicture::Align {
            values.alignment = None;
        }
        self.focus.restart();
    }

    /// Says what keeps the viewfinder from showing more, once. All that is told beside it is of the newest picture.
    pub fn complain(&mut self, problem: impl Into<String>) {
        let problem = Some(problem.into());
        if self.values.problem != problem {
            self.values.problem.clone_from(&problem);
            let told = self.told.as_ref().unwrap_or(&self.values).clone();
            self.board.publish(Event::Viewfinder(Box::new(ViewfinderValues { problem, ..told })));
        }
    }

    /// Takes back a complaint, with the next picture.
    pub fn take_back(&mut self, problem: &str) {
        self.values.problem.take_if(|told| told == problem);
    }

    /// Tells how the rows lie from now on, with the next picture.
    pub fn align(&mut self, alignment: Result<RowAlignment, String>) {
        match alignment {
            Ok(alignment) => {
                let measured = self.values.alignment.as_ref().map_or(0, |before| before.measured) + 1;
                self.values.alignment = Some(RowAlignment { measured, ..alignment });
                self.values.problem = None;
            }
            Err(problem) => self.values.problem = Some(problem),
        }
    }

    /// Unpacks a frame.
    ///
    /// # Errors
    /// If the frame is not as large as the format says.
    pub fn unpack(&mut self, frame: &[u8]) -> Result<&Array2<u16>, String> {
        let Some(pixels) = self.pixels.as_slice_mut() else { return Err("the picture is not whole".into()) };
        self.format.unpack_into(frame, pixels).map_err(|error| error.to_string())?;
        Ok(&self.pixels)
    }

    /// Measures the picture unpacked last and publishes it.
    pub fn show(&mut self) {
        self.rhythm.shown(Instant::now());
        let Self { pixels, values, .. } = self;
        let region = region_of(pixels.view(), values.region);
        let Levels { saturated, underexposed, mean_dn, brightest_dn, histogram } =
            Levels::of(region, &self.scale);
        let step = if self.format.mosaic == Mosaic::Mono { 1 } else { 2 };
        // Under black there is nothing to focus on, and the pictures of `align` differ from each other: a score would
        // compare stripes with their inverse.
        let focus = match values.picture {
            FinderPicture::Black | FinderPicture::Align => None,
            _ => self.focus.add(region, mean_dn, &self.scale, step),
        };
        let (rows, columns) = region.dim();
        values.pictures += 1;
        (values.saturated, values.underexposed) = (saturated, underexposed);
        (values.mean_dn, values.brightest_dn, values.histogram) = (mean_dn, brightest_dn, histogram);
        values.row_cut = cut(region.row(rows / 2), CUT_VALUES);
        values.column_cut = cut(region.column(columns / 2), CUT_VALUES);
        values.focus = focus.map(|focus| FocusScore {
            score: focus.score,
            best: focus.best,
            trend: match focus.tendency {
                Tendency::Rising => FocusTrend::Rising,
                Tendency::Falling => FocusTrend::Falling,
                Tendency::Steady => FocusTrend::Steady,
            },
        });
        if self.is_dot_rig {
            let [top, _, left, _] = values.region;
            values.dot = LitDot::find(region).map(|dot| SeenDot {
                row: dot.row + top as f64,
                column: dot.column + left as f64,
                fwhm_px: dot.fwhm_px,
                peak_dn: dot.peak_dn,
            });
        }
        self.values.sequence = self.publish(self.pixels.view());
        self.told = Some(self.values.clone());
        self.board.publish(Event::Viewfinder(Box::new(self.values.clone())));
    }

    /// Puts the picture into the live file; returns its sequence number, if there is a live file.
    fn publish(&self, pixels: ArrayView2<u16>) -> Option<u64> {
        let Outlet { file, session, .. } = self.live.as_ref()?;
        let side = file.reduction(pixels.shape());
        let image = reduced(pixels, side, self.scale.saturation_dn);
        let entries = [
            ("axes", json!(["t", "s"])),
            (
                "units",
                json!("camera counts; of a block of pixels their mean or, if one is saturated, the largest"),
            ),
            ("session", json!(session)),
            ("picture", json!(self.values.picture)),
            ("region", json!(self.values.region)),
            ("size", json!(pixels.shape())),
            ("pictures", json!(self.values.pictures)),
            ("exposure_us", json!(self.values.exposure_us)),
            ("delay_us", json!(self.values.delay_us)),
            ("black_dn", json!(self.scale.black_dn)),
            ("saturation_dn", json!(self.scale.saturation_dn)),
            ("underexposed_dn", json!(self.scale.underexposed_dn())),
        ];
        let mut metadata: Map<String, Value> =
            entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
        if side > 1 {
            metadata.insert("reduced_by".into(), json!(side));
        }
        let shown = file.publish(VIEWFINDER, image.view().into_dyn(), &metadata);
        shown.map_err(|error| tracing::warn!(%error, "a picture of the viewfinder is not shown")).ok()
    }
}

/// The picture in blocks of pixels: their mean, but the largest count if one is saturated, so that no block hides that.
fn reduced(pixels: ArrayView2<u16>, side: usize, saturation_dn: f64) -> Array2<f32> {
    if side == 1 {
        return pixels.mapv(f32::from);
    }
    let (rows, columns) = pixels.dim();
    Array2::from_shape_fn((rows.div_ceil(side), columns.div_ceil(side)), |(t, s)| {
        let end = |at: usize, len: usize| ((at + 1) * side).min(len);
        let block = region_of(pixels, [t * side, end(t, rows), s * side, end(s, columns)]);
        let most = block.iter().copied().max().unwrap_or(0);
        match f64::from(most) >= saturation_dn {
            true => f32::from(most),
            false => block.iter().map(|&dn| f32::from(dn)).sum::<f32>() / block.len() as f32,
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_do_not_hide_saturated_pixels() {
        let mut pixels = Array2::from_shape_fn((3, 4), |(t, s)| (10 * t + s) as u16);
        assert_eq!(reduced(pixels.view(), 1, 4000.0), pixels.mapv(f32::from));
        pixels[[1, 3]] = 4001;
        let expected = ndarray::arr2(&[[5.5, 4001.0], [20.5, 22.5]]);
        assert_eq!(reduced(pixels.view(), 2, 4000.0), expected);
    }

    /// Times in ms at which frames that come at these times are shown.
    fn shown(frames_ms: impl Iterator<Item = f64>, pace_ms: f64) -> Vec<f64> {
        let began = Instant::now();
        let mut rhythm = Rhythm { pace: Duration::from_secs_f64(pace_ms / 1e3), next: began };
        let mut shown = Vec::new();
        for frame_ms in frames_ms {
            let now = began + Duration::from_secs_f64(frame_ms / 1e3);
            if now >= rhythm.next {
                rhythm.shown(now);
                shown.push(frame_ms);
            }
        }
        shown
    }

    #[test]
    fn a_camera_as_fast_as_the_rhythm_loses_no_frame_to_jitter() {
        let jitter_ms = |frame: u32| f64::from(frame * 7919 % 11) / 5.0 - 1.0;
        let frames = (1..=150).map(|frame| 66.667 * f64::from(frame) + jitter_ms(frame));
        assert!(shown(frames, 66.667).len() >= 149);
    }

    #[test]
    fn a_faster_camera_is_shown_at_the_rhythm_and_a_pause_is_not_made_up_for() {
        let frames = (0..600).map(|frame| f64::from(frame) * 16.667);
        let pauses = frames.filter(|ms| !(2000.0..4000.0).contains(ms));
        let shown = shown(pauses, 66.667);
        let after = |begin: f64| shown.iter().filter(|ms| (begin..begin + 1000.0).contains(*ms)).count();
        assert!((14..=16).contains(&after(0.0)), "{shown:?}");
        assert!((15..=17).contains(&after(4000.0)), "{shown:?}");
    }
}
