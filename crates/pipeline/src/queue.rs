//! The bounded queue between the device threads and the assembler.

pub use crossbeam_channel::Receiver;
use crossbeam_channel::{Sender, TrySendError, bounded};

/// What happens to an item when the queue is full.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Policy {
    /// The sender waits: for simulation and replay, whose source can wait.
    Wait,
    /// The item is returned to its owner, who counts it: for real cameras, where the point is repeated.
    Fail,
}

/// Why an item did not enter the queue.
#[derive(Debug, thiserror::Error)]
pub enum QueueError<T> {
    /// The queue is full, with [`Policy::Fail`].
    #[error("the queue is full")]
    Full(T),
    /// The receiver is gone.
    #[error("the receiving thread has ended")]
    Closed,
}

/// The sending side. A clone sends into the same queue.
pub struct Input<T> {
    sender: Sender<T>,
    policy: Policy,
}

impl<T> Clone for Input<T> {
    fn clone(&self) -> Self {
        Self { sender: self.sender.clone(), policy: self.policy }
    }
}

impl<T> Input<T> {
    /// A queue of at most `capacity` items.
    pub fn new(capacity: usize, policy: Policy) -> (Self, Receiver<T>) {
        let (sender, receiver) = bounded(capacity);
        (Self { sender, policy }, receiver)
    }

    /// Sends an item that may be refused, according to the queue's policy.
    ///
    /// # Errors
    /// `Full` with [`Policy::Fail`]; `Closed` if the receiver is gone.
    pub fn offer(&self, item: T) -> Result<(), QueueError<T>> {
        if self.policy == Policy::Wait {
            return self.send(item);
        }
        match self.sender.try_send(item) {
            Ok(()) => Ok(()),
            Err(TrySendError::Full(item)) => Err(QueueError::Full(item)),
            Err(TrySendError::Disconnected(_)) => Err(QueueError::Closed),
        }
    }

    /// Sends an item that must arrive; waits for room.
    ///
    /// # Errors
    /// `Closed` if the receiver is gone.
    pub fn send(&self, item: T) -> Result<(), QueueError<T>> {
        self.sender.send(item).map_err(|_closed| QueueError::Closed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_policy_does_what_it_says_when_full() {
        let (input, receiver) = Input::new(1, Policy::Fail);
        input.offer(1).unwrap();
        assert!(matches!(input.offer(2), Err(QueueError::Full(2))));
        drop(receiver);
        assert!(matches!(input.offer(3), Err(QueueError::Closed)));

        let (input, receiver) = Input::new(1, Policy::Wait);
        let sender = std::thread::spawn(move || (0..100).for_each(|i| input.offer(i).unwrap()));
        assert_eq!(receiver.iter().collect::<Vec<_>>(), (0..100).collect::<Vec<_>>());
        sender.join().unwrap();
    }
}
