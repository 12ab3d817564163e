//! Selects the background with which a frame is denoised.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use raysweep_transport::dots::Background;

/// Backgrounds by epoch, where an epoch has as many frames as a batch. The background of an epoch is known when all
/// frames up to the end of the epoch before the previous one are decided; earlier requests wait. It therefore never
/// depends on the threads.
pub(super) struct Backgrounds {
    frames_per_epoch: u64,
    known: Mutex<Known>,
    changed: Condvar,
}

struct Known {
    first_epoch: u64,
    backgrounds: VecDeque<Arc<Background>>,
    /// No more frames will be decided: the last background is used.
    closed: bool,
}

/// Number of epochs that may be in progress at once: frames of one, and stragglers of the previous one.
const KEPT: usize = 3;

impl Backgrounds {
    /// Starts with the background of the first two epochs.
    pub fn new(frames_per_epoch: u64, first: Arc<Background>) -> Self {
        let backgrounds = VecDeque::from([first.clone(), first]);
        let known = Known { first_epoch: 0, backgrounds, closed: false };
        Self { frames_per_epoch, known: Mutex::new(known), changed: Condvar::new() }
    }

    fn lock(&self) -> MutexGuard<'_, Known> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn epoch_of(&self, arrival: u64) -> u64 {
        arrival / self.frames_per_epoch
    }

    /// The background of an epoch; waits until it is known.
    pub fn of(&self, epoch: u64) -> Option<Arc<Background>> {
        let mut known = self.lock();
        loop {
            let at = epoch.saturating_sub(known.first_epoch) as usize;
            if let Some(background) = known.backgrounds.get(at) {
                return Some(background.clone());
            }
            if known.closed {
                return known.backgrounds.back().cloned();
            }
            known = self.changed.wait(known).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Reports that frame `arrival` and all before it are decided. If this ends an epoch, `next` returns the
    /// background of the epoch after the next one, or `None` to keep the last.
    pub fn decided(&self, arrival: u64, next: impl FnOnce() -> Option<Arc<Background>>) {
        if !(arrival + 1).is_multiple_of(self.frames_per_epoch) {
            return;
        }
        let fresh = next();
        let mut known = self.lock();
        if let Some(background) = fresh.or_else(|| known.backgrounds.back().cloned()) {
            known.backgrounds.push_back(background);
        }
        while known.backgrounds.len() > KEPT {
            known.backgrounds.pop_front();
            known.first_epoch += 1;
        }
        self.changed.notify_all();
    }

    pub fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }
}
