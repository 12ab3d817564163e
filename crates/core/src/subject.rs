//! What stands before the camera of a dot rig.

/// What stands before the camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Subject {
    /// The scene.
    Scene,
    /// One of the Lambertian calibration planes, counted from 0.
    Plane(usize),
    /// An evenly lit diffuser right before the lens.
    Diffuser,
}
