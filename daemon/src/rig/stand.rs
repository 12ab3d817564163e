//! What stands in front of a rig's camera.

use raysweep_core::{DeviceError, Subject};
use raysweep_sim::SubjectSwitch;

/// Who or what places subjects in front of the camera.
#[derive(Clone)]
pub enum Stand {
    /// The simulator, immediately.
    Simulated(SubjectSwitch),
    /// An operator: the run must wait for one.
    Operator,
    /// Nobody: the recording contains them in the plan's order.
    Recorded,
}

impl Stand {
    /// Places a subject if this needs no person; `false` if an operator must do it.
    ///
    /// # Errors
    /// `OutOfRange` for a subject that the rig does not have; an error of the projector if its pattern cannot be
    /// simulated on the subject.
    pub fn place(&self, subject: Subject) -> Result<bool, DeviceError> {
        match self {
            Self::Simulated(switch) => switch.place(subject).map(|()| true),
            Self::Recorded => Ok(true),
            Self::Operator => Ok(false),
        }
    }
}
