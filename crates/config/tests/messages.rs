//! What users read about faulty rig and plan files. The cases assert which fields are refused, each with a place in the
//! text; the snapshots hold the messages.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::fmt::Write;

use raysweep_config::plan::products_of_argument;
use raysweep_config::{AnyRigFile, ConfigError, DotRigFile, Plan, RigFile};

/// A faulty file: what is wrong, its text, and the fields of its mistakes in their order; `-` is none.
type Case = (&'static str, String, &'static [&'static str]);

/// Reads the faulty files, checks the fields of their mistakes, and returns the messages as they are shown.
fn messages<T>(file: &str, parse: impl Fn(&str) -> Result<T, ConfigError>, cases: &[Case]) -> String {
    let mut shown = String::new();
    let mut others = Vec::new();
    for (name, text, fields) in cases {
        let Err(error) = parse(text) else { panic!("{name}: nothing is wrong with {text:?}") };
        let found: Vec<_> = error.mistakes().map(|mistake| mistake.field.as_deref().unwrap_or("-")).collect();
        if found != *fields {
            others.push(format!("{name}: {found:?}, not {fields:?}: {error}"));
        }
        assert!(error.mistakes().all(|mistake| mistake.span.is_some()), "{name} has no place");
        writeln!(shown, "# {name}\n{}\n", error.render(file, text)).unwrap();
    }
    assert!(others.is_empty(), "{}", others.join("\n"));
    shown
}

const PLANE: &str = "\
kind = \"plane\"
[camera]
driver = \"sim\"
[vsync]
driver = \"sim\"
[projector]
driver = \"sim\"
";

const DOTS: &str = "\
kind = \"dots\"
[camera]
driver = \"sim\"
[mirror]
driver = \"sim\"
";

/// The file with these lines in one of its tables. They replace the table's driver if they name one.
fn with(file: &str, table: &str, lines: &str) -> String {
    let header = format!("[{table}]\ndriver = \"sim\"\n");
    assert!(file.contains(&header), "{table}");
    let kept = if lines.starts_with("driver") { format!("[{table}]\n") } else { header.clone() };
    file.replace(&header, &format!("{kept}{lines}\n"))
}

#[test]
fn five_range_mistakes_in_three_tables_are_five_places() {
    let text = with(PLANE, "camera", "reopen_s = -1\nwhite_dn = 0");
    let text = with(&text, "vsync", "period_us = 5\ngate_us = 0");
    let text = with(&text, "projector", "beam_sigma_rows = -1");
    let cases: [Case; _] = [(
        "five values out of range",
        text,
        &[
            "camera.reopen_s",
            "camera.white_dn",
            "vsync.period_us",
            "vsync.gate_us",
            "projector.beam_sigma_rows",
        ],
    )];
    insta::assert_snapshot!(messages("rig.toml", RigFile::parse, &cases));
}

#[test]
fn plane_rig() {
    let camera = |lines: &str| with(PLANE, "camera", lines);
    let vsync = |lines: &str| with(PLANE, "vsync", lines);
    let projector = |lines: &str| with(PLANE, "projector", lines);
    let aravis = |lines: &str| camera(&format!("driver = \"aravis\"\naravis.name = \"b\"\n{lines}"));
    let v4l2 =
        |lines: &str| camera(&format!("driver = \"v4l2\"\nv4l2.width = 640\nv4l2.height = 360\n{lines}"));
    let fx2lafw = |lines: &str| vsync(&format!("driver = \"fx2lafw\"\n{lines}"));
    let table = |row_table: &str| projector(&format!("rows = 3\nrow_table = {row_table}"));
    let cases: [Case; _] = [
        ("a value is missing", "kind =\n".into(), &["-"]),
        ("a key is given twice", camera("reopen_s = 1\nreopen_s = 2"), &["-"]),
        ("a table is not closed", PLANE.replace("[vsync]", "[vsync"), &["-"]),
        ("the file is empty", String::new(), &["kind"]),
        ("another kind of rig", PLANE.replace("plane", "dots"), &["kind"]),
        ("unknown kind", PLANE.replace("plane", "plan"), &["kind"]),
        ("unknown table", format!("{PLANE}[laser]\n"), &["laser"]),
        ("no [vsync]", PLANE.replace("[vsync]\ndriver = \"sim\"\n", ""), &["vsync"]),
        ("no driver", PLANE.replace("[vsync]\ndriver = \"sim\"\n", "[vsync]\n"), &["vsync"]),
        ("unknown driver", vsync("driver = \"fx3\""), &["vsync.driver"]),
        ("unknown projector", projector("driver = \"nobody\""), &["projector.driver"]),
        ("unknown key", camera("gain = 3"), &["camera.gain"]),
        ("unknown key of a driver", camera("aravis.nam = \"a\""), &["camera.aravis.nam"]),
        ("unknown key of [sim]", camera("[sim.camera]\nlate = 3"), &["sim.camera.late"]),
        (
            "a number for a table",
            PLANE.replace("[vsync]\ndriver = \"sim\"\n", "").replacen('\n', "\nvsync = 3\n", 1),
            &["vsync"],
        ),
        ("a text for a number", camera("row_pitch = \"1\""), &["camera.row_pitch"]),
        ("a fraction for a whole number", projector("rows = 1.5"), &["projector.rows"]),
        ("a negative whole number", camera("[sim]\nseed = -1"), &["sim.seed"]),
        ("too large a whole number", camera("[sim.sensor]\nadc_bits = 5000000000"), &["sim.sensor.adc_bits"]),
        ("a number for a text", camera("aravis.name = 3"), &["camera.aravis.name"]),
        ("a number for a path", vsync("driver = \"pps\"\npps.source = 3"), &["vsync.pps.source"]),
        ("a number for a list", camera("aravis.features = 3"), &["camera.aravis.features"]),
        ("too short a list", camera("aravis.binning = [1]"), &["camera.aravis.binning"]),
        ("a number for a flag", camera("[sim]\nrealtime = 1"), &["sim.realtime"]),
        ("a text for a pair", v4l2("v4l2.controls = [\"gain\"]"), &["camera.v4l2.controls.0"]),
        ("unknown beam", camera("[sim.projector]\nbeam.kind = \"round\""), &["sim.projector.beam.kind"]),
        ("a beam without its kind", camera("[sim.projector]\nbeam.rows = 1"), &["sim.projector.beam"]),
        ("too short a period", vsync("period_us = 5"), &["vsync.period_us"]),
        ("a modem line without its table", vsync("driver = \"modemline\""), &["vsync.driver"]),
        ("a PPS source without its table", vsync("driver = \"pps\""), &["vsync.driver"]),
        ("a triggerbox without its table", vsync("driver = \"triggerbox\""), &["vsync.driver"]),
        ("no such sample rate", fx2lafw("fx2lafw.sample_rate_hz = 7"), &["vsync.fx2lafw.sample_rate_hz"]),
        ("no input for the VSYNC", fx2lafw("fx2lafw.channels.light = 0"), &["vsync.fx2lafw.channels"]),
        ("whites beyond full scale", camera("white_dn = 5000"), &["camera.white_dn"]),
        ("no electrons per count", camera("electrons_per_dn = 0"), &["camera.electrons_per_dn"]),
        ("negative noise", camera("read_noise_e = -1"), &["camera.read_noise_e"]),
        ("rows at another speed", camera("row_time_us = 30"), &["camera.row_time_us"]),
        ("a pitch at another speed", camera("row_pitch = 2\nrow_time_us = 22.22"), &["camera.row_time_us"]),
        ("no pitch", camera("row_pitch = 0"), &["camera.row_pitch"]),
        ("unknown pixel format", camera("pixel_format = \"Mono13\""), &["camera.pixel_format"]),
        ("no such projector row", camera("first_projector_row = 720"), &["camera.first_projector_row"]),
        ("no such columns", camera("projector_columns = [0, 1.5]"), &["camera.projector_columns"]),
        ("a negative wait", camera("reopen_s = -1"), &["camera.reopen_s"]),
        ("no camera is named", camera("driver = \"aravis\""), &["camera.aravis.address"]),
        ("the camera is named twice", aravis("aravis.address = \"10.0.0.2\""), &["camera.aravis.address"]),
        ("a feature without a value", aravis("aravis.features = [\"Gain\"]"), &["camera.aravis.features"]),
        ("no binning", aravis("aravis.binning = [2, 0]"), &["camera.aravis.binning"]),
        ("no pixels", aravis("aravis.region = { width = 0, height = 4 }"), &["camera.aravis.region"]),
        ("no latency", aravis("aravis.trigger_latency_us = nan"), &["camera.aravis.trigger_latency_us"]),
        ("a negative readout", aravis("aravis.readout_us = -1"), &["camera.aravis.readout_us"]),
        ("a least above the most", aravis("aravis.late_frames_min = 4"), &["camera.aravis.late_frames_min"]),
        ("too small a packet", aravis("aravis.packet_size = 100"), &["camera.aravis.packet_size"]),
        ("a V4L2 camera without its table", camera("driver = \"v4l2\""), &["camera.driver"]),
        ("too few buffers", v4l2("v4l2.device = \"a\"\nv4l2.buffers = 1"), &["camera.v4l2.buffers"]),
        ("a device that is no path", v4l2("v4l2.device = \"a\\u0000\""), &["camera.v4l2.device"]),
        ("no time for the rows", projector("rows = 1000"), &["projector.row_time_us"]),
        ("no row time", projector("row_time_us = nan"), &["projector.row_time_us"]),
        ("no rows", projector("rows = 0"), &["projector.rows"]),
        ("a negative beam", projector("beam_sigma_rows = -1"), &["projector.beam_sigma_rows"]),
        ("a scan without a spot", projector("scan = \"one-way\""), &["projector.scan"]),
        (
            "a simulated spot on a finer camera",
            camera("row_pitch = 0.5\n[sim.projector]\nspot = \"one-way\""),
            &["sim.projector.spot"],
        ),
        ("too short a row table", table("[0.0, 20.0]"), &["projector.row_table"]),
        ("two rows at once", table("[0, 20, 20, 40]"), &["projector.row_table"]),
        ("rows before the edge", table("[-600, 20, 30, 40]"), &["projector.row_table"]),
    ];
    insta::assert_snapshot!(messages("rig.toml", RigFile::parse, &cases));
}

#[test]
fn dot_rig() {
    let camera = |lines: &str| with(DOTS, "camera", lines);
    let mirror = |lines: &str| with(DOTS, "mirror", lines);
    let cases: [Case; _] = [
        ("another kind of rig", DOTS.replace("dots", "plane"), &["kind"]),
        ("no [camera]", DOTS.replace("[camera]\ndriver = \"sim\"\n", ""), &["camera"]),
        ("no [mirror]", DOTS.replace("[mirror]\ndriver = \"sim\"\n", ""), &["camera.driver"]),
        ("unknown key of [sim]", format!("{DOTS}[sim.dots]\nscenes = 3\n"), &["sim.dots.scenes"]),
        (
            "unknown key of its camera",
            format!("{DOTS}[sim.dots.camera]\nlate = 3\n"),
            &["sim.dots.camera.late"],
        ),
        ("no exposure", camera("white_exposure_us = 0"), &["camera.white_exposure_us"]),
        ("a V4L2 camera without its table", camera("driver = \"v4l2\""), &["camera.driver", "mirror.driver"]),
        ("a recording without its table", camera("driver = \"replay\""), &["camera.driver", "mirror.driver"]),
        (
            "a simulated mirror before a recording",
            camera("driver = \"replay\"\nreplay.path = \"a.npy\""),
            &["mirror.driver"],
        ),
        ("a mirror without a port", mirror("driver = \"playzerx\""), &["mirror.driver"]),
        ("a laser without a port", mirror("driver = \"optotune\"\nport = \"a\""), &["mirror.driver"]),
        (
            "a tilt beyond full scale",
            mirror("driver = \"mti\"\nport = \"a\"\nfull_scale_deg = 5"),
            &["mirror.limits.max_tilt"],
        ),
        ("too large an angle", mirror("incidence_deg = 80"), &["mirror.incidence_deg"]),
        ("unknown response", mirror("response = \"measured\""), &["mirror.response"]),
        ("a response of one axis", mirror("response = [{ f0_hz = 9, q = 9 }]"), &["mirror.response"]),
        (
            "a resonance at 0 Hz",
            mirror("response = [{ f0_hz = 0, q = 9 }, { f0_hz = 9, q = 9 }]"),
            &["mirror.response.0.f0_hz"],
        ),
        ("unknown limit", mirror("limits.tilt = 3"), &["mirror.limits.tilt"]),
        ("a limit without the others", mirror("limits.max_tilt = 3"), &["mirror.limits"]),
        (
            "too large a step",
            mirror(
                "limits = { max_tilt = 6.5, max_step = 90, max_slew_deg_per_s = 4000, bandwidth_hz = 200, out_of_band = 0.2 }",
            ),
            &["mirror.limits.max_step"],
        ),
    ];
    insta::assert_snapshot!(messages("rig.toml", DotRigFile::parse, &cases));
}

#[test]
fn rig_of_either_kind() {
    let cases: [Case; _] = [
        ("the file is empty", String::new(), &["kind"]),
        ("unknown kind", "kind = \"lines\"\n".into(), &["kind"]),
        ("a plan", "kind = \"sweep\"\n".into(), &["kind"]),
    ];
    insta::assert_snapshot!(messages("rig.toml", AnyRigFile::parse, &cases));
}

#[test]
fn sweep_plan() {
    let plan = |lines: &str| format!("kind = \"sweep\"\n{lines}\n");
    let sweep = |lines: &str| plan(&format!("[sweep]\n{lines}"));
    let cases: [Case; _] = [
        ("the file is empty", String::new(), &["kind"]),
        ("a quote is missing", "kind = \"sweep\n".into(), &["-"]),
        ("unknown kind", "kind = \"swep\"\n".into(), &["kind"]),
        ("a rig file", PLANE.into(), &["kind"]),
        ("half a frame", sweep("average = 2.5"), &["sweep.average"]),
        ("too many frames for the type", sweep("average = 5000000000"), &["sweep.average"]),
        ("a text for a range", sweep("delay_us = \"all\""), &["sweep.delay_us"]),
        ("a delay twice", sweep("delay_us = [0, 0, 10]"), &["sweep.delay_us"]),
        ("an exposure twice", sweep("exposure_us = [600, 600]"), &["sweep.exposure_us"]),
        ("no name", plan("name = \"  \""), &["name"]),
        ("a key outside its table", plan("average = 8"), &["average"]),
        ("the table of another kind", plan("[film]\ncycles = 3"), &["film"]),
        ("unknown key", sweep("averages = 8"), &["sweep.averages"]),
        ("no frames", sweep("average = 0"), &["sweep.average"]),
        ("an empty range", sweep("delay_us = { start = 0, stop = 1, count = 0 }"), &["sweep.delay_us.count"]),
        ("an empty list", sweep("delay_us = []"), &["sweep.delay_us.count"]),
        ("a range without a count", sweep("delay_us = { start = 0, stop = 1 }"), &["sweep.delay_us"]),
        ("no exposure", sweep("exposure_us = [0]"), &["sweep.exposure_us"]),
        ("a delay that is no number", sweep("delay_us = [nan]"), &["sweep.delay_us"]),
        ("negative jitter", sweep("max_jitter_us = -1"), &["sweep.max_jitter_us"]),
        (
            "too many points",
            sweep(
                "[sweep.delay_us]\nstart = 0\nstop = 1\ncount = 1000\n[sweep.exposure_us]\nstart = 1\nstop = 2\ncount = 9",
            ),
            &["sweep"],
        ),
        ("a stage without a name", plan("[[stage]]\nprior = \"split\""), &["stage"]),
        ("an infinite option", plan("[[stage]]\nname = \"demux\"\nalpha = nan"), &["stage.0.alpha"]),
        ("a product without a kind", plan("[[product]]\nname = \"a\""), &["product"]),
        ("an infinite edge", plan("[[product]]\nkind = \"band\"\nfrom_rows = inf"), &["product.0.from_rows"]),
        (
            "mistakes everywhere",
            plan(
                "name = \"\"\n[sweep]\naverage = 0\nmax_jitter_us = nan\nexposure_us = [0]\n[[product]]\nkind = 3",
            ),
            &["name", "sweep.average", "sweep.max_jitter_us", "sweep.exposure_us", "product.0.kind"],
        ),
    ];
    insta::assert_snapshot!(messages("plan.toml", Plan::parse, &cases));
}

#[test]
fn film_plan() {
    let film = |lines: &str| format!("kind = \"film\"\n[film]\n{lines}\n");
    let cases: [Case; _] = [
        ("the table of another kind", "kind = \"film\"\n[sweep]\naverage = 2\n".into(), &["sweep"]),
        ("unknown key", film("order = \"up\""), &["film.order"]),
        ("one delay", film("delay_us = [1]"), &["film.delay_us"]),
        ("a delay twice", film("delay_us = [1, 2, 1]"), &["film.delay_us"]),
        ("an infinite delay", film("delay_us = [1, inf]"), &["film.delay_us"]),
        ("no exposure", film("exposure_us = 0"), &["film.exposure_us"]),
        ("no cycles", film("cycles = 0"), &["film.cycles"]),
        ("jitter that is no number", film("max_jitter_us = nan"), &["film.max_jitter_us"]),
    ];
    insta::assert_snapshot!(messages("plan.toml", Plan::parse, &cases));
}

#[test]
fn batches_plan() {
    let plan = |lines: &str| format!("kind = \"batches\"\n{lines}\n");
    let batches = |lines: &str| plan(&format!("[batches]\n{lines}"));
    let path = |lines: &str| plan(&format!("[batches.path]\n{lines}"));
    let cases: [Case; _] = [
        ("the table of another kind", plan("[sweep]\naverage = 2"), &["sweep"]),
        ("unknown key", batches("speed = 1"), &["batches.speed"]),
        ("no batches", batches("count = 0"), &["batches.count"]),
        ("too few dots", batches("dots = 7"), &["batches.dots"]),
        ("no such trailing dot", batches("trailing_index = 2250"), &["batches.trailing_index"]),
        ("no background", batches("background_indices = []"), &["batches.background_indices"]),
        (
            "background at the trailing dot",
            batches("background_indices = [2249]"),
            &["batches.background_indices"],
        ),
        ("an empty region", batches("trailing_region = [4, 4, 0, 9]"), &["batches.trailing_region"]),
        ("an exposure that is no number", batches("exposure_us = nan"), &["batches.exposure_us"]),
        ("too long an exposure", batches("exposure_us = 80"), &["batches.exposure_us"]),
        ("too few dark frames", batches("dark_frames = 3"), &["batches.dark_frames"]),
        ("too few flat frames", batches("flat_frames = 3"), &["batches.flat_frames"]),
        ("not the mirror's rate", batches("camera_rate_hz = 13000"), &["batches.camera_rate_hz"]),
        ("no rate", batches("camera_rate_hz = 0"), &["batches.camera_rate_hz"]),
        (
            "a plane without batches",
            plan("[[batches.calibration]]\nbatches = 0"),
            &["batches.calibration.0.batches"],
        ),
        ("three planes", plan(&"[[batches.calibration]]\nbatches = 1\n".repeat(3)), &["batches.calibration"]),
        ("no samples", path("samples = 0"), &["batches.path.samples"]),
        ("no points", path("shape = \"points\""), &["batches.path.points_deg"]),
        ("no sample rate", path("rate_hz = 0"), &["batches.path.rate_hz"]),
        ("unknown shape", path("shape = \"zigzag\""), &["batches.path.shape"]),
        ("a tilt of one axis", path("points_deg = [[1]]"), &["batches.path.points_deg.0"]),
    ];
    insta::assert_snapshot!(messages("plan.toml", Plan::parse, &cases));
}

#[test]
fn response_plan() {
    let plan = |lines: &str| format!("kind = \"response\"\n{lines}\n");
    let response = |lines: &str| plan(&format!("[response]\n{lines}"));
    let cases: [Case; _] = [
        ("the table of another kind", plan("[batches]\ncount = 2"), &["batches"]),
        ("a product", plan("[[product]]\nkind = \"floodlit\""), &["product"]),
        ("unknown key", response("axes = 1"), &["response.axes"]),
        ("a band from high to low", response("band_hz = [900, 100]"), &["response.band_hz"]),
        ("a band from 0 Hz", response("band_hz = [0, 100]"), &["response.band_hz"]),
        ("too slow a camera", response("camera_rate_hz = 3000"), &["response.band_hz"]),
        ("too slow a mirror", response("rate_hz = 2000"), &["response.band_hz"]),
        ("no amplitude", response("amplitude_deg = 0"), &["response.amplitude_deg"]),
        ("a quality that is no number", response("max_q = nan"), &["response.max_q"]),
        ("no chirp", response("chirp_s = 0"), &["response.chirp_s"]),
        ("a negative rest", response("rest_s = -1"), &["response.rest_s"]),
        ("too long an exposure", response("exposure_us = 80"), &["response.exposure_us"]),
        ("too few dark frames", response("dark_frames = 3"), &["response.dark_frames"]),
        ("an empty region", response("region = [4, 4, 0, 9]"), &["response.region"]),
    ];
    insta::assert_snapshot!(messages("plan.toml", Plan::parse, &cases));
}

#[test]
fn darks_plan() {
    let plan = |lines: &str| format!("kind = \"darks\"\n{lines}\n");
    let cases: [Case; _] = [
        ("a stage", plan("[[stage]]\nname = \"demux\""), &["stage"]),
        ("no exposures", plan("[darks]\nexposure_us = []"), &["darks.exposure_us"]),
        ("an exposure of 0", plan("[darks]\nexposure_us = [0]"), &["darks.exposure_us"]),
        ("no frames", plan("[darks]\nframes = 0"), &["darks.frames"]),
        ("a limit that is no number", plan("[darks]\nhot_sigmas = nan"), &["darks.hot_sigmas"]),
    ];
    insta::assert_snapshot!(messages("plan.toml", Plan::parse, &cases));
}

#[test]
fn product_of_the_command_line() {
    let mut shown = String::new();
    for (name, argument, field) in [
        ("a value is missing", "kind =", None),
        ("no keys", "epipolar", None),
        ("no kind", "width_rows = 5", Some("product.0")),
        ("an edge that is no number", "kind = \"band\", from_rows = nan", Some("product.0.from_rows")),
    ] {
        let (error, text) = products_of_argument(argument).unwrap_err();
        assert_eq!(error.first().field.as_deref(), field, "{name}: {error}");
        writeln!(shown, "# {name}\n{}\n", error.render("--product", &text)).unwrap();
    }
    insta::assert_snapshot!(shown);
}
