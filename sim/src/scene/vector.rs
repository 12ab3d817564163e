//! Vectors in the scene: x right, y down, z towards the camera.

pub(super) type Vector = [f64; 3];

pub(super) fn minus(a: Vector, b: Vector) -> Vector {
    plus(a, b, -1.0)
}

/// a + t b
pub(super) fn plus(a: Vector, b: Vector, t: f64) -> Vector {
    [a[0] + t * b[0], a[1] + t * b[1], a[2] + t * b[2]]
}

pub(super) fn dot(a: Vector, b: Vector) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(super) fn cross(a: Vector, b: Vector) -> Vector {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

pub(super) fn length(a: Vector) -> f64 {
    dot(a, a).sqrt()
}

/// Reflects `direction` at a plane mirror with the unit `normal`.
pub(super) fn reflect(direction: Vector, normal: Vector) -> Vector {
    plus(direction, normal, -2.0 * dot(direction, normal))
}
