//! The thread that computes light transports from a film's frames while the next ones arrive.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use raysweep_core::{Clock, FilmSummary, Percentiles};
use raysweep_pipeline::{FilmImage, FilmSolver, PipelineError};
use raysweep_processing::film::{note_findings, write_transport};
use raysweep_proto::{Event, FilmEstimate};
use raysweep_session::film::TransportFilm;
use raysweep_transport::plane::Transport;
use serde_json::{Map, Value, json};

use crate::devices::priority;
use crate::live::{EPIPOLAR, INDIRECT, Outlet};
use crate::rig::Pace;
use crate::run::board::StatusBoard;
use crate::run::orders::{Order, Orders};
use crate::run::patience::write_patiently;

/// Capacity of the solver's queue of cycles.
const WAITING_CYCLES: usize = 4;

/// One frame of each setting, from which a transport is computed.
pub struct CycleFrames {
    /// The cycle of the newest frame.
    pub cycle: u32,
    /// The frames in the settings' order, after all stages.
    pub frames: Vec<FilmImage>,
    /// The image without light.
    pub dark: FilmImage,
    /// Start of the oldest exposure, in seconds after the film's first.
    pub start_s: f64,
    /// End of the newest exposure's last row, on the host's clock.
    pub end_ns: i64,
}

/// The film's statistics, shared by the sink and the solver.
#[derive(Default)]
pub struct Account(Mutex<Counted>);

#[derive(Default)]
struct Counted {
    summary: FilmSummary,
    /// Latencies of stored cycles, ascending.
    latencies_ms: Vec<f64>,
}

impl Account {
    /// Statistics of a film with this many cycles planned.
    pub fn new(cycles_planned: usize) -> Self {
        let summary = FilmSummary { cycles_planned, ..FilmSummary::default() };
        Self(Mutex::new(Counted { summary, latencies_ms: Vec::new() }))
    }

    fn lock(&self) -> MutexGuard<'_, Counted> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Updates the statistics.
    pub fn note(&self, change: impl FnOnce(&mut FilmSummary)) {
        change(&mut self.lock().summary);
    }

    fn note_latency(&self, latency_ms: f64) {
        let mut counted = self.lock();
        let place = counted.latencies_ms.partition_point(|&other| other <= latency_ms);
        counted.latencies_ms.insert(place, latency_ms);
        counted.summary.latency_ms = Percentiles::of_sorted(&counted.latencies_ms);
    }

    /// Summary of the film so far.
    pub fn summary(&self) -> FilmSummary {
        self.lock().summary.clone()
    }
}

/// Work that waits for the solver.
#[derive(Default)]
struct Waiting {
    cycles: VecDeque<CycleFrames>,
    /// The newest frames, and when the cycle in progress will be complete.
    sliding: Option<(CycleFrames, Instant)>,
    closed: bool,
}

#[derive(Default)]
struct Inbox {
    waiting: Mutex<Waiting>,
    changed: Condvar,
}

impl Inbox {
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether a complete cycle waits.
    fn has_cycle(&self) -> bool {
        !self.lock().cycles.is_empty()
    }

    /// The next job, and whether it is a sliding one. A sliding job starts only if it should end, after `solve_time`,
    /// before the next cycle arrives; otherwise the solver aborts it in favour of the cycle.
    fn next(&self, solve_time: Duration) -> Option<(CycleFrames, bool)> {
        let mut waiting = self.lock();
        loop {
            if let Some(cycle) = waiting.cycles.pop_front() {
                waiting.sliding = None;
                self.changed.notify_all();
                return Some((cycle, false));
            }
            if let Some((exposed, cycle_end)) = waiting.sliding.take()
                && Instant::now() + solve_time < cycle_end
            {
                return Some((exposed, true));
            }
            if waiting.closed {
                return None;
            }
            waiting = self.changed.wait(waiting).unwrap_or_else(PoisonError::into_inner);
        }
    }
}

/// Everything that the solver's thread needs.
pub struct Solving {
    /// Computes the transports.
    pub solver: FilmSolver,
    /// Where the transports of complete cycles are stored.
    pub transports: TransportFilm,
    /// Where images of them are published, if anywhere.
    pub live: Option<Outlet>,
    /// Notified of each transport.
    pub board: Arc<StatusBoard>,
    /// Counts the transports.
    pub account: Arc<Account>,
    /// Told to end the run when a write fails.
    pub orders: Arc<Orders>,
    /// Whether frames arrive in real time.
    pub pace: Pace,
}

