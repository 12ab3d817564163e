//! Finds the dot in a frame.

use raysweep_pipeline::dots::Sensor;
use raysweep_transport::dots::{FrameShape, Region};

/// A pixel this many standard deviations above the dark level is lit: by chance, about one pixel in 10^9 is.
const LIT_SIGMAS: f64 = 6.0;
/// Fewer lit pixels than this do not count as a dot.
const FEWEST_PX: usize = 4;

/// Locates the dot against the dark background.
pub struct DotFinder {
    width: usize,
    region: Region,
    /// Mean counts without light, `[row, column]`.
    dark_dn: Vec<f32>,
    /// Counts above which a pixel is lit; hot pixels never are.
    limit_dn: Vec<u16>,
}

impl DotFinder {
    /// A finder for a region of frames from this sensor.
    pub fn new(shape: FrameShape, region: Region, sensor: &Sensor) -> Self {
        let dark_dn = sensor.background.mean().to_vec();
        let above_dn = sensor.floor.mean.abs() + LIT_SIGMAS * sensor.floor.sigma;
        let mut limit_dn: Vec<u16> =
            dark_dn.iter().map(|&dark_dn| (f64::from(dark_dn) + above_dn).ceil() as u16).collect();
        for &pixel in sensor.correction.hot() {
            limit_dn[pixel as usize] = u16::MAX;
        }
        Self { width: shape.width(), region, dark_dn, limit_dn }
    }

    /// Row and column of the dot, in pixels, 0 at the centre of the first pixel: the centroid of the light of all lit
    /// pixels. `None` if hardly any pixel is lit, or most are.
    pub fn find(&self, frame: &[u16]) -> Option<[f64; 2]> {
        let Region { rows, columns } = &self.region;
        let (mut light, mut moments, mut lit) = (0.0, [0.0; 2], 0);
        for row in rows.clone() {
            let line = row * self.width + columns.start..row * self.width + columns.end;
            let pixels =
                frame[line.clone()].iter().zip(&self.limit_dn[line.clone()]).zip(&self.dark_dn[line]);
            for (column, ((&raw_dn, &limit_dn), &dark_dn)) in columns.clone().zip(pixels) {
                if raw_dn > limit_dn {
                    let above_dn = f64::from(raw_dn) - f64::from(dark_dn);
                    light += above_dn;
                    moments[0] += above_dn * row as f64;
                    moments[1] += above_dn * column as f64;
                    lit += 1;
                }
            }
        }
        let most = rows.len() * columns.len() / 2;
        (FEWEST_PX..=most).contains(&lit).then(|| moments.map(|moment| moment / light))
    }
}

#[cfg(test)]
mod tests {
    use raysweep_pipeline::dots::DarkRun;
    use raysweep_transport::dots::Sampling;

    use super::*;

    #[test]
    fn a_dot_is_found_within_its_region_and_nothing_else_is() {
        let shape = FrameShape::new(32, 64, 1).unwrap();
        let mut dark = DarkRun::new(shape, 4000, 32, 64).unwrap();
        let noise = |frame: usize, pixel: usize| ((frame * 7919 + pixel * 104_729) % 5) as u16;
        let dark_frame = |frame: usize| -> Vec<u16> {
            // Pixel 5 of row 10 is hot.
            (0..2048).map(|pixel| if pixel == 645 { 900 } else { 100 + noise(frame, pixel) }).collect()
        };
        for frame in 0..32 {
            dark.push(&dark_frame(frame)).unwrap();
        }
        let sensor = dark.finish(8.0, None, Sampling::Full).unwrap();
        let finder = DotFinder::new(shape, Region { rows: 4..24, columns: 0..40 }, &sensor);
        assert_eq!(finder.find(&dark_frame(40)), None);
        let with_dot = |row: f64, column: f64| {
            let mut frame = dark_frame(41);
            for (pixel, raw) in frame.iter_mut().enumerate() {
                let (down, right) = ((pixel / 64) as f64 - row, (pixel % 64) as f64 - column);
                *raw += (800.0 * (-(down * down + right * right) / 8.0).exp()).round() as u16;
            }
            frame
        };
        let [row, column] = finder.find(&with_dot(12.3, 20.75)).unwrap();
        assert!((row - 12.3).abs() < 0.03 && (column - 20.75).abs() < 0.03, "{row} {column}");
        let mut overexposed = with_dot(12.3, 20.75);
        overexposed.fill(4095);
        assert_eq!(finder.find(&overexposed), None);
        assert_eq!(finder.find(&with_dot(12.0, 52.0)), None, "beyond the region");
    }
}
