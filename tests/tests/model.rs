//! Checks the model of rows and beam against the simulator, which integrates light over time and shares no code with
//! the model.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::path::Path;

use ndarray::{Array2, Array3, Axis, concatenate, s, stack};
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::SeedableRng;
use raysweep_config::sim::SimConfig;
use raysweep_config::sim::{RowTable, SimBeam, SimProjector};
use raysweep_core::{PixelFormat, Raster};
use raysweep_sim::{PlaneRig, PlaneSetup};
use raysweep_tests::{Bench, corner_rig, data};
use raysweep_transport::plane::advice::{
    Arrangement, Calibrated, Conditions, Design, Noise, Search, SweepGrid, Usable,
};
use raysweep_transport::plane::{Beam, CameraRows, Demux, Prior, RowTiming, Setting};
use raysweep_transport::quality::{median_profile_error, relative_l2};

const TAU_US: f64 = 22.22;
const RASTER: Raster =
    Raster { rows: 128, row_time_us: TAU_US, first_row_us: 2200.0, period_us: 50_000.0 / 3.0 };

/// Transport of the corner scene, `[v, t, s]`, subsampled to every fourth column.
fn corner() -> Array3<f32> {
    let mut npz = ndarray_npy::NpzReader::new(std::fs::File::open(data("p2r_corner.npz")).unwrap()).unwrap();
    let scene: Array3<f32> = npz.by_name("T").unwrap();
    scene.slice_move(s![.., .., ..;4])
}

/// The paper's sweep.
fn paper_grid() -> SweepGrid {
    SweepGrid {
        delays_us: (0..15).map(|k| -1500.0 + 3000.0 / 14.0 * f64::from(k)).collect(),
        exposures_us: (0..5).map(|k| 600.0 + 150.0 * f64::from(k)).collect(),
    }
}

/// A simulated rig and its true transport `[v, t, s]`.
struct Rig {
    sim: PlaneRig,
    scene: Array3<f32>,
    setup: PlaneSetup,
}

impl Rig {
    fn new(scene: Array3<f32>, row_pitch: f64, camera_row_time_us: f64, projector: SimProjector) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.npz");
        let mut npz = ndarray_npy::NpzWriter::new(std::fs::File::create(&path).unwrap());
        npz.add_array("T", &scene).unwrap();
        npz.finish().unwrap();
        let config = SimConfig { scene: path, projector, ..SimConfig::default() };
        let setup = PlaneSetup {
            raster: Raster { rows: scene.len_of(Axis(0)), ..RASTER },
            camera_row_time_us,
            row_pitch,
            white_dn: 2500.0,
            black_dn: 64.0,
            format: PixelFormat::Mono12,
            first_row: Some(0),
        };
        Self { sim: PlaneRig::new(config, setup, Path::new("")).unwrap(), scene, setup }
    }

    /// The corner scene with a non-ideal projector.
    fn corner(projector: SimProjector) -> Self {
        Self::new(corner(), 1.0, TAU_US, projector)
    }

    fn bent(row_table: RowTable) -> Self {
        Self::corner(SimProjector { row_table, ..SimProjector::default() })
    }

    fn spread(sigma_rows: f64) -> Self {
        Self::corner(SimProjector { beam: SimBeam::Gaussian { sigma_rows }, ..SimProjector::default() })
    }

    /// Row and camera timing of the rig, with a linear row table and an ideal beam.
    fn timing(&self) -> RowTiming {
        let PlaneSetup { raster, row_pitch, camera_row_time_us, .. } = self.setup;
        let rows = self.scene.len_of(Axis(1));
        let camera = CameraRows { first_row: 0, rows, pitch: row_pitch, row_time_us: camera_row_time_us };
        let timing = RowTiming::new(raster.rows, raster.row_time_us, raster.period_us).unwrap();
        timing.with_camera(camera).unwrap()
    }

    /// Like [`Self::timing`], with the rig's true row table.
    fn timing_with_table(&self) -> RowTiming {
        let starts_us = self.sim.row_starts_us().unwrap();
        let table: Vec<f64> = starts_us.iter().map(|start_us| start_us - RASTER.first_row_us).collect();
        self.timing().with_row_table(&table).unwrap()
    }

    /// Errors of the paper's sweep with 8 frames.
    fn recover(&self, timing: &RowTiming) -> Errors {
        self.recover_from(timing, paper_grid().settings(), 8)
    }

    /// Median relative error of the profile, and relative error of the u = 0 image, when recovered under `timing` from
    /// `frames` frames per setting; the sensor has 8000 electrons and a read noise of 15 electrons.
    fn recover_from(&self, timing: &RowTiming, settings: Vec<Setting>, frames: u32) -> Errors {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(1);
        let mut photographed = |light: f32| {
            let electrons = f64::from(light) * 2500.0 / 4095.0 * 8000.0;
            let noise: f64 = StandardNormal.sample(&mut random);
            let mean = electrons + noise * ((electrons + 15.0 * 15.0) / f64::from(frames)).sqrt();
            (mean / 8000.0 * 4095.0 / 2500.0) as f32
        };
        let images: Vec<Array2<f32>> = settings
            .iter()
            .map(|setting| {
                let image = self.sim.noise_free(setting.delays_us[0], setting.exposure_us).unwrap();
                image.mapv(&mut photographed)
            })
            .collect();
        let views: Vec<_> = images.iter().map(|image| image.view()).collect();
        let demux = Demux::new(timing.clone(), settings, Prior::SPLIT).unwrap();
        let found = demux.solve(stack(Axis(0), &views).unwrap().view(), None).unwrap();

        let mut truth = Array3::zeros(found.t.dim());
        for ((v, t, column), &light) in self.scene.indexed_iter() {
            let index = timing.relative_row(v, t) - found.u_min;
            if let Some(truth) = usize::try_from(index).ok().and_then(|u| truth.get_mut([u, t, column])) {
                *truth = light;
            }
        }
        let own = (-found.u_min) as usize;
        let errors = Errors {
            profile: median_profile_error(found.t.view(), truth.view()),
            own_row: relative_l2(found.epipolar(1).view(), truth.index_axis(Axis(0), own)),
        };
        println!("{errors:?}");
        errors
    }
}

