//! The timing between a raster projector and a rolling-shutter camera.

/// When a projector lights its rows, measured from its VSYNC edge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Raster {
    /// Number of rows.
    pub rows: usize,
    /// Time for which each row is lit, which is also the time from one row to the next.
    pub row_time_us: f64,
    /// From the VSYNC edge to the start of row 0.
    pub first_row_us: f64,
    /// From one VSYNC edge to the next.
    pub period_us: f64,
}

/// How to trigger a camera to obtain a wanted delay.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trigger {
    /// Time from the trigger's edge, after the camera's latency, to the start of row 0's exposure; never negative.
    pub trigger_delay_us: f64,
    /// The edge whose light is measured, in edges after the trigger's own (0).
    pub light_edges_later: u32,
}

impl Raster {
    /// Time from the VSYNC edge to the centre of a row's illumination.
    pub fn row_centre_us(&self, row: usize) -> f64 {
        self.first_row_us + (row as f64 + 0.5) * self.row_time_us
    }

    /// The trigger delay for a wanted `delay_us` (t_d: centre of exposure minus centre of illumination of the same
    /// row; positive: the camera row receives light from lower rows).
    ///
    /// `row` is the projector row whose epipolar plane camera row 0 sees. Trigger delays cannot be negative: where
    /// one would be, an earlier edge triggers the frame.
    pub fn trigger(&self, row: usize, delay_us: f64, exposure_us: f64, latency_us: f64) -> Trigger {
        let after_light_edge_us = self.row_centre_us(row) + delay_us - exposure_us / 2.0 - latency_us;
        let light_edges_later = (-after_light_edge_us / self.period_us).ceil().max(0.0);
        Trigger {
            trigger_delay_us: after_light_edge_us + light_edges_later * self.period_us,
            light_edges_later: light_edges_later as u32,
        }
    }

    /// The true t_d of a frame whose row 0 began its exposure `start_us` after the edge of the light it measured.
    pub fn delay_us(&self, row: usize, start_us: f64, exposure_us: f64) -> f64 {
        start_us + exposure_us / 2.0 - self.row_centre_us(row)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RASTER: Raster = Raster { rows: 720, row_time_us: 20.0, first_row_us: 500.0, period_us: 16_000.0 };

    #[test]
    fn a_trigger_worked_by_hand() {
        // Row 10 is lit 700..720 us after the edge. An exposure of 600 us centred 100 us later runs 510..1110 us.
        let trigger = RASTER.trigger(10, 100.0, 600.0, 10.0);
        assert_eq!(trigger, Trigger { trigger_delay_us: 500.0, light_edges_later: 0 });
        assert_eq!(RASTER.delay_us(10, 510.0, 600.0), 100.0);
    }

    #[test]
    fn a_negative_delay_comes_from_the_edge_before() {
        // Row 0's centre is at 510 us: 510 - 1500 - 600 = -1590 us, one period earlier.
        let trigger = RASTER.trigger(0, -1500.0, 1200.0, 0.0);
        assert_eq!(trigger, Trigger { trigger_delay_us: 14_410.0, light_edges_later: 1 });
        assert_eq!(RASTER.delay_us(0, 14_410.0 - 16_000.0, 1200.0), -1500.0);
    }

    #[test]
    fn an_exposure_of_many_periods_still_has_a_trigger() {
        let trigger = RASTER.trigger(0, 0.0, 100_000.0, 0.0);
        assert!((0.0..16_000.0).contains(&trigger.trigger_delay_us));
        assert_eq!(trigger.light_edges_later, 4);
    }
}
