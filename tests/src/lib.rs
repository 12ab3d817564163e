//! Shared code of the integration tests: runs a plan on a rig in a temporary folder through the daemon's core, and
//! opens the resulting session.

pub mod dots;
pub mod monte_carlo;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use ndarray::Array2;
use raysweep::control::Control;
use raysweep::rig::{DotRig, Rig};
use raysweep::{Probes, Runner};
use raysweep_proto::{Event, ResumeParams, RunParams};
use raysweep_session::Session;
use raysweep_session::ledger::State;
use raysweep_session::stack::{ArrayName, Contents};
use tempfile::TempDir;
use tokio::sync::broadcast::Receiver;
use tokio::sync::broadcast::error::RecvError;

/// A test that has not come so far after this time hangs; a busy machine takes a minute.
pub const HUNG: Duration = Duration::from_secs(600);

/// Path of a test data file.
pub fn data(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("data").join(file)
}

/// Waits until `holds` returns true.
///
/// # Panics
/// After [`HUNG`].
pub fn wait_until(mut holds: impl FnMut() -> bool) {
    let began = Instant::now();
    while !holds() {
        assert!(began.elapsed() < HUNG, "waited in vain");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// A rig file for the simulated plane rig; `more` is appended, and `sim` goes at the start of `[sim]`.
pub fn rig_text(rows: usize, sim: &str, more: &str) -> String {
    format!(
        "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n\
         [projector]\ndriver = \"sim\"\nrows = {rows}\nrow_time_us = 22.22\n[sim]\n{sim}\n{more}"
    )
}

/// A rig file for the corner scene from the independent renderer.
pub fn corner_rig(more: &str) -> String {
    rig_text(128, &format!("scene = {:?}", data("p2r_corner.npz")), more)
}

/// A rig file for every second column of the corner scene: for tests of a minute and more, whose time is that of its
/// pixels.
pub fn half_corner_rig(rows: usize, more: &str) -> String {
    rig_text(rows, &format!("scene = {:?}", data("p2r_corner_half.npz")), more)
}

/// One product of every kind that is possible for a camera of 24 x 16 pixels and a plan with an exposure of 250 us, one
/// per line, as on the command line.
pub const PRODUCTS: [&str; 14] = [
    r#"kind = "regular""#,
    r#"kind = "epipolar""#,
    r#"kind = "epipolar", width_rows = 5"#,
    r#"kind = "non-epipolar", width_rows = 5"#,
    r#"kind = "band", from_rows = 1, to_rows = 4, side = "below", name = "just-below""#,
    r#"kind = "relight", stripes = { period_rows = 6, lit_rows = 2 }"#,
    r#"kind = "relight", line = { height_rows = 2, step_rows = 3 }, name = "line""#,
    r#"kind = "bands", from_rows = -4, to_rows = 4, width_rows = 3, step_rows = 2"#,
    r#"kind = "captured""#,
    r#"kind = "captured", delay_us = 0, exposure_us = 250"#,
    r#"kind = "cross-section", row = 11"#,
    r#"kind = "cross-section", column = 5"#,
    r#"kind = "delay-profile", pixel = [12, 8]"#,
    r#"kind = "delay-profile", region = [2, 6, 3, 9], exposure_us = 250"#,
];

/// Puts these products at the start of a plan.
pub fn with_products(products: &[&str], plan: &str) -> String {
    format!("product = [{{ {} }}]\n{plan}", products.join(" }, { "))
}

/// A daemon's core with its own temporary folder.
pub struct Bench {
    /// Folder with the rig file and the sessions.
    pub folder: TempDir,
    /// The daemon's core.
    pub runner: Arc<Runner>,
}

/// Result of a run.
#[derive(Debug, Clone)]
pub struct Ended {
    /// The session's folder.
    pub session: PathBuf,
    /// `complete`, `cancelled` or `faulted`.
    pub state: String,
    /// Error message if the run faulted.
    pub error: Option<String>,
}

impl Bench {
    /// Creates a bench with this rig.
    ///
    /// # Panics
    /// When the rig cannot be built.
    pub fn new(rig: &str) -> Self {
        Self::with_probes(rig, Probes::default())
    }

    /// Creates a bench with this rig and these probes.
    ///
    /// # Panics
    /// When the rig cannot be built.
    pub fn with_probes(rig: &str, probes: Probes) -> Self {
        let folder = TempDir::new().expect("a temporary folder");
        std::fs::write(folder.path().join("rig.toml"), rig).expect("rig.toml written");
        let runner = Arc::new(start(folder.path(), probes));
        Self { folder, runner }
    }

    /// Creates a bench with a dot rig.
    ///
    /// # Panics
    /// When the rig cannot be built.
    pub fn dots(rig: &str) -> Self {
        Self::dots_with_probes(rig, Probes::default())
    }

    /// Creates a bench with a dot rig and these probes.
    ///
    /// # Panics
    /// When the rig cannot be built.
    pub fn dots_with_probes(rig: &str, probes: Probes) -> Self {
        let folder = TempDir::new().expect("a temporary folder");
        std::fs::write(folder.path().join("rig.toml"), rig).expect("rig.toml written");
        let rig = DotRig::load(&folder.path().join("rig.toml")).unwrap_or_else(|error| panic!("{error}"));
        let runner = Runner::new(rig, folder.path().join("sessions"));
        let runner = runner.unwrap_or_else(|error| panic!("{error}")).with_probes(probes);
        Self { runner: Arc::new(runner), folder }
    }

    /// Stops the daemon's core and starts another one on the same folder.
    ///
    /// # Panics
    /// When the rig cannot be built.
    pub fn restart_with(&mut self, probes: Probes) {
        self.runner.shut_down();
        self.runner = Arc::new(start(self.folder.path(), probes));
    }

    /// Like [`Self::restart_with`], with a memory limit for the results.
    ///
    /// # Panics
    /// When the rig cannot be built.
    pub fn limit_memory(&mut self, bytes: u64, probes: Probes) {
        self.runner.shut_down();
        let runner = start(self.folder.path(), probes);
        self.runner = Arc::new(runner.with_memory_limit(bytes));
    }

    /// Runs a plan to its end.
    ///
    /// # Panics
    /// When the plan is refused.
    pub fn run(&self, plan: &str) -> Ended {
        let mut events = self.runner.events();
        let params = RunParams { plan: plan.into(), ..RunParams::default() };
        self.runner.run(params).unwrap_or_else(|error| panic!("{error}"));
        end_of(&mut events).accounted_for()
    }

    /// Acquires the missing points of a session.
    ///
    /// # Panics
    /// When the session cannot be resumed.
    pub fn resume(&self, session: &Path) -> Ended {
        let mut events = self.runner.events();
        let params = ResumeParams { session: session.into() };
        self.runner.resume(params).unwrap_or_else(|error| panic!("{error}"));
        end_of(&mut events).accounted_for()
    }
}

fn start(folder: &Path, probes: Probes) -> Runner {
    let rig = Rig::load(&folder.join("rig.toml")).unwrap_or_else(|error| panic!("{error}"));
    let runner = Runner::new(rig, folder.join("sessions"));
    runner.unwrap_or_else(|error| panic!("{error}")).with_probes(probes)
}

/// Waits until the run ends, and checks in every test that its session keeps its warnings.
///
/// # Panics
/// When the daemon's core stops first.
pub fn end_of(events: &mut Receiver<Event>) -> Ended {
    loop {
        if let Event::Finished { session, state, error, warnings, .. } = next_event(events) {
            // A full disk takes no last line.
            let last =
                Session::open(&session).and_then(|session| session.state()).ok().and_then(|state| state.end);
            assert!(last.is_none_or(|end| end.warnings == warnings), "not those of the ledger: {warnings:?}");
            return Ended { session, state, error };
        }
    }
}

/// Waits for the next event that is still there: a test that is late misses some.
///
/// # Panics
/// When the daemon's core stops first.
pub fn next_event(events: &mut Receiver<Event>) -> Event {
    loop {
        match events.blocking_recv() {
            Ok(event) => return event,
            Err(RecvError::Lagged(_)) => {}
            Err(RecvError::Closed) => panic!("the daemon's core ended before the run"),
        }
    }
}

impl Ended {
    /// Checks the accounting in every test: each trigger is in exactly one column, and each point is stored or missing.
    fn accounted_for(self) -> Self {
        let (_, state) = self.open();
        assert!(state.counts.balanced(), "{:?}", state.counts);
        let array = match state.session.shape.contents {
            Contents::Sweep { .. } => ArrayName::Sum,
            Contents::Darks { .. } => ArrayName::Dark,
            Contents::Board { .. } | Contents::Patterns { .. } => ArrayName::Sum,
            Contents::Film { .. } => {
                assert!(state.cycles().all(|cycle| cycle.counts.balanced()));
                return self;
            }
            Contents::Batches { .. } => {
                assert!(state.batches().all(|batch| batch.counts.balanced()));
                return self;
            }
            Contents::Axes { .. } => {
                assert!(state.axes().all(|axis| axis.counts.balanced()));
                return self;
            }
            Contents::Nothing => return self,
        };
        let (stored, missing) = (state.stored(array).count(), state.missing(array).count());
        assert_eq!(stored + missing, state.session.shape.points());
        assert!(state.stored(array).all(|point| point.counts.balanced()));
        self
    }

    /// Opens the session.
    ///
    /// # Panics
    /// When it cannot be read.
    pub fn open(&self) -> (Session, State) {
        let session = Session::open(&self.session).expect("a session");
        let state = session.state().expect("a ledger");
        (session, state)
    }

    /// Mean counts of a stored point, `[t, s]`.
    ///
    /// # Panics
    /// When it is not stored.
    pub fn mean(&self, array: ArrayName, index: usize) -> Array2<f64> {
        let (session, state) = self.open();
        let point = state.point(array, index).expect("stored");
        let sum = session.stack().and_then(|stack| stack.read_point(array, index)).expect("stored data");
        sum.mapv(|sum| f64::from(sum) / f64::from(point.frames))
    }
}
