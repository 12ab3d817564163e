//! The daemon as its server sees it: everything a client can ask for.

use raysweep_proto::{CheckReport, Event, ResumeParams, RpcError, RunParams, SessionInfo, Started, Status};
use tokio::sync::broadcast;

/// What a client can ask of a daemon. Calls may block on the disk; none waits for a run.
pub trait Control: Send + Sync + 'static {
    /// What the daemon is doing.
    fn status(&self) -> Status;

    /// What a plan would do.
    ///
    /// # Errors
    /// `InvalidPlan`, with the place in its text.
    fn check(&self, plan: &str) -> Result<CheckReport, RpcError>;

    /// Begins a run.
    ///
    /// # Errors
    /// `Busy`, `InvalidPlan`, `Device`, `Storage`.
    fn run(&self, params: RunParams) -> Result<Started, RpcError>;

    /// Begins to acquire what a session lacks.
    ///
    /// # Errors
    /// `Busy`, `NoSession`, `Device`, `Storage`.
    fn resume(&self, params: ResumeParams) -> Result<Started, RpcError>;

    /// Holds the run before its next point.
    ///
    /// # Errors
    /// `NotRunning`.
    fn pause(&self) -> Result<(), RpcError>;

    /// Goes on after [`Control::pause`].
    ///
    /// # Errors
    /// `NotRunning`.
    fn go_on(&self) -> Result<(), RpcError>;

    /// Ends the run in order; what was acquired is kept.
    ///
    /// # Errors
    /// `NotRunning`.
    fn cancel(&self) -> Result<(), RpcError>;

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

    /// Everything that happens from now on.
    fn events(&self) -> broadcast::Receiver<Event>;
}
