//! What is in front of the camera of a rig.

/// What is in front of the camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Subject {
    /// The scene.
    Scene,
    /// One of the Lambertian calibration planes of a dot rig, counted from 0.
    Plane(usize),
    /// An evenly lit diffuser directly in front of the lens of a dot rig's camera.
    Diffuser,
    /// The flat, matt, white board of a plane rig's calibration, in the scene's place.
    Board,
    /// A cap on the lens of a plane rig's camera: no light at all.
    Cap,
}
