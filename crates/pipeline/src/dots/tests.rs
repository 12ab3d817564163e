use proptest::prelude::*;
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};
use std::sync::Arc;
use std::time::Duration;

use raysweep_core::{Counts, Frame, FramePool, FrameStamp, LossCause, PixelFormat};
use raysweep_transport::dots::{
    Background, DotsError, FrameShape, NoiseFloor, Region, Sampling, SparseColumn,
};
use serde_json::json;

use super::*;
use crate::queue::Policy;

const DOTS: u32 = 12;
const WIDTH: usize = 64;
const HEIGHT: usize = 48;
const BACKGROUND: u32 = 3;
const TRAILING: u32 = DOTS - 1;

fn shape() -> FrameShape {
    FrameShape::new(HEIGHT, WIDTH, 1).unwrap()
}

fn scan(batches: u32) -> DotScan {
    DotScan {
        shape: shape(),
        dots: DOTS,
        trailing_index: TRAILING,
        trailing_region: Region { rows: 0..8, columns: 56..64 },
        background_indices: vec![BACKGROUND],
        batches,
    }
}

/// The frame's counts at a step of the scan: dots wander over the frame, the trailing one lands in its corner.
fn counts(step: u64) -> Vec<u16> {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(step);
    let mut counts: Vec<u16> = (0..HEIGHT * WIDTH).map(|_| 100 + (random.next_u64() >> 61) as u16).collect();
    let index = (step % u64::from(DOTS)) as usize;
    let centre = match index as u32 {
        TRAILING => Some((3, 60)),
        BACKGROUND => None,
        _ => Some((12 + 2 * index, 4 + 4 * index)),
    };
    for (row, column) in centre.iter().flat_map(|&(row, column)| {
        (row - 2..row + 3).flat_map(move |row| (column - 2..column + 3).map(move |column| (row, column)))
    }) {
        // The scene brightens from batch to batch.
        counts[row * WIDTH + column] += 500 + 10 * (step / u64::from(DOTS)) as u16;
    }
    counts
}

fn frame(pool: &FramePool, format: PixelFormat, step: u64) -> Frame {
    frame_of(pool, format, step, &counts(step))
}

fn frame_of(pool: &FramePool, format: PixelFormat, step: u64, counts: &[u16]) -> Frame {
    let data = pool.take_within(Duration::from_secs(60));
    let mut data = data.expect("frames of the beam dump hold all buffers");
    format.pack_into(counts, &mut data).unwrap();
    let at_ns = step as i64 * 1000;
    let stamp = FrameStamp {
        seq: step,
        device_ns: at_ns,
        exposure_start_ns: at_ns,
        host_ns: at_ns + 900,
        exposure_us: None,
    };
    Frame { data, format, stamp }
}

fn sensor(format: PixelFormat) -> Sensor {
    let pool = FramePool::new(1, format.frame_bytes(shape().pixels()));
    let mut run = DarkRun::new(shape(), 4000, 64, 16).unwrap();
    let mut unpacked = vec![0; shape().pixels()];
    for number in 0..64 {
        // The beam dump's steps are dark.
        let dark = frame(&pool, format, number * u64::from(DOTS) + u64::from(BACKGROUND));
        format.unpack_into(&dark.data, &mut unpacked).unwrap();
        run.push(&unpacked).unwrap();
    }
    run.finish(8.0, None, Sampling::Full).unwrap()
}

#[derive(Default)]
struct Kept {
    cuts: Vec<Cut>,
    outside: Counts,
    fates: Vec<(u64, Option<(u32, u32)>)>,
}

impl CutSink for Kept {
    fn take(&mut self, cut: Cut) {
        self.cuts.push(cut);
    }

    fn outside(&mut self, counts: Counts) {
        self.outside.add(&counts);
    }

    fn fate(&mut self, _: u64, id: u64, place: Option<(u32, u32)>) {
        self.fates.push((id, place));
    }
}

impl Kept {
    fn counts(&self) -> Counts {
        let mut all = self.outside.clone();
        self.cuts.iter().for_each(|cut| all.add(&cut.counts));
        all
    }
}

