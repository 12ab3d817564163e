use rayon::prelude::*;

use super::super::{PlaneError, Setting};
use super::foresee::{Conditions, Noise, PredictedError};

/// Every delay with every exposure.
#[derive(Debug, Clone, PartialEq)]
pub struct SweepGrid {
    /// Delays, ascending.
    pub delays_us: Vec<f64>,
    /// Exposures, ascending.
    pub exposures_us: Vec<f64>,
}

impl SweepGrid {
    /// The settings of the grid, delays fastest.
    pub fn settings(&self) -> Vec<Setting> {
        let delays = |&exposure_us: &f64| {
            self.delays_us.iter().map(move |&delay_us| Setting::new(delay_us, exposure_us))
        };
        self.exposures_us.iter().flat_map(delays).collect()
    }
}

/// The settings of a sweep or of a film's cycle.
#[derive(Debug, Clone, PartialEq)]
pub struct Design {
    /// The plan's grid, then further ones.
    pub grids: Vec<SweepGrid>,
    /// Frames averaged for each setting.
    pub frames: u32,
}

impl Design {
    /// All settings, grid after grid.
    pub fn settings(&self) -> Vec<Setting> {
        self.grids.iter().flat_map(SweepGrid::settings).collect()
    }

    /// Frames of all settings.
    pub fn total_frames(&self) -> usize {
        self.settings().len() * self.frames as usize
    }
}

/// How a procedure arranges its settings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Arrangement {
    /// A grid, and a second one of a single exposure.
    Sweep,
    /// One exposure, one frame at each delay.
    Film,
}

/// The usable settings of a design on a rig, and the noise of its images.
#[derive(Debug, Clone, PartialEq)]
pub struct Usable {
    /// Settings whose images will be used.
    pub settings: Vec<Setting>,
    /// Their noise.
    pub noise: Noise,
}

/// A design and its predicted error.
#[derive(Debug, Clone, PartialEq)]
pub struct Proposal {
    /// The settings.
    pub design: Design,
    /// Their predicted error.
    pub foreseen: PredictedError,
}

impl Proposal {
    /// What a search minimises: the error of a typical scene and of a hard one count alike.
    fn cost(&self) -> f64 {
        cost(&self.foreseen)
    }
}

fn cost(foreseen: &PredictedError) -> f64 {
    (foreseen.total.median * foreseen.total.high).sqrt()
}

/// The predicted error of a plan, and a better one of the same length if there is one.
#[derive(Debug, Clone, PartialEq)]
pub struct Advice {
    /// Predicted error of the plan.
    pub expected: PredictedError,
    /// Settings of at most as many frames that are worth the change.
    pub better: Option<Proposal>,
}

/// Other settings are worth the change if their error is below this share of the plan's.
const WORTHWHILE: f64 = 0.9;

/// Numbers of frames that are tried one after the other to reach a wanted error.
const FRAMES: [usize; 9] = [8, 15, 30, 60, 120, 240, 480, 960, 1920];

/// Numbers of settings among which a sweep's frames are divided; the largest ones that they suffice for are tried.
const SETTINGS: [usize; 5] = [8, 15, 30, 60, 120];
const TRIED_SETTINGS: usize = 3;

/// Searches designs for the smallest predicted error. `usable` gives what of a design can be used, or `None` if the
/// rig cannot acquire it.
pub struct Search<'a, F> {
    /// The rig and the method.
    pub conditions: Conditions<'a>,
    /// How the settings may be arranged.
    pub arrangement: Arrangement,
    /// The design that gives the range of delays and exposures.
    pub plan: Design,
    /// What can be used of a design.
    pub usable: F,
}

