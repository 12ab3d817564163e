//! Calibration of the dots from the batches of the calibration planes.

use ndarray::{Array2, Array3};
use raysweep_session::dots::Dots;
use raysweep_session::ledger::State;
use raysweep_session::{Result, Session};
use raysweep_transport::dots::calibrate::{
    Centroids, Confusion, Drift, EpipolarFit, Extension, Footprints, Fundamental, PointSpreads,
};
use raysweep_transport::dots::product::{REFERENCE_WIDTH_PX, column_energies, coverage};
use raysweep_transport::dots::{Batch, DotsError, FrameShape};
use serde_json::{Map, json};

use super::columns::from_stored;
use super::task::DotTask;

/// A pixel belongs to a dot's spot from this share of the dot's peak on.
const FOOTPRINT_LEVEL: f64 = 0.5;
/// A pixel counts towards the overlap of dots from this share of a dot's peak on. Light from the rims of the other
/// dots counts as global light: at one half, that was a tenth of all light on the simulated V-groove.
const OVERLAP_LEVEL: f64 = 0.1;

/// Standard deviation of dots from their epipolar lines beyond which these are doubtful, in pixels of a frame that is
/// 1024 pixels wide.
const MOST_EPIPOLAR_PX: f64 = 3.0;
/// Share of outliers beyond which the lines are doubtful.
const MOST_OUTLIERS: f64 = 0.25;

/// Calibration of the dots from the planes.
pub(super) struct Calibration {
    /// Positions on the first plane, averaged over its batches.
    pub centroids: Centroids,
    /// The same with the positions that dots beside the plane would have on it.
    pub places: Centroids,
    /// How these were placed; else the standard deviation of the dots from the mirror's path, in pixels.
    pub extension: std::result::Result<Extension, f64>,
    /// Dots that share pixels on the first plane, or would.
    pub confusion: Confusion,
    /// How strongly all dots together cover each pixel.
    pub coverage: Array3<f32>,
    /// Light of each dot on the plane.
    pub energies: Vec<f64>,
    /// The epipolar geometry between a dot's position on the first plane and the camera, or why there is none.
    pub epipolar: std::result::Result<EpipolarFit, String>,
    /// Radius of a dot on the plane, if any dot stands out from its surroundings.
    pub radius_px: Option<f64>,
    /// Number of dots whose spot is not one connected piece.
    pub not_unimodal: usize,
    /// Drift from the first batch of the first plane to each of its other batches.
    pub drifts: Vec<(usize, Drift)>,
}

/// Reads a stored batch; the error says what is wrong with it.
pub(super) fn read_batch(
    dots: &Dots,
    shape: FrameShape,
    entry: &raysweep_session::dots::BatchEntry,
) -> std::result::Result<(Batch, Vec<bool>), String> {
    let damaged = |why: String| format!("batch {} is damaged ({why})", entry.batch);
    let columns = dots.read(entry.batch).map_err(|error| damaged(error.to_string()))?;
    if columns.crc32() != entry.crc32 {
        return Err(damaged("its checksum differs from the ledger's".into()));
    }
    from_stored(shape, columns).map_err(|error| damaged(error.to_string()))
}

impl Calibration {
    /// Calibrates from the stored batches of the planes; `None` without planes.
    pub fn of(dots: &Dots, task: &DotTask, state: &State, problems: &mut Vec<String>) -> Option<Self> {
        let mut batches_of = |plane: usize| {
            let entries = state.batches().filter(|entry| entry.plane == Some(plane));
            let read = entries.filter_map(|entry| match read_batch(dots, task.shape, entry) {
                Ok((batch, _)) => Some((entry.batch, batch)),
                Err(problem) => {
                    problems.push(problem);
                    None
                }
            });
            read.collect::<Vec<_>>()
        };
        let (first, second) = (batches_of(0), batches_of(1));
        if first.is_empty() {
            return None;
        }
        let made = Self::made(&first, &second, &task.directions);
        let made = made
            .map_err(|error| problems.push(format!("the calibration planes cannot be used: {error}")))
            .ok()?;
        problems.extend(made.doubts(task));
        Some(made)
    }

    /// What makes the epipolar geometry doubtful.
    fn doubts(&self, task: &DotTask) -> Option<String> {
        let EpipolarFit { dots, outliers, sd_px, .. } = *self.epipolar.as_ref().ok()?;
        let most_px = MOST_EPIPOLAR_PX * task.shape.width() as f64 / REFERENCE_WIDTH_PX;
        let share = outliers as f64 / dots as f64;
        (sd_px > most_px || share > MOST_OUTLIERS).then(|| {
            format!(
                "the epipolar geometry is doubtful: on the second plane, {outliers} of {dots} dots lie far from their \
                 epipolar lines, the others {sd_px:.2} px (standard deviation; up to {most_px:.2} px is usual): \
                 check that nothing moved between the planes, and that both fill the field"
            )
        })
    }