/// Handle of the solver's thread. Dropping it ends the thread when its work is done.
pub struct Worker {
    inbox: Arc<Inbox>,
    pace: Pace,
    account: Arc<Account>,
    thread: Option<JoinHandle<raysweep_session::Result<()>>>,
}

impl Worker {
    /// Starts the thread, with its own workers: the workers that process frames must never wait for it.
    ///
    /// # Errors
    /// When the thread cannot be started.
    pub fn start(solving: Solving) -> Result<Self, PipelineError> {
        let workers = rayon::ThreadPoolBuilder::new()
            .thread_name(|index| format!("film-{index}"))
            .start_handler(|_| priority::for_computing())
            .build()
            .map_err(|error| PipelineError::Spawn { name: "film", source: error.into() })?;
        let inbox = Arc::new(Inbox::default());
        let (pace, account) = (solving.pace, solving.account.clone());
        let thread = thread::Builder::new()
            .name("film".into())
            .spawn({
                let inbox = inbox.clone();
                move || solving.run(&inbox, &workers)
            })
            .map_err(|source| PipelineError::Spawn { name: "film", source: source.into() })?;
        Ok(Self { inbox, pace, account, thread: Some(thread) })
    }

    /// Hands over a complete cycle. In real time, a cycle that finds the queue full gets no transport for now.
    pub fn cycle(&self, exposed: CycleFrames) {
        let mut waiting = self.inbox.lock();
        while waiting.cycles.len() >= WAITING_CYCLES && self.is_alive() {
            if self.pace == Pace::Devices {
                self.account.note(|film| film.transports_missing += 1);
                return;
            }
            waiting = self.inbox.changed.wait(waiting).unwrap_or_else(PoisonError::into_inner);
        }
        waiting.cycles.push_back(exposed);
        self.inbox.changed.notify_all();
    }

    /// Offers the newest frames, to be solved if there is time before `cycle_end`, when the cycle in progress is
    /// complete.
    pub fn sliding(&self, exposed: CycleFrames, cycle_end: Instant) {
        self.inbox.lock().sliding = Some((exposed, cycle_end));
        self.inbox.changed.notify_all();
    }

    fn is_alive(&self) -> bool {
        self.thread.as_ref().is_some_and(|thread| !thread.is_finished())
    }

    /// Waits until all transports are computed and stored.
    ///
    /// # Errors
    /// When a write failed, or the thread panicked.
    pub fn finish(mut self) -> raysweep_session::Result<Result<(), PipelineError>> {
        self.close();
        match self.thread.take().map(JoinHandle::join) {
            Some(Ok(stored)) => stored.map(Ok),
            Some(Err(_panic)) => Ok(Err(PipelineError::Panicked("film"))),
            None => Ok(Ok(())),
        }
    }

    fn close(&self) {
        self.inbox.lock().closed = true;
        self.inbox.changed.notify_all();
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        self.close();
        if let Some(thread) = self.thread.take() {
            // The result is only needed by callers of `finish`.
            let _ = thread.join();
        }
    }
}

impl Solving {
    fn run(mut self, inbox: &Inbox, workers: &rayon::ThreadPool) -> raysweep_session::Result<()> {
        let mut solve_time = Duration::ZERO;
        while let Some((exposed, is_sliding)) = inbox.next(solve_time) {
            let began = Instant::now();
            let CycleFrames { cycle, frames, dark, .. } = &exposed;
            let go_on = || !is_sliding || !inbox.has_cycle();
            let solved = workers.install(|| self.solver.solve(frames, dark, &go_on));
            if is_sliding && solved.is_err() && !go_on() {
                // Aborted in favour of a cycle. Remember if it took longer than those before.
                solve_time = solve_time.max(began.elapsed());
                continue;
            }
            solve_time = began.elapsed();
            let transport = match solved {
                Ok(transport) => transport,
                Err(error) => {
                    tracing::error!(%error, cycle, "no transport");
                    self.account.note(|film| film.transports_missing += usize::from(!is_sliding));
                    continue;
                }
            };
            self.publish(&exposed, is_sliding, &transport, solve_time);
            let store = || write_transport(&self.transports, *cycle as usize, &transport);
            if !is_sliding && let Err(error) = write_patiently(&self.orders, &self.board, store) {
                tracing::error!(%error, cycle, "transport not stored");
                self.orders.give(Order::Fault);
                return Err(error);
            }
            if !is_sliding && let Some(learned) = workers.install(|| self.solver.learn(frames, dark)) {
                self.account.note(|film| note_findings(film, learned));
                self.account.summary().warnings.iter().for_each(|warning| tracing::warn!("{warning}"));
            }
        }
        Ok(())
    }

