use raysweep_core::{CameraSettings, FirstFrame, FramePool, PixelFormat, Readout, Shutter};

use super::*;

const PERIOD_NS: i64 = 16_666_667;
const EXPOSURE_US: f64 = 600.0;

/// A camera without latency on a projector whose row 0 is centred 1 ms after its edge: t_d = 0 for a trigger delay of
/// 700 us.
fn config() -> AssemblerConfig {
    AssemblerConfig {
        camera: CameraCapabilities {
            model: "scripted".into(),
            width: 2,
            height: 1,
            format: PixelFormat::Mono12,
            row_time_us: 20.0,
            trigger_latency_us: 0.0,
            readout_us: 1000.0,
            readout: Readout::Sequential,
            exposure_us: 1.0..=1e6,
            trigger_delay_us: 0.0..=1e6,
        },
        raster: Raster { rows: 2, row_time_us: 20.0, first_row_us: 990.0, period_us: 16_666.667 },
        first_row: 0,
        max_jitter_us: 50.0,
        saturation_dn: 4000.0,
        edge_gate_us: 500.0,
    }
}

/// Feeds an assembler and records its decisions.
struct Feed {
    assembler: Assembler,
    decisions: Vec<Decision>,
    pool: FramePool,
    seq: u64,
}

impl Feed {
    fn new() -> Self {
        let pool = FramePool::new(64, 4);
        Self { assembler: Assembler::new(config()), decisions: Vec::new(), pool, seq: 0 }
    }

    fn push(&mut self, event: DeviceEvent) {
        let decisions = &mut self.decisions;
        self.assembler.push(event, |decision| decisions.push(decision));
    }

    fn edge(&mut self, host_ns: i64) {
        self.push(DeviceEvent::Edge(Edge { seq: 0, host_ns }));
    }

    /// Edges number `from..to` of a perfectly regular line.
    fn edges(&mut self, from: i64, to: i64) {
        (from..to).for_each(|k| self.edge(k * PERIOD_NS));
    }

    fn begin(&mut self, frames: u32, trigger_delay_us: f64, light_edges_later: u32) {
        self.begin_after(None, frames, trigger_delay_us, light_edges_later);
    }

    fn begin_after(
        &mut self,
        periods_from_last: Option<u32>,
        frames: u32,
        trigger_delay_us: f64,
        light_edges_later: u32,
    ) {
        let actual = CameraSettings { shutter: Shutter::Rolling, exposure_us: EXPOSURE_US, trigger_delay_us };
        self.push(DeviceEvent::Begin(Job {
            id: SettingsId { point: 7, attempt: 0 },
            frames,
            applied: Applied { actual, first_frame: FirstFrame::Exactly(0) },
            delay_us: 0.0,
            light_edges_later,
            periods_from_last,
        }));
    }

    /// The frame triggered at `trigger_ns`, with both pixels at `counts`.
    fn frame_at(&mut self, trigger_ns: i64, delay_us: f64, counts: u16, label: Label) {
        let mut data = self.pool.take();
        PixelFormat::Mono12.pack_into(&[counts; 2], &mut data).unwrap();
        let stamp = self.stamp(trigger_ns + ns_from_us(delay_us));
        self.push(DeviceEvent::Frame(Frame { data, format: PixelFormat::Mono12, stamp }, label));
    }

    fn stamp(&mut self, exposure_start_ns: i64) -> FrameStamp {
        self.seq += 1;
        FrameStamp {
            seq: self.seq,
            device_ns: 0,
            exposure_start_ns,
            host_ns: exposure_start_ns + 2_000_000,
            exposure_us: Some(EXPOSURE_US),
        }
    }

    fn frame(&mut self, edge: i64, counts: u16) {
        self.frame_at(edge * PERIOD_NS, 700.0, counts, Label::Counted);
    }

    fn unit(&self) -> &Unit {
        match &self.decisions[..] {
            [Decision::Unit(unit)] => unit,
            other => panic!("{} decisions", other.len()),
        }
    }

    fn failed(&self) -> &Counts {
        match &self.decisions[..] {
            [Decision::Failed(_, Failure::Losses, counts)] => counts,
            other => panic!("{} decisions", other.len()),
        }
    }
}

#[test]
fn frames_are_summed_once_their_edges_are_known() {
    let mut feed = Feed::new();
    feed.edges(0, 3);
    feed.begin(2, 700.0, 0);
    feed.frame(2, 100);
    feed.edge(3 * PERIOD_NS);
    feed.frame(3, 23);
    feed.push(DeviceEvent::End);
    assert!(feed.decisions.is_empty(), "the edge after the last frame may still change its verdict");
    feed.edge(4 * PERIOD_NS);
    let unit = feed.unit();
    assert_eq!(unit.sum.iter().copied().collect::<Vec<_>>(), [123, 123]);
    assert_eq!(unit.delays_us, [0.0, 0.0]);
    assert_eq!((unit.counts.expected, unit.counts.averaged), (2, 2));
    assert!(unit.counts.balanced());
}

