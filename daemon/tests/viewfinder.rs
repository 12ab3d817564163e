//! The viewfinder on simulated rigs: what it shows, what clients change, and how it ends.
#![expect(clippy::unwrap_used, reason = "a helper of a test fails the test")]

mod daemon;
mod process;
mod program;

use std::process::Stdio;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use process::HUNG;
use program::Program;
use raysweep::Probes;
use raysweep::Runner;
use raysweep::control::Control;
use raysweep::live::{LiveFile, LiveReader, VIEWFINDER};
use raysweep::rig::{AnyRig, Devices, Rig};
use raysweep_core::{DeviceError, FinderPicture, Pattern, Projector, Shown};
use raysweep_processing::process as process_session;
use raysweep_proto::{
    Client, ErrorCode, Event, ResumeParams, RunParams, RunState, ViewfinderParams, ViewfinderValues,
};
use raysweep_session::Session;
use raysweep_sim::{LensControl, LensOf, PlaneTruth};
use tempfile::TempDir;
use tokio::sync::broadcast;
use tokio::sync::broadcast::error::TryRecvError;

const PLANE: &str = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n[projector]\ndriver = \"sim\"\n\
                     [sim]\nscene = \"v-groove\"\nscene_rows = 96\nscene_columns = 96\nseed = 5\n\
                     [sim.board]\nprojector_columns = [0.40, 0.475]\n";

/// A daemon's core with a viewfinder, and its events.
struct View {
    runner: Runner,
    events: broadcast::Receiver<Event>,
    folder: TempDir,
    /// What the projector was told, `None`: dark.
    told: Arc<Mutex<Vec<Option<Pattern>>>>,
    lenses: Option<LensControl>,
    truth: Option<PlaneTruth>,
}

impl View {
    fn new(rig: &str, plan: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.toml");
        std::fs::write(&path, rig).unwrap();
        let told = Arc::new(Mutex::new(Vec::new()));
        let rig = AnyRig::load(&path).unwrap();
        let simulated = match &rig {
            AnyRig::Plane(rig) => rig.simulated(),
            AnyRig::Dots(_) => None,
        };
        let (lenses, truth) = (simulated.map(|sim| sim.lenses()), simulated.map(|sim| sim.truth().clone()));
        let spy = told.clone();
        let devices = move |devices: Devices| {
            let projector = Box::new(Spied { inner: devices.projector, told: spy.clone() });
            Devices { projector, ..devices }
        };
        let live = LiveFile::create(&folder.path().join("live")).unwrap();
        let runner = Runner::new(rig, folder.path().join("sessions"))
            .unwrap()
            .with_live(live)
            .with_probes(Probes { devices: Some(Arc::new(devices)), ..Probes::default() });
        let events = runner.events();
        // Out of step with the projector, so that a camera that runs freely begins its frames anywhere in a period.
        let plan = format!("kind = \"viewfinder\"\n[viewfinder]\npictures_per_s = 29\n{plan}");
        runner.run(RunParams { plan, ..RunParams::default() }).unwrap();
        Self { runner, events, folder, told, lenses, truth }
    }

    fn event(&mut self) -> Event {
        let began = Instant::now();
        loop {
            match self.events.try_recv() {
                Ok(event) => return event,
                Err(TryRecvError::Lagged(_)) => {}
                Err(TryRecvError::Empty) => {
                    assert!(began.elapsed() < HUNG, "no event");
                    std::thread::sleep(Duration::from_millis(1));
                }
                Err(TryRecvError::Closed) => panic!("the daemon's core has ended"),
            }
        }
    }

    /// The next picture for which this holds.
    fn picture(&mut self, holds: impl Fn(&ViewfinderValues) -> bool) -> ViewfinderValues {
        let began = Instant::now();
        loop {
            match self.event() {
                Event::Viewfinder(values) if holds(&values) => return *values,
                Event::Finished { error, .. } => panic!("the viewfinder has ended: {error:?}"),
                event => assert!(began.elapsed() < HUNG, "no such picture; {event:?}"),
            }
        }
    }

