//! Everything that is sent to a controller between two stops, in playing order.

use raysweep_core::{MirrorLimits, MirrorPath, MirrorPoint, Tilt};
use serde::{Deserialize, Serialize};

/// How long the mirror rests, dark, before and after a movement: late samples of the host do no harm in this time.
const DWELL_S: f64 = 0.01;
/// The same before a path: time to fill the controller's FIFO, which a path must not outrun, on a busy host too.
const LEAD_S: f64 = 0.5;
/// The same after the approach to a path: time to measure the controller's rate.
const MEASURE_S: f64 = 0.25;

/// Points played once, then points played repeatedly, then points played once.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Sequence {
    /// Position of the mirror at the beginning.
    from: Tilt,
    lead: Vec<MirrorPoint>,
    path: Vec<MirrorPoint>,
    batches: u32,
    tail: Vec<MirrorPoint>,
}

fn dark(tilt: Tilt) -> MirrorPoint {
    MirrorPoint { tilt, light: 0 }
}

fn dwell(tilt: Tilt, rate_hz: f64, seconds: f64) -> impl Iterator<Item = MirrorPoint> {
    // At least two points: one to get there and one to rest.
    std::iter::repeat_n(dark(tilt), ((rate_hz * seconds).ceil() as usize).max(2))
}

fn ramp(from: Tilt, to: Tilt, rate_hz: f64, limits: &MirrorLimits) -> Vec<MirrorPoint> {
    let there = limits.ramp(from, to, rate_hz).map(dark);
    there.chain(dwell(to, rate_hz, DWELL_S)).collect()
}

impl Sequence {
    /// From one position to another, dark.
    pub fn travel(from: Tilt, to: Tilt, rate_hz: f64, limits: &MirrorLimits) -> Self {
        let lead = dwell(from, rate_hz, DWELL_S).chain(ramp(from, to, rate_hz, limits)).collect();
        Self { from, lead, path: Vec::new(), batches: 0, tail: Vec::new() }
    }

    /// The same, with a longer rest at the end.
    pub fn approach(from: Tilt, to: Tilt, rate_hz: f64, limits: &MirrorLimits) -> Self {
        let mut sequence = Self::travel(from, to, rate_hz, limits);
        sequence.tail = dwell(to, rate_hz, MEASURE_S).collect();
        sequence
    }

    /// A rest, `times` as long as that after an approach, and like a path with a lead that fills the FIFO and without gaps.
    pub fn rest(at: Tilt, rate_hz: f64, times: u32) -> Self {
        let [lead, path] = [LEAD_S, MEASURE_S].map(|seconds| dwell(at, rate_hz, seconds).collect());
        Self { from: at, lead, path, batches: times, tail: Vec::new() }
    }

    /// A path from its first point, `batches` times, then to the origin.
    pub fn play(path: &MirrorPath, batches: u32, limits: &MirrorLimits) -> Self {
        let (first, last) = (path.at(0).tilt, path.at(path.points().len() as u64 - 1).tilt);
        Self {
            from: first,
            lead: dwell(first, path.rate_hz(), LEAD_S).collect(),
            path: path.points().to_vec(),
            batches,
            tail: ramp(last, Tilt::ORIGIN, path.rate_hz(), limits),
        }
    }

    pub fn lead_len(&self) -> u64 {
        self.lead.len() as u64
    }

    pub fn path_len(&self) -> u64 {
        self.path.len() as u64 * u64::from(self.batches)
    }

    pub fn len(&self) -> u64 {
        self.lead_len() + self.path_len() + self.tail.len() as u64
    }

    /// The sample with this index; beyond the end, the last sample.
    pub fn at(&self, index: u64) -> MirrorPoint {
        let (lead, path) = (self.lead_len(), self.path_len());
        let point = if index < lead {
            self.lead.get(index as usize)
        } else if index < lead + path {
            self.path.get(((index - lead) % self.path.len() as u64) as usize)
        } else {
            self.tail.get((index - lead - path) as usize).or(self.tail.last()).or(self.lead.last())
        };
        point.copied().unwrap_or(dark(self.from))
    }

    /// Position of the mirror after `played` samples.
    pub fn after(&self, played: u64) -> Tilt {
        match played {
            0 => self.from,
            played => self.at(played - 1).tilt,
        }
    }

    /// Whether any sample has light.
    pub fn is_lit(&self) -> bool {
        self.path.iter().any(|point| point.light > 0)
    }

    /// Number of path samples among the first `samples`.
    pub fn of_path(&self, samples: u64) -> u64 {
        samples.saturating_sub(self.lead_len()).min(self.path_len())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_follow_each_other_without_a_step_beyond_the_limits() {
        let limits = MirrorLimits::A7B2_3_3600AL;
        let path = MirrorPath::lissajous(Tilt::new(3.0, 2.0), [30, 17], 6500, 39_000.0, &limits).unwrap();
        let first = path.at(0).tilt;
        let approach = Sequence::approach(Tilt::ORIGIN, first, 39_000.0, &limits);
        let play = Sequence::play(&path, 3, &limits);
        assert_eq!(play.path_len(), 3 * 6500);
        let mut last = Tilt::ORIGIN;
        for (sequence, end) in [(&approach, first), (&play, Tilt::ORIGIN)] {
            assert_eq!(sequence.after(0), last);
            for played in 0..sequence.len() + 5 {
                let tilt = sequence.at(played).tilt;
                assert!(tilt.distance_deg(last) <= limits.max_step.0);
                assert_eq!(sequence.after(played + 1), tilt);
                last = tilt;
            }
            assert_eq!(last, end);
        }
        assert_eq!(play.of_path(play.lead_len() + 100), 100);
        assert_eq!(play.of_path(play.len()), 3 * 6500);
        assert_eq!(play.at(play.lead_len() + 6500 + 7), path.points()[7]);
    }
}
