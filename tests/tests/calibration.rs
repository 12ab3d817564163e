//! From a white board to the model of a rig that nobody knows: the simulator's devices show the pictures of a
//! calibration, the estimators find the rig in them, and the transport of a scene is recovered with what they found.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use ndarray::{Array2, Array3, ArrayView3, Axis, s};
use raysweep::rig::Rig;
use raysweep_core::{
    Camera, CameraSettings, Edge, FramePool, Pattern, Projector, Raster, SettingsId, Shutter, Subject,
};
use raysweep_sim::{PlaneDevices, PlaneRig, SubjectSwitch};
use raysweep_tests::{data, rig_text};
use raysweep_transport::plane::board::images::{
    CappedFrames, CodedPictures, DarkFit, LightLevel, Phases, Responses, WhiteMap, locate_rows,
    photon_transfer,
};
use raysweep_transport::plane::board::times::{
    self, BoardFrame, BoardSetting, CoarseSweep, Columns, Nominal, RowTimes, arrival_settings,
    check_settings, sweep_settings,
};
use raysweep_transport::plane::calibrate::latency;
use raysweep_transport::plane::{
    CameraRows, Demux, NoiseModel, PixelResponse, Prior, RESPONSE_ROWS, RowTiming, Setting, relative_rows,
};
use raysweep_transport::quality::median_profile_error;

const FULL_SCALE_DN: f32 = 4095.0;

/// The simulated devices, with VSYNC monitored on a thread of its own because virtual time waits for every device.
struct Studio {
    camera: Option<Box<dyn Camera>>,
    projector: Box<dyn Projector>,
    subject: SubjectSwitch,
    edges: Receiver<Edge>,
    pool: FramePool,
    size: (usize, usize),
    latency_us: f64,
    not_before_ns: i64,
    points: u32,
}

impl Studio {
    fn open(rig: &PlaneRig) -> Self {
        let PlaneDevices { mut camera, mut vsync, projector, subject, .. } = rig.open();
        let (seen, edges) = channel();
        std::thread::spawn(move || {
            while let Ok(edge) = vsync.next_edge(Duration::from_secs(1)) {
                if edge.is_some_and(|edge| seen.send(edge).is_err()) {
                    break;
                }
            }
        });
        camera.arm().unwrap();
        let capabilities = camera.capabilities();
        let (size, latency_us) = ((capabilities.height, capabilities.width), capabilities.trigger_latency_us);
        let pool = FramePool::new(1, size.0 * size.1 * 2);
        Self {
            camera: Some(camera),
            projector,
            subject,
            edges,
            pool,
            size,
            latency_us,
            not_before_ns: 0,
            points: 0,
        }
    }

    /// Shows a picture (`None`: no light) on a subject.
    fn show(&mut self, subject: Subject, pattern: Option<&Pattern>) {
        self.subject.place(subject).unwrap();
        let shown = match pattern {
            Some(pattern) => self.projector.show(pattern).unwrap(),
            None => self.projector.blank().unwrap(),
        };
        self.not_before_ns = shown.not_before_ns;
    }

    /// Frames of one setting, `[n, t, s]` in DN. `delay_us` is the time from the edge to the start of row 0's exposure.
    fn take(&mut self, shutter: Shutter, delay_us: f64, exposure_us: f64, frames: usize) -> Array3<f32> {
        let (height, width) = self.size;
        let camera = self.camera.as_mut().unwrap();
        let trigger_delay_us = delay_us - self.latency_us;
        let settings = CameraSettings { shutter, exposure_us, trigger_delay_us };
        let format = camera.capabilities().format;
        let mut images = Array3::zeros((frames, height, width));
        let mut counts = vec![0_u16; height * width];
        let mut taken = 0;
        while taken < frames {
            if taken == 0 {
                // A key of its own for each setting, so that its noise is its own.
                camera.configure(SettingsId { point: self.points, attempt: 0 }, &settings).unwrap();
                self.points += 1;
            }
            let mut data = self.pool.take();
            let stamp = camera.next_frame(&mut data, Duration::from_secs(1)).unwrap().expect("a frame");
            if stamp.exposure_start_ns >= self.not_before_ns {
                format.unpack_into(&data, &mut counts).unwrap();
                let image = counts.iter().map(|&dn| f32::from(dn));
                images.index_axis_mut(Axis(0), taken).iter_mut().zip(image).for_each(|(to, dn)| *to = dn);
                taken += 1;
            }
            while self.edges.try_recv().is_ok() {}
        }
        images
    }