#[test]
fn clipped_frames_are_counted_even_where_the_mean_is_not_clipped() {
    let mut feed = Feed::new();
    feed.edges(0, 3);
    feed.begin(2, 700.0, 0);
    feed.frame(2, 4000);
    feed.edge(3 * PERIOD_NS);
    feed.frame(3, 3999);
    feed.push(DeviceEvent::End);
    feed.edge(4 * PERIOD_NS);
    let clipped = feed.unit().clipped.as_ref().unwrap();
    assert_eq!(clipped.iter().copied().collect::<Vec<_>>(), [1, 1]);

    let mut feed = Feed::new();
    feed.edges(0, 3);
    feed.begin(1, 700.0, 0);
    feed.frame(2, 3999);
    feed.push(DeviceEvent::End);
    feed.edge(3 * PERIOD_NS);
    assert!(feed.unit().clipped.is_none());
}

#[test]
fn the_delay_is_measured_against_the_edge_of_the_light_not_of_the_trigger() {
    let mut feed = Feed::new();
    feed.edges(0, 3);
    // One period more than for a delay of zero. The light's edge is 30 us late, so the delay is 30 us short.
    let trigger_delay_us = 700.0 + 16_666.667;
    feed.begin(1, trigger_delay_us, 1);
    feed.edge(3 * PERIOD_NS + 30_000);
    feed.frame_at(2 * PERIOD_NS, trigger_delay_us, 5, Label::Counted);
    feed.push(DeviceEvent::End);
    feed.edge(4 * PERIOD_NS);
    assert!((feed.unit().delays_us[0] + 30.0).abs() < 0.01, "{:?}", feed.unit().delays_us);
}

#[test]
fn a_frame_by_a_false_edge_does_not_count() {
    let mut feed = Feed::new();
    feed.edges(0, 3);
    feed.begin(1, 700.0, 0);
    let false_ns = 2 * PERIOD_NS + 6_000_000;
    feed.edge(false_ns);
    feed.frame_at(false_ns, 700.0, 9, Label::Counted);
    feed.edges(3, 5);
    feed.push(DeviceEvent::End);
    assert_eq!(feed.failed().lost, [(LossCause::FalseEdge, 1)].into());
    assert!(feed.failed().balanced());
}

#[test]
fn a_frame_without_its_edge_waits_and_then_does_not_count() {
    let mut feed = Feed::new();
    feed.edges(0, 3);
    feed.begin(1, 700.0, 0);
    feed.frame(3, 9);
    feed.push(DeviceEvent::End);
    assert!(feed.decisions.is_empty());
    feed.edge(4 * PERIOD_NS);
    assert_eq!(feed.failed().lost, [(LossCause::EdgeMissing, 1)].into());
}

#[test]
fn a_line_that_has_died_does_not_hold_frames_for_ever() {
    let mut feed = Feed::new();
    feed.edges(0, 3);
    feed.begin(1, 700.0, 0);
    feed.frame(3, 9);
    feed.push(DeviceEvent::End);
    // A frame 100 ms later on the host's clock shows that the edge will not come.
    feed.frame_at(10 * PERIOD_NS, 700.0, 9, Label::Cancelled);
    assert_eq!(feed.failed().lost, [(LossCause::EdgeMissing, 1)].into());
}

#[test]
fn whoever_waits_for_decisions_is_told_of_the_last_one() {
    let mut feed = Feed::new();
    feed.edges(0, 3);
    feed.begin(1, 700.0, 0);
    feed.frame(2, 9);
    feed.push(DeviceEvent::End);
    let decided = Arc::new(AtomicBool::new(false));
    feed.push(DeviceEvent::Settle(decided.clone()));
    assert!(
        !decided.load(Ordering::Acquire) && feed.decisions.is_empty(),
        "the edge after the frame is to come"
    );
    feed.edges(3, 4);
    assert!(decided.load(Ordering::Acquire));
    assert!(matches!(&feed.decisions[..], [Decision::Unit(_)]));
}

#[test]
fn a_flush_decides_what_waits() {
    let mut feed = Feed::new();
    feed.edges(0, 3);
    feed.begin(1, 700.0, 0);
    feed.frame(2, 9);
    feed.push(DeviceEvent::End);
    feed.push(DeviceEvent::Flush);
    assert!(matches!(&feed.decisions[..], [Decision::Unit(_), Decision::Flushed(..)]));
}

