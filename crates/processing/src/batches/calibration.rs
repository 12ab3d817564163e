//! Calibration of the dots from the batches of the calibration planes.

use ndarray::{Array2, Array3};
use raysweep_session::dots::Dots;
use raysweep_session::ledger::State;
use raysweep_session::{Result, Session};
use raysweep_transport::dots::calibrate::{
    Centroids, Confusion, Correspondence, Drift, Footprints, Fundamental, PointSpreads,
};
use raysweep_transport::dots::product::{column_energies, coverage};
use raysweep_transport::dots::{Batch, DotsError, FrameShape};
use serde_json::{Map, json};

use super::columns::from_stored;

/// A pixel belongs to a dot's spot from this share of the dot's peak on.
const FOOTPRINT_LEVEL: f64 = 0.5;
/// A pixel counts towards the overlap of dots from this share of a dot's peak on. Light from the rims of the other
/// dots counts as global light: at one half, that was a tenth of all light on the simulated V-groove.
const OVERLAP_LEVEL: f64 = 0.1;

/// Calibration of the dots from the planes.
pub(super) struct Calibration {
    /// Positions on the first plane, averaged over its batches.
    pub centroids: Centroids,
    /// Dots that share pixels on the first plane.
    pub confusion: Confusion,
    /// How strongly all dots together cover each pixel.
    pub coverage: Array3<f32>,
    /// Light of each dot on the plane.
    pub energies: Vec<f64>,
    /// The epipolar geometry between a dot's position on the first plane and the camera, or why there is none.
    pub fundamental: std::result::Result<Fundamental, String>,
    /// Root mean square distance of the second plane's dots from their epipolar lines.
    pub epipolar_px: Option<f64>,
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
    pub fn of(dots: &Dots, shape: FrameShape, state: &State, problems: &mut Vec<String>) -> Option<Self> {
        let mut batches_of = |plane: usize| {
            let entries = state.batches().filter(|entry| entry.plane == Some(plane));
            let read = entries.filter_map(|entry| match read_batch(dots, shape, entry) {
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
        let made = Self::made(&first, &second);
        made.map_err(|error| problems.push(format!("the calibration planes cannot be used: {error}"))).ok()
    }

    fn made(first: &[(usize, Batch)], second: &[(usize, Batch)]) -> std::result::Result<Self, DotsError> {
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
        let spreads = PointSpreads::new(plane)?;
        let not_unimodal = spreads.unimodal.iter().filter(|unimodal| !**unimodal).count();
        let behind = second
            .iter()
            .map(|(_, batch)| centroids_of(batch))
            .collect::<std::result::Result<Vec<_>, DotsError>>()?;
        let behind = (!behind.is_empty()).then(|| mean(behind));
        let (fundamental, epipolar_px) = epipolar_geometry(&centroids, behind.as_ref());
        Ok(Self {
            confusion: Confusion::new(&Footprints::new(plane, OVERLAP_LEVEL)?),
            coverage: coverage(&spreads),
            energies: column_energies(plane),
            centroids,
            fundamental,
            epipolar_px,
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
        if let Ok(fundamental) = &self.fundamental {
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

/// The fundamental matrix from the positions of the dots on two planes. A dot's position on the first plane stands
/// for its direction: the points along that direction project onto one line. So neither the mirror's angles nor its
/// tracking accuracy need to be known.
fn epipolar_geometry(
    first: &Centroids,
    second: Option<&Centroids>,
) -> (std::result::Result<Fundamental, String>, Option<f64>) {
    let Some(second) = second else {
        return (
            Err("an epipolar mask needs planes at two depths: add a second [[batches.calibration]]".into()),
            None,
        );
    };
    let both: Vec<([f64; 2], [f64; 2])> =
        first.xy.iter().zip(&second.xy).filter_map(|(first, second)| Some(((*first)?, (*second)?))).collect();
    let correspondences: Vec<Correspondence> = both
        .iter()
        .flat_map(|&(mirror, behind)| [mirror, behind].map(|camera| Correspondence { mirror, camera }))
        .collect();
    match Fundamental::from_correspondences(&correspondences) {
        Ok(fundamental) => {
            let square = |&(mirror, [x, y]): &([f64; 2], [f64; 2])| {
                let [a, b, c] = fundamental.epipolar_line(mirror);
                ((a * x + b * y + c) / a.hypot(b)).powi(2)
            };
            let rms_px = (both.iter().map(square).sum::<f64>() / both.len() as f64).sqrt();
            (Ok(fundamental), Some(rms_px))
        }
        Err(error) => (Err(error.to_string()), None),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_planes_give_the_epipole_and_one_gives_a_reason() {
        let shape = FrameShape::new(256, 256, 1).unwrap();
        let batch = Batch::new(shape, raysweep_transport::dots::BatchArrays::default()).unwrap();
        let footprints = Footprints::new(&batch, 0.5).unwrap();
        let mut first = Centroids::new(&batch, &footprints).unwrap();
        first.xy = (0..100)
            .map(|dot| Some([20.0 + 20.0 * f64::from(dot % 10), 20.0 + 20.0 * f64::from(dot / 10)]))
            .collect();
        // Positions farther away move towards an epipole at (600, 90), by a share that depends on the position.
        let mut second = first.clone();
        for xy in second.xy.iter_mut().flatten() {
            let share = 0.05 + 1e-4 * (xy[0] + 2.0 * xy[1]);
            *xy = [xy[0] + share * (600.0 - xy[0]), xy[1] + share * (90.0 - xy[1])];
        }
        let (fundamental, rms_px) = epipolar_geometry(&first, Some(&second));
        let [x, y, w] = fundamental.unwrap().epipole();
        assert!((x / w - 600.0).abs() < 1.0 && (y / w - 90.0).abs() < 1.0, "{} {}", x / w, y / w);
        assert!(rms_px.unwrap() < 1e-6);
        assert!(epipolar_geometry(&first, None).0.is_err(), "one depth");
        assert!(epipolar_geometry(&first, Some(&first)).0.is_err(), "the same depth twice");
    }
}
