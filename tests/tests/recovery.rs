//! The paper's sweep on a scene that an independent renderer made: the transport that comes out is the scene's.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use ndarray::{Array2, Array3, Axis, s};
use raysweep::control::Control;
use raysweep_tests::{Bench, Ended, corner_rig, data};
use raysweep_transport::plane::{RowTiming, Setting, reach, relative_rows};
use raysweep_transport::quality::{median_profile_error, relative_l2, share_near};

fn truth() -> Array3<f32> {
    let mut npz = ndarray_npy::NpzReader::new(std::fs::File::open(data("p2r_corner.npz")).unwrap()).unwrap();
    let scene: Array3<f32> = npz.by_name("T").unwrap();
    let timing = RowTiming::new(128, 22.22, 16_666.667).unwrap();
    let settings: Vec<Setting> = [-1500.0, 1500.0].map(|delay_us| Setting::new(delay_us, 1200.0)).into();
    relative_rows(scene.view(), &reach(&timing, &settings).unwrap())
}

fn product<D: ndarray::Dimension>(ended: &Ended, name: &str) -> ndarray::Array<f32, D> {
    ndarray_npy::read_npy(ended.session.join("products").join(name)).unwrap()
}

#[test]
fn the_split_prior_recovers_the_rendered_scene_through_the_daemon() {
    let bench = Bench::new(&corner_rig(""));
    let ended = bench.run("kind = \"sweep\"\nname = \"corner\"\n");
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    let (_, state) = ended.open();
    assert!(state.counts.balanced(), "{:?}", state.counts);
    assert_eq!(state.counts.averaged, (75 + 6 + 1) * 8);

    let (found, truth): (Array3<f32>, _) = (product(&ended, "transport.npy"), truth());
    assert_eq!(found.dim(), (189, 128, 128));
    let total = |t: &Array3<f32>| t.iter().map(|&x| f64::from(x)).sum::<f64>();
    let u_min = -94;
    let (total_off, share_off) = (
        total(&found) / total(&truth) - 1.0,
        share_near(found.view(), u_min, 2) - share_near(truth.view(), u_min, 2),
    );
    let profile = median_profile_error(found.view(), truth.view());
    let epipolar: Array2<f32> = product(&ended, "epipolar.npy");
    let direct = relative_l2(epipolar.view(), truth.index_axis(ndarray::Axis(0), 94));
    println!(
        "total {total_off:+.5}, share {share_off:+.5}, median profile {profile:.4}, u = 0 image {direct:.4}"
    );
    assert!(total_off.abs() < 0.01, "total off by {total_off}");
    assert!(share_off.abs() < 0.01, "share of |u| <= 2 off by {share_off}");
    assert!(profile < 0.03 && direct < 0.03, "profile {profile}, u = 0 image {direct}");

    let regular: Array2<f32> = product(&ended, "regular.npy");
    let predicted = total(&found) / regular.iter().map(|&x| f64::from(x)).sum::<f64>();
    assert!((predicted - 1.0).abs() < 0.02, "the model predicts {predicted} of the regular image");
}

#[test]
fn the_sweep_that_check_proposes_errs_less_than_the_papers() {
    let bench = Bench::new(&corner_rig(""));
    let rest = "kind = \"sweep\"\n[[stage]]\nname = \"demux\"\nprior = \"split\"\ncoupling = false\n";
    let own = format!("{rest}[sweep]\naverage = 1\n");
    let advice = bench.runner.check(&own).unwrap().advice.unwrap();
    let better = advice.better.unwrap();
    let proposed = format!("{rest}{}", better.sweep);
    // Its error is told over the reach of the first.
    let again = bench.runner.check(&proposed).unwrap().advice.unwrap();
    assert!((again.expected.profile / better.expected.profile - 1.0).abs() < 0.05, "{again:?}");

    let truth = truth();
    let errors = |plan: &str| {
        let ended = bench.run(plan);
        assert_eq!(ended.state, "complete", "{:?}", ended.error);
        let found: Array3<f32> = product(&ended, "transport.npy");
        // The proposed sweep may reach less far.
        let beyond = (189 - found.len_of(Axis(0))) / 2;
        let truth = truth.slice(s![beyond..189 - beyond, .., ..]);
        let own_row = found.len_of(Axis(0)) / 2;
        let direct = relative_l2(found.index_axis(Axis(0), own_row), truth.index_axis(Axis(0), own_row));
        let errors = (median_profile_error(found.view(), truth), direct);
        println!("{errors:?}");
        errors
    };
    println!("{:?} {:?}", advice.expected, better);
    let (paper, better) = (errors(&own), errors(&proposed));
    assert!(better.0 < 0.9 * paper.0 && better.1 < 0.9 * paper.1, "{better:?} {paper:?}");
}