#[test]
fn jitter_beyond_the_plans_limit_and_foreign_exposures_do_not_count() {
    let mut feed = Feed::new();
    feed.edges(0, 3);
    feed.begin(2, 700.0, 0);
    feed.frame_at(2 * PERIOD_NS, 700.0 + 60.0, 9, Label::Counted);
    let mut data = feed.pool.take();
    data.fill(0);
    let start_ns = 3 * PERIOD_NS + 700_000;
    let stamp = FrameStamp { exposure_us: Some(900.0), ..feed.stamp(start_ns) };
    feed.push(DeviceEvent::Frame(Frame { data, format: PixelFormat::Mono12, stamp }, Label::Counted));
    feed.edges(3, 5);
    feed.push(DeviceEvent::End);
    let lost = [(LossCause::SettingsMismatch, 1), (LossCause::Jitter, 1)].into();
    assert_eq!(feed.failed().lost, lost);
}

#[test]
fn gaps_in_frame_ids_and_unanswered_edges_are_counted_where_they_happen() {
    let mut feed = Feed::new();
    feed.edges(0, 12);
    feed.begin(3, 700.0, 0);
    feed.frame(2, 1);
    feed.seq += 2; // two frames exposed by edges 3 and 4, and lost on the way
    feed.frame(5, 1);
    feed.frame(8, 1); // edges 6 and 7 triggered no frame
    feed.push(DeviceEvent::End);
    let counts = &feed.unit().counts;
    assert_eq!(counts.lost, [(LossCause::CameraGap, 2), (LossCause::MissedTrigger, 2)].into());
    assert_eq!((counts.expected, counts.averaged), (7, 3));
    assert!(counts.balanced());
}

#[test]
fn a_camera_that_needs_two_periods_misses_no_trigger_by_answering_every_second() {
    let mut feed = Feed::new();
    feed.edges(0, 12);
    // Delay, exposure and readout together take more than one period.
    feed.begin(2, 700.0 + 16_000.0, 0);
    feed.frame_at(2 * PERIOD_NS, 16_700.0, 1, Label::Counted);
    feed.frame_at(4 * PERIOD_NS, 16_700.0, 1, Label::Counted);
    feed.push(DeviceEvent::End);
    assert!(!feed.failed().lost.contains_key(&LossCause::MissedTrigger), "{:?}", feed.failed());
}

#[test]
fn settling_and_idle_frames_have_columns_of_their_own() {
    let mut feed = Feed::new();
    feed.edges(0, 12);
    feed.frame_at(PERIOD_NS, 0.0, 1, Label::Cancelled);
    feed.push(DeviceEvent::Idle);
    feed.seq += 5; // frames that nobody took
    feed.begin(1, 700.0, 0);
    feed.frame_at(2 * PERIOD_NS, 0.0, 1, Label::Settling);
    feed.frame(3, 1);
    feed.push(DeviceEvent::End);
    let counts = feed.unit().counts.clone();
    assert_eq!((counts.expected, counts.averaged, counts.settling, counts.cancelled), (7, 1, 1, 5));
    feed.push(DeviceEvent::Flush);
    let Some(Decision::Flushed(outside, _)) = feed.decisions.last() else { panic!() };
    assert_eq!((outside.expected, outside.cancelled), (1, 1));
}

#[test]
fn spare_frames_stand_in_for_unsound_ones_and_are_left_when_they_need_not() {
    let mut feed = Feed::new();
    feed.edges(0, 3);
    feed.begin(2, 700.0, 0);
    feed.frame_at(2 * PERIOD_NS, 700.0 + 60.0, 9, Label::Counted);
    feed.edges(3, 7);
    feed.frame(3, 10);
    feed.frame(4, 20);
    feed.frame(5, 1000);
    feed.push(DeviceEvent::End);
    let unit = feed.unit();
    assert_eq!(unit.sum[[0, 0]], 30);
    assert_eq!((unit.counts.averaged, unit.counts.cancelled, unit.counts.lost_total()), (2, 1, 1));
    assert!(unit.counts.balanced());
}

#[test]
fn a_flush_ends_an_attempt_that_a_failing_device_left_open() {
    let mut feed = Feed::new();
    feed.edges(0, 3);
    feed.begin(2, 700.0, 0);
    feed.frame(2, 9);
    feed.push(DeviceEvent::Flush);
    let [Decision::Failed(_, Failure::Interrupted, counts), Decision::Flushed(..)] = &feed.decisions[..]
    else {
        panic!()
    };
    assert_eq!((counts.expected, counts.cancelled), (1, 1));
}

