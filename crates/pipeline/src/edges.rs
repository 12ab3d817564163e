//! Detects which VSYNC edges come from the projector: period gate, missed and false edges, jitter.

use std::collections::VecDeque;

use raysweep_core::{Edge, VsyncStats, us_from_ns};

use crate::regularity::{Regularity, TrueEdge};

/// The properties of the line given by the rig file.
#[derive(Debug, Clone, Copy)]
pub struct Line {
    /// Nominal period.
    pub period_ns: i64,
    /// An edge farther than this from its position expected from the last true edge is false.
    pub gate_ns: i64,
}

/// The edge near a given time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Found {
    /// A true edge.
    True(TrueEdge),
    /// An edge that does not come from the projector.
    False,
    /// No edge.
    Nothing,
}

/// Number of edges that the tracker remembers: more than any exposure spans.
const MEMORY: usize = 256;
/// This many consecutive false edges mean that the lock itself was wrong.
const RELOCK_AFTER: u32 = 8;

/// Classifies the edges of a VSYNC line as true or false.
pub struct EdgeTracker {
    line: Line,
    last: Option<TrueEdge>,
    /// Edges before the first pair that is an integer number of periods apart.
    candidates: VecDeque<i64>,
    false_in_a_row: u32,
    recent: VecDeque<(i64, Option<TrueEdge>)>,
    stats: VsyncStats,
    regularity: Regularity,
    /// Number of pairs of edges one period apart, and their total excess over the nominal period.
    periods: u64,
    sum_us: f64,
}

impl EdgeTracker {
    /// A tracker in its initial state.
    pub fn new(line: Line) -> Self {
        Self {
            line,
            last: None,
            candidates: VecDeque::new(),
            false_in_a_row: 0,
            recent: VecDeque::new(),
            stats: VsyncStats::default(),
            regularity: Regularity::new(line.period_ns),
            periods: 0,
            sum_us: 0.0,
        }
    }

    /// Processes the next edge of the line.
    pub fn push(&mut self, edge: Edge) {
        let now_ns = edge.host_ns;
        let accepted = match self.last {
            Some(last) => self
                .periods_between(last.host_ns, now_ns)
                .filter(|n| self.regularity.fits(last.index + n, now_ns))
                .map(|n| (last, n)),
            None => self.lock(now_ns),
        };
        let true_edge = accepted.map(|(from, n)| {
            let edge = TrueEdge { index: from.index + n, host_ns: now_ns };
            self.note_true(from, edge, n);
            edge
        });
        if true_edge.is_none()
            && let Some(last) = self.last
        {
            self.stats.false_edges += 1;
            self.false_in_a_row += 1;
            if now_ns - last.host_ns <= self.line.gate_ns && self.regularity.fits(last.index, now_ns) {
                self.doubt(last);
            }
            if self.false_in_a_row >= RELOCK_AFTER {
                self.last = None;
                self.candidates.clear();
                self.regularity.restart();
                // Counting restarts, and an index must not refer to two edges.
                self.recent.iter_mut().for_each(|(_, edge)| *edge = None);
            }
        }
        self.remember(now_ns, true_edge);
    }

    /// Two edges lie where one is expected. Either could be the projector's, so no frame is tied to them.
    fn doubt(&mut self, taken: TrueEdge) {
        for (_, edge) in &mut self.recent {
            edge.take_if(|edge| *edge == taken);
        }
    }

    fn remember(&mut self, host_ns: i64, edge: Option<TrueEdge>) {
        if self.recent.len() == MEMORY {
            self.recent.pop_front();
        }
        self.recent.push_back((host_ns, edge));
    }

    /// Number of periods between two times, at least one; `None` if it is not an integer within the gate.
    fn periods_between(&self, from_ns: i64, to_ns: i64) -> Option<i64> {
        let n = ((to_ns - from_ns) as f64 / self.line.period_ns as f64).round() as i64;
        let off_ns = (to_ns - from_ns - n * self.line.period_ns).abs();
        (n >= 1 && off_ns <= self.line.gate_ns).then_some(n)
    }

