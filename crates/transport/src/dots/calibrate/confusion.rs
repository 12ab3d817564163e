use rayon::prelude::*;

use super::{Centroids, Footprints};
use crate::dots::DotsError;
use crate::dots::error::check_shape;
use crate::dots::sensor::median;

/// The number of pixels that each pair of dots shares: the calibration confusion matrix M, symmetric, with the dots'
/// areas on its diagonal. Only nonzero entries are stored, as compressed sparse rows in the layout of
/// `scipy.sparse.csr_matrix`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Confusion {
    offsets: Vec<u64>,
    neighbours: Vec<u32>,
    overlaps_px: Vec<u32>,
}

impl Confusion {
    /// From the footprints of the calibration plane's dots.
    pub fn new(footprints: &Footprints) -> Self {
        let buckets = Buckets::new(footprints);
        let dots = footprints.dots();
        let rows: Vec<Vec<(u32, u32)>> = (0..dots)
            .into_par_iter()
            .map_init(
                || (vec![0_u32; dots], Vec::new()),
                |(overlaps, met), dot| {
                    for (word, mask) in footprints.words(dot) {
                        for &(other, others) in buckets.of_word(word) {
                            let overlap = (mask & others).count_ones();
                            if overlap > 0 && overlaps[other as usize] == 0 {
                                met.push(other);
                            }
                            overlaps[other as usize] += overlap;
                        }
                    }
                    met.sort_unstable();
                    met.drain(..)
                        .map(|other| (other, std::mem::take(&mut overlaps[other as usize])))
                        .collect()
                },
            )
            .collect();
        Self::of_rows(rows)
    }

    fn of_rows(rows: Vec<Vec<(u32, u32)>>) -> Self {
        let mut confusion = Self { offsets: vec![0], ..Self::default() };
        for row in rows {
            confusion.neighbours.extend(row.iter().map(|(other, _)| other));
            confusion.overlaps_px.extend(row.iter().map(|(_, overlap)| overlap));
            confusion.offsets.push(confusion.neighbours.len() as u64);
        }
        confusion
    }

    /// The same with neighbours for the dots that the plane does not show, but whose places are known: each shares one
    /// pixel with itself and with all dots as near as the farthest neighbour of a seen dot is in the median. Unchanged
    /// if no dot has a neighbour.
    ///
    /// # Errors
    /// [`DotsError::Shape`] if the numbers of dots differ.
    pub fn extended(&self, seen: &Centroids, places: &Centroids) -> Result<Self, DotsError> {
        let dots = self.dots();
        check_shape("seen", "[dots]", &[seen.xy.len()], &[dots])?;
        check_shape("places", "[dots]", &[places.xy.len()], &[dots])?;
        let distance = |one: usize, other: usize| {
            let (one, other) = (places.xy[one]?, places.xy[other]?);
            Some((one[0] - other[0]).hypot(one[1] - other[1]))
        };
        let farthest = |dot: usize| {
            let neighbours = self.neighbours(dot).iter().filter(|other| seen.xy[**other as usize].is_some());
            neighbours.filter_map(|other| distance(dot, *other as usize)).fold(0.0, f64::max)
        };
        let seen_dots = (0..dots).filter(|dot| seen.xy[*dot].is_some());
        let mut reaches: Vec<f64> = seen_dots.map(farthest).filter(|reach| *reach > 0.0).collect();
        if reaches.is_empty() {
            return Ok(self.clone());
        }
        let reach = median(&mut reaches);
        let unseen: Vec<usize> = (0..dots).filter(|dot| seen.xy[*dot].is_none()).collect();
        let all: Vec<usize> = (0..dots).collect();
        let rows = (0..dots).into_par_iter().map(|dot| {
            let met = self.neighbours(dot).iter().map(|&other| (other, self.overlap_px(dot, other as usize)));
            let candidates = if seen.xy[dot].is_none() { &all } else { &unseen };
            let near = candidates.iter().filter(|other| {
                distance(dot, **other).is_some_and(|distance| distance <= reach)
                    && self.overlap_px(dot, **other) == 0
            });
            let mut row: Vec<(u32, u32)> = met.chain(near.map(|other| (*other as u32, 1))).collect();
            row.sort_unstable();
            row
        });
        Ok(Self::of_rows(rows.collect()))
    }

    /// Number of dots.
    pub fn dots(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    /// The dots that share pixels with `dot`, including itself, in ascending order.
    ///
    /// # Panics
    /// If the dot does not exist.
    pub fn neighbours(&self, dot: usize) -> &[u32] {
        &self.neighbours[self.offsets[dot] as usize..self.offsets[dot + 1] as usize]
    }

    /// Number of pixels that two dots share.
    ///
    /// # Panics
    /// If `dot` does not exist.
    pub fn overlap_px(&self, dot: usize, other: usize) -> u32 {
        let at = self.neighbours(dot).binary_search(&(other as u32));
        at.map_or(0, |at| self.overlaps_px[self.offsets[dot] as usize + at])
    }

    /// Row offsets, column indices and values.
    pub fn arrays(&self) -> (&[u64], &[u32], &[u32]) {
        (&self.offsets, &self.neighbours, &self.overlaps_px)
    }
}

/// All dots' masks, sorted by word, so that dots without a common word are never compared.
struct Buckets {
    offsets: Vec<u32>,
    dots: Vec<(u32, u32)>,
}

impl Buckets {
    fn new(footprints: &Footprints) -> Self {
        let dots = 0..footprints.dots();
        let all =
            || dots.clone().flat_map(|dot| footprints.words(dot).map(move |(word, mask)| (word, dot, mask)));
        let mut offsets = vec![0_u32; footprints.shape().words() + 2];
        // Counted two entries ahead, so that filling moves each offset to its final value.
        all().for_each(|(word, ..)| offsets[word + 2] += 1);
        (2..offsets.len()).for_each(|at| offsets[at] += offsets[at - 1]);
        let mut sorted = vec![(0, 0); offsets.last().map_or(0, |&count| count as usize)];
        for (word, dot, mask) in all() {
            sorted[offsets[word + 1] as usize] = (dot as u32, mask);
            offsets[word + 1] += 1;
        }
        Self { offsets, dots: sorted }
    }

    fn of_word(&self, word: usize) -> &[(u32, u32)] {
        &self.dots[self.offsets[word] as usize..self.offsets[word + 1] as usize]
    }
}