    fn mean(&mut self, shutter: Shutter, delay_us: f64, exposure_us: f64, frames: usize) -> Array2<f32> {
        self.take(shutter, delay_us, exposure_us, frames).mean_axis(Axis(0)).unwrap()
    }
}

impl Drop for Studio {
    fn drop(&mut self) {
        // Without the camera the clock runs on for the monitor, which then finds its receiver gone.
        self.camera = None;
    }
}

/// What is known of a rig when a sweep is solved.
#[derive(Clone)]
struct Known {
    row_starts_us: Vec<f64>,
    camera_row_time_us: f64,
    exposure_offset_us: f64,
    response: PixelResponse,
    white_dn: Array2<f32>,
    dark: DarkFit,
}

/// What the rig file says: where a calibration begins.
struct Stated {
    raster: Raster,
    first_row: usize,
    camera_row_time_us: f64,
    size: (usize, usize),
}

impl Stated {
    fn nominal(&self) -> Nominal {
        Nominal {
            projector_rows: self.raster.rows,
            first_row_us: self.raster.first_row_us,
            row_time_us: self.raster.row_time_us,
            camera_row_time_us: self.camera_row_time_us,
            period_us: self.raster.period_us,
        }
    }
}

const WHOLE_US: f64 = 3600.0;

/// The steps of a calibration, without those for flying spots, ambient light and linearity.
fn calibrate(studio: &mut Studio, stated: &Stated) -> Known {
    let mut dark = Vec::new();
    studio.show(Subject::Cap, None);
    for exposure_us in [60.0, 600.0, 1200.0, WHOLE_US] {
        dark.push((exposure_us, studio.take(Shutter::Rolling, 8000.0, exposure_us, 16)));
    }
    let runs: Vec<CappedFrames> = dark
        .iter()
        .map(|(exposure_us, frames)| CappedFrames { exposure_us: *exposure_us, frames: frames.view() })
        .collect();
    let dark = DarkFit::new(&runs).unwrap();

    let around_us = stated.raster.row_centre_us(stated.first_row) - 1600.0;
    let whole = |studio: &mut Studio, pattern: &Pattern, frames: usize| {
        studio.show(Subject::Board, Some(pattern));
        studio.take(Shutter::Rolling, around_us, WHOLE_US, frames)
    };
    let black = whole(studio, &Pattern::Black, 32);
    let white = whole(studio, &Pattern::White, 32);
    let greys: Vec<(f64, Array3<f32>)> =
        [0.25, 0.5, 0.75].map(|level| (f64::from(level), whole(studio, &Pattern::Grey { level }, 8))).into();
    let dark_dn = dark.image(WHOLE_US);
    let levels: Vec<LightLevel> = greys
        .iter()
        .map(|(light, frames)| LightLevel { light: *light, frames: frames.view(), dark_dn: dark_dn.view() })
        .chain([LightLevel { light: 1.0, frames: white.view(), dark_dn: dark_dn.view() }])
        .collect();
    let noise = photon_transfer(&levels, FULL_SCALE_DN, None).unwrap().noise();
    let white = WhiteMap::new(white.view(), black.view(), FULL_SCALE_DN, noise).unwrap();
    white.check(FULL_SCALE_DN).unwrap();
    let black_dn = black.mean_axis(Axis(0)).unwrap();

    let mean = |studio: &mut Studio, pattern: &Pattern, frames: usize| {
        whole(studio, pattern, frames).mean_axis(Axis(0)).unwrap()
    };
    let rows = |image: Vec<Array2<f32>>| {
        ndarray::stack(Axis(0), &image.iter().map(|image| image.view()).collect::<Vec<_>>()).unwrap()
    };
    let phases = (0..16).map(|phase| mean(studio, &Pattern::SparseRows { phase, period: 16 }, 4) - &black_dn);
    let phases = rows(phases.collect());
    let codes = (0..7).rev().flat_map(|bit| [false, true].map(|inverse| (bit, inverse)));
    let codes = codes.map(|(bit, inverse)| mean(studio, &Pattern::GrayRows { bit, inverse, block: 8 }, 1));
    let codes = rows(codes.collect());
    let phases = Phases { images: phases.view(), frames: 4 };
    let code = CodedPictures { images: codes.view(), lines_per_block: 8 };
    let places = locate_rows(&phases, &code, white.lit().view(), stated.raster.rows).unwrap();
    let responses = Responses::new(&phases, &white, &places, stated.raster.rows).unwrap();

    let nominal = stated.nominal();
    let columns = Columns::new(responses.place.view(), responses.response.view()).unwrap();
    studio.show(Subject::Board, Some(&Pattern::White));
    let mut frames = Vec::new();
    let shoot = |studio: &mut Studio, frames: &mut Vec<BoardFrame>, setting: BoardSetting, count: usize| {
        let shutter = match setting.shutter {
            times::ExposureMode::Global => Shutter::Global,
            times::ExposureMode::Rolling => Shutter::Rolling,
        };
        for _ in 0..count {
            let image = studio.mean(shutter, setting.delay_us, setting.exposure_us, 1);
            let light = (image - dark.image(setting.exposure_us)) / &white.white_dn;
            frames.push(BoardFrame { setting, light: columns.average(light.view()).unwrap() });
        }
    };
    for setting in sweep_settings(&nominal, columns.seen_rows()).unwrap() {
        shoot(studio, &mut frames, setting, 1);
    }
    let coarse = CoarseSweep::from_borders(&columns, &frames, &nominal).unwrap();
    for setting in arrival_settings(&columns, &coarse, &nominal).unwrap() {
        shoot(studio, &mut frames, setting, 3);
    }
    for setting in check_settings(&columns, &coarse, &nominal).unwrap() {
        shoot(studio, &mut frames, setting, 1);
    }
    let level_dn = white.level_dn.value;
    let share = NoiseModel {
        read_variance: (noise.read_noise_e / noise.electrons_per_dn / level_dn).powi(2),
        gain: 1.0 / (noise.electrons_per_dn * level_dn),
    };
    let times = RowTimes::fit(&columns, &frames, &nominal, share).unwrap();
    println!(
        "tau {:?} rc {:?} delta {:?} latency {} jitter {:?}, {} useful frames of {}",
        times.row_time_us,
        times.camera_row_time_us,
        times.exposure_offset_us,
        times.latency_sd_us,
        times.jitter_us,
        times.useful_frames,
        frames.len()
    );
    Known {
        row_starts_us: times.row_starts_us,
        camera_row_time_us: times.camera_row_time_us.value,
        exposure_offset_us: times.exposure_offset_us.value,
        response: responses.pixel_response().unwrap(),
        white_dn: white.white_dn,
        dark,
    }
}

