//! `rig.toml` of a dot rig: a mirror that moves one spot of light, and a camera that takes one frame per position.

use std::path::PathBuf;

use raysweep_core::{MechanicalDeg, MirrorLimits, PixelFormat, SecondOrder};
use serde::Deserialize;

use super::aravis::AravisConfig;
use super::replay::ReplayConfig;
use super::v4l2::V4l2Config;
use super::{
    RigKind, default_black_dn, default_pixel_format, default_reopen_s, default_white_dn, scene_file,
};
use crate::document::Document;
use crate::sim::DotsConfig;
use crate::{ConfigError, Places};

/// A dot rig.
#[derive(Debug, Clone)]
pub struct DotRigFile {
    /// `[camera]`
    pub camera: DotCameraSection,
    /// `[mirror]`; absent if the frames come from a recording.
    pub mirror: Option<MirrorSection>,
    /// `[sim]`, for the driver `sim`.
    pub sim: DotSimSection,
    /// Folders, relative to the rig file, whose files plans may name beside the sessions in the daemon's data folder.
    pub plan_folders: Vec<PathBuf>,
    /// Positions of the values in the text.
    pub places: Places,
}

/// `[sim]` of a dot rig.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DotSimSection {
    /// `[sim.dots]`
    pub dots: DotsConfig,
}

/// Drivers of a dot rig's camera, by their names in rig files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DotCameraDriver {
    /// The simulated rig.
    Sim,
    /// Previously recorded frames.
    Replay,
    /// GigE Vision and USB3 Vision through libaravis.
    Aravis,
    /// Cameras supported by the Linux kernel (V4L2).
    V4l2,
}

/// `[camera]` of a dot rig.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DotCameraSection {
    /// The driver that opens it.
    pub driver: DotCameraDriver,
    /// Pixel format of the frames.
    #[serde(default = "default_pixel_format")]
    pub pixel_format: PixelFormat,
    /// Counts, above black, of a white plane at the centre of the dot; default: 2500 of 4096, scaled to the format.
    white_dn: Option<f64>,
    /// The exposure that `white_dn` is for.
    #[serde(default = "default_white_exposure_us")]
    pub white_exposure_us: f64,
    /// Counts without light; default: 64 of 4096, scaled to the format.
    black_dn: Option<f64>,
    /// How long to wait, in a run, for a camera that has stopped responding.
    #[serde(default = "default_reopen_s")]
    pub reopen_s: f64,
    /// `[camera.aravis]`, for the driver `aravis`.
    #[serde(default)]
    pub aravis: AravisConfig,
    /// `[camera.v4l2]`, for the driver `v4l2`.
    pub v4l2: Option<V4l2Config>,
    /// `[camera.replay]`, for the driver `replay`; its path is relative to the rig file.
    pub replay: Option<ReplayConfig>,
}

impl DotCameraSection {
    /// Counts, above black, of a white plane at the centre of the dot.
    pub fn white_dn(&self) -> f64 {
        self.white_dn.unwrap_or_else(|| default_white_dn(self.pixel_format))
    }

    /// Counts without light.
    pub fn black_dn(&self) -> f64 {
        self.black_dn.unwrap_or_else(|| default_black_dn(self.pixel_format))
    }
}

/// Mirror drivers, by their names in rig files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MirrorDriver {
    /// The simulated rig.
    Sim,
    /// Mirrorcle's PlayzerX.
    PlayzerX,
    /// Mirrorcle's MTI controllers.
    Mti,
    /// Optotune's MR-E-2.
    Optotune,
}

impl MirrorDriver {
    /// Its name in rig files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Sim => "sim",
            Self::PlayzerX => "playzerx",
            Self::Mti => "mti",
            Self::Optotune => "optotune",
        }
    }
}