    /// The state in which the run ends, and its error.
    fn end(&mut self) -> (String, Option<String>) {
        loop {
            if let Event::Finished { state, error, .. } = self.event() {
                return (state, error);
            }
        }
    }

    fn change(&self, wanted: ViewfinderParams) {
        self.runner.viewfinder(&wanted).unwrap();
    }

    fn show(&self, picture: FinderPicture) {
        self.change(ViewfinderParams { picture: Some(picture), ..ViewfinderParams::default() });
    }
}

const DOTS: &str = "kind = \"dots\"\n[camera]\ndriver = \"sim\"\n[mirror]\ndriver = \"sim\"\n\
                    [sim.dots]\nrows = 36\ncolumns = 64\n";

/// A projector that notes what it is told.
struct Spied {
    inner: Box<dyn Projector>,
    told: Arc<Mutex<Vec<Option<Pattern>>>>,
}

impl Projector for Spied {
    fn show(&mut self, pattern: &Pattern) -> Result<Shown, DeviceError> {
        self.told.lock().unwrap().push(Some(pattern.clone()));
        self.inner.show(pattern)
    }

    fn blank(&mut self) -> Result<Shown, DeviceError> {
        self.told.lock().unwrap().push(None);
        self.inner.blank()
    }
}

#[test]
fn pictures_and_their_figures_are_published_until_it_is_cancelled() {
    let mut view = View::new(PLANE, "subject = \"board\"\nregion = [10, 80, 20, 90]\n");
    let values = view.picture(|values| values.pictures == 3);
    assert_eq!((values.picture, values.region), (FinderPicture::White, [10, 80, 20, 90]));
    assert_eq!(values.histogram.iter().sum::<u64>(), 70 * 70);
    assert_eq!((values.row_cut.len(), values.column_cut.len()), (70, 70));
    // The white board gives the white level above black.
    assert!((values.mean_dn / 2564.0 - 1.0).abs() < 0.02, "{}", values.mean_dn);
    assert_eq!((values.saturated, values.underexposed), (0.0, 0.0));
    let status = view.runner.status();
    assert!(status.state == RunState::Running && status.viewfinder.is_some(), "{status:?}");

    let image =
        LiveReader::open(&view.folder.path().join("live")).unwrap().newest(VIEWFINDER).unwrap().unwrap();
    assert_eq!(image.image.shape(), [96, 96]);
    let is_close = |dn: &&f32| (**dn / 2564.0 - 1.0).abs() < 0.15;
    assert!(image.image.iter().filter(is_close).count() > 9000);
    assert_eq!(image.metadata["saturation_dn"], 0.97 * 4095.0);

    view.show(FinderPicture::Black);
    let dark = view.picture(|values| values.picture == FinderPicture::Black);
    assert!(dark.underexposed > 0.99 && dark.mean_dn < 70.0, "{dark:?}");
    view.change(ViewfinderParams { region: Some([0, 8, 0, 96]), ..ViewfinderParams::default() });
    assert_eq!(view.picture(|values| values.region == [0, 8, 0, 96]).column_cut.len(), 8);
    for (params, field) in [
        (ViewfinderParams { region: Some([0, 97, 0, 96]), ..ViewfinderParams::default() }, "region"),
        (ViewfinderParams { region: Some([5, 5, 0, 96]), ..ViewfinderParams::default() }, "region"),
        (ViewfinderParams { exposure_us: Some(f64::NAN), ..ViewfinderParams::default() }, "exposure_us"),
    ] {
        let error = view.runner.viewfinder(&params).unwrap_err();
        assert_eq!(
            (error.name(), error.data.unwrap().field.unwrap().as_str()),
            (Some(ErrorCode::InvalidParams), field)
        );
    }

    view.runner.cancel().unwrap();
    assert_eq!(view.end(), ("complete".into(), None));
    assert_eq!(view.told.lock().unwrap().last(), Some(&None), "the light is off");
    assert_eq!(view.runner.status().viewfinder, None);
    assert_eq!(
        view.runner.viewfinder(&ViewfinderParams::default()).unwrap_err().name(),
        Some(ErrorCode::NotRunning)
    );
    // It has stored when there was light, and nothing to process.
    let dir = view.runner.status().session.unwrap();
    let state = Session::open(&dir).unwrap().state().unwrap();
    assert_eq!(
        (state.session.kind.as_str(), state.stored_points(), state.missing_points()),
        ("viewfinder", 0, 0)
    );
    assert!(process_session(&dir).unwrap_err().to_string().contains("stores no images"));
    assert!(!dir.join("stack.zarr").exists());
}