/// What the simulator knows.
fn truth(rig: &PlaneRig, stated: &Stated, beam: &[(i32, f64)], found: &Known) -> Known {
    let truth = rig.truth();
    let places = Array2::from_shape_fn(stated.size, |(t, s)| truth.place(t, s) as f32);
    let mut shares = [0.0; RESPONSE_ROWS];
    // A row that the beam spreads to `d` rows below is seen there while it is drawn `d` rows above.
    beam.iter().for_each(|&(d, share)| shares[(7 - d) as usize] += share);
    // The stamps of frames hold the stated latency.
    let late_us = truth.trigger_latency_us - 8.0;
    let starts = rig.row_starts_us().unwrap();
    Known {
        row_starts_us: starts.iter().map(|start_us| start_us - late_us).collect(),
        camera_row_time_us: truth.camera_row_time_us,
        exposure_offset_us: 0.0,
        response: PixelResponse::with_beam(places, &shares).unwrap(),
        white_dn: found.white_dn.clone(),
        dark: found.dark.clone(),
    }
}

/// Median error of the transport of the rig's scene, from a sweep of these images, and by how much its light is found to
/// be late.
fn error(
    known: &Known,
    stated: &Stated,
    sweep: &[(f64, f64, Array2<f32>)],
    scene: ArrayView3<f32>,
    refine: bool,
) -> (f64, f64) {
    let raster = &stated.raster;
    let nominal_us = raster.row_centre_us(stated.first_row);
    let camera = CameraRows {
        first_row: stated.first_row,
        rows: stated.size.0,
        pitch: 1.0,
        row_time_us: known.camera_row_time_us,
    };
    let starts: Vec<f64> =
        known.row_starts_us.iter().map(|start_us| start_us - raster.first_row_us).collect();
    let timing = RowTiming::new(raster.rows, raster.row_time_us, raster.period_us)
        .unwrap()
        .with_camera(camera)
        .unwrap()
        .with_row_table(&starts)
        .unwrap()
        .with_response(known.response.clone())
        .unwrap();
    let delta_us = known.exposure_offset_us;
    let settings: Vec<Setting> = sweep
        .iter()
        .map(|&(delay_us, exposure_us, _)| {
            Setting::new(delay_us + (exposure_us + delta_us) / 2.0 - nominal_us, exposure_us + delta_us)
        })
        .collect();
    let light: Vec<Array2<f32>> = sweep
        .iter()
        .map(|(_, exposure_us, image)| (image - &known.dark.image(*exposure_us)) / &known.white_dn)
        .collect();
    let stack = ndarray::stack(Axis(0), &light.iter().map(|image| image.view()).collect::<Vec<_>>()).unwrap();
    let late_us = match refine {
        true => {
            let rows: Vec<usize> = (0..stated.size.0).collect();
            let found = latency(&timing, &settings, &rows, stack.view(), None).unwrap();
            println!("{found:?}");
            found.late_us
        }
        false => 0.0,
    };
    let settings = settings.into_iter().map(|mut setting| {
        setting.delays_us.iter_mut().for_each(|delay_us| *delay_us -= late_us);
        setting
    });
    let demux = Demux::new(timing, settings.collect(), Prior::Split { alpha: 0.01, beta: 0.001 }).unwrap();
    let transport = demux.solve(stack.view(), None).unwrap();
    // Rows far from all others of the plan are seen by few settings.
    let kept = -94..=94;
    let found =
        transport.t.slice(s![(-94 - transport.u_min) as usize..=(94 - transport.u_min) as usize, .., ..]);
    (median_profile_error(found, relative_rows(scene, &kept).view()), late_us)
}

