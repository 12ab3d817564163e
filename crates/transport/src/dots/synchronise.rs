use std::collections::VecDeque;

use super::error::{check_range, check_shape};
use super::sensor::median;
use super::{DotsError, FrameShape, Region};

/// Largest number of batches between two seen trailing dots: one dot may be missing, as the next one confirms both
/// batches.
const MOST_BATCHES: u64 = 2;

/// Number of frames by which a scan may be longer or shorter than nominal, as mirror and camera have independent
/// clocks.
const DRIFT_FRAMES: u64 = 1;

/// The synchroniser's settings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SyncSettings {
    /// Frames from one trailing dot to the next.
    pub frames_per_batch: u32,
    /// Index in the batch of the frame that shows the trailing dot, usually the last.
    pub trailing_index: u32,
    /// Energy from which the region counts as showing the dot; see [`pulse_threshold`].
    pub threshold: u64,
}

/// The properties of a frame that the synchroniser uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Observation {
    /// The camera's frame id, which also counts lost frames; a running count of frames if the camera has no ids.
    pub id: u64,
    /// Sum of the counts in the region of the trailing dot.
    pub energy: u64,
    /// Whether the frame is overexposed, so that its energy is meaningless.
    pub saturated: bool,
}

impl Observation {
    /// Evaluates a raw frame, `[height, width, channels]`. It is saturated if more than half of the region's values
    /// are at `full_scale` or above, so the region should be larger than the dot.
    ///
    /// # Errors
    /// [`DotsError::Shape`] and [`DotsError::OutOfRange`] if frame or region do not fit the shape.
    pub fn new(
        id: u64,
        frame: &[u16],
        shape: FrameShape,
        region: &Region,
        full_scale: u16,
    ) -> Result<Self, DotsError> {
        region.check(shape)?;
        check_shape("frame", "[values]", &[frame.len()], &[shape.values()])?;
        let (mut energy, mut full) = (0, 0);
        let values = region.columns.start * shape.channels()..region.columns.end * shape.channels();
        for row in
            frame.chunks_exact(shape.width() * shape.channels()).take(region.rows.end).skip(region.rows.start)
        {
            let row = &row[values.clone()];
            energy += row.iter().map(|&raw| u64::from(raw)).sum::<u64>();
            full += row.iter().filter(|&&raw| raw >= full_scale).count();
        }
        Ok(Self { id, energy, saturated: full > region.rows.len() * values.len() / 2 })
    }
}

/// The trailing dot is seen if its energy exceeds the median by this many times the median deviation.
const LEAST_SPREADS: f64 = 12.0;

/// Midpoint between the region's energy without and with the trailing dot, from a run of some batches: the median and
/// the largest energy of the frames that are not saturated.
///
/// # Errors
/// [`DotsError::OutOfRange`] if no frame exceeds the noise of the others.
pub fn pulse_threshold(run: &[Observation]) -> Result<u64, DotsError> {
    let mut energies: Vec<f64> =
        run.iter().filter(|seen| !seen.saturated).map(|seen| seen.energy as f64).collect();
    let largest = energies.iter().copied().fold(0.0, f64::max);
    let dark = median(&mut energies);
    energies.iter_mut().for_each(|energy| *energy = (*energy - dark).abs());
    let spread = median(&mut energies);
    let (energy, needed) = (largest - dark, LEAST_SPREADS * spread.max(1.0));
    match energy > needed {
        true => Ok(((dark + largest) / 2.0) as u64),
        false => Err(DotsError::NoDot { frames: run.len(), energy, needed }),
    }
}

/// The batch and index of a frame, or the reason why it is not used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fate {
    /// A frame of a batch.
    Dot {
        /// Number of scans since the first trailing dot that was confirmed by another one, whose own batch is 0.
        batch: u64,
        /// Index in the batch, from 0.
        index: u32,
    },
    /// The frame must not be used.
    Unused(Cause),
}

/// Why a frame is not used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cause {
    /// It is not enclosed by two trailing dots a whole number of batches apart.
    Unsynchronised,
    /// Its id, or a later one, has arrived before.
    Duplicate,
    /// It is overexposed.
    Saturated,
    /// Its batch had a frame too many, and another frame is nearer to the index.
    Surplus,
}

/// The fate of a frame, reported once it is certain.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Decided {
    /// The frame's number in the order of [`Synchroniser::push`], from 0.
    pub arrival: u64,
    /// Its fate.
    pub fate: Fate,
}

