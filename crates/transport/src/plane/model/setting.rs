/// The exposure of one image of a stack: the mean of one frame per delay, all with the same exposure.
#[derive(Debug, Clone, PartialEq)]
pub struct Setting {
    /// True delay `t_d` of each averaged frame: centre of a row's exposure minus centre of its illumination, relative
    /// to the VSYNC edge of that frame. Positive: the camera row sees rows below its own (`u > 0`).
    pub delays_us: Vec<f64>,
    /// Exposure of a camera row, `t_e`.
    pub exposure_us: f64,
}

impl Setting {
    /// A setting whose frames all have the same delay.
    pub fn new(delay_us: f64, exposure_us: f64) -> Self {
        Self { delays_us: vec![delay_us], exposure_us }
    }

    /// The mean delay of its frames.
    pub fn mean_delay_us(&self) -> f64 {
        self.delays_us.iter().sum::<f64>() / self.delays_us.len() as f64
    }

    /// The same setting with an exposure that begins at the same time and is longer by `by_us`.
    pub fn longer(&self, by_us: f64) -> Self {
        Self {
            delays_us: self.delays_us.iter().map(|delay_us| delay_us + by_us / 2.0).collect(),
            exposure_us: self.exposure_us + by_us,
        }
    }

    /// The same setting with its delays reduced by `by_us`: that of light which comes so much later than assumed.
    pub fn earlier(&self, by_us: f64) -> Self {
        Self { delays_us: self.delays_us.iter().map(|delay_us| delay_us - by_us).collect(), ..*self }
    }
}

/// Delay `t_d` from the offset `t'_o` between the start of a row's exposure and the start of its illumination.
///
/// `t_d = (t_e - t_p)/2 - t'_o`. The paper's Eq. 1 prints `(t_e - t'_o)/2`, which contradicts its own text: light in
/// the middle of the exposure must give 0. For `t_e` = 600 us and `t_p` = 20 us, light centred in the exposure starts
/// at `t'_o` = 290 us and gives 0; light at the very start gives +290 us.
pub fn delay_us(exposure_us: f64, offset_us: f64, lit_us: f64) -> f64 {
    (exposure_us - lit_us) / 2.0 - offset_us
}

/// The offset `t'_o` that yields the delay `t_d`; the inverse of [`delay_us`].
pub fn offset_us(exposure_us: f64, delay_us: f64, lit_us: f64) -> f64 {
    (exposure_us - lit_us) / 2.0 - delay_us
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(a: f64, b: f64) {
        assert!((a - b).abs() < 1e-9, "{a} is not {b}");
    }

    #[test]
    fn eq_1_by_hand() {
        close(delay_us(600.0, 290.0, 20.0), 0.0);
        close(delay_us(600.0, 0.0, 20.0), 290.0);
        close(delay_us(600.0, 580.0, 20.0), -290.0);
        close(offset_us(600.0, delay_us(600.0, 123.0, 20.0), 20.0), 123.0);
    }
}