/// The paper's sweep of the scene, about the light that `known` expects at the middle row: openings, exposures, means.
fn sweep(studio: &mut Studio, known: &Known, size: (usize, usize)) -> Vec<(f64, f64, Array2<f32>)> {
    let (middle, own) = (size.0 / 2, known.response.places()[[size.0 / 2, size.1 / 2]]);
    let row = own.round() as usize;
    let light_us = (known.row_starts_us[row] + known.row_starts_us[row + 1]) / 2.0
        - middle as f64 * known.camera_row_time_us;
    studio.show(Subject::Scene, Some(&Pattern::White));
    let mut images = Vec::new();
    for exposure in 0..5 {
        for delay in 0..15 {
            let exposure_us = 600.0 + 150.0 * f64::from(exposure);
            let delay_us = light_us - 1500.0 + 3000.0 / 14.0 * f64::from(delay) - exposure_us / 2.0;
            images.push((delay_us, exposure_us, studio.mean(Shutter::Rolling, delay_us, exposure_us, 8)));
        }
    }
    images
}

/// Median errors of the transport.
#[derive(Debug)]
struct Recovered {
    /// With the calibration alone.
    calibrated: f64,
    /// With the calibration, and the latency from the sweep itself.
    refined: f64,
    /// With what the simulator knows.
    with_truth: f64,
    /// Errors of the times at which the rows seen are lit, as calibrated.
    row_errors_us: Vec<f64>,
    /// Error of the camera's row time.
    camera_row_time_error_us: f64,
    /// By how much the sweep's light is later than calibrated.
    late_us: f64,
}

