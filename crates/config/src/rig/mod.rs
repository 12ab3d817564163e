//! `rig.toml`: the devices of a rig.

pub mod aravis;
pub mod dots;
pub mod plane;
pub mod replay;
mod sensor;
pub mod v4l2;
pub mod vsync;

use std::path::Path;

use raysweep_core::PixelFormat;
use serde::Deserialize;

pub use self::dots::DotRigFile;
pub use self::plane::RigFile;
use crate::ConfigError;
use crate::document::Document;
use crate::plan::is_kind;

/// The kinds of rigs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RigKind {
    /// Raster projector and rolling-shutter camera.
    Plane,
    /// Mirror and fast camera.
    Dots,
}

/// A rig file of either kind.
pub enum AnyRigFile {
    /// File of a plane rig.
    Plane(Box<RigFile>),
    /// File of a dot rig.
    Dots(Box<DotRigFile>),
}

impl AnyRigFile {
    /// Reads a rig file of either kind.
    ///
    /// # Errors
    /// All mistakes, with positions in the text.
    pub fn parse(text: &str) -> Result<Self, ConfigError> {
        let mut document = Document::parse(text)?;
        if let Some(plan) = document.string("kind").filter(|kind| is_kind(kind)) {
            let message = format!(
                "kind = {plan:?}: this is a plan; give a rig file, with kind = \"plane\" or kind = \"dots\""
            );
            document.refuse(&["kind"], message);
            return document.finish(None);
        }
        match document.require("kind", "kind = \"plane\" or kind = \"dots\"") {
            Some(RigKind::Plane) => RigFile::read(document).map(|rig| Self::Plane(Box::new(rig))),
            Some(RigKind::Dots) => DotRigFile::read(document).map(|rig| Self::Dots(Box::new(rig))),
            None => document.finish(None),
        }
    }
}

/// Longer than a camera takes to start.
pub(super) fn default_reopen_s() -> f64 {
    60.0
}
/// 2500 of the 4096 counts of 12 bits, scaled to a format.
pub(super) fn default_white_dn(format: PixelFormat) -> f64 {
    2500.0 / 4096.0 * full_scale_dn(format)
}

/// 64 of the 4096 counts of 12 bits, scaled to a format.
pub(super) fn default_black_dn(format: PixelFormat) -> f64 {
    64.0 / 4096.0 * full_scale_dn(format)
}

pub(super) fn full_scale_dn(format: PixelFormat) -> f64 {
    f64::from(format.max_value()) + 1.0
}

pub(super) fn default_pixel_format() -> PixelFormat {
    PixelFormat::Mono12
}

/// A scene, unless it is the name of a built-in one.
fn scene_file(scene: &Path) -> Option<&Path> {
    scene.extension().is_some().then_some(scene)
}
