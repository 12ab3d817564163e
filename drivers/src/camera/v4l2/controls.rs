//! Controls by name, including those that contain times.

use std::io;
use std::ops::RangeInclusive;

use nix::libc::ERANGE;

use super::node::{ControlKind, Node, NodeControl};
use raysweep_config::rig::v4l2::TimeControl;

/// Exposure controls of the kernel, in order of preference. The absolute ones are in units of 100 us, that of a
/// sensor is in rows. The name changed with kernel 5.13.
const EXPOSURES: [&str; 3] = ["exposure_time_absolute", "exposure_absolute", "exposure"];
/// Unit of the absolute exposures (`V4L2_CID_EXPOSURE_ABSOLUTE`).
const ABSOLUTE_UNIT_US: f64 = 100.0;

/// Why a control could not be set.
#[derive(Debug)]
pub(super) enum ControlError {
    /// The control does not exist, or does not have that value.
    Value(String),
    /// The kernel refused.
    Kernel(String, io::Error),
}

/// The controls of a node.
pub(super) struct Controls(Vec<NodeControl>);

impl Controls {
    pub(super) fn of(node: &dyn Node) -> io::Result<Self> {
        node.controls().map(Self)
    }

    fn find(&self, name: &str) -> Option<&NodeControl> {
        self.0.iter().find(|control| spelt(&control.name) == spelt(name))
    }

    fn named(&self, key: &str, name: &str) -> Result<&NodeControl, ControlError> {
        self.find(name).ok_or_else(|| {
            let names: Vec<String> = self.0.iter().map(|control| spelt(&control.name)).collect();
            ControlError::Value(format!(
                "camera.v4l2.{key}: the camera has no control {name:?}; it has {}",
                if names.is_empty() { "none".to_owned() } else { names.join(", ") }
            ))
        })
    }

    /// Writes a control and verifies its value.
    pub(super) fn write(&self, node: &mut dyn Node, name: &str, value: i64) -> Result<(), ControlError> {
        let control = self.named("controls", name)?;
        let refused = |found: &str| {
            ControlError::Value(format!(
                "camera.v4l2.controls: {name} = {value}{found}: must be from {} to {} in steps of {}",
                control.minimum, control.maximum, control.step
            ))
        };
        if control.kind != ControlKind::Button && !(control.minimum..=control.maximum).contains(&value) {
            return Err(refused(""));
        }
        let kernel = |error: io::Error| match error.raw_os_error() {
            Some(ERANGE) => refused(""),
            _ => ControlError::Kernel(format!("camera.v4l2.controls: {name} = {value}"), error),
        };
        node.set_control(control, value).map_err(kernel)?;
        if control.kind == ControlKind::Button {
            return Ok(());
        }
        let actual = node.control(control).map_err(kernel)?;
        if actual == value { Ok(()) } else { Err(refused(&format!(" reads back as {actual}"))) }
    }

    /// From the start of one row to the start of the next, if the sensor reports it: (width + horizontal blanking) /
    /// pixel rate.
    pub(super) fn row_time_us(&self, node: &dyn Node, width: u32) -> io::Result<Option<f64>> {
        let (Some(blanking), Some(rate)) = (self.find("horizontal_blanking"), self.find("pixel_rate")) else {
            return Ok(None);
        };
        let (blanking, rate) = (node.control(blanking)?, node.control(rate)?);
        Ok((rate > 0).then(|| (f64::from(width) + blanking as f64) / rate as f64 * 1e6))
    }

    /// The exposure control: the one named in the rig file, otherwise one of the kernel's.
    pub(super) fn exposure(
        &self,
        stated: Option<&TimeControl>,
        row_time_us: f64,
    ) -> Result<TimedControl, ControlError> {
        let control = match stated {
            Some(stated) => self.named("exposure", &stated.control)?,
            None => EXPOSURES
                .iter()
                .find_map(|name| self.find(name))
                .map_or_else(|| self.named("exposure", EXPOSURES[0]), Ok)?,
        };
        let of_its_name =
            if spelt(&control.name).ends_with("_absolute") { ABSOLUTE_UNIT_US } else { row_time_us };
        Ok(TimedControl::new(control, stated.and_then(|stated| stated.unit_us).unwrap_or(of_its_name)))
    }

    /// The trigger delay control, if the rig file names one.
    pub(super) fn trigger_delay(
        &self,
        stated: Option<&TimeControl>,
    ) -> Result<Option<TimedControl>, ControlError> {
        let Some(stated) = stated else { return Ok(None) };
        let control = self.named("trigger_delay", &stated.control)?;
        Ok(Some(TimedControl::new(control, stated.unit_us.unwrap_or(1.0))))
    }
}

/// A control that contains a time.
pub(super) struct TimedControl {
    control: NodeControl,
    unit_us: f64,
}

impl TimedControl {
    fn new(control: &NodeControl, unit_us: f64) -> Self {
        Self { control: control.clone(), unit_us }
    }

    pub(super) fn range_us(&self) -> RangeInclusive<f64> {
        self.control.minimum as f64 * self.unit_us..=self.control.maximum as f64 * self.unit_us
    }

    /// The nearest time that the control can have.
    pub(super) fn nearest_us(&self, time_us: f64) -> f64 {
        self.value(time_us) as f64 * self.unit_us
    }

    fn value(&self, time_us: f64) -> i64 {
        let NodeControl { minimum, maximum, step, .. } = self.control;
        let steps = ((time_us / self.unit_us - minimum as f64) / step as f64).round() as i64;
        minimum.saturating_add(steps.saturating_mul(step)).clamp(minimum, maximum)
    }

    pub(super) fn read_us(&self, node: &dyn Node) -> io::Result<f64> {
        Ok(node.control(&self.control)? as f64 * self.unit_us)
    }

    /// Writes the nearest value and returns the time that the camera applied.
    pub(super) fn write_us(&self, node: &mut dyn Node, time_us: f64) -> io::Result<f64> {
        node.set_control(&self.control, self.value(time_us))?;
        self.read_us(node)
    }
}

/// A name as `v4l2-ctl` spells it: lower-case letters and digits, with an underscore for all characters in between.
fn spelt(name: &str) -> String {
    let words = name.split(|c: char| !c.is_ascii_alphanumeric()).filter(|word| !word.is_empty());
    words.collect::<Vec<_>>().join("_").to_ascii_lowercase()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_spelt_as_v4l2_ctl_lists_them() {
        let cases = [
            ("Exposure Time, Absolute", "exposure_time_absolute"),
            ("Exposure (Absolute)", "exposure_absolute"),
            ("trigger_mode", "trigger_mode"),
            ("White Balance, Auto & Preset", "white_balance_auto_preset"),
        ];
        for (name, expected) in cases {
            assert_eq!(spelt(name), expected);
        }
    }

    #[test]
    fn times_go_to_the_nearest_step_within_the_range() {
        let control = NodeControl {
            id: 1,
            name: "Exposure".into(),
            kind: ControlKind::Number,
            minimum: 4,
            maximum: 20,
            step: 3,
        };
        let timer = TimedControl::new(&control, 10.0);
        assert_eq!(timer.range_us(), 40.0..=200.0);
        for (wanted_us, nearest_us) in [(40.0, 40.0), (54.0, 40.0), (56.0, 70.0), (1e12, 200.0), (-5.0, 40.0)]
        {
            assert_eq!(timer.nearest_us(wanted_us), nearest_us, "{wanted_us}");
        }
    }
}