#[test]
fn it_ends_with_the_daemon_and_after_its_time_with_the_light_off() {
    let mut view = View::new(PLANE, "");
    view.picture(|_| true);
    view.runner.shut_down();
    assert_eq!(view.end().0, "complete");
    assert_eq!(view.told.lock().unwrap().last(), Some(&None));
    let mut view = View::new(PLANE, "seconds = 0.2\n");
    assert_eq!(view.end(), ("complete".into(), None));
    assert_eq!(view.told.lock().unwrap().last(), Some(&None));
}

#[test]
fn a_paused_one_ends_after_its_time_too() {
    for rig in [PLANE, DOTS] {
        let mut view = View::new(rig, "seconds = 2\n");
        view.picture(|_| true);
        view.runner.pause().unwrap();
        assert_eq!(view.runner.status().state, RunState::Paused);
        assert_eq!(view.end(), ("complete".into(), None));
    }
}

#[test]
fn light_is_turned_off_in_a_pause_too_and_only_time_with_light_counts() {
    let mut view = View::new(PLANE, "seconds = 3\n");
    view.picture(|_| true);
    view.runner.pause().unwrap();
    view.show(FinderPicture::Black);
    let began = Instant::now();
    while view.told.lock().unwrap().last() != Some(&None) {
        assert!(began.elapsed() < HUNG, "the projector is still lit");
        std::thread::sleep(Duration::from_millis(1));
    }
    let lit_s = began.elapsed().as_secs_f64() + 1.0;
    assert_eq!(view.runner.status().state, RunState::Paused);
    assert_eq!(view.end(), ("complete".into(), None));
    let light_s = |view: &View| {
        let dir = view.runner.status().session.unwrap();
        Session::open(&dir).unwrap().state().unwrap().end.unwrap().light_s.unwrap()
    };
    let of_most = light_s(&view);
    assert!(of_most > 0.0 && of_most < 3.0_f64.min(lit_s + 1.0), "{of_most} s of light");
    for rig in [PLANE, DOTS] {
        let mut dark = View::new(rig, "picture = \"black\"\nseconds = 0.3\n");
        assert_eq!(dark.end(), ("complete".into(), None));
        assert_eq!(light_s(&dark), 0.0);
    }
}

#[test]
fn what_keeps_it_from_showing_more_is_said() {
    // A scene from a file is known by its rows.
    let scene = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/data/p2r_corner.npz");
    let corner = PLANE.replace("\"v-groove\"", &format!("{scene:?}"));
    let mut view = View::new(&corner, "picture = \"grid\"\n");
    let problem = view.picture(|values| values.problem.is_some()).problem.unwrap();
    assert!(problem.contains("a checkerboard") && problem.contains("known by its rows"), "{problem}");
    assert_eq!(view.picture(|values| values.pictures > 0).picture, FinderPicture::Black);
    view.show(FinderPicture::Rows);
    assert_eq!(view.picture(|values| values.picture == FinderPicture::Rows).problem, None);
    view.show(FinderPicture::Align);
    // A groove is no board, yet its rows can be seen or not: either is said.
    view.picture(|values| values.alignment.is_some() || values.problem.is_some());
    drop(view);

    let mut view = View::new(&PLANE.replace("[sim.board]", "[sim.vsync]\nmissing = 1.0\n[sim.board]"), "");
    let waits = view.picture(|values| values.problem.is_some());
    let problem = waits.problem.unwrap();
    assert!(
        problem.contains("gets no trigger") && problem.contains("viewfinder --trigger none"),
        "{problem}"
    );
    view.runner.cancel().unwrap();
    assert_eq!(view.end().0, "complete");
}

