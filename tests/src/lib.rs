//! What the tests of the whole have in common: a rig and a plan in a folder of their own, run through the daemon's
//! core, and the session that comes out.

pub mod dots;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use ndarray::Array2;
use raysweep::control::Control;
use raysweep::rig::{DotRig, Rig};
use raysweep::run::Runner;
use raysweep_pipeline::Registry;
use raysweep_proto::{Event, ResumeParams, RunParams};
use raysweep_session::Session;
use raysweep_session::ledger::State;
use raysweep_session::stack::ArrayName;
use tempfile::TempDir;

/// The folder of the tests' data.
pub fn data(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("data").join(file)
}

/// Waits for something that comes soon.
///
/// # Panics
/// If it has not come after a minute.
pub fn wait_until(mut holds: impl FnMut() -> bool) {
    let began = Instant::now();
    while !holds() {
        assert!(began.elapsed() < Duration::from_secs(60), "waited in vain");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// A rig file for the simulated plane rig; `more` is appended, `sim` stands at the head of `[sim]`.
pub fn rig_text(rows: usize, sim: &str, more: &str) -> String {
    format!(
        "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n\
         [projector]\ndriver = \"sim\"\nrows = {rows}\nrow_time_us = 22.22\n[sim]\n{sim}\n{more}"
    )
}

/// The rig of the rendered corner scene.
pub fn corner_rig(more: &str) -> String {
    rig_text(128, &format!("scene = {:?}", data("p2r_corner.npz")), more)
}

/// Products of every kind that a camera of 24 x 16 pixels and a plan with an exposure of 250 us can have; one line each,
/// as on the command line.
pub const PRODUCTS: [&str; 9] = [
    r#"kind = "regular""#,
    r#"kind = "epipolar""#,
    r#"kind = "epipolar", width_rows = 5"#,
    r#"kind = "non-epipolar", width_rows = 5"#,
    r#"kind = "band", from_rows = 1, to_rows = 4, side = "below", name = "just-below""#,
    r#"kind = "relight", stripes = { period_rows = 6, lit_rows = 2 }"#,
    r#"kind = "relight", line = { height_rows = 2, step_rows = 3 }, name = "line""#,
    r#"kind = "delay-profile", pixel = [12, 8]"#,
    r#"kind = "delay-profile", region = [2, 6, 3, 9], exposure_us = 250"#,
];

/// A plan with these products at its head.
pub fn with_products(products: &[&str], plan: &str) -> String {
    format!("product = [{{ {} }}]\n{plan}", products.join(" }, { "))
}

/// A daemon's core over a folder of its own.
pub struct Bench {
    /// Rig file and sessions.
    pub folder: TempDir,
    /// The daemon's core.
    pub runner: Arc<Runner>,
}

/// How a run ended.
#[derive(Debug, Clone)]
pub struct Ended {
    /// Its session.
    pub session: PathBuf,
    /// `complete`, `cancelled`, `faulted`.
    pub state: String,
    /// Why it faulted.
    pub error: Option<String>,
}

impl Bench {
    /// A bench with this rig.
    ///
    /// # Panics
    /// When the rig cannot be built.
    pub fn new(rig: &str) -> Self {
        Self::with_registry(rig, Registry::default())
    }

    /// A bench with this rig and these stages.
    ///
    /// # Panics
    /// When the rig cannot be built.
    pub fn with_registry(rig: &str, registry: Registry) -> Self {
        let folder = TempDir::new().expect("a temporary folder");
        std::fs::write(folder.path().join("rig.toml"), rig).expect("rig.toml written");
        let runner = Arc::new(start(folder.path(), registry));
        Self { folder, runner }
    }

    /// A bench with a dot rig.
    ///
    /// # Panics
    /// When the rig cannot be built.
    pub fn dots(rig: &str) -> Self {
        Self::dots_with_registry(rig, Registry::default())
    }

    /// A bench with a dot rig and these stages.
    ///
    /// # Panics
    /// When the rig cannot be built.
    pub fn dots_with_registry(rig: &str, registry: Registry) -> Self {
        let folder = TempDir::new().expect("a temporary folder");
        std::fs::write(folder.path().join("rig.toml"), rig).expect("rig.toml written");
        let rig = DotRig::load(&folder.path().join("rig.toml")).unwrap_or_else(|error| panic!("{error}"));
        let runner = Runner::new(rig, folder.path().join("sessions"), registry);
        Self { runner: Arc::new(runner.unwrap_or_else(|error| panic!("{error}"))), folder }
    }

    /// Ends the daemon's core and starts another over the same folder.
    ///
    /// # Panics
    /// When the rig cannot be built.
    pub fn restart_with(&mut self, registry: Registry) {
        self.runner.shut_down();
        self.runner = Arc::new(start(self.folder.path(), registry));
    }

    /// As [`Self::restart_with`], with results that may take so much memory.
    ///
    /// # Panics
    /// When the rig cannot be built.
    pub fn limit_memory(&mut self, bytes: u64, registry: Registry) {
        self.runner.shut_down();
        let runner = start(self.folder.path(), registry);
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

    /// Acquires what a session lacks.
    ///
    /// # Panics
    /// When the session is refused.
    pub fn resume(&self, session: &Path) -> Ended {
        let mut events = self.runner.events();
        let params = ResumeParams { session: session.into() };
        self.runner.resume(params).unwrap_or_else(|error| panic!("{error}"));
        end_of(&mut events).accounted_for()
    }
}

fn start(folder: &Path, registry: Registry) -> Runner {
    let rig = Rig::load(&folder.join("rig.toml")).unwrap_or_else(|error| panic!("{error}"));
    let runner = Runner::new(rig, folder.join("sessions"), registry);
    runner.unwrap_or_else(|error| panic!("{error}"))
}

/// Waits for the end of the run.
///
/// # Panics
/// When the daemon's core ends first.
pub fn end_of(events: &mut tokio::sync::broadcast::Receiver<Event>) -> Ended {
    use tokio::sync::broadcast::error::RecvError;
    loop {
        match events.blocking_recv() {
            Ok(Event::Finished { session, state, error, .. }) => return Ended { session, state, error },
            Ok(_) | Err(RecvError::Lagged(_)) => {}
            Err(RecvError::Closed) => panic!("the daemon's core ended before the run"),
        }
    }
}

impl Ended {
    /// Holds the accounting, whatever the test is about: every trigger in one column, every point stored or missing.
    fn accounted_for(self) -> Self {
        let (_, state) = self.open();
        assert!(state.counts.balanced(), "{:?}", state.counts);
        if state.session.shape.is_batches() {
            assert!(state.batches().all(|batch| batch.counts.balanced()));
            return self;
        }
        if state.session.shape.is_axes() {
            assert!(state.axes().all(|axis| axis.counts.balanced()));
            return self;
        }
        if state.session.shape.is_film() {
            assert!(state.cycles().all(|cycle| cycle.counts.balanced()));
            return self;
        }
        let (stored, missing) = (state.stored(ArrayName::Sum).count(), state.missing(ArrayName::Sum).count());
        assert_eq!(stored + missing, state.session.shape.points);
        assert!(state.stored(ArrayName::Sum).all(|point| point.counts.balanced()));
        self
    }

    /// The session on disk.
    ///
    /// # Panics
    /// When it cannot be read.
    pub fn open(&self) -> (Session, State) {
        let session = Session::open(&self.session).expect("a session");
        let state = session.state().expect("a ledger");
        (session, state)
    }

    /// The mean counts of a stored point, `[t, s]`.
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
