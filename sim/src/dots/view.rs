//! Geometry of projector and camera: two pinholes, not rectified, with the epipole outside the image.

/// Position of the camera relative to the projector, x, y and z, in units of the scene's distance.
const BASELINE: [f64; 3] = [0.12, 0.03, -0.05];

/// A camera with square pixels that sees the beam's field of view at the scene's distance.
#[derive(Debug, Clone, Copy)]
pub struct CameraView {
    /// Scene rows and columns.
    pub size: (usize, usize),
    /// Half the beam's field of view, as tangents x and y.
    pub half: [f64; 2],
}

impl CameraView {
    fn tangent_per_px(&self) -> f64 {
        2.0 * self.half[0] / self.size.1 as f64
    }

    /// Direction from the projector to the point at distance `depth` that a pixel sees.
    pub fn direction(&self, row: usize, column: usize, depth: f64) -> [f64; 2] {
        let (rows, columns) = self.size;
        let from_middle = [column as f64 + 0.5 - columns as f64 / 2.0, row as f64 + 0.5 - rows as f64 / 2.0];
        let at_scene = from_middle.map(|px| px * self.tangent_per_px());
        let [x, y, z] = BASELINE;
        let ray = |at_scene: f64, base: f64| (at_scene - base) / (1.0 - z);
        [(at_scene[0], x), (at_scene[1], y)].map(|(at, base)| (base + (depth - z) * ray(at, base)) / depth)
    }

    /// Pixel coordinates (row, column; centres at half-integers) of the point at `depth` in a direction.
    pub fn pixel(&self, direction: [f64; 2], depth: f64) -> [f64; 2] {
        let (rows, columns) = self.size;
        let [x, y, z] = BASELINE;
        let at_scene = [(direction[0], x), (direction[1], y)]
            .map(|(m, base)| base + (1.0 - z) * (depth * m - base) / (depth - z));
        [
            at_scene[1] / self.tangent_per_px() + rows as f64 / 2.0,
            at_scene[0] / self.tangent_per_px() + columns as f64 / 2.0,
        ]
    }

    /// Position of the beam in the field of view, 0..1 from left to right and from top to bottom.
    pub fn uv(&self, direction: [f64; 2]) -> [f64; 2] {
        [0, 1].map(|axis| 0.5 + direction[axis] / (2.0 * self.half[axis]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_and_directions_are_inverse_and_agree_at_the_scenes_distance() {
        let view = CameraView { size: (240, 256), half: [0.081, 0.0459] };
        for depth in [0.8, 1.0, 1.3] {
            let [row, column] = view.pixel(view.direction(30, 200, depth), depth);
            assert!((row - 30.5).abs() < 1e-9 && (column - 200.5).abs() < 1e-9, "{row} {column}");
        }
        let [u, _] = view.uv(view.direction(3, 0, 1.0));
        assert!((u - 0.5 / 256.0).abs() < 1e-12, "{u}");
        let shift = view.pixel([0.0, 0.0], 1.1)[1] - view.pixel([0.0, 0.0], 1.0)[1];
        assert!(shift.abs() > 8.0, "depth shows: {shift}");
    }
}
