//! The daemon's interface to its server: everything that a client can request.

use std::path::Path;

use raysweep_proto::{
    CalibrationInfo, CheckReport, DesignParams, DesignReport, DoctorParams, DoctorReport, Event,
    ResumeParams, RpcError, RunParams, SessionInfo, Started, Status, ViewfinderParams,
};
use tokio::sync::broadcast;

/// What a client can request of a daemon. Calls may block on the disk; none waits for a run.
pub trait Control: Send + Sync + 'static {
    /// The daemon's current state.
    fn status(&self) -> Status;

    /// Checks a plan and predicts its run.
    ///
    /// # Errors
    /// `InvalidPlan`, with the position in the plan's text.
    fn check(&self, plan: &str) -> Result<CheckReport, RpcError>;

    /// Searches the settings of a plan for a wanted error or a time of light.
    ///
    /// # Errors
    /// `InvalidPlan`, with the position in the plan's text; `BadParams`.
    fn design(&self, params: &DesignParams) -> Result<DesignReport, RpcError>;

    /// Examines the rig and its host; opens the devices, so no run can begin meanwhile.
    ///
    /// # Errors
    /// `Busy`, `InvalidPlan`.
    fn doctor(&self, params: &DoctorParams) -> Result<DoctorReport, RpcError>;

    /// Starts a run.
    ///
    /// # Errors
    /// `Busy`, `InvalidPlan`, `Device`, `Storage`.
    fn run(&self, params: RunParams) -> Result<Started, RpcError>;

    /// Starts to acquire what is missing in a session.
    ///
    /// # Errors
    /// `Busy`, `NoSession`, `Device`, `Storage`.
    fn resume(&self, params: ResumeParams) -> Result<Started, RpcError>;

    /// Pauses the run before its next point, or at once where a mirror moves, which is parked.
    ///
    /// # Errors
    /// `NotRunning`.
    fn pause(&self) -> Result<(), RpcError>;

    /// Continues after [`Control::pause`].
    ///
    /// # Errors
    /// `NotRunning`.
    fn go_on(&self) -> Result<(), RpcError>;

    /// Ends the run cleanly; acquired data are kept.
    ///
    /// # Errors
    /// `NotRunning`.
    fn cancel(&self) -> Result<(), RpcError>;

    /// Ends the run of this session cleanly, if it is in progress: the client that it was attached to has gone.
    fn abandon(&self, session: &Path);

    /// Permits a mirror's light until the next boot.
    ///
    /// # Errors
    /// `Storage`.
    fn arm_light(&self) -> Result<(), RpcError>;

    /// The sessions of the data folder, oldest first.
    ///
    /// # Errors
    /// `Storage`.
    fn sessions(&self) -> Result<Vec<SessionInfo>, RpcError>;

    /// The calibrations in the data folder, oldest first.
    ///
    /// # Errors
    /// `Storage`.
    fn calibrations(&self) -> Result<Vec<CalibrationInfo>, RpcError>;

    /// Makes a session's calibration the one that later runs use.
    ///
    /// # Errors
    /// `NoSession`, `Storage`.
    fn use_calibration(&self, session: &Path) -> Result<(), RpcError>;

    /// Changes what the running viewfinder shows.
    ///
    /// # Errors
    /// `NotRunning`, `InvalidParams`.
    fn viewfinder(&self, wanted: &ViewfinderParams) -> Result<(), RpcError>;

    /// Subscribes to all events from now on.
    fn events(&self) -> broadcast::Receiver<Event>;
}