#[test]
fn a_camera_that_runs_freely_needs_neither_an_edge_nor_a_watcher() {
    // An exposure that begins in the midst of every row's light sees the rest of it a period later: of the same length
    // only without jitter.
    let steady = PLANE.replace("[sim.board]", "[sim.vsync]\njitter_us = 0\n[sim.board]");
    let without_edges = steady.replace("jitter_us = 0", "jitter_us = 0\nmissing = 1.0");
    let without_watcher = steady
        .replace(
            "[vsync]\ndriver = \"sim\"",
            "[vsync]\ndriver = \"modemline\"\nmodemline.port = \"/nowhere\"",
        )
        .replace("[sim]\n", "[sim]\nrealtime = true\n");
    for rig in [without_edges, without_watcher] {
        let mut view = View::new(&rig, "trigger = \"none\"\nsubject = \"board\"\n");
        // An exposure of a whole period sees all light of each row, wherever it begins: no row is darker than another.
        for _ in 0..15 {
            let values = view.picture(|values| values.pictures > 2);
            let cut = &values.column_cut;
            assert!((values.mean_dn / 2564.0 - 1.0).abs() < 0.02, "{}: {cut:?}", values.mean_dn);
            assert!(cut.iter().all(|dn| (2000.0..3200.0).contains(dn)), "{cut:?}");
            assert_eq!(values.problem, None);
        }
        view.show(FinderPicture::Align);
        let complaint = view.picture(|values| values.problem.is_some());
        let problem = complaint.problem.unwrap();
        assert!(problem.contains("needs trigger = \"vsync\""), "{problem}");
        // The figures beside it are those of the picture before, and named as such.
        assert_eq!(complaint.picture, FinderPicture::White);
        assert!((complaint.mean_dn / 2564.0 - 1.0).abs() < 0.02, "{}", complaint.mean_dn);
        view.show(FinderPicture::White);
        view.picture(|values| values.picture == FinderPicture::White && values.problem.is_none());
        view.runner.cancel().unwrap();
        assert_eq!(view.end(), ("complete".into(), None));
    }
}

/// That of these positions at which the mean focus score of pictures is largest.
fn sharpest(view: &mut View, lens: LensOf, positions_mm: &[f64]) -> f64 {
    let lenses = view.lenses.clone().unwrap();
    let scores: Vec<f64> = positions_mm
        .iter()
        .map(|&position_mm| {
            lenses.turn(lens, position_mm);
            // Frames before may be under way, and a score is of two pictures.
            let skipped = 3;
            let scores =
                (0..skipped + 3).map(|_| view.picture(|values| values.focus.is_some()).focus.unwrap().score);
            scores.skip(skipped).sum()
        })
        .collect();
    let best = (0..scores.len()).max_by(|&a, &b| scores[a].total_cmp(&scores[b])).unwrap();
    positions_mm[best]
}

#[test]
fn the_focus_score_is_largest_where_the_lens_is_in_focus() {
    let lenses = "[sim.camera.lens]\nposition_mm = 9.0\nfocus_mm = 8.37\ndepth_of_field_mm = 0.6\n\
                  [sim.projector.lens]\nposition_mm = -2.0\nfocus_mm = -2.13\ndepth_of_field_mm = 0.4\n";
    let mut view = View::new(&format!("{PLANE}{lenses}"), "subject = \"board\"\npicture = \"grid\"\n");
    let positions =
        |middle: f64, step: f64| (-12..=12).map(|i| middle + step * f64::from(i)).collect::<Vec<_>>();
    // Steps that meet the focus of neither.
    let found = sharpest(&mut view, LensOf::Camera, &positions(8.30, 0.055));
    assert!((found - 8.37).abs() < 0.06, "{found}");
    view.lenses.as_ref().unwrap().turn(LensOf::Camera, 8.37);
    let found = sharpest(&mut view, LensOf::Projector, &positions(-2.05, 0.035));
    assert!((found + 2.13).abs() < 0.04, "{found}");
}