/// `[mirror]`
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MirrorSection {
    /// The driver that opens it.
    pub driver: MirrorDriver,
    /// Its serial port, for all drivers but `sim`.
    pub port: Option<PathBuf>,
    /// How a PlayzerX is connected.
    #[serde(default)]
    pub link: PlayzerXLink,
    /// Tilt of the mirror at the controller's full scale.
    #[serde(default = "default_full_scale")]
    pub full_scale_deg: f64,
    /// Angle between the beam and the mirror's normal at rest.
    #[serde(default)]
    pub incidence_deg: f64,
    /// Limits that protect the mirror from damage.
    #[serde(default = "default_limits")]
    pub limits: MirrorLimits,
    /// Drive parameters of an MTI controller.
    #[serde(default)]
    pub drive: MtiDrive,
    /// The maximum drive parameters of the mirror, from its data sheet.
    #[serde(default)]
    pub max_drive: MtiDrive,
    /// Response of the axes; if given, paths are predistorted so that the mirror follows them.
    pub response: Option<ResponseKey>,
    /// A file that starts with `1` while the interlock is closed, such as a GPIO's value; default: the operator
    /// permits light.
    pub interlock: Option<PathBuf>,
    /// The port whose RTS line enables the laser; for the driver `optotune`.
    pub laser_port: Option<PathBuf>,
}

/// `mirror.response`
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(
    untagged,
    expecting = "expected \"identified\", or [{ f0_hz = .., q = .. }, { f0_hz = .., q = .. }] of x and y"
)]
pub enum ResponseKey {
    /// The response that a run of kind `response` has identified.
    Found(IdentifiedWord),
    /// Responses stated here, for x and y.
    Stated([SecondOrder; 2]),
}

/// Accepts only the word `identified`.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum IdentifiedWord {
    /// Use the response that was identified.
    Identified,
}

/// How a PlayzerX is connected.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PlayzerXLink {
    /// Over USB, as a virtual serial port: fast enough for any rate.
    #[default]
    VirtualCom,
    /// Over a UART at 921,600 baud: with 10 bits per byte and 9 bytes per sample, at most 10,240 samples/s.
    Uart,
}

/// Drive parameters of an MTI controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MtiDrive {
    /// Bias voltage, 0..=100 V.
    pub bias_v: u32,
    /// Largest voltage difference between the electrodes of an axis, 0..=200 V.
    pub difference_v: u32,
    /// -3 dB frequency of the controller's low-pass, 50..=15,000 Hz.
    pub bandwidth_hz: u32,
}

impl MtiDrive {
    /// Maximum for Mirrorcle's A7B2.3-3600AL.
    pub const A7B2_3_3600AL: Self = Self { bias_v: 80, difference_v: 150, bandwidth_hz: 200 };
}

impl Default for MtiDrive {
    fn default() -> Self {
        Self::A7B2_3_3600AL
    }
}

/// Near the period of the paper's camera, 13,500 frames/s.
fn default_white_exposure_us() -> f64 {
    70.0
}
fn default_full_scale() -> f64 {
    MirrorLimits::A7B2_3_3600AL.max_tilt.0
}
/// Any tilt that can throw a beam forwards.
const OF_RECORDINGS: MirrorLimits = MirrorLimits {
    max_tilt: MechanicalDeg(44.0),
    max_step: MechanicalDeg(88.0),
    max_slew_deg_per_s: 1e12,
    bandwidth_hz: 1e12,
    out_of_band: MechanicalDeg(88.0),
};

fn default_limits() -> MirrorLimits {
    MirrorLimits::A7B2_3_3600AL
}

impl DotRigFile {
    /// What the file refers to, by paths that are relative to it or absolute, with the keys that give them.
    pub fn paths(&self) -> Vec<(Vec<String>, PathBuf)> {
        let keys = |keys: &[&str]| keys.iter().map(|key| (*key).to_owned()).collect::<Vec<_>>();
        let dots = &self.sim.dots;
        let scene = scene_file(&dots.scene).map(|scene| (keys(&["sim", "dots", "scene"]), scene.to_owned()));
        let mut paths: Vec<_> = scene.into_iter().collect();
        for (index, file) in dots.plane_files.iter().enumerate() {
            paths.push((keys(&["sim", "dots", "plane_files", &index.to_string()]), file.clone()));
        }
        for (index, folder) in self.plan_folders.iter().enumerate() {
            paths.push((keys(&["plan_folders", &index.to_string()]), folder.clone()));
        }
        paths.extend(
            self.camera
                .replay
                .iter()
                .map(|replay| (keys(&["camera", "replay", "path"]), replay.path.clone())),
        );
        paths
    }