fn recover(sim: &str, beam: &[(i32, f64)]) -> Recovered {
    let folder = tempfile::tempdir().unwrap();
    let text = rig_text(720, &format!("scene = {:?}", data("p2r_corner.npz")), sim);
    let path = folder.path().join("rig.toml");
    std::fs::write(&path, text).unwrap();
    let rig = Rig::load(&path).unwrap();
    let sim = rig.simulated().unwrap();
    let scene = sim.scene().transport.index_axis(Axis(3), 0).to_owned();
    let stated = Stated {
        raster: rig.file.raster(),
        first_row: 296,
        camera_row_time_us: rig.file.camera_row_time_us(),
        size: sim.scene().size(),
    };
    let mut studio = Studio::open(sim);
    let found = calibrate(&mut studio, &stated);
    let images = sweep(&mut studio, &found, stated.size);
    let known = truth(sim, &stated, beam, &found);
    let middle = (stated.size.0 / 2, stated.size.1 / 2);
    let row = known.response.places()[middle].round() as usize;
    println!(
        "row {row}: {} us found, {} us true; place {} and {}",
        found.row_starts_us[row],
        known.row_starts_us[row],
        found.response.places()[middle],
        known.response.places()[middle]
    );
    let (calibrated, _) = error(&found, &stated, &images, scene.view(), false);
    let (refined, late_us) = error(&found, &stated, &images, scene.view(), true);
    let (with_truth, _) = error(&known, &stated, &images, scene.view(), false);
    let rows = stated.first_row..stated.first_row + stated.size.0;
    Recovered {
        calibrated,
        refined,
        with_truth,
        row_errors_us: rows.map(|row| found.row_starts_us[row] - known.row_starts_us[row]).collect(),
        camera_row_time_error_us: found.camera_row_time_us - known.camera_row_time_us,
        late_us,
    }
}

#[test]
fn a_rig_that_nobody_knows_is_found_on_a_board() {
    // A flat top from 0.5 rows above to 1.2 below, as the simulator samples it.
    let total = 1.0 + 0.7;
    let beam = [(0, 1.0 / total), (1, 0.7 / total)];
    let recovered = recover(
        "[sim.projector]\nbeam = { kind = \"flat-top\", up_rows = 0.5, down_rows = 1.2 }\nphase_jitter_us = 5.0\n\
         row_table = { kind = \"quadratic\", percent = 1.0 }\n\
         [sim.sensor]\nvignetting_percent = 20.0\n\
         [sim.truth]\ncamera_row_time_us = 22.6\nrow_offset_rows = 0.4\nrotation_deg = 0.2\ntrigger_latency_us = 30.0\n",
        &beam,
    );
    let Recovered { calibrated, refined, with_truth, row_errors_us, camera_row_time_error_us, late_us } =
        recovered;
    println!(
        "errors: {calibrated:.4} calibrated, {refined:.4} refined by {late_us:.2} us, {with_truth:.4} with the truth"
    );
    assert!(refined < 1.15 * with_truth && calibrated < 1.3 * with_truth && with_truth < 0.05);
    let mean_us = row_errors_us.iter().sum::<f64>() / row_errors_us.len() as f64;
    let from_mean_us = || row_errors_us.iter().map(|error_us| error_us - mean_us);
    let rms_us =
        (from_mean_us().map(|error_us| error_us.powi(2)).sum::<f64>() / row_errors_us.len() as f64).sqrt();
    let most_us = from_mean_us().fold(0.0, |most: f64, error_us| most.max(error_us.abs()));
    println!("rows: {mean_us:.3} us off, {rms_us:.3} us rms, {most_us:.3} us at most");
    assert!(rms_us < 0.02 * 22.22 && most_us < 0.05 * 22.22, "{row_errors_us:?}");
    // The rest is the mean of the jitter of about 125 frames of the board, and of those of the sweep.
    assert!(mean_us.abs() < 1.5 && (mean_us + late_us).abs() < 1.0, "{mean_us} and {late_us}");
    assert!(camera_row_time_error_us.abs() < 2e-4 * 22.6, "{camera_row_time_error_us}");
}