#[test]
fn the_align_aid_measures_a_misalignment_to_a_tenth_of_a_row() {
    let truth = "[sim.truth]\nrow_offset_rows = 0.4\nrotation_deg = 0.2\nmagnification = 1.01\n";
    let rig = format!("{PLANE}{truth}");
    let mut view = View::new(&rig, "subject = \"board\"\npicture = \"align\"\n");
    let found = view.picture(|values| values.alignment.is_some()).alignment.unwrap();
    let truth = view.truth.clone().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("rig.toml");
    std::fs::write(&path, &rig).unwrap();
    let first_row = Rig::load(&path).unwrap().simulated().unwrap().first_row() as f64;
    // Everywhere in the picture, what was found leads to the row that the pixel truly sees.
    let worst = (0..96 * 96)
        .map(|pixel| {
            let (t, s) = (pixel / 96, pixel % 96);
            let (down, right) = (t as f64 - 47.5, s as f64 - 47.5);
            let off = found.shift_rows
                + found.rotation_deg.to_radians().tan() * right
                + (found.magnification - 1.0) * down;
            (first_row + t as f64 + off - truth.place(t, s)).abs()
        })
        .fold(0.0, f64::max);
    println!("{found:?}, at most {worst:.3} rows off");
    assert!(worst < 0.1, "{found:?}: {worst} rows off");
    assert!((found.shift_rows - 0.4).abs() < 0.05 && (found.rotation_deg - 0.2).abs() < 0.05, "{found:?}");
    assert!((found.magnification - 1.01).abs() < 0.001 && found.residual_rows < 0.1, "{found:?}");
    assert_eq!(found.advice.len(), 3, "{found:?}");
    // It is measured again and again, without a score of pictures that differ.
    let again = view.picture(|values| values.alignment.as_ref().is_some_and(|found| found.measured == 2));
    assert_eq!((again.picture, again.focus), (FinderPicture::Align, None));
}

#[test]
fn the_dot_of_a_dot_rig_has_its_place_size_and_peak() {
    let mut view = View::new(DOTS, "");
    let dot = view.picture(|values| values.dot.is_some()).dot.unwrap();
    println!("{dot:?}");
    // The rig's dot is 0.42 degrees wide, and its 9.27 degrees fill 64 columns. The mirror at rest points at the middle,
    // where the groove's sides do not send back the same light.
    assert!((dot.fwhm_px / (0.42 / 9.27 * 64.0) - 1.0).abs() < 0.15, "{dot:?}");
    assert!(
        (dot.row - 17.5).abs() < 3.0 && (dot.column - 31.5).abs() < 3.0 && dot.peak_dn > 100.0,
        "{dot:?}"
    );
    view.show(FinderPicture::Black);
    let dark = view.picture(|values| values.picture == FinderPicture::Black);
    assert_eq!(dark.dot, None);
    let align = ViewfinderParams { picture: Some(FinderPicture::Align), ..ViewfinderParams::default() };
    let refused = view.runner.viewfinder(&align).unwrap_err();
    assert!(
        refused.name() == Some(ErrorCode::InvalidParams) && refused.message.contains("no rows"),
        "{refused:?}"
    );
    view.runner.cancel().unwrap();
    assert_eq!(view.end(), ("complete".into(), None));
    let mut tilted = View::new(DOTS, "tilt_deg = [1.0, 0.0]\n");
    let moved = tilted.picture(|values| values.dot.is_some()).dot.unwrap();
    assert!((moved.column - dot.column).abs() > 3.0, "{dot:?} and {moved:?}");
}

