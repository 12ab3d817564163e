//! Who is connected: a limit for each user, and places that only operators take.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use raysweep_proto::{ErrorCode, RpcError};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::{Limits, Peer};

/// The places of all connections.
pub(super) struct Seats {
    limits: Limits,
    taken: Mutex<Taken>,
}

#[derive(Default)]
struct Taken {
    users: HashMap<u32, Connected>,
    connections: usize,
    observers: usize,
}

/// The connections of a user.
struct Connected {
    connections: usize,
    /// Held by the one call of the user that computes.
    turn: Arc<Semaphore>,
}

/// A connection's place, which is free again when this is dropped.
pub(super) struct Seat {
    seats: Arc<Seats>,
    /// The user who has it.
    pub peer: Peer,
    is_observer: bool,
    turn: Arc<Semaphore>,
}

impl Seats {
    pub(super) fn new(limits: Limits) -> Arc<Self> {
        Arc::new(Self { limits, taken: Mutex::default() })
    }

    fn lock(&self) -> MutexGuard<'_, Taken> {
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a place for a user.
    ///
    /// # Errors
    /// `TooManyClients`.
    pub(super) fn take(self: &Arc<Self>, peer: Peer) -> Result<Seat, RpcError> {
        let Limits { clients, clients_per_user, .. } = self.limits;
        let mut taken = self.lock();
        if taken.connections >= clients {
            return Err(full(format!("{clients} clients are already connected")));
        }
        let user = taken
            .users
            .entry(peer.uid)
            .or_insert_with(|| Connected { connections: 0, turn: Arc::new(Semaphore::new(1)) });
        if user.connections >= clients_per_user {
            return Err(full(format!(
                "the user with id {} already has {clients_per_user} connections",
                peer.uid
            )));
        }
        user.connections += 1;
        let turn = user.turn.clone();
        taken.connections += 1;
        Ok(Seat { seats: self.clone(), peer, is_observer: false, turn })
    }
}

impl Seat {
    /// Makes it the place of an observer.
    ///
    /// # Errors
    /// `TooManyClients`, if only those of operators are left.
    pub(super) fn observe(&mut self) -> Result<(), RpcError> {
        let Limits { clients, clients_of_operators, .. } = self.seats.limits;
        let most = clients.saturating_sub(clients_of_operators);
        let mut taken = self.seats.lock();
        if taken.observers >= most {
            return Err(full(format!(
                "{most} observers are already connected, and the other places are for operators"
            )));
        }
        taken.observers += 1;
        self.is_observer = true;
        Ok(())
    }

    /// Waits until no other call of this user computes, so that the users take turns, however many connections each has.
    pub(super) fn turn(&self) -> impl Future<Output = Option<OwnedSemaphorePermit>> + use<> {
        let turn = self.turn.clone();
        async move { turn.acquire_owned().await.ok() }
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        let mut taken = self.seats.lock();
        taken.connections -= 1;
        taken.observers -= usize::from(self.is_observer);
        if let Some(user) = taken.users.get_mut(&self.peer.uid) {
            user.connections -= 1;
            if user.connections == 0 {
                taken.users.remove(&self.peer.uid);
            }
        }
    }
}

fn full(what: String) -> RpcError {
    RpcError::new(ErrorCode::TooManyClients, format!("{what}; close one of them, or try again later"))
}