    fn made(
        first: &[(usize, Batch)],
        second: &[(usize, Batch)],
        directions: &[Option<[f64; 2]>],
    ) -> std::result::Result<Self, DotsError> {
        let centroids_of = |batch: &Batch| Centroids::new(batch, &Footprints::new(batch, FOOTPRINT_LEVEL)?);
        let all: Vec<(usize, Centroids)> = first
            .iter()
            .map(|(number, batch)| Ok((*number, centroids_of(batch)?)))
            .collect::<std::result::Result<_, DotsError>>()?;
        let drifts = all.iter().skip(1).map(|(number, later)| Ok((*number, later.drift_from(&all[0].1)?)));
        let drifts = drifts.collect::<std::result::Result<_, DotsError>>()?;
        let centroids = mean(all.into_iter().map(|(_, centroids)| centroids).collect());
        // One batch is used where averaging would blur: the last one, which is nearest in time to the scene.
        let plane = &first[first.len() - 1].1;
        let spreads = PointSpreads::new(plane, &centroids)?;
        let seen = centroids.xy.iter().zip(&spreads.unimodal);
        let not_unimodal = seen.filter(|(xy, unimodal)| xy.is_some() && !**unimodal).count();
        let behind = second
            .iter()
            .map(|(_, batch)| centroids_of(batch))
            .collect::<std::result::Result<Vec<_>, DotsError>>()?;
        let behind = (!behind.is_empty()).then(|| mean(behind));
        let (places, extension) = match centroids.extended(directions) {
            Ok((places, extension)) => (places, Ok(extension)),
            Err(sd_px) => (centroids.clone(), Err(sd_px)),
        };
        let epipolar = match &behind {
            Some(behind) => {
                Fundamental::from_planes(&places.xy, &behind.xy).map_err(|error| error.to_string())
            }
            None => {
                Err("an epipolar mask needs planes at two depths: add a second [[batches.calibration]]"
                    .into())
            }
        };
        let confusion = Confusion::new(&Footprints::new(plane, OVERLAP_LEVEL)?);
        Ok(Self {
            confusion: confusion.extended(&centroids, &places)?,
            coverage: coverage(&spreads),
            energies: column_energies(plane),
            centroids,
            places,
            extension,
            epipolar,
            radius_px: spreads.radius_px(),
            not_unimodal,
            drifts,
        })
    }

    /// The confusion matrix as an image `[dot, dot]`; entries are counts of pixels.
    pub fn confusion_image(&self) -> Array2<f32> {
        let dots = self.confusion.dots();
        let (offsets, neighbours, overlaps) = self.confusion.arrays();
        let mut image = Array2::zeros((dots, dots));
        for dot in 0..dots {
            for at in offsets[dot] as usize..offsets[dot + 1] as usize {
                image[[dot, neighbours[at] as usize]] = overlaps[at] as f32;
            }
        }
        image
    }

    /// Writes the data that the products are based on: `confusion`, `coverage`, and a table of the `dots`.
    pub fn write(&self, session: &Session) -> Result<()> {
        let files = session.products();
        let about = |text: &str, axes: &[&str]| {
            let mut metadata = Map::new();
            metadata.insert("about".into(), json!(text));
            metadata.insert("axes".into(), json!(axes));
            metadata
        };
        let text = "calibration confusion matrix: pixels of the plane that two dots share, their areas on the diagonal";
        files.image("confusion", self.confusion_image().view(), &about(text, &["dot", "dot"]))?;
        let text = "how strongly all dots together cover each pixel of the plane; 1 = one dot's middle";
        let cover = self.coverage.index_axis(ndarray::Axis(2), 0);
        files.image("coverage", cover, &about(text, &["t", "s"]))?;
        let place = |axis: usize| self.centroids.xy.iter().map(|xy| xy.map_or(-1.0, |xy| xy[axis])).collect();
        let columns = [
            ("dot", (0..self.energies.len()).map(|dot| dot as f64).collect::<Vec<f64>>()),
            ("column_px", place(0)),
            ("row_px", place(1)),
            ("light_dn", self.energies.clone()),
            (
                "neighbours",
                (0..self.confusion.dots()).map(|dot| self.confusion.neighbours(dot).len() as f64).collect(),
            ),
        ];
        let mut metadata =
            about("where the dots land on the first calibration plane; -1: not seen", &["dot", "column"]);
        if let Ok(EpipolarFit { fundamental, .. }) = &self.epipolar {
            metadata.insert("fundamental".into(), json!(fundamental.rows()));
            metadata.insert("epipole".into(), json!(fundamental.epipole()));
        }
        files.table("dots", &columns, &metadata)
    }
}

/// Mean positions of the dots over the batches that show them.
fn mean(batches: Vec<Centroids>) -> Centroids {
    let mut mean = batches[0].clone();
    for (dot, xy) in mean.xy.iter_mut().enumerate() {
        let seen: Vec<[f64; 2]> = batches.iter().filter_map(|batch| batch.xy[dot]).collect();
        let of = |axis: usize| seen.iter().map(|xy| xy[axis]).sum::<f64>() / seen.len() as f64;
        *xy = (!seen.is_empty()).then(|| [of(0), of(1)]);
    }
    mean
}