#[derive(Debug)]
struct Errors {
    profile: f64,
    own_row: f64,
}

impl Errors {
    fn assert_at_most(&self, profile: f64, own_row: f64) {
        assert!(self.profile <= profile && self.own_row <= own_row, "{self:?}");
    }
}

#[test]
fn a_linear_rig() {
    let rig = Rig::corner(SimProjector::default());
    // Measured: 0.0138, 0.0119.
    rig.recover(&rig.timing()).assert_at_most(0.02, 0.02);
}

#[test]
fn bent_row_tables_are_as_good_as_linear_ones_once_they_are_known() {
    let quadratic = Rig::bent(RowTable::Quadratic { percent: 2.0 });
    // Measured: 0.0135, 0.0115, and 1.13, 0.90 without the table.
    quadratic.recover(&quadratic.timing_with_table()).assert_at_most(0.02, 0.02);
    let unknown = quadratic.recover(&quadratic.timing());
    assert!(unknown.own_row > 0.5, "the table matters: {unknown:?}");

    let kinked = Rig::bent(RowTable::Kinked { pieces: 8, amplitude_us: 40.0, percent: 0.0 });
    // Measured: 0.0130, 0.0134, and 0.19, 0.42 without the table.
    kinked.recover(&kinked.timing_with_table()).assert_at_most(0.02, 0.02);
    let unknown = kinked.recover(&kinked.timing());
    assert!(unknown.own_row > 0.1, "the table matters: {unknown:?}");
}

#[test]
fn a_beam_is_taken_out_once_it_is_known() {
    for sigma_rows in [0.7, 1.5] {
        let rig = Rig::spread(sigma_rows);
        let known = rig.timing().with_beam(Beam::Gaussian { sigma_rows }).unwrap();
        // Measured: 0.0139, 0.0149 at 0.7 rows and 0.0132, 0.0196 at 1.5 rows; 0.30, 0.27 and 0.67, 0.62 without the
        // beam.
        rig.recover(&known).assert_at_most(0.04, 0.04);
        let unknown = rig.recover(&rig.timing());
        assert!(unknown.profile > 0.2, "the beam matters: {unknown:?}");
    }
}

