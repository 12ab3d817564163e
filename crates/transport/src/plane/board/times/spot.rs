use ndarray::ArrayView2;

use super::super::super::NoiseModel;
use super::super::super::model::{FlyingSpot, Scan};
use super::super::images::Responses;
use super::columns::Columns;
use super::error::TimesError;
use super::result::RowTimes;
use super::settings::{BoardFrame, Nominal};

impl RowTimes {
    /// [`Self::fit`] for rows that are drawn by a flying spot whose direction is unknown, which passes the projector's
    /// `columns` that pixels see, `[t, s]` in 0..=1. `None` if no direction explains the frames.
    ///
    /// # Errors
    /// [`TimesError::Direction`] if both do; those of [`Columns::new`].
    pub fn find_spot(
        responses: &Responses,
        columns: ArrayView2<f32>,
        frames: &[BoardFrame],
        nominal: &Nominal,
        noise: NoiseModel,
    ) -> Result<Option<(Self, FlyingSpot)>, TimesError> {
        let fit = |scan| {
            let spot = FlyingSpot { scan, columns: columns.to_owned() };
            let columns = Columns::new(responses.place.view(), responses.response.view(), Some(&spot))?
                .with_errors_of(responses)?;
            Ok::<_, TimesError>(Self::fit(&columns, frames, nominal, noise).ok().map(|times| (times, spot)))
        };
        let (one_way, bidirectional) = rayon::join(|| fit(Scan::OneWay), || fit(Scan::Bidirectional));
        match (one_way?, bidirectional?) {
            (Some(_), Some(_)) => Err(TimesError::Direction),
            (one_way, bidirectional) => Ok(one_way.or(bidirectional)),
        }
    }
}