/// The fates of all frames. `used + unsynchronised + duplicate + saturated + surplus` is the number of frames
/// decided.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SyncCounts {
    /// Frames with a batch and an index.
    pub used: u64,
    /// See [`Cause::Unsynchronised`].
    pub unsynchronised: u64,
    /// See [`Cause::Duplicate`].
    pub duplicate: u64,
    /// See [`Cause::Saturated`].
    pub saturated: u64,
    /// See [`Cause::Surplus`].
    pub surplus: u64,
    /// Ids that never arrived.
    pub dropped: u64,
    /// Batches that were one frame longer or shorter than nominal.
    pub drifted: u64,
    /// Trailing dots that were not seen, but whose batches were confirmed by the next dot.
    pub bridged: u64,
}

/// Divides the stream of frames into batches at the trailing dots, independently for every batch.
///
/// A frame's index is certain only when the trailing dots before and after it have been seen at a distance of one
/// batch, give or take a frame, or two batches if the dot between is missing. Until then the frame waits; at most two
/// batches and a few frames are waiting. Drift is distributed evenly over the batch. Frames that are not enclosed by
/// two such dots are reported as unsynchronised, never guessed.
#[derive(Debug, Clone)]
pub struct Synchroniser {
    settings: SyncSettings,
    arrivals: u64,
    last_id: Option<u64>,
    was_lit: bool,
    /// Undecided frames, by id.
    pending: VecDeque<Pending>,
    /// The last confirmed trailing dot. It is kept when synchronisation is lost, to number later batches.
    anchor: Option<Anchor>,
    locked: bool,
    /// Later dots that do not fit the anchor, until one is confirmed by another.
    candidates: VecDeque<u64>,
    decided: Vec<Decided>,
    counts: SyncCounts,
}

#[derive(Debug, Clone, Copy)]
struct Pending {
    arrival: u64,
    id: u64,
    saturated: bool,
}

#[derive(Debug, Clone, Copy)]
struct Anchor {
    id: u64,
    batch: u64,
}

impl Synchroniser {
    /// # Errors
    /// [`DotsError::OutOfRange`] for fewer than 8 frames per batch, or a trailing index outside the batch.
    pub fn new(settings: SyncSettings) -> Result<Self, DotsError> {
        let frames = settings.frames_per_batch;
        check_range("frames_per_batch", frames.into(), frames >= 8, "at least 8")?;
        let index = settings.trailing_index;
        check_range("trailing_index", index.into(), index < frames, "below frames_per_batch")?;
        // Allocated in advance, so that nothing grows while frames arrive.
        let waiting = (MOST_BATCHES * (u64::from(frames) + DRIFT_FRAMES)) as usize + 2;
        Ok(Self {
            settings,
            arrivals: 0,
            last_id: None,
            was_lit: false,
            pending: VecDeque::with_capacity(waiting),
            anchor: None,
            locked: false,
            candidates: VecDeque::with_capacity(waiting),
            decided: Vec::with_capacity(waiting),
            counts: SyncCounts::default(),
        })
    }

    /// The same for a stream of which this many frames have been decided before.
    #[must_use]
    pub fn after(self, arrivals: u64) -> Self {
        Self { arrivals, ..self }
    }

    /// Takes the next frame and returns the frames whose fates have become certain.
    pub fn push(&mut self, seen: Observation) -> &[Decided] {
        self.decided.clear();
        let arrival = self.arrivals;
        self.arrivals += 1;
        let expected = self.last_id.map_or(seen.id, |last| last + 1);
        if seen.id < expected {
            self.decide(arrival, Fate::Unused(Cause::Duplicate));
            return &self.decided;
        }
        if seen.id > expected {
            self.counts.dropped += seen.id - expected;
            self.was_lit = false;
        }
        self.last_id = Some(seen.id);
        self.pending.push_back(Pending { arrival, id: seen.id, saturated: seen.saturated });

        // A dot that spans two frames counts at the first.
        if !seen.saturated {
            let is_lit = seen.energy >= self.settings.threshold;
            if is_lit && !self.was_lit {
                self.trailing_dot(seen.id);
            }
            self.was_lit = is_lit;
        }
        self.give_up_before(seen.id);
        &self.decided
    }

    /// Ends the stream. Frames that still wait belong to an incomplete batch.
    pub fn finish(&mut self) -> &[Decided] {
        self.decided.clear();
        self.reject_until(u64::MAX);
        (self.locked, self.anchor) = (false, None);
        self.candidates.clear();
        &self.decided
    }