#[test]
fn the_daemon_takes_table_and_beam_from_the_rig_file() {
    let truth = Rig::corner(SimProjector {
        row_table: RowTable::Quadratic { percent: 2.0 },
        ..SimProjector::default()
    });
    let starts_us = truth.timing_with_table().row_starts_us().to_vec();
    let rig = corner_rig(
        "[sim.projector]\nrow_table = { kind = \"quadratic\", percent = 2 }\n\
         beam = { kind = \"gaussian\", sigma_rows = 0.7 }\n",
    );
    let known = format!("first_row_us = 2200\nbeam_sigma_rows = 0.7\nrow_table = {starts_us:?}\n[sim]");
    let bench = Bench::new(&rig.replacen("[sim]", &known, 1));
    let ended = bench.run("kind = \"sweep\"\nname = \"corner\"\n");
    assert_eq!(ended.state, "complete", "{:?}", ended.error);

    let epipolar: Array2<f32> =
        ndarray_npy::read_npy(ended.session.join("products").join("epipolar.npy")).unwrap();
    let (rows, _, columns) = truth.scene.dim();
    let own_row = Array2::from_shape_fn((rows, columns), |(t, s)| truth.scene[[t, t, s]]);
    let error = relative_l2(epipolar.slice(s![.., ..;4]), own_row.view());
    println!("u = 0 image {error:.4}");
    assert!(error < 0.03, "{error}");
}

#[test]
fn a_bent_table_and_a_beam_at_once() {
    let rig = Rig::corner(SimProjector {
        row_table: RowTable::Quadratic { percent: -3.0 },
        beam: SimBeam::Gaussian { sigma_rows: 0.7 },
        ..SimProjector::default()
    });
    let known = rig.timing_with_table().with_beam(Beam::Gaussian { sigma_rows: 0.7 }).unwrap();
    rig.recover(&known).assert_at_most(0.04, 0.04);
}

#[test]
fn camera_rows_of_two_projector_rows() {
    let scene = corner().slice_move(s![.., ..;2, ..]);
    let rig = Rig::new(scene, 2.0, 2.0 * TAU_US, SimProjector::default());
    rig.recover(&rig.timing()).assert_at_most(0.02, 0.02);
}

#[test]
fn camera_rows_of_half_a_projector_row() {
    // Projector row v lights camera rows 2v - 1 and 2v, whose positions v - 1/2 and v are closest to it.
    let fine = corner();
    let first = fine.slice(s![..1, .., ..]);
    let pairs = &fine.slice(s![1..127;2, .., ..]) + &fine.slice(s![2..;2, .., ..]);
    let scene = concatenate![Axis(0), first, pairs].slice_move(s![.., ..127, ..]);
    let rig = Rig::new(scene, 0.5, 0.5 * TAU_US, SimProjector::default());
    rig.recover(&rig.timing()).assert_at_most(0.03, 0.03);
}

#[test]
fn a_camera_that_is_one_percent_slow() {
    let rig = Rig::new(corner(), 1.0, 1.01 * TAU_US, SimProjector::default());
    rig.recover(&rig.timing()).assert_at_most(0.02, 0.02);
    let known = rig.timing();
    let pace = known.clone().window(0, known.camera_rows()).unwrap();
    let unknown = rig.recover(&pace);
    assert!(unknown.own_row > 0.1, "the drift matters: {unknown:?}");
}

#[test]
fn a_plan_that_is_expected_to_be_better_is() {
    let rig = Rig::corner(SimProjector::default());
    let timing = rig.timing();
    let white_e = 8000.0 * 2500.0 / 4095.0;
    for frames in [1, 8] {
        let noise = Noise { read: 15.0 / white_e, gain: 1.0 / white_e, frames, dark_frames: None };
        let search = Search {
            conditions: Conditions { timing: &timing, prior: Prior::SPLIT, calibrated: Calibrated::EXACTLY },
            arrangement: Arrangement::Sweep,
            plan: Design { grids: vec![paper_grid()], frames },
            usable: |design: &Design| Some(Usable { settings: design.settings(), noise }),
        };
        let proposed = search.advise().unwrap().better.unwrap();
        println!("{proposed:?}");
        let paper = rig.recover_from(&timing, paper_grid().settings(), frames);
        let better = rig.recover_from(&timing, proposed.design.settings(), frames);
        assert!(better.profile <= paper.profile, "{better:?} {paper:?}");
    }
}