/// Sends the frames of these steps through a flow, each preceded by the given losses.
fn cut(
    format: PixelFormat,
    stage: Arc<dyn ColumnStage>,
    threads: usize,
    batches: u32,
    steps: impl IntoIterator<Item = (u64, Vec<Loss>)>,
) -> Gathered<Kept> {
    cut_frames(
        format,
        stage,
        threads,
        batches,
        steps.into_iter().map(|(step, lost)| (step, counts(step), lost)),
    )
}

/// As [`cut`], with the counts of each frame.
fn cut_frames(
    format: PixelFormat,
    stage: Arc<dyn ColumnStage>,
    threads: usize,
    batches: u32,
    frames: impl IntoIterator<Item = (u64, Vec<u16>, Vec<Loss>)>,
) -> Gathered<Kept> {
    let Sensor { correction, background, floor } = sensor(format);
    let config = DotsFlowConfig {
        scan: scan(batches),
        format,
        saturation_dn: 4000,
        stage,
        correction,
        background,
        floor,
        threads,
        queue_frames: 4,
        policy: Policy::Wait,
    };
    let pool = FramePool::new(40, format.frame_bytes(shape().pixels()));
    flow_of(config, &pool, frames)
}

fn flow_of(
    config: DotsFlowConfig,
    pool: &FramePool,
    frames: impl IntoIterator<Item = (u64, Vec<u16>, Vec<Loss>)>,
) -> Gathered<Kept> {
    let format = config.format;
    let (flow, mut input) = DotsFlow::start(config, Kept::default()).unwrap();
    for (step, counts, lost_before) in frames {
        let arrival = Arrival { frame: frame_of(pool, format, step, &counts), lost_before };
        assert!(input.offer(arrival).is_ok());
    }
    drop(input);
    flow.join().unwrap()
}

fn denoise(format: PixelFormat) -> Arc<dyn ColumnStage> {
    let correction = sensor(format).correction;
    column_stage("denoise", json!({ "radius_px": 5.0 }), &correction).unwrap()
}

fn whole(steps: std::ops::Range<u64>) -> impl Iterator<Item = (u64, Vec<Loss>)> {
    steps.map(|step| (step, Vec::new()))
}

#[test]
fn every_frame_becomes_the_column_of_its_dot_whatever_the_threads_and_the_packing() {
    let format = PixelFormat::Mono12;
    let kept = cut(format, denoise(format), 1, 8, whole(5..DOTS.into()).chain(whole(12..9 * 12 + 5)));
    assert!(kept.error.is_none());
    let Kept { cuts, fates, .. } = &kept.sink;
    assert_eq!(cuts.iter().map(|cut| cut.batch).collect::<Vec<_>>(), (0..8).collect::<Vec<_>>());
    for (id, place) in fates.iter().filter_map(|(id, place)| Some((id, place.as_ref()?))) {
        assert_eq!((u64::from(place.0) + 1) * 12 + u64::from(place.1), *id);
    }
    for cut in cuts {
        let scene: Vec<bool> = (0..DOTS).map(|index| scan(8).is_scene(index)).collect();
        assert_eq!((&cut.seen, cut.counts.averaged), (&scene, 12));
        let words = &cut.columns.word_offsets;
        for (index, is_scene) in scene.into_iter().enumerate() {
            assert_eq!(words[index + 1] > words[index], is_scene, "dot {index}");
        }
    }
    // From the first trailing dot on, every frame of the beam dump is added as soon as its position is known.
    // The variance of 56 dark frames is a 56th; with six more frames of a mean that is worth 16, it is 0.086.
    assert!((0.08..0.118).contains(&kept.background.variance()), "{}", kept.background.variance());
    let counts = kept.sink.counts();
    assert!(counts.balanced() && counts.averaged == 96 && counts.lost.is_empty(), "{counts:?}");
    assert_eq!((counts.settling, counts.cancelled), (7, 5));

    for (threads, format) in [(3, PixelFormat::Mono12), (2, PixelFormat::Mono12p)] {
        let again = cut(format, denoise(format), threads, 8, whole(5..12).chain(whole(12..9 * 12 + 5)));
        assert!(again.sink.cuts == *cuts, "{threads} threads, {format}");
    }
}