    fn publish(&self, exposed: &CycleFrames, is_sliding: bool, transport: &Transport, solve_time: Duration) {
        // Rows that the settings do not tell apart are one band.
        let width_rows = if self.account.summary().one_band { 5 } else { 1 };
        let views =
            [(EPIPOLAR, transport.epipolar(width_rows)), (INDIRECT, transport.non_epipolar(width_rows))];
        if let Some(Outlet { file, session, .. }) = &self.live {
            let entries = [
                ("axes", json!(["t", "s"])),
                ("units", json!("1 = a white pixel lit by its own projector row")),
                ("session", json!(session)),
                ("cycle", json!(exposed.cycle)),
                ("sliding", json!(is_sliding)),
                ("start_s", json!(exposed.start_s)),
            ];
            let metadata: Map<String, Value> =
                entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
            for (name, image) in &views {
                if let Err(error) = file.publish(name, image.view().into_dyn(), &metadata) {
                    tracing::warn!(%error, "a view of the film is not shown");
                }
            }
        }
        let latency_ms = (self.pace == Pace::Devices)
            .then(|| Clock::real().now_ns().saturating_sub(exposed.end_ns) as f64 * 1e-6);
        if is_sliding {
            self.account.note(|film| film.sliding_estimates += 1);
        } else {
            self.account.note(|film| film.transports += 1);
            if let Some(latency_ms) = latency_ms {
                self.account.note_latency(latency_ms);
            }
        }
        let [epipolar, non_epipolar] = views.map(|(_, image)| f64::from(image.mean().unwrap_or(0.0)));
        self.board.publish(Event::Film(FilmEstimate {
            cycle: exposed.cycle,
            sliding: is_sliding,
            start_s: exposed.start_s,
            latency_ms,
            solve_ms: solve_time.as_secs_f64() * 1e3,
            epipolar,
            non_epipolar,
            // The sentences are in status and at the end.
            film: FilmSummary { findings: Vec::new(), ..self.account.summary() },
        }));
    }
}

#[cfg(test)]
mod tests {
    use raysweep_transport::plane::Setting;

    use super::*;

    fn exposed(cycle: u32) -> CycleFrames {
        let dark =
            FilmImage { setting: Setting::new(0.0, 1.0), starts_ns: Vec::new(), counts: Arc::default() };
        CycleFrames { cycle, frames: Vec::new(), dark, start_s: 0.0, end_ns: 0 }
    }

    fn slide(inbox: &Inbox, cycle: u32, left: Duration) {
        inbox.lock().sliding = Some((exposed(cycle), Instant::now() + left));
    }

    const HOUR: Duration = Duration::from_secs(3600);

    #[test]
    fn the_newest_frames_are_estimated_where_there_is_time() {
        let inbox = Inbox::default();
        slide(&inbox, 1, HOUR);
        slide(&inbox, 2, HOUR);
        let (newest, is_sliding) = inbox.next(Duration::from_secs(1800)).unwrap();
        assert_eq!((newest.cycle, is_sliding), (2, true));
        inbox.lock().closed = true;
        assert!(inbox.next(Duration::ZERO).is_none(), "each is estimated once");
    }

    #[test]
    fn frames_that_would_not_be_done_before_the_cycle_are_left() {
        let inbox = Inbox::default();
        slide(&inbox, 1, HOUR);
        inbox.lock().closed = true;
        assert!(inbox.next(2 * HOUR).is_none());
    }

    #[test]
    fn a_cycle_comes_before_sliding_frames_makes_them_old_and_stops_their_estimate() {
        let inbox = Inbox::default();
        slide(&inbox, 1, HOUR);
        assert!(!inbox.has_cycle());
        inbox.lock().cycles.push_back(exposed(1));
        assert!(inbox.has_cycle());
        let (cycle, is_sliding) = inbox.next(Duration::ZERO).unwrap();
        assert_eq!((cycle.cycle, is_sliding), (1, false));
        inbox.lock().closed = true;
        assert!(inbox.next(Duration::ZERO).is_none());
    }
}