    /// Reads a rig file.
    ///
    /// # Errors
    /// All mistakes, with positions in the text.
    pub fn parse(text: &str) -> Result<Self, ConfigError> {
        let mut document = Document::parse(text)?;
        match document.require("kind", "kind = \"dots\"") {
            Some(RigKind::Dots) => {}
            Some(RigKind::Plane) => {
                document.refuse(&["kind"], "kind = \"plane\": must be \"dots\" for a dot rig")
            }
            None => return document.finish(None),
        }
        Self::read(document)
    }

    /// Reads a document whose kind is [`RigKind::Dots`].
    pub(super) fn read(mut document: Document<'_>) -> Result<Self, ConfigError> {
        let camera: Option<DotCameraSection> = document.require("camera", "a table [camera] with a driver");
        let has_mirror = document.places().has(&["mirror"]);
        let mirror: Option<MirrorSection> = document.take("mirror");
        let sim: Option<DotSimSection> = document.take_or_default("sim");
        let plan_folders: Option<Vec<PathBuf>> = document.take_or_default("plan_folders");
        document.refuse_others(&["kind", "camera", "mirror", "sim", "plan_folders"]);
        if let Some(camera) = &camera {
            camera.check(&mut document);
        }
        if let Some(mirror) = &mirror {
            mirror.check(&mut document);
        }
        let (Some(camera), Some(sim), Some(plan_folders), true) =
            (camera, sim, plan_folders, mirror.is_some() == has_mirror)
        else {
            return document.finish(None);
        };
        let rig = Self { camera, mirror, sim, plan_folders, places: document.places().clone() };
        rig.check(&mut document);
        document.finish(Some(rig))
    }

    /// Limits of its mirror's paths; none for a recording, whose mirror has moved already.
    pub fn limits(&self) -> MirrorLimits {
        self.mirror.as_ref().map_or(OF_RECORDINGS, |mirror| mirror.limits)
    }

    /// Angle between the beam and the mirror's normal at rest.
    pub fn incidence(&self) -> MechanicalDeg {
        MechanicalDeg(self.mirror.as_ref().map_or(0.0, |mirror| mirror.incidence_deg))
    }

    /// Checks rules that involve several tables.
    fn check(&self, document: &mut Document<'_>) {
        match &self.mirror {
            None if self.camera.driver != DotCameraDriver::Replay => {
                let message = "missing table [mirror]: add it with the mirror's driver; only camera.driver = \"replay\" needs none";
                document.refuse(&["camera", "driver"], message);
            }
            Some(mirror)
                if mirror.driver == MirrorDriver::Sim && self.camera.driver != DotCameraDriver::Sim =>
            {
                let message = "mirror.driver = \"sim\" requires camera.driver = \"sim\": give the driver of the real mirror, or leave [mirror] out for a recording";
                document.refuse(&["mirror", "driver"], message);
            }
            _ => {}
        }
    }
}

