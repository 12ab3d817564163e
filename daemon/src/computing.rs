//! What is computed for clients: one call at a time, on a thread that yields to capture, and not during a run.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};
use raysweep_proto::{CheckReport, ErrorCode, RpcError, RunState};

use crate::devices::priority;

/// Number of reports that are kept.
const KEPT: usize = 16;

/// The thread that computes for clients, and its latest reports.
pub struct Computing {
    thread: ThreadPool,
    /// Plans with their reports, oldest first.
    kept: Mutex<VecDeque<(String, CheckReport)>>,
}

impl Computing {
    /// Starts the thread.
    ///
    /// # Errors
    /// When the system has no thread left.
    pub fn new() -> Result<Self, ThreadPoolBuildError> {
        let thread = ThreadPoolBuilder::new()
            .num_threads(1)
            .thread_name(|_| "for-clients".into())
            .start_handler(|_| priority::for_computing())
            .build()?;
        Ok(Self { thread, kept: Mutex::default() })
    }

    /// Computes what is short enough for any time, such as a list of files. Waits for its turn.
    pub fn now<T: Send>(&self, compute: impl FnOnce() -> T + Send) -> T {
        self.thread.install(compute)
    }

    /// Computes what would take the processor from a run, and so is refused during one.
    ///
    /// # Errors
    /// Those of `compute`, and `Busy` during a run.
    pub fn between_runs<T: Send>(
        &self,
        state: impl Fn() -> RunState + Sync,
        compute: impl FnOnce() -> Result<T, RpcError> + Send,
    ) -> Result<T, RpcError> {
        // The state when its turn has come, not when it was asked for.
        self.now(|| match is_free(state()) {
            true => compute(),
            false => Err(busy("a run is in progress, and this would take the processor from it")),
        })
    }

    /// Checks a plan. During a run, only a plan that was checked before is answered, with the report of then.
    ///
    /// # Errors
    /// Those of `check`, and `Busy` during a run.
    pub fn check(
        &self,
        plan: &str,
        state: impl Fn() -> RunState + Sync,
        check: impl FnOnce() -> Result<CheckReport, RpcError> + Send,
    ) -> Result<CheckReport, RpcError> {
        if !is_free(state()) {
            let kept = self.kept();
            let found = kept.iter().find(|(of, _)| of == plan).map(|(_, report)| report.clone());
            let mut report = found.ok_or_else(|| {
                busy("a run is in progress, and only plans that were checked before it can be checked")
            })?;
            report.warnings.push(
                "this report was made before the run in progress: free memory and disk space are those of then".into(),
            );
            return Ok(report);
        }
        let report = self.between_runs(state, check)?;
        let mut kept = self.kept();
        kept.retain(|(of, _)| of != plan);
        kept.push_back((plan.to_owned(), report.clone()));
        if kept.len() > KEPT {
            kept.pop_front();
        }
        Ok(report)
    }

    /// Forgets all reports, when something that they depend on has changed.
    pub fn forget(&self) {
        self.kept().clear();
    }

    fn kept(&self) -> MutexGuard<'_, VecDeque<(String, CheckReport)>> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Whether no run is in progress.
fn is_free(state: RunState) -> bool {
    state.is_over()
}

fn busy(why: &str) -> RpcError {
    RpcError::new(ErrorCode::Busy, format!("{why}: try again after its end"))
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    fn report(points: usize) -> CheckReport {
        serde_json::from_value(serde_json::json!({
            "points": points, "frames": 1, "light_s": 1.0, "memory_bytes": 1, "memory_free_bytes": 1, "disk_bytes": 1,
            "disk_free_bytes": 1, "warnings": [], "extra_points": 0,
        }))
        .unwrap()
    }

    #[test]
    fn calls_are_made_one_at_a_time_and_yield_to_capture() {
        let computing = Computing::new().unwrap();
        let (now, most) = (AtomicUsize::new(0), AtomicUsize::new(0));
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| {
                    computing.now(|| {
                        most.fetch_max(now.fetch_add(1, Ordering::SeqCst) + 1, Ordering::SeqCst);
                        // Parallel parts stay on the same thread.
                        let names = rayon::broadcast(|_| std::thread::current().name().map(str::to_owned));
                        assert_eq!(names, [Some("for-clients".to_owned())]);
                        now.fetch_sub(1, Ordering::SeqCst);
                    });
                });
            }
        });
        assert_eq!(most.load(Ordering::SeqCst), 1);
        let nice = computing.now(|| {
            let stat = std::fs::read_to_string("/proc/thread-self/stat").unwrap();
            stat[stat.rfind(')').unwrap() + 2..].split_whitespace().nth(16).unwrap().parse::<i32>().unwrap()
        });
        assert!(nice >= 9, "proc(5): the 19th field of stat is the nice value");
    }

    #[test]
    fn during_a_run_only_what_is_known_is_answered() {
        let computing = Computing::new().unwrap();
        let (idle, running) = (|| RunState::Idle, || RunState::Running);
        let computed = || -> Result<CheckReport, RpcError> { panic!("computed during a run") };
        assert_eq!(computing.check("a", idle, || Ok(report(1))).unwrap(), report(1));
        // Without a run, everything is computed anew: a file or the free space may have changed.
        assert_eq!(computing.check("a", idle, || Ok(report(2))).unwrap(), report(2));
        let kept = computing.check("a", running, computed).unwrap();
        assert_eq!((kept.points, kept.warnings.len()), (2, 1));
        let busy =
            |result: Result<CheckReport, RpcError>| result.unwrap_err().name() == Some(ErrorCode::Busy);
        assert!(
            busy(computing.check("b", running, computed)) && busy(computing.between_runs(running, computed))
        );
        for plan in 0..KEPT {
            computing.check(&plan.to_string(), idle, || Ok(report(plan))).unwrap();
        }
        assert!(busy(computing.check("a", running, computed)), "it was the oldest");
        computing.forget();
        assert!(busy(computing.check("1", running, computed)));
    }
}
