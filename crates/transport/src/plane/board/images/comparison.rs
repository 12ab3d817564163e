//! The responses of two boards, of which one may scatter light inside.

use std::fmt;

use super::response::{REACH_COLUMNS, REACH_ROWS, Responses};
use super::{Estimate, ImagesError};

/// Which of two boards has the narrower responses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Narrower {
    /// The first.
    First,
    /// The second.
    Second,
    /// They do not differ: the first is as good.
    Neither,
}

/// Widths of the responses of two boards, as second central moments in rows^2.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ResponseComparison {
    /// The board whose responses are to be taken.
    pub narrower: Narrower,
    /// Mean second moment of each board.
    pub second_moments: [f64; 2],
    /// The second board's moment minus the first's.
    pub difference: Estimate,
    /// The smallest difference of the moments that counts.
    pub resolution: f64,
}

impl fmt::Display for ResponseComparison {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let [first, second] = self.second_moments;
        let Estimate { value, sd } = self.difference;
        let (wider, taken) = match self.narrower {
            Narrower::First => ("the second board", "the responses of the first are taken"),
            Narrower::Second => ("the first board", "the responses of the second are taken"),
            Narrower::Neither => {
                return write!(
                    f,
                    "both boards respond alike (second moments {first:.3} and {second:.3} rows^2): the responses of \
                     the first are taken"
                );
            }
        };
        write!(
            f,
            "{wider} scatters light over {:.2} rows more than the other (second moments {first:.3} and {second:.3} \
             rows^2, difference {value:.3} with standard deviation {sd:.3}): {taken}",
            value.abs().sqrt()
        )
    }
}

/// Groups of pixels by the fraction of their place: the moment of a sharp-edged beam depends on it.
const FRACTIONS: usize = 16;
/// Largest number of pixels that share their light through averaging.
const AVERAGED: f64 = ((2 * REACH_ROWS + 1) * (2 * REACH_COLUMNS + 1)) as f64;
/// A difference counts from this many standard deviations, and from this share of the moment.
const DIFFERENCE_SIGMAS: f64 = 3.0;
const DIFFERENCE_SHARE: f64 = 0.02;

/// Compares the responses of two boards of different material.
///
/// A board that scatters light inside widens the responses, which cannot be told from the beam's width with one board.
/// The narrower responses are closer to the beam's. Pixels are compared at the same fraction of a row.
///
/// # Errors
/// [`ImagesError::TooFew`] if the boards have no fraction in common.
pub fn compare_responses(first: &Responses, second: &Responses) -> Result<ResponseComparison, ImagesError> {
    let [of_first, of_second] = [first, second].map(moments_by_fraction);
    let (mut sums, mut variance, mut groups) = ([0.0; 2], 0.0, 0);
    for (a, b) in of_first.iter().zip(&of_second) {
        if let (Some(a), Some(b)) = (a, b) {
            sums[0] += a.value;
            sums[1] += b.value;
            variance += a.sd.powi(2) + b.sd.powi(2);
            groups += 1;
        }
    }
    if groups == 0 {
        let cure = "move the second board by a few per cent of its distance";
        let what = "fractions of a row that both boards have in common";
        return Err(ImagesError::TooFew { what, given: 0, needed: 1, cure });
    }
    let n = f64::from(groups);
    let second_moments = sums.map(|sum| sum / n);
    let difference = Estimate { value: second_moments[1] - second_moments[0], sd: variance.sqrt() / n };
    let resolution =
        (DIFFERENCE_SIGMAS * difference.sd).max(DIFFERENCE_SHARE * second_moments[0].max(second_moments[1]));
    let narrower = match difference.value {
        value if value > resolution => Narrower::First,
        value if value < -resolution => Narrower::Second,
        _ => Narrower::Neither,
    };
    Ok(ResponseComparison { narrower, second_moments, difference, resolution })
}

/// Mean second moment of the pixels of each fraction of a row, if there are enough of them.
fn moments_by_fraction(responses: &Responses) -> Vec<Option<Estimate>> {
    let mut groups = vec![Vec::new(); FRACTIONS];
    for ((t, s), &place) in responses.place.indexed_iter() {
        if !place.is_nan() {
            let group = (place.rem_euclid(1.0) * FRACTIONS as f32) as usize;
            groups[group.min(FRACTIONS - 1)].push(responses.second_moment(t, s));
        }
    }
    let estimate = |moments: Vec<f64>| {
        let n = moments.len() as f64;
        (n >= AVERAGED).then(|| {
            let value = moments.iter().sum::<f64>() / n;
            let scatter = moments.iter().map(|moment| (moment - value).powi(2)).sum::<f64>() / n;
            Estimate { value, sd: (scatter * AVERAGED / n).sqrt() }
        })
    };
    groups.into_iter().map(estimate).collect()
}