impl<F: Fn(&Design) -> Option<Usable> + Sync> Search<'_, F> {
    /// Predicts the plan's error, and finds settings of the same number and with the same averaging whose error is
    /// smaller by 10 %.
    ///
    /// # Errors
    /// Those of [`Conditions::foresee`]; [`PlaneError::NoDelays`] if no setting of the plan is usable.
    pub fn advise(&self) -> Result<Advice, PlaneError> {
        let usable = (self.usable)(&self.plan).filter(|usable| !usable.settings.is_empty());
        let Usable { settings, noise } = usable.ok_or(PlaneError::NoDelays { index: 0 })?;
        let expected = self.conditions.foresee(&settings, &noise)?;
        let settings = self.plan.settings().len();
        let best = self.best(self.candidates(settings, self.plan.frames))?;
        let better = best.filter(|best| best.cost() <= WORTHWHILE * cost(&expected));
        Ok(Advice { expected, better })
    }

    /// The best settings of at most `frames` frames; `None` if the rig can acquire none.
    ///
    /// # Errors
    /// Those of [`Conditions::foresee`].
    pub fn of_frames(&self, frames: usize) -> Result<Option<Proposal>, PlaneError> {
        self.rough(frames)?.map(|best| self.refined(best)).transpose()
    }

    /// The shortest design whose median error is at most `error`; the best one of the longest if none is.
    ///
    /// # Errors
    /// Those of [`Conditions::foresee`].
    pub fn of_error(&self, error: f64) -> Result<Option<Proposal>, PlaneError> {
        let mut best: Option<Proposal> = None;
        for frames in FRAMES {
            let Some(found) = self.rough(frames)? else { continue };
            if best.as_ref().is_none_or(|best| found.foreseen.total.median < best.foreseen.total.median) {
                best = Some(found);
            }
            if best.as_ref().is_some_and(|best| best.foreseen.total.median <= error) {
                break;
            }
        }
        let Some(best) = best else { return Ok(None) };
        let reaches = |proposal: &Proposal| proposal.foreseen.total.median <= error;
        let refined = self.refined(best.clone())?;
        // What suits hard scenes better may suit typical ones less.
        Ok(Some(if reaches(&best) && !reaches(&refined) { best } else { refined }))
    }

    /// The best of the candidates of at most `frames` frames.
    fn rough(&self, frames: usize) -> Result<Option<Proposal>, PlaneError> {
        let candidates = match self.arrangement {
            Arrangement::Film => self.candidates(frames, 1),
            Arrangement::Sweep => {
                let counts = SETTINGS.into_iter().rev().filter(|&settings| settings <= frames);
                let of = |settings: usize| self.candidates(settings, (frames / settings) as u32);
                counts.take(TRIED_SETTINGS).flat_map(of).collect()
            }
        };
        self.best(candidates)
    }

    fn propose(&self, design: Design) -> Result<Option<Proposal>, PlaneError> {
        let usable = (self.usable)(&design).filter(|usable| !usable.settings.is_empty());
        let foresee = |Usable { settings, noise }| self.conditions.foresee(&settings, &noise);
        let foreseen = usable.map(foresee).transpose()?;
        Ok(foreseen.map(|foreseen| Proposal { design, foreseen }))
    }

    fn best(&self, designs: Vec<Design>) -> Result<Option<Proposal>, PlaneError> {
        let proposals: Vec<Option<Proposal>> =
            designs.into_par_iter().map(|design| self.propose(design)).collect::<Result<_, _>>()?;
        Ok(proposals.into_iter().flatten().min_by(|a, b| a.cost().total_cmp(&b.cost())))
    }

    /// Moves the delays of the main grid in pairs, outwards and inwards, as long as the error falls.
    fn refined(&self, mut best: Proposal) -> Result<Proposal, PlaneError> {
        let delays = best.design.grids[0].delays_us.len();
        if delays > MAX_REFINED {
            return Ok(best);
        }
        // The outermost delays give the reach.
        for pair in 1..delays / 2 {
            let moved = |factor: f64| {
                let mut design = best.design.clone();
                let delays_us = &mut design.grids[0].delays_us;
                for index in [pair, delays - 1 - pair] {
                    delays_us[index] = rounded(delays_us[index] * factor);
                }
                delays_us.is_sorted_by(|a, b| a < b).then_some(design)
            };
            let moved = MOVES.into_iter().filter_map(moved).collect();
            best = self.best(moved)?.filter(|moved| moved.cost() < best.cost()).unwrap_or(best);
        }
        Ok(best)
    }

    /// Designs of `settings` settings with the plan's reach.
    fn candidates(&self, settings: usize, frames: u32) -> Vec<Design> {
        let main = &self.plan.grids[0];
        let [shortest_us, longest_us] = range_of(main.exposures_us.iter().copied());
        let range_us = range_of(main.delays_us.iter().copied());
        let edges = Edges { row_time_us: self.conditions.timing.row_time_us(), exposure_us: shortest_us };
        match self.arrangement {
            Arrangement::Sweep => sweeps(settings, range_us, [shortest_us, longest_us], &edges),
            Arrangement::Film => films(settings, range_us, &edges),
        }
        .into_iter()
        .map(|grids| Design { grids, frames })
        .collect()
    }
}

/// Designs with more delays are not refined: single delays matter little there, and it would take long.
const MAX_REFINED: usize = 21;
const MOVES: [f64; 4] = [0.85, 0.95, 1.05, 1.15];

/// Exponents by which the delays spread out away from 0: evenly, denser near 0.
const DENSITIES: [f64; 3] = [1.0, 1.3, 1.7];

/// Numbers of settings whose opening edge steps over the pixel's own row, and the steps in rows.
const SWEEP_EDGES: [(usize, f64); 3] = [(0, 0.0), (7, 1.0), (15, 0.5)];
/// The same for films, for the opening and the closing edge each.
const FILM_EDGES: [(usize, f64); 8] =
    [(0, 0.0), (2, 1.0), (2, 2.0), (3, 1.0), (3, 1.5), (4, 0.7), (4, 1.0), (5, 0.7)];