    /// The fates of all frames so far.
    pub fn counts(&self) -> SyncCounts {
        self.counts
    }

    fn trailing_dot(&mut self, id: u64) {
        let confirmed = self.anchor.filter(|_| self.locked);
        if let Some((anchor, batches)) =
            confirmed.and_then(|anchor| Some((anchor, self.batches(anchor.id, id)?)))
        {
            self.close(anchor, id, batches);
            return;
        }
        match self.candidates.iter().copied().find(|&first| self.batches(first, id) == Some(1)) {
            Some(first) => {
                self.reject_until(first);
                let batch = self.anchor.map_or(0, |lost| lost.batch + self.scans_between(lost.id, first));
                self.close(Anchor { id: first, batch }, id, 1);
            }
            None => self.candidates.push_back(id),
        }
    }

    /// Number of batches between two trailing dots, if their distance is a whole number of batches.
    fn batches(&self, first: u64, last: u64) -> Option<u64> {
        let distance = last - first;
        let frames = u64::from(self.settings.frames_per_batch);
        (1..=MOST_BATCHES).find(|batches| distance.abs_diff(batches * frames) <= batches * DRIFT_FRAMES)
    }

    /// Number of scans from one dot to another, however many frames were lost in between.
    fn scans_between(&self, first: u64, last: u64) -> u64 {
        let frames = u64::from(self.settings.frames_per_batch);
        ((last - first + frames / 2) / frames).max(1)
    }

    /// Labels the frames after `anchor` up to the trailing dot in frame `id`.
    fn close(&mut self, anchor: Anchor, id: u64, batches: u64) {
        let frames = u64::from(self.settings.frames_per_batch);
        let (should, took) = (batches * frames, id - anchor.id);
        self.counts.drifted += u64::from(took != should);
        self.counts.bridged += batches - 1;
        let mut last_step = None;
        while let Some(frame) = self.next_until(id) {
            // Steps of the scan since the anchor, taken at the middle of each frame.
            let step = (2 * (frame.id - anchor.id) - 1) * should / (2 * took);
            let index = u64::from(self.settings.trailing_index) + 1 + step;
            let fate = match frame.saturated {
                true => Fate::Unused(Cause::Saturated),
                false if last_step == Some(step) => Fate::Unused(Cause::Surplus),
                false => Fate::Dot { batch: anchor.batch + index / frames, index: (index % frames) as u32 },
            };
            if !frame.saturated {
                last_step = Some(step);
            }
            self.decide(frame.arrival, fate);
        }
        self.anchor = Some(Anchor { id, batch: anchor.batch + batches });
        self.locked = true;
        self.candidates.clear();
    }

    /// Drops the anchor if no later frame can confirm it, and frames that can no longer be enclosed.
    fn give_up_before(&mut self, id: u64) {
        let frames = u64::from(self.settings.frames_per_batch);
        let too_far = |first: u64, batches: u64| id - first > batches * (frames + DRIFT_FRAMES);
        if self.candidates.front().is_some_and(|&first| too_far(first, 1)) {
            self.candidates.pop_front();
        }
        if self.locked && self.anchor.is_some_and(|anchor| too_far(anchor.id, MOST_BATCHES)) {
            self.locked = false;
        }
        if !self.locked {
            self.reject_until(self.candidates.front().copied().unwrap_or(id));
        }
    }

    /// The frame that has waited longest, if its id is at most `id`.
    fn next_until(&mut self, id: u64) -> Option<Pending> {
        let due = self.pending.front().is_some_and(|frame| frame.id <= id);
        if due { self.pending.pop_front() } else { None }
    }

    fn reject_until(&mut self, id: u64) {
        while let Some(frame) = self.next_until(id) {
            self.decide(frame.arrival, Fate::Unused(Cause::Unsynchronised));
        }
    }

