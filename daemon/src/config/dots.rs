//! `rig.toml` of a dot rig: a mirror that moves one spot of light, and a camera that takes a frame of each place.

use std::path::PathBuf;

use raysweep_core::{MechanicalDeg, MirrorLimits, PixelFormat, SecondOrder};
use raysweep_drivers::camera::aravis::{AravisConfig, ConfigFault};
use raysweep_drivers::camera::replay::ReplayConfig;
use raysweep_drivers::camera::v4l2::V4l2Config;
use raysweep_drivers::mirror::{Link, MtiDrive};
use raysweep_sim::dots::DotsConfig;
use serde::Deserialize;

use super::ConfigError;
use super::rig::{RigKind, default_black_dn, default_pixel_format, default_reopen_s, default_white_dn};

/// A dot rig.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DotRigFile {
    /// [`RigKind::Dots`].
    pub kind: RigKind,
    /// `[camera]`
    pub camera: DotCameraSection,
    /// `[mirror]`; left out where frames come from a recording.
    pub mirror: Option<MirrorSection>,
    /// `[sim]`, for the driver `sim`.
    #[serde(default)]
    pub sim: DotSimSection,
}

/// `[sim]` of a dot rig.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DotSimSection {
    /// `[sim.dots]`
    pub dots: DotsConfig,
}

/// Drivers of a dot rig's camera by the names that rig files use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DotCameraDriver {
    /// The simulated rig.
    Sim,
    /// Frames that were recorded before.
    Replay,
    /// GigE Vision and USB3 Vision through libaravis.
    Aravis,
    /// Cameras of the Linux kernel.
    V4l2,
}

/// `[camera]` of a dot rig.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DotCameraSection {
    /// Which driver opens it.
    pub driver: DotCameraDriver,
    /// How frames are packed.
    #[serde(default = "default_pixel_format")]
    pub pixel_format: PixelFormat,
    /// Counts, above black, of a white plane in the dot's middle; left out: 2500 of 4096 of the format's.
    white_dn: Option<f64>,
    /// The exposure that `white_dn` is for.
    #[serde(default = "default_white_exposure_us")]
    pub white_exposure_us: f64,
    /// Counts without light; left out: 64 of 4096 of the format's.
    black_dn: Option<f64>,
    /// How long a camera that stops answering within a run may stay away.
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
    /// Counts, above black, of a white plane in the dot's middle.
    pub fn white_dn(&self) -> f64 {
        self.white_dn.unwrap_or_else(|| default_white_dn(self.pixel_format))
    }

    /// Counts without light.
    pub fn black_dn(&self) -> f64 {
        self.black_dn.unwrap_or_else(|| default_black_dn(self.pixel_format))
    }
}

/// Drivers of mirrors by the names that rig files use.
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
    /// As rig files call it.
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
    /// Which driver opens it.
    pub driver: MirrorDriver,
    /// Its serial port, for all drivers but `sim`.
    pub port: Option<PathBuf>,
    /// How a PlayzerX is connected.
    #[serde(default)]
    link: LinkKind,
    /// Tilt of the mirror at the controller's full scale.
    #[serde(default = "default_full_scale")]
    pub full_scale_deg: f64,
    /// Angle between the beam and the mirror's normal at rest.
    #[serde(default)]
    pub incidence_deg: f64,
    /// What the mirror survives.
    #[serde(default = "default_limits")]
    pub limits: MirrorLimits,
    /// What an MTI controller drives the mirror with.
    #[serde(default)]
    drive: DriveTable,
    /// The most that the mirror takes of it, from its data sheet.
    #[serde(default)]
    max_drive: DriveTable,
    /// How the axes answer; paths are then distorted beforehand so that the mirror follows them.
    pub response: Option<ResponseKey>,
    /// A file that begins with `1` while the interlock is closed, such as a GPIO's value; left out: the operator's word.
    pub interlock: Option<PathBuf>,
    /// The port whose RTS line enables the laser, for the driver `optotune`.
    pub laser_port: Option<PathBuf>,
}

/// `mirror.response`
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(
    untagged,
    expecting = "\"identified\", or [{ f0_hz = .., q = .. }, { f0_hz = .., q = .. }] of x and y"
)]
pub enum ResponseKey {
    /// As a plan of kind `response` has found it.
    Found(Identified),
    /// As stated here, x and y.
    Stated([SecondOrder; 2]),
}

/// The word `identified`.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Identified {
    /// It has no other.
    Identified,
}

#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum LinkKind {
    #[default]
    VirtualCom,
    Uart,
}

#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct DriveTable {
    bias_v: u32,
    difference_v: u32,
    bandwidth_hz: u32,
}

impl Default for DriveTable {
    fn default() -> Self {
        let MtiDrive { bias_v, difference_v, bandwidth_hz } = MtiDrive::A7B2_3_3600AL;
        Self { bias_v, difference_v, bandwidth_hz }
    }
}

impl From<DriveTable> for MtiDrive {
    fn from(DriveTable { bias_v, difference_v, bandwidth_hz }: DriveTable) -> Self {
        Self { bias_v, difference_v, bandwidth_hz }
    }
}

