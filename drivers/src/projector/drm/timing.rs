//! Video timings.

use drm::control::Mode;
use drm_ffi::{drm_mode_modeinfo, drm_sys};

/// A video timing, as in an X11 modeline.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timing {
    /// Pixels per millisecond, including blanking.
    pub pixel_clock_khz: u32,
    /// Columns: visible, start of the sync pulse, end of the sync pulse, total.
    pub columns: [u16; 4],
    /// Rows: visible, start of the sync pulse, end of the sync pulse, total.
    pub rows: [u16; 4],
    /// Whether the horizontal and the vertical sync pulse are positive.
    pub positive_sync: [bool; 2],
}

impl Timing {
    /// 1280x720 at 60 Hz with 750 rows (CEA-861, format 4).
    pub const HD_720P60: Self = Self {
        pixel_clock_khz: 74_250,
        columns: [1280, 1390, 1430, 1650],
        rows: [720, 725, 730, 750],
        positive_sync: [true, true],
    };

    /// Time from one VSYNC to the next, in us.
    pub fn period_us(&self) -> f64 {
        f64::from(self.columns[3]) * f64::from(self.rows[3]) / f64::from(self.pixel_clock_khz) * 1e3
    }

    /// The timing as a kernel mode.
    pub(super) fn mode(&self) -> Mode {
        let ([hdisplay, hsync_start, hsync_end, htotal], [vdisplay, vsync_start, vsync_end, vtotal]) =
            (self.columns, self.rows);
        let [horizontal, vertical] = self.positive_sync;
        let hsync = if horizontal { drm_sys::DRM_MODE_FLAG_PHSYNC } else { drm_sys::DRM_MODE_FLAG_NHSYNC };
        let vsync = if vertical { drm_sys::DRM_MODE_FLAG_PVSYNC } else { drm_sys::DRM_MODE_FLAG_NVSYNC };
        Mode::from(drm_mode_modeinfo {
            clock: self.pixel_clock_khz,
            hdisplay,
            hsync_start,
            hsync_end,
            htotal,
            hskew: 0,
            vdisplay,
            vsync_start,
            vsync_end,
            vtotal,
            vscan: 0,
            vrefresh: (1e6 / self.period_us()).round() as u32,
            flags: hsync | vsync,
            type_: drm_sys::DRM_MODE_TYPE_USERDEF,
            name: [0; 32],
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hd_is_sixty_frames_of_750_rows() {
        let timing = Timing::HD_720P60;
        assert!((timing.period_us() - 16_666.666_667).abs() < 1e-6);
        let mode = timing.mode();
        assert_eq!((mode.size(), mode.vrefresh()), ((1280, 720), 60));
    }
}
