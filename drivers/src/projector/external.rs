//! A projector operated by a person: on another computer, or with a lens cap.
//!
//! The driver sends requests; the component that talks to the operator (a terminal, the daemon's socket) answers. The
//! driver does not ask again for what is already shown, so a sweep of many passes needs one answer.

use std::fmt;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::Duration;

use raysweep_core::{Clock, DeviceError, DeviceErrorKind, Pattern, Projector, Shown};

use super::DEVICE;

/// What the operator should show.
#[derive(Debug, Clone, PartialEq)]
pub enum WantedPicture {
    /// This pattern.
    Pattern(Pattern),
    /// No light at all.
    Dark,
}

impl fmt::Display for WantedPicture {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Pattern(pattern) => pattern.fmt(f),
            Self::Dark => write!(f, "no light at all"),
        }
    }
}

/// A request to the operator. If dropped without an answer, it counts as refused.
pub struct ShowRequest {
    /// What to show.
    pub wanted: WantedPicture,
    answer: SyncSender<Result<(), String>>,
}

impl ShowRequest {
    /// Confirms that it is shown.
    pub fn done(self) {
        // The driver no longer listens after its timeout.
        let _ = self.answer.send(Ok(()));
    }

    /// Reports that it cannot be shown, and why.
    pub fn refuse(self, why: impl Into<String>) {
        let _ = self.answer.send(Err(why.into()));
    }
}

/// Why the run cannot continue with the operator's answer.
#[derive(Debug, thiserror::Error)]
enum ExternalError {
    #[error("no operator is there to show {0}")]
    Nobody(WantedPicture),
    #[error("the operator has not shown {wanted} within {patience:?}: ask again when somebody is there")]
    Late { wanted: WantedPicture, patience: Duration },
    #[error("the operator did not show {wanted}: {why}")]
    Refused { wanted: WantedPicture, why: String },
}

/// An externally operated projector.
pub struct External {
    requests: SyncSender<ShowRequest>,
    patience: Duration,
    shown: Option<WantedPicture>,
    clock: Clock,
}

impl External {
    /// Returns the projector and the receiver of its requests.
    pub fn new(patience: Duration) -> (Self, Receiver<ShowRequest>) {
        let (requests, receiver) = sync_channel(1);
        (Self { requests, patience, shown: None, clock: Clock::real() }, receiver)
    }

    fn ask(&mut self, wanted: WantedPicture) -> Result<Shown, DeviceError> {
        if self.shown.as_ref() != Some(&wanted) {
            // Until the answer arrives, anything may be shown.
            self.shown = None;
            self.answer(&wanted).map_err(|error| {
                let kind = match error {
                    ExternalError::Nobody(_) => DeviceErrorKind::Disconnected,
                    ExternalError::Late { .. } => DeviceErrorKind::Timeout,
                    ExternalError::Refused { .. } => DeviceErrorKind::NotReady,
                };
                DeviceError::new(DEVICE, kind, error)
            })?;
            self.shown = Some(wanted);
        }
        Ok(Shown { not_before_ns: self.clock.now_ns() })
    }

    fn answer(&self, wanted: &WantedPicture) -> Result<(), ExternalError> {
        let (answer, answers) = sync_channel(1);
        let request = ShowRequest { wanted: wanted.clone(), answer };
        // A full channel holds a request that nobody has read; another request would not help.
        self.requests.try_send(request).map_err(|_error| ExternalError::Nobody(wanted.clone()))?;
        let refused = |why| ExternalError::Refused { wanted: wanted.clone(), why };
        match answers.recv_timeout(self.patience) {
            Ok(answer) => answer.map_err(refused),
            Err(RecvTimeoutError::Timeout) => {
                Err(ExternalError::Late { wanted: wanted.clone(), patience: self.patience })
            }
            Err(RecvTimeoutError::Disconnected) => Err(refused("the question was dropped".to_owned())),
        }
    }
}

impl Projector for External {
    fn show(&mut self, pattern: &Pattern) -> Result<Shown, DeviceError> {
        self.ask(WantedPicture::Pattern(pattern.clone()))
    }

    fn blank(&mut self) -> Result<Shown, DeviceError> {
        self.ask(WantedPicture::Dark)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::TryRecvError;

    const LONG: Duration = Duration::from_secs(60);

    /// Answers one request per entry of the given answers and returns the requests.
    fn operator(
        requests: Receiver<ShowRequest>,
        answers: Vec<Result<(), &'static str>>,
    ) -> std::thread::JoinHandle<(Vec<WantedPicture>, Receiver<ShowRequest>)> {
        std::thread::spawn(move || {
            let asked = answers.into_iter().map(|answer| {
                let request = requests.recv().unwrap();
                let wanted = request.wanted.clone();
                match answer {
                    Ok(()) => request.done(),
                    Err(why) => request.refuse(why),
                }
                wanted
            });
            (asked.collect(), requests)
        })
    }

    #[test]
    fn what_is_shown_is_not_asked_for_again() {
        let (mut projector, requests) = External::new(LONG);
        let operator = operator(requests, vec![Ok(()); 3]);
        let before_ns = Clock::real().now_ns();
        for _ in 0..2 {
            assert!(projector.show(&Pattern::White).unwrap().not_before_ns >= before_ns);
        }
        projector.blank().unwrap();
        projector.blank().unwrap();
        projector.show(&Pattern::White).unwrap();
        let (asked, requests) = operator.join().unwrap();
        let white = WantedPicture::Pattern(Pattern::White);
        assert_eq!(asked, [white.clone(), WantedPicture::Dark, white]);
        assert!(matches!(requests.try_recv(), Err(TryRecvError::Empty)));
    }

    #[test]
    fn a_refusal_is_told_and_asked_again() {
        let (mut projector, requests) = External::new(LONG);
        let operator = operator(requests, vec![Err("the lamp is broken"), Ok(())]);
        let error = projector.show(&Pattern::White).unwrap_err();
        assert_eq!(error.kind, DeviceErrorKind::NotReady);
        assert_eq!(error.source.to_string(), "the operator did not show a white picture: the lamp is broken");
        projector.show(&Pattern::White).unwrap();
        operator.join().unwrap();
    }

    #[test]
    fn nobody_and_no_answer_are_told_apart() {
        let (mut projector, requests) = External::new(Duration::from_millis(1));
        assert_eq!(projector.blank().unwrap_err().kind, DeviceErrorKind::Timeout);
        drop(requests);
        assert_eq!(projector.blank().unwrap_err().kind, DeviceErrorKind::Disconnected);
    }
}