impl MirrorSection {
    /// How a PlayzerX is connected.
    pub fn link(&self) -> Link {
        match self.link {
            LinkKind::VirtualCom => Link::VirtualCom,
            LinkKind::Uart => Link::Uart,
        }
    }

    /// What an MTI controller drives the mirror with.
    pub fn drive(&self) -> MtiDrive {
        self.drive.into()
    }

    /// The most that the mirror takes of it.
    pub fn max_drive(&self) -> MtiDrive {
        self.max_drive.into()
    }
}

/// Near the period of the paper's camera, 13,500 frames/s.
fn default_white_exposure_us() -> f64 {
    70.0
}
fn default_full_scale() -> f64 {
    MirrorLimits::A7B2_3_3600AL.max_tilt.0
}
fn default_limits() -> MirrorLimits {
    MirrorLimits::A7B2_3_3600AL
}

impl DotRigFile {
    /// Reads a rig file.
    ///
    /// # Errors
    /// With the place in the text, for anything that is not a dot rig.
    pub fn parse(text: &str) -> Result<Self, ConfigError> {
        let rig: Self = toml::from_str(text).map_err(|error| ConfigError::parse(&error))?;
        if rig.kind != RigKind::Dots {
            let message = "kind: a dot rig's is \"dots\"";
            return Err(ConfigError::at(text, &["kind"], message));
        }
        rig.check(text)?;
        Ok(rig)
    }

    /// What its mirror's paths must keep to.
    pub fn limits(&self) -> MirrorLimits {
        self.mirror.as_ref().map_or_else(default_limits, |mirror| mirror.limits)
    }

    /// Angle between the beam and the mirror's normal at rest.
    pub fn incidence(&self) -> MechanicalDeg {
        MechanicalDeg(self.mirror.as_ref().map_or(0.0, |mirror| mirror.incidence_deg))
    }

    fn check(&self, text: &str) -> Result<(), ConfigError> {
        let camera = &self.camera;
        let max_dn = f64::from(camera.pixel_format.max_value());
        let mut rules: Vec<(&[&str], f64, f64, f64)> = vec![
            (&["camera", "white_dn"], camera.white_dn(), 1.0, 16.0 * max_dn),
            (&["camera", "white_exposure_us"], camera.white_exposure_us, 0.1, 1e6),
            (&["camera", "black_dn"], camera.black_dn(), 0.0, max_dn / 2.0),
            (&["camera", "reopen_s"], camera.reopen_s, 0.0, 3600.0),
        ];
        if let Some(mirror) = &self.mirror {
            let limits = &mirror.limits;
            rules.extend([
                (&["mirror", "full_scale_deg"] as &[&str], mirror.full_scale_deg, 0.1, 45.0),
                (&["mirror", "incidence_deg"], mirror.incidence_deg, 0.0, 60.0),
                (&["mirror", "limits", "max_tilt"], limits.max_tilt.0, 0.01, 45.0),
                (&["mirror", "limits", "max_step"], limits.max_step.0, 1e-4, limits.max_tilt.0),
                (&["mirror", "limits", "max_slew_deg_per_s"], limits.max_slew_deg_per_s, 1e-3, 1e7),
                (&["mirror", "limits", "bandwidth_hz"], limits.bandwidth_hz, 1.0, 1e5),
                (&["mirror", "limits", "out_of_band"], limits.out_of_band.0, 0.0, limits.max_tilt.0),
            ]);
            if let Some(ResponseKey::Stated(axes)) = &mirror.response {
                for SecondOrder { f0_hz, q } in axes {
                    rules.push((&["mirror", "response"], *f0_hz, 1.0, 1e6));
                    rules.push((&["mirror", "response"], *q, 0.1, 1e5));
                }
            }
        }
        for (path, value, low, high) in rules {
            if !(low..=high).contains(&value) {
                let message = format!("{} = {value}: allowed is {low} to {high}", path.join("."));
                return Err(ConfigError::at(text, path, message));
            }
        }
        self.check_camera(text)?;
        self.check_mirror(text)
    }

    fn check_camera(&self, text: &str) -> Result<(), ConfigError> {
        let camera = &self.camera;
        match camera.driver {
            DotCameraDriver::Sim => Ok(()),
            DotCameraDriver::Replay if camera.replay.is_some() => Ok(()),
            DotCameraDriver::Replay => {
                let message = "camera.driver = \"replay\": a table [camera.replay] with the path of the recording is missing";
                Err(ConfigError::at(text, &["camera", "driver"], message))
            }
            DotCameraDriver::Aravis => camera.aravis.check().map_err(|fault: ConfigFault| {
                ConfigError::at(text, &["camera", "aravis", fault.key], fault.to_string())
            }),
            DotCameraDriver::V4l2 => {
                let Some(v4l2) = &camera.v4l2 else {
                    let message = "camera.driver = \"v4l2\": a table [camera.v4l2] with device, width and height is missing";
                    return Err(ConfigError::at(text, &["camera", "driver"], message));
                };
                v4l2.check()
                    .map_err(|(key, message)| ConfigError::at(text, &["camera", "v4l2", key], message))
            }
        }
    }

