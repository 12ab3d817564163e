//! Changes the subject in front of a simulated camera, as an operator would.

use std::sync::Arc;

use raysweep_core::{DeviceError, DeviceErrorKind, Subject};

/// Changes the subject in front of the camera of a simulated rig, at once.
#[derive(Clone)]
pub struct SubjectSwitch(Arc<dyn Fn(Subject) -> Result<(), DeviceError> + Send + Sync>);

impl SubjectSwitch {
    pub(crate) fn new(place: impl Fn(Subject) -> Result<(), DeviceError> + Send + Sync + 'static) -> Self {
        Self(Arc::new(place))
    }

    /// Places a subject in front of the camera.
    ///
    /// # Errors
    /// `OutOfRange` for a subject that this rig does not have; an error of the projector for a pattern that cannot be
    /// simulated on the subject.
    pub fn place(&self, subject: Subject) -> Result<(), DeviceError> {
        (self.0)(subject)
    }
}

/// The error of a subject that a rig does not have.
pub(crate) fn not_there(what: String) -> DeviceError {
    DeviceError::new("subject", DeviceErrorKind::OutOfRange, what)
}