    /// Looks for the first edge that is confirmed by a later one.
    fn lock(&mut self, now_ns: i64) -> Option<(TrueEdge, i64)> {
        let found = self.candidates.iter().find_map(|&first_ns| {
            let n = self.periods_between(first_ns, now_ns).filter(|&n| n <= 4)?;
            Some((first_ns, n))
        });
        let Some((first_ns, n)) = found else {
            if self.candidates.len() == RELOCK_AFTER as usize {
                self.candidates.pop_front();
            }
            self.candidates.push_back(now_ns);
            return None;
        };
        let first = TrueEdge { index: 0, host_ns: first_ns };
        for (host_ns, edge) in &mut self.recent {
            if *host_ns == first_ns {
                *edge = Some(first);
            }
        }
        self.candidates.clear();
        self.stats.edges += 1;
        self.regularity.push(first);
        Some((first, n))
    }

    fn note_true(&mut self, from: TrueEdge, edge: TrueEdge, n: i64) {
        self.last = Some(edge);
        self.false_in_a_row = 0;
        self.stats.edges += 1;
        self.stats.missed += n.unsigned_abs() - 1;
        self.regularity.push(edge);
        if n == 1 {
            self.periods += 1;
            self.sum_us += us_from_ns(edge.host_ns - from.host_ns - self.line.period_ns);
        }
    }

    /// The time up to which all edges are known.
    pub fn known_until_ns(&self) -> i64 {
        self.recent.back().map_or(i64::MIN, |&(host_ns, _)| host_ns)
    }

    /// The edge nearest to `host_ns`, within `tolerance_ns`.
    pub fn near(&self, host_ns: i64, tolerance_ns: i64) -> Found {
        let nearest = self.recent.iter().min_by_key(|(edge_ns, _)| (edge_ns - host_ns).abs());
        match nearest {
            Some(&(edge_ns, edge)) if (edge_ns - host_ns).abs() <= tolerance_ns => {
                edge.map_or(Found::False, Found::True)
            }
            _ => Found::Nothing,
        }
    }

    /// The true edge with this index, if it was seen.
    pub fn by_index(&self, index: i64) -> Option<TrueEdge> {
        self.recent.iter().rev().find_map(|&(_, edge)| edge.filter(|edge| edge.index == index))
    }

    /// Nominal time of the edge `periods` after `edge`, which tells when it is overdue.
    pub fn expected_ns(&self, edge: TrueEdge, periods: i64) -> i64 {
        edge.host_ns + periods * self.line.period_ns
    }

    /// Largest distance of an edge from its expected position.
    pub fn gate_ns(&self) -> i64 {
        self.line.gate_ns
    }