impl DotCameraSection {
    fn check(&self, document: &mut Document<'_>) {
        let max_dn = f64::from(self.pixel_format.max_value());
        for (key, value, allowed) in [
            ("white_dn", self.white_dn(), 1.0..=16.0 * max_dn),
            ("white_exposure_us", self.white_exposure_us, 0.1..=1e6),
            ("black_dn", self.black_dn(), 0.0..=max_dn / 2.0),
            ("reopen_s", self.reopen_s, 0.0..=3600.0),
        ] {
            document.check_range(&["camera", key], value, allowed);
        }
        match self.driver {
            DotCameraDriver::Sim => {}
            DotCameraDriver::Replay if self.replay.is_some() => {}
            DotCameraDriver::Replay => {
                let message = "camera.driver = \"replay\" requires a table [camera.replay] with the path of the recording";
                document.refuse(&["camera", "driver"], message);
            }
            DotCameraDriver::Aravis => document.refuse_all(&["camera", "aravis"], self.aravis.faults()),
            DotCameraDriver::V4l2 => V4l2Config::check_section(self.v4l2.as_ref(), document),
        }
    }
}

impl MirrorSection {
    fn check(&self, document: &mut Document<'_>) {
        document.check_range(&["mirror", "full_scale_deg"], self.full_scale_deg, 0.1..=45.0);
        document.check_range(&["mirror", "incidence_deg"], self.incidence_deg, 0.0..=60.0);
        let limits = &self.limits;
        for (key, value, allowed) in [
            ("max_tilt", limits.max_tilt.0, 0.01..=45.0),
            ("max_step", limits.max_step.0, 1e-4..=limits.max_tilt.0),
            ("max_slew_deg_per_s", limits.max_slew_deg_per_s, 1e-3..=1e7),
            ("bandwidth_hz", limits.bandwidth_hz, 1.0..=1e5),
            ("out_of_band", limits.out_of_band.0, 0.0..=limits.max_tilt.0),
        ] {
            document.check_range(&["mirror", "limits", key], value, allowed);
        }
        if let Some(ResponseKey::Stated(axes)) = &self.response {
            for (axis, SecondOrder { f0_hz, q }) in axes.iter().enumerate() {
                let axis = axis.to_string();
                document.check_range(&["mirror", "response", &axis, "f0_hz"], *f0_hz, 1.0..=1e6);
                document.check_range(&["mirror", "response", &axis, "q"], *q, 0.1..=1e5);
            }
        }
        let driver = self.driver.name();
        if self.driver != MirrorDriver::Sim && self.port.is_none() {
            let message = format!(
                "mirror.driver = \"{driver}\" requires mirror.port, such as \"/dev/serial/by-id/...\""
            );
            document.refuse(&["mirror", "driver"], message);
        }
        if self.driver == MirrorDriver::Optotune && self.laser_port.is_none() {
            let message = "mirror.driver = \"optotune\" requires mirror.laser_port: an MR-E-2 has no output for a laser, so give the serial port whose RTS line enables it";
            document.refuse(&["mirror", "driver"], message);
        }
        if limits.max_tilt.0 > self.full_scale_deg
            && matches!(self.driver, MirrorDriver::PlayzerX | MirrorDriver::Mti)
        {
            let message = format!(
                "mirror.limits.max_tilt = {} exceeds mirror.full_scale_deg = {}: give the smaller of the mirror's and the controller's limits",
                limits.max_tilt.0, self.full_scale_deg
            );
            document.refuse(&["mirror", "limits", "max_tilt"], message);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MINIMAL: &str = "kind = \"dots\"\n[camera]\ndriver = \"sim\"\n[mirror]\ndriver = \"sim\"\n";

    #[test]
    fn every_key_but_kind_and_drivers_has_a_default() {
        let rig = DotRigFile::parse(MINIMAL).unwrap();
        assert_eq!(rig.camera.white_dn(), 2500.0);
        assert_eq!(rig.limits(), MirrorLimits::A7B2_3_3600AL);
    }

    #[test]
    fn the_documented_rig_file_is_the_defaults() {
        let page = include_str!("../../../../docs/reference/rig.md");
        let mut blocks = page.split("```toml\n").filter_map(|rest| rest.split("```").next());
        let documented = blocks.find(|block| block.contains("kind = \"dots\"")).unwrap();
        assert_eq!(
            format!("{:#?}", DotRigFile::parse(documented).unwrap()),
            format!("{:#?}", DotRigFile::parse(MINIMAL).unwrap())
        );
    }
}
