/// A number of a calibration that all pixels and images of a run share.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CalibrationParameter {
    /// Time at which the light of all rows arrives, in microseconds.
    Latency,
    /// What exposures have more than their nominal length, in microseconds.
    ExposureOffset,
    /// Where a pixel looks, in projector rows.
    Place,
    /// Width of a pixel's response, relative to itself.
    Width,
    /// White level, relative to itself.
    White,
}

impl CalibrationParameter {
    /// In the order of a [`CalibrationCovariance`].
    pub const ALL: [Self; 5] = [Self::Latency, Self::ExposureOffset, Self::Place, Self::Width, Self::White];
}

/// Covariance of the errors of a calibration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CalibrationCovariance {
    /// Rows and columns as in [`CalibrationParameter::ALL`].
    pub matrix: [[f64; CalibrationParameter::ALL.len()]; CalibrationParameter::ALL.len()],
}

impl CalibrationCovariance {
    /// Independent errors with these standard deviations.
    pub fn independent(sds: [f64; CalibrationParameter::ALL.len()]) -> Self {
        let matrix =
            std::array::from_fn(|a| std::array::from_fn(|b| if a == b { sds[a].powi(2) } else { 0.0 }));
        Self { matrix }
    }

    /// The same after a run has measured the latency itself, with this standard deviation.
    #[must_use]
    pub fn with_latency_sd(mut self, sd_us: f64) -> Self {
        let latency = CalibrationParameter::Latency as usize;
        for other in 0..self.matrix.len() {
            (self.matrix[latency][other], self.matrix[other][latency]) = (0.0, 0.0);
        }
        self.matrix[latency][latency] = sd_us.powi(2);
        self
    }

    /// Standard deviation of a parameter.
    pub fn sd(&self, parameter: CalibrationParameter) -> f64 {
        self.matrix[parameter as usize][parameter as usize].sqrt()
    }

    /// Variance of a quantity that changes by `changes` with each parameter.
    pub fn variance_of(&self, changes: &[f64; CalibrationParameter::ALL.len()]) -> f64 {
        let rows = self.matrix.iter().zip(changes);
        let row = |row: &[f64]| row.iter().zip(changes).map(|(a, b)| a * b).sum::<f64>();
        rows.map(|(of_row, change)| change * row(of_row)).sum::<f64>().max(0.0)
    }
}