#[test]
fn an_attempt_that_is_interrupted_is_not_to_blame_for_what_it_lacks() {
    let mut feed = Feed::new();
    feed.edges(0, 3);
    feed.begin(2, 700.0, 0);
    feed.frame_at(2 * PERIOD_NS, 700.0 + 60.0, 9, Label::Counted);
    feed.push(DeviceEvent::Interrupt);
    feed.edges(3, 5);
    let [Decision::Failed(_, Failure::Interrupted, counts)] = &feed.decisions[..] else { panic!() };
    assert_eq!(counts.lost, [(LossCause::Jitter, 1)].into());
}

#[test]
fn a_frame_that_a_false_edge_may_have_triggered_under_the_settings_before_does_not_count() {
    let label = |triggered_ns: i64| Label::CountedUnless { triggered_ns };
    let false_ns = 3 * PERIOD_NS - 2_000_000;
    let decide = |has_false_edge: bool| {
        let mut feed = Feed::new();
        feed.edges(0, 3);
        feed.begin(2, 700.0, 0);
        feed.frame(2, 100);
        if has_false_edge {
            feed.edge(false_ns);
        }
        // The previous settings had 2 ms more delay, so both triggers give the same start of the exposure.
        feed.frame_at(3 * PERIOD_NS, 700.0, 100, label(false_ns));
        feed.edges(3, 6);
        feed.frame(4, 100);
        feed.push(DeviceEvent::End);
        feed.decisions
    };
    assert!(matches!(&decide(false)[..], [Decision::Unit(_)]));
    let decisions = decide(true);
    let [Decision::Failed(_, Failure::Interrupted, counts)] = &decisions[..] else { panic!() };
    // If the false edge did trigger it, the next true edge was not answered.
    assert_eq!(counts.lost, [(LossCause::MissedTrigger, 1)].into());
    assert_eq!((counts.expected, counts.settling, counts.cancelled), (4, 1, 2), "frames after it neither");
}

#[test]
fn frame_ids_that_fall_back_do_no_harm() {
    let mut feed = Feed::new();
    feed.edges(0, 9);
    feed.begin(3, 700.0, 0);
    feed.seq = 65_535;
    feed.frame(2, 1);
    feed.seq = 0; // 16-bit ids wrap around
    feed.frame(3, 1);
    feed.frame(4, 1);
    feed.push(DeviceEvent::End);
    assert!(feed.unit().counts.balanced());
}

#[test]
fn triggers_that_a_film_misses_between_two_settings_are_counted() {
    let mut feed = Feed::new();
    feed.edges(0, 12);
    // One frame per job. The third takes a period more than the others because of its settings, the fifth because the
    // camera missed edge 7.
    for (job, edge) in [2, 3, 5, 6, 8].into_iter().enumerate() {
        let periods = [None, Some(1), Some(2), Some(1), Some(1)][job];
        feed.begin_after(periods, 1, 700.0, 0);
        feed.frame(edge, 100);
        feed.push(DeviceEvent::End);
    }
    let missed = feed.decisions.iter().map(|decision| match decision {
        Decision::Unit(unit) => unit.counts.lost_total(),
        _ => panic!("every frame is sound"),
    });
    assert_eq!(missed.collect::<Vec<_>>(), [0, 0, 0, 0, 1]);
}

#[test]
fn a_frame_that_found_no_room_is_lost_once() {
    let mut feed = Feed::new();
    feed.edges(0, 12);
    feed.begin(2, 700.0, 0);
    feed.frame(2, 100);
    let lost = feed.stamp(3 * PERIOD_NS);
    feed.push(DeviceEvent::Lost(lost.seq, Some(LossCause::PoolEmpty)));
    feed.frame(4, 100);
    feed.push(DeviceEvent::End);
    let counts = &feed.unit().counts;
    assert_eq!((counts.expected, counts.lost_total()), (3, 1), "its trigger was answered");
}

#[test]
fn a_long_attempt_tells_how_far_it_is_twice_a_second() {
    let mut feed = Feed::new();
    feed.edges(0, 2);
    feed.begin(100, 700.0, 0);
    for edge in 2..102 {
        feed.edge(edge * PERIOD_NS);
        feed.frame(edge, 1);
    }
    feed.push(DeviceEvent::End);
    feed.edges(102, 104);
    let told = feed.decisions.iter().map(|decision| match decision {
        Decision::UnderWay(point) => (point.frames, point.of),
        Decision::Unit(unit) => (unit.frames, 0),
        _ => panic!("neither progress nor a unit"),
    });
    let told: Vec<_> = told.collect();
    // 100 frames take 1.67 s; half a second is 30 periods.
    assert_eq!(told, [(31, 100), (61, 100), (91, 100), (100, 0)]);
}
