//! What a client is answered that asks for what cannot be done.

use raysweep_config::ConfigError;
use raysweep_proto::{ErrorCode, Mistake, RpcError, RunState};

use crate::run::board::WrongState;

pub fn no_session(what: String) -> RpcError {
    RpcError::new(ErrorCode::NoSession, what)
}

pub fn invalid_plan(error: &ConfigError) -> RpcError {
    let mut rpc = RpcError::new(ErrorCode::InvalidPlan, error.to_string());
    if let Some(data) = &mut rpc.data {
        let span = |mistake: &raysweep_config::ConfigMistake| {
            mistake.span.clone().map(|span| (span.start, span.end))
        };
        data.field.clone_from(&error.first().field);
        data.span = span(error.first());
        data.mistakes = error
            .mistakes()
            .map(|mistake| Mistake {
                message: mistake.message.clone(),
                field: mistake.field.clone(),
                span: span(mistake),
            })
            .collect();
    }
    rpc
}

/// Why a session was not made.
pub struct NotBegun(pub RpcError);

impl From<raysweep_session::Error> for NotBegun {
    fn from(error: raysweep_session::Error) -> Self {
        Self(storage(&error))
    }
}

pub fn storage(error: &raysweep_session::Error) -> RpcError {
    RpcError::new(ErrorCode::Storage, error.to_string())
}

pub fn wrong_state(WrongState(state): WrongState) -> RpcError {
    let what = format!("the daemon is {}: wait for the run's end, or cancel it", name_of(state));
    RpcError::new(ErrorCode::Busy, what)
}

fn name_of(state: RunState) -> &'static str {
    match state {
        RunState::Idle => "idle",
        RunState::Preparing => "preparing a run",
        RunState::Armed => "armed",
        RunState::Running => "running",
        RunState::Paused => "paused",
        RunState::Draining => "finishing a run",
        RunState::Faulted => "faulted",
    }
}
