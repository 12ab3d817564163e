//! A daemon's runs that identify its rig's mirror.

use std::sync::Arc;

use raysweep_proto::{CheckReport, RpcError, RunParams, Started};

use super::conclude::conduct_response;
use super::dots::ResponseRun;
use super::orders::Orders;
use super::{Current, Runner, invalid_plan, spawn_run};
use crate::config::{Plan, PlanKind};
use crate::response::{self, ResponseTask};
use crate::rig::DotRig;

/// Whether a plan is one of a mirror's chirps.
pub fn is_response(plan: &str) -> Result<bool, RpcError> {
    let plan = Plan::parse(plan).map_err(|error| invalid_plan(&error))?;
    Ok(plan.kind == PlanKind::Response)
}

impl Runner {
    /// A plan of a mirror's chirps on this rig, and what it would do.
    pub(super) fn foresee_response(
        &self,
        rig: &DotRig,
        plan: &str,
    ) -> Result<(ResponseTask, CheckReport), RpcError> {
        let foreseen = || {
            let size = (self.camera.height, self.camera.width);
            let task = ResponseTask::new(Plan::parse(plan)?, plan, &rig.file, self.camera.format, size)?;
            let camera = self.camera_at(task.response().camera_rate_hz);
            let report = response::check::check(&task, plan, &camera, &self.data, self.memory_limit_bytes)?;
            Ok((task, report))
        };
        foreseen().map_err(|error| invalid_plan(&error))
    }

    /// Prepares a run of a mirror's chirps and starts its thread.
    pub(super) fn begin_response(
        &self,
        rig: &Arc<DotRig>,
        params: &RunParams,
    ) -> Result<(Started, Current), RpcError> {
        let (task, report) = self.foresee_response(rig, &params.plan)?;
        self.check_room(&report, "take smaller frames")?;
        let (name, shape) = (task.plan.name.clone(), task.stack_shape());
        let (session, ledger) =
            self.create_session(params, PlanKind::Response, &name, shape, 0, &rig.text)?;
        let dir = session.dir().to_owned();
        self.board.set_session(dir.clone());
        let orders = Arc::new(Orders::default());
        let run = ResponseRun {
            rig: rig.clone(),
            task: Arc::new(task),
            session,
            ledger,
            data: self.data.clone(),
            orders: orders.clone(),
            board: self.board.clone(),
        };
        let board = self.board.clone();
        let thread = spawn_run({
            let dir = dir.clone();
            move || conduct_response(run, &board, &dir)
        })?;
        Ok((Started { session: dir }, Current { orders, thread }))
    }
}