    /// Statistics so far.
    pub fn stats(&self) -> VsyncStats {
        VsyncStats {
            period_us: us_from_ns(self.line.period_ns) + self.sum_us / self.periods.max(1) as f64,
            jitter_us: self.regularity.sigma_us(),
            jitter_p99_us: self.regularity.p99_us(),
            allan_1s: self.regularity.allan_1s(),
            ..self.stats
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::regularity::tests::Normal;

    const LINE: Line = Line { period_ns: 16_666_667, gate_ns: 500_000 };

    fn tracker(edges: impl IntoIterator<Item = i64>) -> EdgeTracker {
        let mut tracker = EdgeTracker::new(LINE);
        edges
            .into_iter()
            .enumerate()
            .for_each(|(seq, host_ns)| tracker.push(Edge { seq: seq as u64, host_ns }));
        tracker
    }

    #[test]
    fn missing_and_false_edges_are_told_apart_and_counted() {
        let true_edges = (0..100_i64).filter(|k| k % 10 != 7).map(|k| k * LINE.period_ns);
        let false_edges = (0..10_i64).map(|k| (k * 10 + 3) * LINE.period_ns + 5_000_000);
        let mut edges: Vec<i64> = true_edges.chain(false_edges).collect();
        edges.sort_unstable();
        let tracker = tracker(edges);
        let stats = tracker.stats();
        assert_eq!((stats.edges, stats.missed, stats.false_edges), (90, 10, 10));
        assert_eq!(tracker.near(93 * LINE.period_ns + 5_000_100, 1_000), Found::False);
        assert_eq!(tracker.near(97 * LINE.period_ns, 1_000_000), Found::Nothing);
        assert_eq!(tracker.by_index(97), None);
        assert_eq!(tracker.by_index(98).unwrap().host_ns, 98 * LINE.period_ns);
    }

    #[test]
    fn a_false_edge_at_the_very_start_does_not_become_the_reference() {
        let edges = [4_000_000].into_iter().chain((1..6).map(|k| k * LINE.period_ns));
        let tracker = tracker(edges);
        assert_eq!(tracker.near(4_000_000, 10), Found::False);
        assert_eq!(tracker.by_index(4).unwrap().host_ns, 5 * LINE.period_ns);
    }

    #[test]
    fn a_projector_that_restarts_is_found_again() {
        let jump_ns = LINE.period_ns / 2;
        let edges = (0..5).map(|k| k * LINE.period_ns).chain((5..30).map(|k| k * LINE.period_ns + jump_ns));
        let tracker = tracker(edges);
        assert!(matches!(tracker.near(29 * LINE.period_ns + jump_ns, 10), Found::True(_)));
    }

    #[test]
    fn jitter_is_the_spread_of_the_edges() {
        // Alternating +-30 us.
        let edges = (0..200).map(|k: i64| k * LINE.period_ns + if k % 2 == 0 { 30_000 } else { -30_000 });
        let stats = tracker(edges).stats();
        assert!((stats.jitter_us - 30.0).abs() < 1.0, "{}", stats.jitter_us);
        assert!((stats.period_us - 16_666.667).abs() < 1.0, "{}", stats.period_us);
    }

    #[test]
    fn an_edge_off_the_line_s_own_jitter_is_false_though_within_the_gate() {
        let wobble = |k: i64| k * LINE.period_ns + if k % 2 == 0 { 5_000 } else { -5_000 };
        let stray_ns = 80 * LINE.period_ns - 300_000;
        let tracker = tracker((0..80).map(wobble).chain([stray_ns]).chain((80..90).map(wobble)));
        assert_eq!(tracker.near(stray_ns, 10), Found::False);
        assert_eq!(tracker.near(wobble(80), 10), Found::True(TrueEdge { index: 80, host_ns: wobble(80) }));
        assert_eq!((tracker.stats().false_edges, tracker.stats().missed), (1, 0));
    }

    #[test]
    fn of_two_edges_in_one_place_neither_is_taken() {
        let mut edges: Vec<i64> = (0..90).map(|k| k * LINE.period_ns).collect();
        edges.insert(81, 80 * LINE.period_ns + 30_000);
        let tracker = tracker(edges);
        assert_eq!(tracker.near(80 * LINE.period_ns, 10), Found::False);
        assert_eq!(tracker.near(80 * LINE.period_ns + 30_000, 10), Found::False);
        assert!(matches!(tracker.near(81 * LINE.period_ns, 10), Found::True(TrueEdge { index: 81, .. })));
        assert_eq!(tracker.by_index(80), None);
    }

    /// Edges with 5 us of jitter, 1 % missing, and 1 % false ones at any time: once the line is known, all edges
    /// classified as true are true.
    #[test]
    fn no_false_edge_is_taken_wherever_it_lies() {
        let mut random = Normal::new(3);
        let mut edges = Vec::new();
        let mut truth = std::collections::BTreeMap::new();
        for k in 0..50_000_i64 {
            let true_ns = k * LINE.period_ns + (5_000.0 * random.next()) as i64;
            if random.uniform() >= 0.01 {
                edges.push(true_ns);
                truth.insert(true_ns, k);
            }
            if random.uniform() < 0.01 {
                edges.push(k * LINE.period_ns + ((random.uniform() - 0.5) * LINE.period_ns as f64) as i64);
            }
        }
        edges.sort_unstable();
        let mut tracker = EdgeTracker::new(LINE);
        let mut taken = 0;
        for (seq, pair) in edges.windows(2).enumerate() {
            tracker.push(Edge { seq: seq as u64, host_ns: pair[0] });
            // Evaluated when the next edge is known, as in the assembler.
            if seq > 100
                && let Found::True(edge) = tracker.near(edges[seq - 1], 0)
            {
                assert_eq!(truth.get(&edge.host_ns), Some(&edge.index), "edge {seq}");
                taken += 1;
            }
        }
        assert!(taken > truth.len() - 200, "{taken} of {}", truth.len());
        let jitter_us = tracker.stats().jitter_us;
        assert!((jitter_us / 5.0 - 1.0).abs() < 0.1, "{jitter_us}");
    }
}
