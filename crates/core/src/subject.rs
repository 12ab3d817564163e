//! What is in front of the camera of a dot rig.

/// What is in front of the camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Subject {
    /// The scene.
    Scene,
    /// One of the Lambertian calibration planes, counted from 0.
    Plane(usize),
    /// An evenly lit diffuser directly in front of the lens.
    Diffuser,
}
