//! What a sweep acquires, point by point, in the order of acquisition.

use raysweep_core::{CameraSettings, Raster, Shutter};

/// What a point's image is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Role {
    /// Projector dark; the index counts the exposures, shortest first.
    Dark(u32),
    /// One whole VSYNC period of exposure: every row lit once.
    Regular,
    /// The plan's point: `exposure_index * delays + delay_index`.
    Sweep(u32),
}

/// One point: frames under one setting that are averaged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// What it is for.
    pub role: Role,
    /// Wanted t_d.
    pub delay_us: f64,
    /// Wanted t_e.
    pub exposure_us: f64,
    /// Frames to average.
    pub frames: u32,
}

/// All points of a run. A point's ordinal is its place in `points`.
#[derive(Debug, Clone, PartialEq)]
pub struct Schedule {
    /// In the order of acquisition: dark frames, the regular image, then the sweep.
    pub points: Vec<Point>,
}

impl Schedule {
    /// How many points the plan's sweep has.
    pub fn sweep_len(&self) -> usize {
        self.points.iter().filter(|point| matches!(point.role, Role::Sweep(_))).count()
    }

    /// How many dark points belong to it.
    pub fn dark_len(&self) -> usize {
        self.points.iter().filter(|point| matches!(point.role, Role::Dark(_))).count()
    }

    /// The dark point of an exposure.
    pub fn dark_of(&self, exposure_us: f64) -> Option<Role> {
        let dark = |point: &&Point| matches!(point.role, Role::Dark(_)) && point.exposure_us == exposure_us;
        self.points.iter().find(dark).map(|point| point.role)
    }
}

/// What turns counts and times into light transport: the rig, as the rig file states it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SweepGeometry {
    /// When the projector lights its rows.
    pub raster: Raster,
    /// Projector row that camera row 0 sees.
    pub first_row: usize,
    /// Camera rows.
    pub height: usize,
    /// Camera columns.
    pub width: usize,
    /// Counts, above black, of a white pixel in the time of one projector row.
    pub white_dn: f64,
    /// Counts from which on a pixel counts as saturated.
    pub saturation_dn: f64,
}

/// How a camera must be set for a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shot {
    /// Its settings.
    pub settings: CameraSettings,
    /// Which edge's light is measured: the trigger's own (0) or a later one.
    pub light_edges_later: u32,
}

impl SweepGeometry {
    /// The settings for a point on a camera with this trigger latency.
    pub fn shot(&self, point: &Point, trigger_latency_us: f64) -> Shot {
        let trigger =
            self.raster.trigger(self.first_row, point.delay_us, point.exposure_us, trigger_latency_us);
        Shot {
            settings: CameraSettings {
                shutter: Shutter::Rolling,
                exposure_us: point.exposure_us,
                trigger_delay_us: trigger.trigger_delay_us,
            },
            light_edges_later: trigger.light_edges_later,
        }
    }
}
