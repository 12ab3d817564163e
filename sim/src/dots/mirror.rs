//! The simulated mirror, and the adapter that moves the simulated beam with a mirror that has its own driver.

use std::sync::Arc;

use raysweep_core::{DeviceError, DeviceErrorKind, Mirror, MirrorCapabilities, MirrorPath, MirrorProgress};

use super::world::World;

/// Time from the start to the path's first sample.
const LEAD_NS: i64 = 1_000_000;

/// A mirror without a controller: it plays its path by the rig's clock.
pub struct DotMirror {
    world: Arc<World>,
    capabilities: MirrorCapabilities,
    phase: Phase,
}

enum Phase {
    Parked,
    Ready(MirrorPath),
    Moving,
}

impl DotMirror {
    pub fn new(world: Arc<World>) -> Self {
        let capabilities = MirrorCapabilities {
            model: "raysweep simulated mirror".into(),
            limits: world.bench.setup.limits,
            rate_hz: 50.0..=50_000.0,
            fifo_samples: 125_000,
        };
        Self { world, capabilities, phase: Phase::Parked }
    }
}

fn fault(kind: DeviceErrorKind, what: impl Into<String>) -> DeviceError {
    DeviceError::new("mirror", kind, what.into())
}

impl Mirror for DotMirror {
    fn capabilities(&self) -> &MirrorCapabilities {
        &self.capabilities
    }

    fn load(&mut self, path: &MirrorPath) -> Result<f64, DeviceError> {
        self.park()?;
        // Check the limits of this mirror; the path may have been built for another.
        let path = MirrorPath::new(path.points().to_vec(), path.rate_hz(), &self.capabilities.limits)
            .map_err(|error| fault(DeviceErrorKind::OutOfRange, error.to_string()))?;
        let rate_hz = path.rate_hz();
        if !self.capabilities.rate_hz.contains(&rate_hz) {
            let what = format!("rate_hz = {rate_hz}: the simulated mirror takes 50 to 50000");
            return Err(fault(DeviceErrorKind::OutOfRange, what));
        }
        self.phase = Phase::Ready(path);
        Ok(rate_hz)
    }

    fn start(&mut self, batches: u32) -> Result<(), DeviceError> {
        if batches == 0 {
            return Err(fault(DeviceErrorKind::OutOfRange, "batches = 0: play the path once at least"));
        }
        match std::mem::replace(&mut self.phase, Phase::Moving) {
            Phase::Ready(path) => {
                self.world.start(path, batches, Some(self.world.clock.now_ns() + LEAD_NS));
                Ok(())
            }
            before => {
                self.phase = before;
                Err(fault(DeviceErrorKind::NotReady, "no path is loaded: load one before each start"))
            }
        }
    }

    fn feed(&mut self) -> Result<MirrorProgress, DeviceError> {
        if !matches!(self.phase, Phase::Moving) {
            let what = "nothing is being played: load a path and start it";
            return Err(fault(DeviceErrorKind::NotReady, what));
        }
        let (played, total) = self.world.played();
        let parked = played == total;
        if parked {
            self.phase = Phase::Parked;
        }
        Ok(MirrorProgress { played, sent: total, total, parked, rate_hz: None })
    }

    fn park(&mut self) -> Result<(), DeviceError> {
        if let Phase::Moving = std::mem::replace(&mut self.phase, Phase::Parked) {
            self.world.stop();
        }
        Ok(())
    }
}

impl Drop for DotMirror {
    fn drop(&mut self) {
        // Parking cannot fail.
        let _ = self.park();
    }
}

/// A mirror with its own driver; its beam falls on the simulated scene.
pub struct WatchedMirror {
    mirror: Box<dyn Mirror>,
    world: Arc<World>,
    loaded: Option<MirrorPath>,
}

impl WatchedMirror {
    pub fn new(mirror: Box<dyn Mirror>, world: Arc<World>) -> Self {
        Self { mirror, world, loaded: None }
    }
}

impl Mirror for WatchedMirror {
    fn capabilities(&self) -> &MirrorCapabilities {
        self.mirror.capabilities()
    }

    fn load(&mut self, path: &MirrorPath) -> Result<f64, DeviceError> {
        self.world.stop();
        let rate_hz = self.mirror.load(path)?;
        self.loaded = Some(path.clone());
        Ok(rate_hz)
    }

    fn start(&mut self, batches: u32) -> Result<(), DeviceError> {
        self.mirror.start(batches)?;
        if let Some(path) = self.loaded.take() {
            self.world.start(path, batches, None);
        }
        Ok(())
    }

    fn feed(&mut self) -> Result<MirrorProgress, DeviceError> {
        let progress = self.mirror.feed().inspect_err(|_| self.world.stop())?;
        if progress.played > 0 {
            let rate_hz = progress.rate_hz.unwrap_or_else(|| self.world.rate_hz());
            let since_ns = (progress.played as f64 / rate_hz * 1e9) as i64;
            self.world.started(self.world.clock.now_ns() - since_ns);
        }
        Ok(progress)
    }

    fn park(&mut self) -> Result<(), DeviceError> {
        self.world.stop();
        self.mirror.park()
    }
}

impl Drop for WatchedMirror {
    fn drop(&mut self) {
        // The driver itself parks its mirror.
        self.world.stop();
    }
}