#[test]
fn lost_frames_leave_dots_without_light_and_are_told_by_cause() {
    let format = PixelFormat::Mono12;
    let gap = |frames, cause| vec![Loss { frames, cause }];
    let steps = whole(0..40)
        .chain([(42, gap(2, LossCause::PoolEmpty)), (42, Vec::new()), (43, Vec::new())])
        .chain(whole(44..60));
    let kept = cut(format, denoise(format), 2, 4, steps).sink;
    let counts = kept.counts();
    assert!(counts.balanced(), "{counts:?}");
    assert_eq!(counts.lost, [(LossCause::PoolEmpty, 2)].into());
    let hit = &kept.cuts[2];
    assert_eq!((hit.counts.averaged, hit.counts.expected, hit.duplicates), (10, 12, 1));
    let missing: Vec<usize> = (0..12).filter(|&dot| scan(4).is_scene(dot as u32) && !hit.seen[dot]).collect();
    assert_eq!(missing, [4, 5]);
    assert_eq!(hit.columns.discs.len(), 12);
}

#[test]
fn the_background_follows_a_change_of_the_room_by_its_weight() {
    const CHANGE_DN: u16 = 4;
    /// The mean is worth 16 frames of the beam dump: in the end each keeps 15/17 of the previous mean, but more of one
    /// of 56 dark frames. The change comes after five.
    fn kept(changed: usize) -> f64 {
        let weight: f64 = 2.0 / 17.0;
        let drift = weight * weight / (1.0 - weight);
        let (mut variance, mut kept) = (1.0 / 56.0, 1.0);
        for frame in 0..5 + changed {
            variance += drift;
            variance /= 1.0 + variance;
            kept *= if frame < 5 { 1.0 } else { 1.0 - variance };
        }
        kept
    }
    let format = PixelFormat::Mono12;
    let brighter_from = 6 * u64::from(DOTS);
    let frames = (0..32 * u64::from(DOTS)).map(|step| {
        let change = if step < brighter_from { 0 } else { CHANGE_DN };
        (step, counts(step).iter().map(|counts| counts + change).collect(), Vec::new())
    });
    let cuts = cut_frames(format, denoise(format), 2, 30, frames).sink.cuts;
    // Light beyond the dots, the mean of the scene's dots; the first round does not give a batch.
    let beyond = |batch: usize| {
        let cut = &cuts[batch - 1];
        let residual = cut.columns.residual.chunks_exact(cut.columns.residual.len() / DOTS as usize);
        let scene = residual.zip(&cut.seen).filter(|(_, seen)| **seen).flat_map(|(blocks, _)| blocks);
        let light: Vec<f64> = scene.map(|&light| f64::from(light)).collect();
        light.iter().sum::<f64>() / light.len() as f64
    };
    assert!(beyond(5).abs() < 0.2, "{}", beyond(5));
    // Frames of two rounds are denoised with the previous background.
    for batch in [6, 7] {
        assert!((beyond(batch) - beyond(5) - f64::from(CHANGE_DN)).abs() < 0.2, "{batch}: {}", beyond(batch));
    }
    for batch in [10, 15, 25] {
        let expected = f64::from(CHANGE_DN) * kept(batch - 7);
        assert!((beyond(batch) - expected).abs() < 0.2, "{batch}: {}, expected {expected}", beyond(batch));
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    /// Whichever frames go into the beam dump and whatever is lost, the buffers suffice that a scan asks for.
    #[test]
    fn frames_of_the_beam_dump_leave_room_for_others_and_all_of_them_count(
        dumped in proptest::collection::btree_set(0..DOTS - 1, 1..DOTS as usize),
        lost in proptest::collection::btree_set(40..20 * u64::from(DOTS), 0..12),
    ) {
        let format = PixelFormat::Mono16;
        let is_dumped = |step: u64| dumped.contains(&((step % u64::from(DOTS)) as u32));
        // Frames of the beam dump show the room, which brightens.
        let room = |step: u64| vec![100 + (step / 7) as u16; shape().pixels()];
        let counts = |step: u64| if is_dumped(step) { room(step) } else { counts(step) };
        let steps = 0..20 * u64::from(DOTS);
        let frames = steps.clone().filter(|step| !lost.contains(step)).map(|step| (step, counts(step), Vec::new()));
        let Sensor { correction, background, floor } = sensor(format);
        let mut expected = background.clone();
        let scan = DotScan { background_indices: dumped.iter().copied().collect(), ..scan(18) };
        let config = DotsFlowConfig {
            format,
            saturation_dn: 4000,
            stage: denoise(format),
            correction,
            background,
            floor,
            threads: 2,
            queue_frames: 1,
            policy: Policy::Wait,
            scan,
        };
        // In the two queues, in the workers, with the gatherer, and with the camera.
        let pool = FramePool::new(config.scan.frames_kept() + 8, format.frame_bytes(shape().pixels()));
        let gathered = flow_of(config, &pool, frames);
        if lost.is_empty() {
            // Frames count from the first that arrives after the trailing dot has been learnt.
            let learnt = 2 * u64::from(DOTS) + 1;
            for step in steps.filter(|step| *step >= learnt && is_dumped(*step)) {
                expected.push(&room(step)).unwrap();
            }
            prop_assert_eq!(gathered.background.mean(), expected.mean());
        }
    }
}

/// Returns an error for one dot and panics for another.
struct Fragile(Arc<dyn ColumnStage>);

struct FragileWorker(Box<dyn ColumnWorker>);

impl ColumnStage for Fragile {
    fn worker(&self) -> Box<dyn ColumnWorker> {
        Box::new(FragileWorker(self.0.worker()))
    }
}

impl ColumnWorker for FragileWorker {
    fn column(
        &mut self,
        frame: &[u16],
        background: &Background,
        floor: NoiseFloor,
        column: &mut SparseColumn,
    ) -> Result<(), DotsError> {
        let lit = |index: usize| frame[(12 + 2 * index) * WIDTH + 4 + 4 * index] > 400;
        assert!(!lit(5), "dot 5 is too much");
        if lit(7) {
            return Err(DotsError::TooFew { what: "sevens", given: 0, needed: 1 });
        }
        self.0.column(frame, background, floor, column)
    }
}

#[test]
fn a_stage_that_fails_or_panics_costs_its_dot_and_nothing_else() {
    let format = PixelFormat::Mono12;
    let kept = cut(format, Arc::new(Fragile(denoise(format))), 2, 2, whole(0..40)).sink;
    assert_eq!(kept.cuts.len(), 2);
    for cut in &kept.cuts {
        assert_eq!(cut.counts.lost, [(LossCause::StageFailed, 2)].into());
        assert!(!cut.seen[5] && !cut.seen[7] && cut.seen[6]);
        assert!(cut.problem.as_ref().unwrap().contains("dot 5 is too much"), "{:?}", cut.problem);
    }
    assert!(kept.counts().balanced());
}

#[test]
fn without_a_trailing_dot_the_stream_ends_with_a_word_and_an_account() {
    let format = PixelFormat::Mono12;
    let dumps = (0..60).map(|number| (number * 12 + u64::from(BACKGROUND), Vec::new()));
    let gathered = cut(format, denoise(format), 2, 2, dumps);
    assert!(gathered.error.unwrap().to_string().contains("trailing dot"));
    let counts = gathered.sink.counts();
    // Other frames are missing between these, so the first ones are given up in the hope of a trailing dot.
    assert!(counts.balanced() && counts.settling == 36 && counts.cancelled == 24, "{counts:?}");
}

#[test]
fn a_trailing_dot_that_is_lost_again_and_again_at_first_is_waited_for() {
    let format = PixelFormat::Mono12;
    let trailing = u64::from(scan(1).trailing_index);
    let lost = vec![Loss { frames: 1, cause: LossCause::CameraGap }];
    let late =
        (0..5 * 12).filter(|step| step % 12 != trailing).map(|step| match step % 12 == (trailing + 1) % 12 {
            true if step > trailing => (step, lost.clone()),
            _ => (step, Vec::new()),
        });
    let gathered = cut(format, denoise(format), 2, 4, late.chain(whole(60..10 * 12)));
    assert!(gathered.error.is_none(), "{:?}", gathered.error);
    let kept = gathered.sink;
    let whole: Vec<u64> = kept.cuts.iter().map(|cut| cut.counts.averaged).collect();
    assert_eq!(whole, [12; 4]);
    let counts = kept.counts();
    assert!(counts.balanced() && counts.lost_total() == 4, "{counts:?}");
}