/// Numbers of exposures in candidate grids, beside the longest alone.
const EXPOSURES: [usize; 2] = [2, 4];

/// Delays at which an edge of an exposure lies at a wanted row.
struct Edges {
    row_time_us: f64,
    exposure_us: f64,
}

impl Edges {
    /// `count` delays whose opening edges lie at rows `step_rows` apart about the pixel's own.
    fn opening(&self, count: usize, step_rows: f64) -> Vec<f64> {
        let row = |k: usize| (k as f64 - (count as f64 - 1.0) / 2.0) * step_rows;
        (0..count).map(|k| rounded(self.exposure_us / 2.0 + row(k) * self.row_time_us)).collect()
    }

    /// The same for closing edges.
    fn closing(&self, count: usize, step_rows: f64) -> Vec<f64> {
        self.opening(count, step_rows).into_iter().rev().map(|delay_us| -delay_us).collect()
    }
}

fn sweeps(
    settings: usize,
    delays_us: [f64; 2],
    exposures_us: [f64; 2],
    edges: &Edges,
) -> Vec<Vec<SweepGrid>> {
    let [shortest_us, longest_us] = exposures_us;
    // Rows that only the longest exposure reaches would be lost without it.
    let mut sets = vec![vec![longest_us]];
    if longest_us > shortest_us {
        sets.extend(EXPOSURES.map(|count| even([shortest_us, longest_us], count)));
    }
    let mut designs = Vec::new();
    for exposures_us in sets {
        for (count, step_rows) in SWEEP_EDGES {
            // Edges are for the rows near the own one; the far ones need most of the settings.
            let delays = settings.saturating_sub(count) / exposures_us.len();
            if 3 * count > settings || delays < 2 {
                continue;
            }
            for delays_us in delays_between(delays_us, delays) {
                let mut grids = vec![SweepGrid { delays_us, exposures_us: exposures_us.clone() }];
                if count > 0 {
                    let delays_us = edges.opening(count, step_rows);
                    grids.push(SweepGrid { delays_us, exposures_us: vec![edges.exposure_us] });
                }
                designs.push(grids);
            }
        }
    }
    designs
}

fn films(settings: usize, range_us: [f64; 2], edges: &Edges) -> Vec<Vec<SweepGrid>> {
    let mut designs = Vec::new();
    for (count, step_rows) in FILM_EDGES {
        let far = settings.saturating_sub(2 * count);
        if far < 3 {
            continue;
        }
        for far_us in delays_between(range_us, far) {
            let mut delays_us =
                [far_us, edges.opening(count, step_rows), edges.closing(count, step_rows)].concat();
            delays_us.sort_by(f64::total_cmp);
            delays_us.dedup();
            let inside = |delay_us: &f64| (range_us[0]..=range_us[1]).contains(delay_us);
            if delays_us.len() == settings && delays_us.iter().all(inside) {
                designs.push(vec![SweepGrid { delays_us, exposures_us: vec![edges.exposure_us] }]);
            }
        }
    }
    designs
}

/// `count` delays from the first to the last: evenly, and denser near 0 (`± d_max (k/h)^p`) if they lie on both sides.
fn delays_between([first_us, last_us]: [f64; 2], count: usize) -> Vec<Vec<f64>> {
    if first_us >= last_us || count < 2 {
        return Vec::new();
    }
    if first_us >= 0.0 || last_us <= 0.0 {
        return vec![even([first_us, last_us], count)];
    }
    // Number of delays on each side of 0, and whether one of them is 0.
    let (half, odd) = (count / 2, count % 2 == 1);
    let steps = half as f64 - if odd { 0.0 } else { 0.5 };
    let place = |far_us: f64, k: usize, density: f64| {
        rounded(far_us * ((k as f64 - if odd { 0.0 } else { 0.5 }) / steps).powf(density))
    };
    let delays = |density: f64| {
        let before = (1..=half).rev().map(move |k| place(first_us, k, density));
        before.chain(odd.then_some(0.0)).chain((1..=half).map(move |k| place(last_us, k, density))).collect()
    };
    DENSITIES.into_iter().map(delays).collect()
}

/// More digits are neither readable nor used by any camera.
fn rounded(delay_us: f64) -> f64 {
    (delay_us * 10.0).round() / 10.0
}

fn range_of(values: impl Iterator<Item = f64>) -> [f64; 2] {
    values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| [low.min(value), high.max(value)])
}

/// `count` evenly spaced values from `first` to `last`, at least two.
fn even([first, last]: [f64; 2], count: usize) -> Vec<f64> {
    (0..count).map(|k| first + (last - first) * k as f64 / (count - 1) as f64).collect()
}