    fn decide(&mut self, arrival: u64, fate: Fate) {
        *match fate {
            Fate::Dot { .. } => &mut self.counts.used,
            Fate::Unused(Cause::Unsynchronised) => &mut self.counts.unsynchronised,
            Fate::Unused(Cause::Duplicate) => &mut self.counts.duplicate,
            Fate::Unused(Cause::Saturated) => &mut self.counts.saturated,
            Fate::Unused(Cause::Surplus) => &mut self.counts.surplus,
        } += 1;
        self.decided.push(Decided { arrival, fate });
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand_xoshiro::Xoshiro256PlusPlus;
    use rand_xoshiro::rand_core::{Rng, SeedableRng};

    use super::*;

    const FRAMES: u32 = 50;

    fn settings(trailing_index: u32) -> SyncSettings {
        SyncSettings { frames_per_batch: FRAMES, trailing_index, threshold: 1000 }
    }

    /// A frame of the scan: its step among all steps of the mirror, and its observation.
    fn at(step: u64, id: u64, trailing_index: u32) -> (u64, Observation) {
        let lit = step % u64::from(FRAMES) == u64::from(trailing_index);
        (step, Observation { id, energy: if lit { 1900 } else { 100 }, saturated: false })
    }

    /// Fates in order of arrival; each frame has exactly one.
    fn fates(stream: &[(u64, Observation)], trailing_index: u32) -> (Vec<Fate>, SyncCounts) {
        let mut synchroniser = Synchroniser::new(settings(trailing_index)).unwrap();
        let mut fates = vec![None; stream.len()];
        let mut note = |decided: &[Decided]| {
            for decided in decided {
                assert_eq!(fates[decided.arrival as usize].replace(decided.fate), None);
            }
        };
        for (_, seen) in stream {
            note(synchroniser.push(*seen));
            assert!(synchroniser.pending.len() <= 2 * (FRAMES as usize + 1) + 1);
        }
        note(synchroniser.finish());
        let counts = synchroniser.counts();
        let SyncCounts { used, unsynchronised, duplicate, saturated, surplus, .. } = counts;
        assert_eq!(used + unsynchronised + duplicate + saturated + surplus, stream.len() as u64);
        (fates.into_iter().map(|fate| fate.unwrap()).collect(), counts)
    }

    /// Difference between the labels and the truth in steps of the mirror, for all labelled frames.
    fn errors(stream: &[(u64, Observation)], fates: &[Fate]) -> Vec<(u64, i64)> {
        let labelled = stream.iter().zip(fates).filter_map(|((step, _), fate)| match fate {
            Fate::Dot { batch, index } => {
                Some((*step, (batch * u64::from(FRAMES) + u64::from(*index)) as i64 - *step as i64))
            }
            Fate::Unused(_) => None,
        });
        let mut errors: Vec<(u64, i64)> = labelled.collect();
        // The number of the first scan is arbitrary, but the offset must be a whole number of scans.
        let number_0 = errors[0].1;
        assert_eq!(number_0 % i64::from(FRAMES), 0);
        errors.iter_mut().for_each(|(_, error)| *error -= number_0);
        errors
    }

    proptest! {
        #[test]
        fn no_frame_is_mislabelled_at_any_offset_with_losses_duplicates_and_overexposure(
            seed in any::<u64>(),
            offset in 0..u64::from(FRAMES),
            trailing_index in 0..FRAMES,
        ) {
            let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
            let mut one_in = |count: u64| random.next_u64() % count == 0;
            let mut stream = Vec::new();
            for step in offset..offset + 20 * u64::from(FRAMES) {
                let (_, mut seen) = at(step, 7000 + step, trailing_index);
                if one_in(60) {
                    (seen.saturated, seen.energy) = (true, 900_000);
                }
                if !one_in(60) {
                    stream.push((step, seen));
                    if one_in(60) {
                        stream.push((step, seen));
                    }
                }
            }
            let (fates, counts) = fates(&stream, trailing_index);
            let errors = errors(&stream, &fates);
            let wrong = errors.iter().find(|(_, error)| *error != 0);
            prop_assert_eq!(wrong, None);
            // Two missing dots in a row lose two batches, once in a thousand batches.
            prop_assert!(counts.used as usize > stream.len() / 2, "{counts:?} of {}", stream.len());
            prop_assert_eq!(counts.drifted, 0);
        }
    }

    /// Streams of ten scans; `change` may alter them before they are processed.
    fn ten_scans(
        change: impl Fn(&mut Vec<(u64, Observation)>),
    ) -> (Vec<(u64, Observation)>, Vec<Fate>, SyncCounts) {
        let mut stream: Vec<_> = (0..10 * u64::from(FRAMES)).map(|step| at(step, step, FRAMES - 1)).collect();
        change(&mut stream);
        let (fates, counts) = fates(&stream, FRAMES - 1);
        (stream, fates, counts)
    }

    #[test]
    fn all_but_the_first_scan_is_labelled() {
        let (stream, fates, counts) = ten_scans(|_| ());
        assert_eq!((counts.used, counts.unsynchronised), (450, 50));
        assert!(errors(&stream, &fates).iter().all(|(_, error)| *error == 0));
        assert_eq!(fates[50], Fate::Dot { batch: 1, index: 0 });
    }

    #[test]
    fn a_drift_of_one_frame_is_followed_and_spread() {
        for longer in [true, false] {
            // The fifth scan takes one frame more or less, so all later scans are shifted by a frame.
            let (stream, fates, counts) = ten_scans(|stream| {
                match longer {
                    true => stream.insert(225, stream[225]),
                    false => drop(stream.remove(225)),
                }
                stream.iter_mut().enumerate().for_each(|(id, (_, seen))| seen.id = id as u64);
            });
            assert_eq!((counts.drifted, counts.surplus), (1, u64::from(longer)));
            for (step, error) in errors(&stream, &fates) {
                assert!(
                    error.abs() <= i64::from((200..250).contains(&step)),
                    "step {step} is off by {error}"
                );
            }
            assert_eq!(counts.unsynchronised, 50);
        }
    }

    #[test]
    fn a_missing_trailing_dot_is_bridged() {
        let (stream, fates, counts) = ten_scans(|stream| stream[199].1.energy = 100);
        assert_eq!((counts.used, counts.bridged), (450, 1));
        assert!(errors(&stream, &fates).iter().all(|(_, error)| *error == 0));
    }

    #[test]
    fn losses_that_the_camera_does_not_number_cost_their_batch_alone() {
        let (stream, fates, counts) = ten_scans(|stream| {
            stream.drain(210..214);
            stream.iter_mut().enumerate().for_each(|(id, (_, seen))| seen.id = id as u64);
        });
        assert_eq!(counts.unsynchronised, 50 + 46);
        let errors = errors(&stream, &fates);
        assert!(errors.iter().all(|(_, error)| *error == 0), "{errors:?}");
    }

    #[test]
    fn a_trailing_dot_right_after_a_gap_is_one_of_its_own() {
        // Everything between two dots is lost, so the dots follow each other directly.
        let stream: Vec<_> = (0..100).chain(149..301).map(|step| at(step, step, 49)).collect();
        let (fates, counts) = fates(&stream, 49);
        assert_eq!((counts.bridged, counts.drifted), (0, 0));
        assert!(errors(&stream, &fates).iter().all(|(_, error)| *error == 0));
    }

    #[test]
    fn a_flash_is_no_trailing_dot() {
        let (stream, fates, counts) = ten_scans(|stream| {
            for flash in [220, 248] {
                (stream[flash].1.energy, stream[flash].1.saturated) = (900_000, true);
            }
            // Not overexposed, but not at the position of a trailing dot.
            stream[333].1.energy = 5000;
        });
        assert_eq!((counts.used, counts.saturated, counts.unsynchronised), (448, 2, 50));
        assert!(errors(&stream, &fates).iter().all(|(_, error)| *error == 0));
    }

    #[test]
    fn a_region_that_stays_lit_synchronises_nothing() {
        let (_, _, counts) = ten_scans(|stream| stream.iter_mut().for_each(|(_, seen)| seen.energy = 5000));
        assert_eq!((counts.used, counts.unsynchronised), (0, 500));
    }

    #[test]
    fn the_threshold_lies_between_dark_and_lit_and_needs_a_dot() {
        let run: Vec<_> = (0..200).map(|step| at(step, step, 3).1).collect();
        assert_eq!(pulse_threshold(&run).unwrap(), 1000);
        let dark: Vec<_> =
            run.iter().map(|seen| Observation { energy: 100 + seen.id % 5, ..*seen }).collect();
        assert!(pulse_threshold(&dark).is_err());
    }

    #[test]
    fn energy_is_that_of_the_region() {
        let shape = FrameShape::new(4, 32, 1).unwrap();
        let mut frame = vec![10; 128];
        frame[32 + 5] = 500;
        let region = Region { rows: 1..3, columns: 4..8 };
        let seen = Observation::new(3, &frame, shape, &region, 4095).unwrap();
        assert_eq!(seen, Observation { id: 3, energy: 570, saturated: false });
        let seen = Observation::new(3, &[4095; 128], shape, &region, 4095).unwrap();
        assert!(seen.saturated);
    }
}
