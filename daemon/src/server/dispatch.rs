//! Maps a method's name and parameters to a call of the daemon.

use std::path::PathBuf;

use raysweep_proto::{
    CheckParams, DesignParams, DoctorParams, Empty, ErrorCode, Event, Method, ResumeParams, Role, RpcError,
    RunParams, Status, UseCalibrationParams, ViewfinderParams, describe, params,
};
use serde::Serialize;
use serde_json::{Map, Value};
use tokio::sync::broadcast;

use crate::control::Control;

/// Who calls.
pub(super) struct Caller {
    pub role: Role,
    /// The group whose members are operators.
    pub operators: Option<String>,
}

/// Result of a call.
pub(super) struct CallResult {
    /// The method's result.
    pub result: Value,
    /// For `subscribe`: the events to send from now on.
    pub events: Option<broadcast::Receiver<Event>>,
    /// The session of a run that ends with the connection.
    pub attached: Option<PathBuf>,
}

impl CallResult {
    fn of(result: impl Serialize) -> Result<Self, RpcError> {
        Ok(Self { result: value(result)?, events: None, attached: None })
    }
}

/// Whether a call may take long, or reads many files.
pub(super) fn computes(method: Method) -> bool {
    matches!(
        method,
        Method::Check | Method::Design | Method::Doctor | Method::Sessions | Method::Calibrations
    )
}

/// Executes a call; may block.
pub(super) fn carry_out(
    control: &dyn Control,
    method: Method,
    caller: Caller,
    given: Map<String, Value>,
) -> Result<CallResult, RpcError> {
    let result = match method {
        Method::Check => control.check(&params::<CheckParams>(given)?.plan).and_then(value),
        Method::Design => control.design(&params::<DesignParams>(given)?).and_then(value),
        Method::Doctor => control.doctor(&params::<DoctorParams>(given)?).and_then(value),
        Method::Run => {
            let params = params::<RunParams>(given)?;
            let is_attached = params.attached;
            let started = control.run(params)?;
            let attached = is_attached.then(|| started.session.clone());
            return Ok(CallResult { attached, ..CallResult::of(started)? });
        }
        Method::Resume => control.resume(params::<ResumeParams>(given)?).and_then(value),
        Method::Describe => none(given).and_then(|()| value(describe(env!("CARGO_PKG_VERSION")))),
        Method::Status => {
            none(given)?;
            let Caller { role, operators } = caller;
            value(Status { role: Some(role), operators, ..control.status() })
        }
        Method::Sessions => none(given).and_then(|()| control.sessions()).and_then(value),
        Method::Calibrations => none(given).and_then(|()| control.calibrations()).and_then(value),
        Method::UseCalibration => {
            let params = params::<UseCalibrationParams>(given)?;
            control.use_calibration(&params.session).and_then(done)
        }
        Method::Viewfinder => control.viewfinder(&params::<ViewfinderParams>(given)?).and_then(done),
        Method::Pause => none(given).and_then(|()| control.pause()).and_then(done),
        Method::Continue => none(given).and_then(|()| control.go_on()).and_then(done),
        Method::Cancel => none(given).and_then(|()| control.cancel()).and_then(done),
        Method::ArmLight => none(given).and_then(|()| control.arm_light()).and_then(done),
        Method::Subscribe => {
            none(given)?;
            return Ok(CallResult { events: Some(control.events()), ..CallResult::of(Empty {})? });
        }
    };
    Ok(CallResult { result: result?, events: None, attached: None })
}

/// Reads the parameters of a method that has none.
fn none(given: Map<String, Value>) -> Result<(), RpcError> {
    params::<Empty>(given).map(|Empty {}| ())
}

/// The result of a method that returns nothing.
fn done((): ()) -> Result<Value, RpcError> {
    value(Empty {})
}

fn value(result: impl Serialize) -> Result<Value, RpcError> {
    serde_json::to_value(result).map_err(|error| RpcError::new(ErrorCode::Internal, error.to_string()))
}
