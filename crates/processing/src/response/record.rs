//! Commanded angle and dot position, frame by frame.

use std::ops::Range;

use ndarray::Array2;
use raysweep_session::{Result, Session};
use serde_json::{Map, Value, json};

use super::task::{AXES, ResponseTask};
use crate::software::SOFTWARE;

/// The record of one axis, indexed by frame number, so that a lost frame shifts none of the others.
#[derive(Debug, Clone, PartialEq)]
pub struct Record {
    /// Mean of the path's samples over each frame's exposure.
    pub commanded_deg: Vec<f64>,
    /// Row and column of the dot's centre; NaN where a frame was lost or shows no dot.
    pub track_px: [Vec<f64>; 2],
}

impl Record {
    /// A record without any frames yet.
    pub fn new(commanded_deg: Vec<f64>) -> Self {
        let nowhere = vec![f64::NAN; commanded_deg.len()];
        Self { commanded_deg, track_px: [nowhere.clone(), nowhere] }
    }

    /// Records the dot's position in a frame.
    pub fn note(&mut self, frame: usize, place: [f64; 2]) {
        for (track, place) in self.track_px.iter_mut().zip(place) {
            track[frame] = place;
        }
    }

    /// Whether a frame shows the dot.
    pub fn shows(&self, frame: usize) -> bool {
        !self.track_px[0][frame].is_nan()
    }

    /// Ranges of frames that were lost or show no dot.
    pub fn gaps(&self) -> Vec<Range<usize>> {
        let mut gaps: Vec<Range<usize>> = Vec::new();
        for frame in (0..self.commanded_deg.len()).filter(|&frame| !self.shows(frame)) {
            match gaps.last_mut().filter(|gap| gap.end == frame) {
                Some(gap) => gap.end += 1,
                None => gaps.push(frame..frame + 1),
            }
        }
        gaps
    }

    /// Writes the table `chirp_x` or `chirp_y` among the session's products.
    ///
    /// # Errors
    /// When the session cannot be written.
    pub fn write(&self, session: &Session, axis: usize, task: &ResponseTask) -> Result<()> {
        let [rows, columns] = &self.track_px;
        let table = [
            ("commanded_deg", self.commanded_deg.clone()),
            ("row_px", rows.clone()),
            ("column_px", columns.clone()),
        ];
        let about = "a frame a line, in the order of their ids: mean of the mirror's commanded tilt over the exposure; middle of the dot, 0 in the middle of the first pixel, NaN where the frame did not come or shows no dot";
        let entries = [
            ("about", json!(about)),
            ("axis", json!(AXES[axis])),
            ("camera_rate_hz", json!(task.response.camera_rate_hz)),
            ("exposure_us", json!(task.response.exposure_us)),
            ("software", json!(SOFTWARE)),
        ];
        let metadata: Map<String, Value> =
            entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
        session.products().table(&name(axis), &table, &metadata)
    }

    /// Reads it back, in the precision of the file.
    ///
    /// # Errors
    /// When it is missing or damaged.
    pub fn read(session: &Session, axis: usize) -> Result<Self> {
        let name = name(axis);
        let table: Array2<f32> = session.products().read_image(&name)?;
        if table.ncols() != 3 {
            let (found, allowed) = (table.shape().to_vec(), "[frame, 3]".into());
            return Err(raysweep_session::Error::Shape { what: format!("table `{name}`"), found, allowed });
        }
        let column = |at: usize| table.column(at).iter().map(|&value| f64::from(value)).collect();
        Ok(Self { commanded_deg: column(0), track_px: [column(1), column(2)] })
    }
}

fn name(axis: usize) -> String {
    format!("chirp_{}", AXES[axis])
}