    fn check_mirror(&self, text: &str) -> Result<(), ConfigError> {
        let Some(mirror) = &self.mirror else {
            if self.camera.driver == DotCameraDriver::Replay {
                return Ok(());
            }
            let message = "[mirror] is missing: name the driver that moves the beam; only camera.driver = \"replay\" needs none";
            return Err(ConfigError::at(text, &["camera", "driver"], message));
        };
        let driver = mirror.driver.name();
        if mirror.driver != MirrorDriver::Sim && mirror.port.is_none() {
            let message = format!(
                "mirror.driver = \"{driver}\": a mirror.port is missing, such as \"/dev/serial/by-id/...\""
            );
            return Err(ConfigError::at(text, &["mirror", "driver"], message));
        }
        if mirror.driver == MirrorDriver::Optotune && mirror.laser_port.is_none() {
            let message = "mirror.driver = \"optotune\": a mirror.laser_port is missing: an MR-E-2 has no output for a laser; name the serial port whose RTS line enables it";
            return Err(ConfigError::at(text, &["mirror", "driver"], message));
        }
        if mirror.driver == MirrorDriver::Sim && self.camera.driver != DotCameraDriver::Sim {
            let message = "mirror.driver = \"sim\" moves no light before a real camera, and a recording needs no mirror: take the mirror's own driver, leave [mirror] out for a recording, or set camera.driver = \"sim\"";
            return Err(ConfigError::at(text, &["mirror", "driver"], message));
        }
        if mirror.limits.max_tilt.0 > mirror.full_scale_deg
            && matches!(mirror.driver, MirrorDriver::PlayzerX | MirrorDriver::Mti)
        {
            let message = format!(
                "mirror.limits.max_tilt = {} is beyond mirror.full_scale_deg = {}: give the smaller of what mirror and controller reach",
                mirror.limits.max_tilt.0, mirror.full_scale_deg
            );
            return Err(ConfigError::at(text, &["mirror", "limits", "max_tilt"], message));
        }
        Ok(())
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
    fn bad_rigs_are_refused_with_field_and_place() {
        let cases = [
            (MINIMAL.replace("\"dots\"", "\"plane\""), "\"dots\""),
            (MINIMAL.replace("[mirror]\ndriver = \"sim\"", "[mirror]\ndriver = \"playzerx\""), "mirror.port"),
            (
                MINIMAL
                    .replace("[mirror]\ndriver = \"sim\"", "[mirror]\ndriver = \"optotune\"\nport = \"a\""),
                "mirror.laser_port",
            ),
            (MINIMAL.replace("[mirror]\ndriver = \"sim\"\n", ""), "[mirror] is missing"),
            (MINIMAL.replace("[camera]\ndriver = \"sim\"", "[camera]\ndriver = \"v4l2\""), "[camera.v4l2]"),
            (
                MINIMAL.replace("[camera]\ndriver = \"sim\"", "[camera]\ndriver = \"replay\""),
                "[camera.replay]",
            ),
            (
                MINIMAL.replace(
                    "[camera]\ndriver = \"sim\"",
                    "[camera]\ndriver = \"replay\"\nreplay.path = \"a.npy\"",
                ),
                "leave [mirror] out for a recording",
            ),
            (MINIMAL.replace("[mirror]\n", "[mirror]\nincidence_deg = 80\n"), "mirror.incidence_deg = 80"),
            (
                MINIMAL.replace("[camera]\n", "[camera]\nwhite_exposure_us = 0\n"),
                "camera.white_exposure_us = 0",
            ),
            (MINIMAL.replace("[mirror]\n", "[mirror]\nresponse = \"measured\"\n"), "\"identified\", or ["),
            (
                MINIMAL.replace(
                    "[mirror]\n",
                    "[mirror]\nresponse = [{ f0_hz = 0, q = 9 }, { f0_hz = 9, q = 9 }]\n",
                ),
                "mirror.response = 0",
            ),
            (format!("{MINIMAL}[sim.dots]\nscenes = 3\n"), "scenes"),
            (format!("{MINIMAL}[sim.dots.camera]\nlate = 3\n"), "late"),
        ];
        for (text, expected) in cases {
            let error = DotRigFile::parse(&text).unwrap_err();
            assert!(error.message.contains(expected), "{text:?}: {}", error.message);
            assert!(error.span.is_some(), "{text:?} has no place");
        }
    }

    #[test]
    fn the_documented_rig_file_is_the_defaults() {
        let page = include_str!("../../../docs/reference/rig.md");
        let mut blocks = page.split("```toml\n").filter_map(|rest| rest.split("```").next());
        let documented = blocks.find(|block| block.contains("kind = \"dots\"")).unwrap();
        assert_eq!(
            format!("{:#?}", DotRigFile::parse(documented).unwrap()),
            format!("{:#?}", DotRigFile::parse(MINIMAL).unwrap())
        );
    }
}
