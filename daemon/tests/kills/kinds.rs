//! The kinds of sessions whose runs are killed.

/// A rig and a plan.
pub struct Kind {
    pub name: &'static str,
    pub rig: String,
    pub plan: &'static str,
    /// What is run before it, so that the data folder has its calibration.
    pub before: Option<&'static str>,
    /// Whether a run that was killed is resumed; otherwise, what it stored is processed.
    pub is_resumable: bool,
    /// Text of the plan, and what takes its place before the session is processed.
    pub edit: Option<[&'static str; 2]>,
}

/// 8 x 8 pixels, and all faults whose effects could differ after a crash.
const PLANE: &str = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n\
                     [projector]\ndriver = \"sim\"\nrows = 8\n\
                     [sim]\nscene = \"v-groove\"\nscene_rows = 8\nscene_columns = 8\nseed = 11\n\
                     [sim.vsync]\nmissing = 0.02\nfalse_edges = 0.02\nunseen = 0.02\n\
                     [sim.camera]\nlate_frames_max = 3\ndropped = 0.02\n\
                     [sim.ambient]\nlevel = 0.001\nflicker = 0.5\nphase = \"drawn\"\n\
                     [sim.projector]\nphase_jitter_us = 5\n";
const BOARD: &str = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n\
                     [projector]\ndriver = \"sim\"\nrows = 720\nrow_time_us = 22.22\n\
                     [sim]\nscene_rows = 96\nscene_columns = 48\n";
const DOTS: &str = "kind = \"dots\"\n[camera]\ndriver = \"sim\"\n[mirror]\ndriver = \"sim\"\n\
                    [sim.dots]\nscene = \"v-groove\"\nrows = 112\ncolumns = 128\nmargin_rows = 16\nseed = 5\n";
const RESONANT: &str = "[sim.dots.mirror]\nf0_hz = [500, 480]\nq = [30, 22]\nfilter_hz = 5000\n";

const SWEEP: &str = "kind = \"sweep\"\nname = \"crash\"\n[sweep]\naverage = 2\n\
                     delay_us = [-60, 0, 60]\nexposure_us = [50, 100, 150]\n\
                     [[product]]\nkind = \"regular\"\n[[product]]\nkind = \"epipolar\"\nwidth_rows = 3\n";
const ON_BOARD: &str =
    "kind = \"sweep\"\n[sweep]\naverage = 2\ndelay_us = [-300, 0, 300]\nexposure_us = [500]\n";
const FILM: &str = "kind = \"film\"\n[film]\ncycles = 12\ndelay_us = [-60, 0, 60]\nexposure_us = 50\n";
const BATCHES: &str = "kind = \"batches\"\nproduct = [{ kind = \"floodlit\" }]\n[batches]\ncount = 4\ndots = 60\n\
                       exposure_us = 100\ndark_frames = 64\ntrailing_region = [112, 128, 48, 80]\n\
                       background_indices = [0]\ncalibration = []\n[batches.path]\nshape = \"lissajous\"\n\
                       cycles = [7, 1]\namplitude_deg = [2.3, 1.3]\nsamples = 1500\nrate_hz = 30000\n";
const DARKS: &str = "kind = \"darks\"\n[darks]\nexposure_us = [50, 100, 150, 200]\nframes = 8\n";
const PATTERNS: &str = "kind = \"patterns\"\n[patterns]\nexposure_us = [100]\naverage = 2\n\
                        [[pattern]]\nkind = \"gray-code\"\n[[pattern]]\nkind = \"checkerboard\"\nsize_px = 4\nshifts = 32\n";
const CALIBRATION: &str =
    "kind = \"calibration\"\n[calibration]\nframes = 8\npicture_frames = 2\ndelays = 40\n";
const RESPONSE: &str = "kind = \"response\"\n[response]\nchirp_s = 0.2\nrest_s = 0.1\nrate_hz = 30000\n\
                        camera_rate_hz = 4000\nexposure_us = 100\ndark_frames = 64\nregion = [0, 112, 0, 128]\n";

/// All kinds.
pub fn kinds() -> Vec<Kind> {
    let resumable = |name, rig: &str, plan| Kind {
        name,
        rig: rig.to_owned(),
        plan,
        before: None,
        is_resumable: true,
        edit: None,
    };
    let past = |name, rig: &str, plan| Kind { is_resumable: false, ..resumable(name, rig, plan) };
    let failing = PLANE.replace("0.02", "0.06").replace("seed = 11", "seed = 14");
    // Those that take longest come first, because two are tried at a time.
    vec![
        resumable("calibration", BOARD, CALIBRATION),
        past("response", &format!("{DOTS}{RESONANT}"), RESPONSE),
        Kind { edit: Some(["width_rows = 3", "width_rows = 5"]), ..resumable("sweep", PLANE, SWEEP) },
        resumable("failing points", &failing, SWEEP),
        Kind { before: Some(CALIBRATION), ..resumable("calibrated sweep", BOARD, ON_BOARD) },
        resumable("patterns", PLANE, PATTERNS),
        resumable("darks", PLANE, DARKS),
        past("film", PLANE, FILM),
        past("batches", DOTS, BATCHES),
    ]
}