#[cfg(test)]
mod tests {
    use super::super::super::{Prior, RowTiming, reach};
    use super::super::Calibrated;
    use super::*;

    const TAU_US: f64 = 22.22;

    fn timing() -> RowTiming {
        RowTiming::new(128, TAU_US, 50_000.0 / 3.0).unwrap()
    }

    fn paper_grid() -> SweepGrid {
        SweepGrid { delays_us: even([-1500.0, 1500.0], 15), exposures_us: even([600.0, 1200.0], 5) }
    }

    /// 15 electrons of read noise, and 4884 electrons that a white pixel collects per row.
    fn noise(frames: u32) -> Noise {
        Noise { read: 15.0 / 4884.0, gain: 1.0 / 4884.0, frames, dark_frames: Some(8) }
    }

    fn search<'a>(
        timing: &'a RowTiming,
        arrangement: Arrangement,
        grid: SweepGrid,
        usable: impl Fn(&Design) -> bool + Sync,
    ) -> Search<'a, impl Fn(&Design) -> Option<Usable> + Sync> {
        let usable = move |design: &Design| {
            usable(design).then(|| Usable { settings: design.settings(), noise: noise(design.frames) })
        };
        let conditions = Conditions { timing, prior: Prior::SPLIT, calibrated: Calibrated::EXACTLY };
        Search { conditions, arrangement, plan: Design { grids: vec![grid], frames: 1 }, usable }
    }

    #[test]
    fn the_proposed_sweep_is_as_long_and_reaches_as_far() {
        let timing = timing();
        let search = search(&timing, Arrangement::Sweep, paper_grid(), |_| true);
        let Advice { expected, better } = search.advise().unwrap();
        let Proposal { design, foreseen } = better.unwrap();
        assert_eq!(search.conditions.foresee(&design.settings(), &noise(1)).unwrap(), foreseen);
        assert!(cost(&foreseen) < WORTHWHILE * cost(&expected));
        assert!(design.settings().len() <= 75 && design.frames == 1);
        assert_eq!(reach(&timing, &design.settings()), reach(&timing, &paper_grid().settings()));
    }

    #[test]
    fn what_the_rig_cannot_take_is_not_proposed() {
        let timing = timing();
        let own = Design { grids: vec![paper_grid()], frames: 1 };
        let only_own = search(&timing, Arrangement::Sweep, paper_grid(), |design| *design == own).advise();
        assert_eq!(only_own.unwrap().better, None);
        let none = search(&timing, Arrangement::Sweep, paper_grid(), |_| false);
        assert_eq!(none.advise(), Err(PlaneError::NoDelays { index: 0 }));
        assert_eq!(none.of_frames(30), Ok(None));
    }

    #[test]
    fn a_film_gets_edges_on_the_own_row_unless_they_are_not_known() {
        let timing = timing();
        let film = SweepGrid { delays_us: even([-1500.0, 1500.0], 15), exposures_us: vec![600.0] };
        let mut search = search(&timing, Arrangement::Film, film, |_| true);
        let nearest_edge_rows = |proposal: &Proposal| {
            let edges = proposal.design.grids[0].delays_us.iter();
            edges.map(|delay_us| (delay_us.abs() - 300.0).abs() / TAU_US).fold(f64::INFINITY, f64::min)
        };
        let known = search.of_frames(15).unwrap().unwrap();
        assert_eq!(known.design.settings().len(), 15);
        assert!(nearest_edge_rows(&known) < 0.6, "{known:?}");
        search.conditions.calibrated = Calibrated { edge_us: 10.0, ..Calibrated::EXACTLY };
        let unknown = search.of_frames(15).unwrap().unwrap();
        assert!(nearest_edge_rows(&unknown) > 0.6, "{unknown:?}");
    }

    #[test]
    fn more_light_is_taken_for_a_smaller_error() {
        let timing = timing();
        let search = search(&timing, Arrangement::Sweep, paper_grid(), |_| true);
        let [rough, fine] = [0.08, 0.03].map(|error| search.of_error(error).unwrap().unwrap());
        assert!(rough.foreseen.total.median <= 0.08 && fine.foreseen.total.median <= 0.03);
        assert!(rough.design.total_frames() < fine.design.total_frames());
    }

    #[test]
    fn delays_to_one_side_stay_there() {
        let grids =
            sweeps(12, [0.0, 2000.0], [300.0, 600.0], &Edges { row_time_us: 20.0, exposure_us: 300.0 });
        assert!(!grids.is_empty());
        for grid in grids {
            assert_eq!((grid[0].delays_us[0], grid[0].delays_us.last().copied()), (0.0, Some(2000.0)));
        }
        assert_eq!(
            sweeps(2, [0.0, 0.0], [600.0, 900.0], &Edges { row_time_us: 20.0, exposure_us: 600.0 }),
            Vec::<Vec<SweepGrid>>::new()
        );
    }
}