#[test]
fn a_plane_rig_has_no_light_to_permit() {
    let program = Program::start(PLANE);
    let refused = program.raysweep(&["arm-light"]);
    let said = String::from_utf8(refused.stderr).unwrap();
    assert!(refused.status.code() == Some(5) && said.contains("this rig has no mirror"), "{said}");
}

#[test]
fn a_viewfinder_ends_with_its_client_however_that_ends() {
    for signal in [Signal::SIGINT, Signal::SIGTERM, Signal::SIGHUP] {
        let program = Program::start(PLANE);
        let mut client = Client::connect(program.folder.path().join("socket")).unwrap();
        let mut command = program.command(&["viewfinder"]);
        let mut viewfinder = process::Process::start(command.stdout(Stdio::null()).stderr(Stdio::null()));
        process::wait_for("a picture", || client.status().unwrap().viewfinder);
        viewfinder.signal(signal);
        viewfinder.wait();
        assert_eq!(client.status().unwrap().state, RunState::Idle, "{signal}");
    }
}

/// Somebody else may go on with a session that was begun by a client that is still there.
#[test]
fn a_resumed_run_does_not_end_with_the_client_that_began_the_session() {
    let mut view = View::new(PLANE, "");
    view.runner.cancel().unwrap();
    view.end();
    let plan = "kind = \"sweep\"\n[sweep]\ndelay_us = [-200, -100, 0, 100, 200]\nexposure_us = [400]\naverage = 100\n";
    let params = RunParams { plan: plan.into(), attached: true, ..RunParams::default() };
    let session = view.runner.run(params).unwrap().session;
    view.runner.abandon(&session);
    assert_eq!(view.end().0, "cancelled");
    view.runner.resume(ResumeParams { session: session.clone() }).unwrap();
    view.runner.abandon(&session);
    assert_eq!(view.end().0, "complete");
}

#[test]
fn a_viewfinder_ends_when_its_client_is_stopped_and_takes_no_events_any_more() {
    let program = Program::start(PLANE);
    let mut client = Client::connect(program.folder.path().join("socket")).unwrap();
    let mut command = program.command(&["viewfinder"]);
    let viewfinder = process::Process::start(command.stdout(Stdio::null()).stderr(Stdio::null()));
    process::wait_for("a picture", || client.status().unwrap().viewfinder);
    viewfinder.signal(Signal::SIGSTOP);
    let began = std::time::Instant::now();
    process::wait_for("its end", || (client.status().unwrap().state == RunState::Idle).then_some(()));
    println!("ended after {:?}", began.elapsed());
}

#[test]
fn a_viewfinder_ends_when_its_client_is_killed_unless_it_was_detached() {
    let program = Program::start(PLANE);
    let mut client = Client::connect(program.folder.path().join("socket")).unwrap();
    program.plan("kind = \"viewfinder\"\n");
    for words in [["viewfinder"].as_slice(), &["run", "plan.toml"]] {
        let mut command = program.command(words);
        let mut viewfinder = process::Process::start(command.stdout(Stdio::null()).stderr(Stdio::null()));
        process::wait_for("a picture", || client.status().unwrap().viewfinder);
        viewfinder.signal(Signal::SIGKILL);
        viewfinder.wait();
        process::wait_for("its end", || (client.status().unwrap().state == RunState::Idle).then_some(()));
    }
    assert!(program.raysweep(&["viewfinder", "--detach"]).status.success());
    // Its second picture comes long after its client has gone.
    let pictures = |client: &mut Client| client.status().unwrap().viewfinder.map_or(0, |seen| seen.pictures);
    let first = pictures(&mut client);
    process::wait_for("pictures", || (pictures(&mut client) > first + 3).then_some(()));
    client.cancel().unwrap();
}
