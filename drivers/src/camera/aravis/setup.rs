//! Settings made once when a camera is opened, in the order that cameras need: formats before sizes, sizes before
//! offsets, all trigger settings before the trigger mode.

use raysweep_core::{DeviceErrorKind, PixelFormat};

use super::features::{FeatureError, Features, Result, first_present, put_boolean, put_integer, put_text};
use super::sequencer;
use super::settings::Names;
use raysweep_config::rig::aravis::{AravisConfig, SensorRegion};

/// Result of setting up a camera.
#[derive(Debug, PartialEq)]
pub struct SetUp {
    /// Its names of the features that sweeps change.
    pub names: Names,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// The chunk data in its frames.
    pub chunks: ChunksOn,
    /// From the end of row 0's exposure until the camera is ready, if it reports that.
    pub readout_us: Option<f64>,
    /// Features that it lacks, in words.
    pub lacks: Vec<String>,
}

/// The chunk data that a camera was set to send.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ChunksOn {
    /// `ChunkExposureTime`: the exposure time.
    pub exposure: bool,
    /// `ChunkSequencerSetActive`: the active sequencer set.
    pub sequencer_set: bool,
}

/// Sets a camera up according to the rig file; with `free_hz`, without its trigger and at this frame rate.
///
/// # Errors
/// A missing feature that sweeps require, or a value that the camera rejects.
pub fn set_up(
    features: &impl Features,
    config: &AravisConfig,
    format: PixelFormat,
    free_hz: Option<f64>,
) -> Result<SetUp> {
    let mut lacks = Vec::new();
    // While the sequencer runs, cameras accept no settings.
    sequencer::stop(features)?;
    for line in &config.features {
        features.set_line(line)?;
    }
    for name in ["GammaEnable", "LUTEnable"] {
        if features.has(name) {
            put_boolean(features, name, false)?;
        }
    }
    if !features.has("GammaEnable") && features.has("Gamma") {
        features.set_float("Gamma", 1.0)?;
        let gamma = features.float("Gamma")?;
        if (gamma - 1.0).abs() > 1e-3 {
            let what = format!("was set to 1 and reads {gamma}: pixel values must be linear in light");
            return Err(FeatureError::new("Gamma", DeviceErrorKind::OutOfRange, what));
        }
    }
    for name in ["ExposureAuto", "GainAuto", "BlackLevelAuto", "BalanceWhiteAuto", "TargetBrightnessAuto"] {
        if features.has(name) {
            put_text(features, name, "Off")?;
        }
    }
    if features.has("ExposureMode") {
        put_text(features, "ExposureMode", "Timed")?;
    }
    set_format(features, format)?;
    let (width, height) = set_region(features, config, &mut lacks)?;
    if let Some(black_level) = config.black_level {
        let name = require(features, &["BlackLevel", "BlackLevelRaw"], "a black level")?;
        // A float by the standard, but an integer under some old names.
        if features.float_range(name).is_ok() {
            features.set_float(name, black_level)?;
        } else {
            put_integer(features, name, black_level.round() as i64)?;
        }
    }
    if features.has("AcquisitionMode") {
        put_text(features, "AcquisitionMode", "Continuous")?;
    }
    let names = Names::probe(features)?;
    if names.delay.is_none() {
        lacks.push("a trigger delay (TriggerDelay, TriggerDelayAbs): delays cannot be swept".into());
    }
    if names.shutter.is_none() {
        lacks.push(
            "a shutter mode (SensorShutterMode, ShutterMode): its shutter is taken for a rolling one".into(),
        );
    }
    let chunks = set_chunks(features)?;
    if !chunks.exposure {
        lacks.push(
            "the exposure time as chunk data: the exposure that it was set to is taken for true".into(),
        );
    }
    set_trigger(features, config, names.exposure, free_hz)?;
    let readout_us = match first_present(features, &["SensorReadoutTime", "ReadoutTime"]) {
        Some(name) => features.float(name).ok(),
        None => None,
    };
    Ok(SetUp { names, width, height, chunks, readout_us, lacks })
}

/// The first of the names that exists.
pub fn require(features: &impl Features, names: &[&'static str], what: &str) -> Result<&'static str> {
    first_present(features, names).ok_or_else(|| {
        let message = format!("is not there, nor any other name of it: the camera lacks {what}");
        FeatureError::new(names[0], DeviceErrorKind::Unsupported, message)
    })
}

fn set_format(features: &impl Features, format: PixelFormat) -> Result<()> {
    put_text(features, "PixelFormat", &format!("{format:?}"))
}

fn set_region(
    features: &impl Features,
    config: &AravisConfig,
    lacks: &mut Vec<String>,
) -> Result<(usize, usize)> {
    for (name, &binning) in ["BinningHorizontal", "BinningVertical"].into_iter().zip(&config.binning) {
        if features.has(name) {
            put_integer(features, name, i64::from(binning))?;
        } else if binning != 1 {
            require(features, &[name], "binning")?;
        }
    }
    // An offset limits the size, so it is reset first and set last.
    for name in ["OffsetX", "OffsetY"] {
        if features.has(name) {
            features.set_integer(name, *features.integer_range(name)?.start())?;
        } else {
            lacks.push(format!("{name}: its region starts in the corner"));
        }
    }
    let full = SensorRegion { x: 0, y: 0, width: 0, height: 0 };
    let region = config.region.unwrap_or(full);
    for (name, pixels) in [("Width", region.width), ("Height", region.height)] {
        let pixels = if pixels == 0 { *features.integer_range(name)?.end() } else { i64::from(pixels) };
        put_integer(features, name, pixels)?;
    }
    if config.region.is_some() {
        for (name, offset) in [("OffsetX", region.x), ("OffsetY", region.y)] {
            if features.has(name) || offset != 0 {
                put_integer(features, name, i64::from(offset))?;
            }
        }
    }
    let pixels = |name| -> Result<usize> {
        let value = features.integer(name)?;
        usize::try_from(value)
            .map_err(|_negative| FeatureError::new(name, DeviceErrorKind::Protocol, format!("reads {value}")))
    };
    Ok((pixels("Width")?, pixels("Height")?))
}

/// Enables chunk data: the exposure time, and the sequencer set if there is a sequencer.
fn set_chunks(features: &impl Features) -> Result<ChunksOn> {
    if !features.has("ChunkModeActive") || !features.has("ChunkSelector") {
        return Ok(ChunksOn::default());
    }
    // On some cameras, chunks can be selected only while chunk mode is on.
    put_boolean(features, "ChunkModeActive", true)?;
    let offered = features.choices("ChunkSelector")?;
    let enable = |chunk: &str| -> Result<bool> {
        let is_offered = offered.iter().any(|choice| choice == chunk);
        if is_offered {
            put_text(features, "ChunkSelector", chunk)?;
            put_boolean(features, "ChunkEnable", true)?;
        }
        Ok(is_offered)
    };
    let on = ChunksOn {
        exposure: enable("ExposureTime")?,
        sequencer_set: sequencer::is_offered(features) && enable("SequencerSetActive")?,
    };
    if on == ChunksOn::default() {
        put_boolean(features, "ChunkModeActive", false)?;
    }
    Ok(on)
}

const RATE: &str = "AcquisitionFrameRate";
const LIMITED: &str = "AcquisitionFrameRateEnable";
/// More than any camera's rate: some state no limit.
const FASTEST_HZ: f64 = 1e5;

/// Sets the rate of a free-running camera. Without it, a camera may go as fast as it can, with short exposures alone.
fn limit_rate(features: &impl Features, free_hz: f64) -> Result<()> {
    if features.has(LIMITED) {
        put_boolean(features, LIMITED, true)?;
    }
    if features.has(RATE) {
        let range = features.float_range(RATE)?;
        features.set_float(RATE, free_hz.max(*range.start()).min(*range.end()))?;
    }
    Ok(())
}

/// Ends the limit that a viewfinder, even one that was killed, has left in the camera: it would delay triggers.
fn free_rate(features: &impl Features, exposure: &str) -> Result<()> {
    if features.has(LIMITED) {
        return put_boolean(features, LIMITED, false);
    }
    if features.has(RATE) {
        // The rate that a camera allows may depend on its exposure, which may be a viewfinder's still.
        features.set_float(exposure, *features.float_range(exposure)?.start())?;
        let most_hz = features.float_range(RATE)?.end().min(FASTEST_HZ);
        if let Err(error) = features.set_float(RATE, most_hz) {
            // It shows a rate that nobody can set, a viewfinder neither.
            tracing::debug!(%error, "the camera's frame rate is left as it is");
        }
    }
    Ok(())
}

fn set_trigger(
    features: &impl Features,
    config: &AravisConfig,
    exposure: &str,
    free_hz: Option<f64>,
) -> Result<()> {
    let is_triggered = config.is_triggered() && free_hz.is_none();
    if is_triggered {
        free_rate(features, exposure)?;
    }
    if features.has("TriggerSelector") {
        for selector in features.choices("TriggerSelector")? {
            put_text(features, "TriggerSelector", &selector)?;
            put_text(features, "TriggerMode", "Off")?;
        }
    }
    if !is_triggered {
        return free_hz.map_or(Ok(()), |free_hz| limit_rate(features, free_hz));
    }
    if features.has("TriggerSelector") {
        put_text(features, "TriggerSelector", "FrameStart")?;
    }
    require(features, &["TriggerMode"], "a hardware trigger")?;
    put_text(features, "TriggerSource", &config.trigger_source)?;
    if features.has("TriggerActivation") {
        put_text(features, "TriggerActivation", &config.trigger_activation)?;
    }
    // Last, because some cameras accept none of the above while they wait for triggers (aravis#1045).
    put_text(features, "TriggerMode", "On")
}

#[cfg(test)]
mod tests {
    use super::super::features::scripted::{Scripted, Value};
    use super::*;

    fn sfnc() -> Scripted {
        Scripted::default()
            .with("GammaEnable", Value::Boolean(true))
            .with_text("ExposureAuto", &["Continuous", "Off"])
            .with_text("GainAuto", &["Off", "Once"])
            .with_text("PixelFormat", &["Mono8", "Mono12p"])
            .with("BinningHorizontal", Value::Integer(2, 1..=4))
            .with("BinningVertical", Value::Integer(2, 1..=4))
            .with("OffsetX", Value::Integer(8, 0..=1592))
            .with("OffsetY", Value::Integer(8, 0..=1192))
            .with("Width", Value::Integer(8, 8..=1600))
            .with("Height", Value::Integer(8, 8..=1200))
            .with("BlackLevel", Value::Float(0.0, 0.0..=255.0))
            .with_text("AcquisitionMode", &["SingleFrame", "Continuous"])
            .with_text("SensorShutterMode", &["Global", "Rolling"])
            .with("ExposureTime", Value::Float(5000.0, 20.0..=1e6))
            .with("TriggerDelay", Value::Float(0.0, 0.0..=16e6))
            .with_text("TriggerSelector", &["AcquisitionStart", "FrameStart"])
            .with_text("TriggerMode", &["Off", "On"])
            .with_text("TriggerSource", &["Software", "Line0", "Line1"])
            .with_text("TriggerActivation", &["RisingEdge", "FallingEdge"])
            .with("ChunkModeActive", Value::Boolean(false))
            .with_text("ChunkSelector", &["FrameID", "ExposureTime"])
            .with("ChunkEnable", Value::Boolean(false))
            .with("SensorReadoutTime", Value::Float(16_100.0, 0.0..=1e6))
    }

    fn config() -> AravisConfig {
        AravisConfig {
            name: Some("camera".into()),
            features: vec!["LineSelector=Line0".into(), "LineMode=Input".into()],
            region: Some(SensorRegion { x: 16, y: 32, width: 640, height: 480 }),
            black_level: Some(16.0),
            ..AravisConfig::default()
        }
    }

    fn position(written: &[String], line: &str) -> usize {
        written.iter().rposition(|w| w == line).unwrap_or_else(|| panic!("{line} in {written:?}"))
    }

    #[test]
    fn settings_are_written_in_the_order_that_cameras_need() {
        let camera = sfnc();
        let set_up = set_up(&camera, &config(), PixelFormat::Mono12p, None).unwrap();
        assert_eq!((set_up.width, set_up.height), (640, 480));
        // There is no sequencer, so no set to report.
        assert_eq!(set_up.chunks, ChunksOn { exposure: true, sequencer_set: false });
        assert_eq!((set_up.readout_us, set_up.lacks), (Some(16_100.0), vec![]));
        let written = camera.take_written();
        assert_eq!(written[..2], ["LineSelector=Line0", "LineMode=Input"]);
        let in_order = [
            "PixelFormat=Mono12p",
            "BinningHorizontal=1",
            "BinningVertical=1",
            "Width=640",
            "Height=480",
            "OffsetX=16",
            "OffsetY=32",
            "BlackLevel=16",
            "AcquisitionMode=Continuous",
            "TriggerSelector=FrameStart",
            "TriggerSource=Line0",
            "TriggerActivation=RisingEdge",
            "TriggerMode=On",
        ];
        assert!(in_order.map(|line| position(&written, line)).is_sorted(), "{written:?}");
        assert_eq!(written.last().unwrap(), "TriggerMode=On");
        let first = |line: &str| written.iter().position(|w| w == line).unwrap();
        assert!(first("OffsetX=0") < first("Width=640"), "an old offset would forbid the width");
        assert!(first("ChunkModeActive=true") < first("ChunkSelector=ExposureTime"));
        for line in ["GammaEnable=false", "ExposureAuto=Off", "GainAuto=Off"] {
            position(&written, line);
        }
    }

    #[test]
    fn frames_tell_the_sequencers_set_where_they_can() {
        let chunks = |chunks: &[&'static str]| {
            let camera = sfnc().with_text("SequencerMode", &["Off", "On"]).with_text("ChunkSelector", chunks);
            let on = set_up(&camera, &config(), PixelFormat::Mono8, None).unwrap().chunks;
            (on.exposure, on.sequencer_set, camera.boolean("ChunkModeActive").unwrap())
        };
        assert_eq!(chunks(&["ExposureTime", "SequencerSetActive"]), (true, true, true));
        assert_eq!(chunks(&["ExposureTime"]), (true, false, true));
        assert_eq!(chunks(&["SequencerSetActive"]), (false, true, true));
        assert_eq!(chunks(&["FrameID"]), (false, false, false));
    }

    #[test]
    fn all_of_the_sensor_is_read_and_a_free_running_camera_waits_for_nothing() {
        let camera = sfnc();
        let config = AravisConfig { region: None, trigger_source: "off".into(), ..config() };
        let set_up = set_up(&camera, &config, PixelFormat::Mono8, None).unwrap();
        assert_eq!((set_up.width, set_up.height), (1600, 1200));
        assert_eq!(camera.text("TriggerMode").unwrap(), "Off");

        let rated = sfnc()
            .with("AcquisitionFrameRateEnable", Value::Boolean(false))
            .with("AcquisitionFrameRate", Value::Float(160.0, 1.0..=160.0));
        super::set_up(&rated, &self::config(), PixelFormat::Mono8, Some(15.0)).unwrap();
        assert_eq!(rated.text("TriggerMode").unwrap(), "Off");
        let rate_hz = |camera: &Scripted| camera.float("AcquisitionFrameRate").unwrap();
        assert!(rated.boolean("AcquisitionFrameRateEnable").unwrap());
        assert_eq!(rate_hz(&rated), 15.0);
        super::set_up(&rated, &self::config(), PixelFormat::Mono8, Some(0.1)).unwrap();
        assert_eq!(rate_hz(&rated), 1.0, "the slowest that it can");
    }

    #[test]
    fn the_rate_of_a_viewfinder_does_not_limit_the_triggered_run_after_it() {
        let rated = || sfnc().with("AcquisitionFrameRate", Value::Float(160.0, 1.0..=160.0));
        let switched = rated().with("AcquisitionFrameRateEnable", Value::Boolean(false));
        for camera in [&rated(), &switched] {
            for free_hz in [Some(15.0), None] {
                set_up(camera, &config(), PixelFormat::Mono8, free_hz).unwrap();
            }
            let is_limited = camera.boolean("AcquisitionFrameRateEnable").unwrap_or(true);
            let rate_hz = camera.float("AcquisitionFrameRate").unwrap();
            assert!(!is_limited || rate_hz == 160.0, "{rate_hz} Hz");
            assert_eq!(camera.text("TriggerMode").unwrap(), "On");
        }
    }

    #[test]
    fn what_a_camera_lacks_is_said_and_what_it_cannot_do_without_is_refused() {
        let poor = Scripted::default()
            .with_text("PixelFormat", &["Mono8"])
            .with("Width", Value::Integer(512, 1..=2048))
            .with("Height", Value::Integer(512, 1..=2048))
            .with("ExposureTimeAbs", Value::Float(1e4, 10.0..=1e6))
            .with_text("TriggerMode", &["Off", "On"])
            .with_text("TriggerSource", &["Line0", "Software"]);
        let config = AravisConfig { features: vec![], region: None, black_level: None, ..config() };
        let set_up_poor = set_up(&poor, &config, PixelFormat::Mono8, None).unwrap();
        assert_eq!(set_up_poor.names.exposure, "ExposureTimeAbs");
        let lacks = set_up_poor.lacks.join("; ");
        for what in ["trigger delay", "shutter mode", "chunk data"] {
            assert!(lacks.contains(what), "{lacks}");
        }

        let refused = |camera: Scripted, config: &AravisConfig, format| {
            set_up(&camera, config, format, None).unwrap_err().to_string()
        };
        let without_exposure = Scripted::default()
            .with_text("PixelFormat", &["Mono8"])
            .with("Width", Value::Integer(512, 1..=2048))
            .with("Height", Value::Integer(512, 1..=2048));
        assert!(
            refused(without_exposure, &config, PixelFormat::Mono8).contains("ExposureTime: is not there")
        );
        let message = refused(sfnc(), &config, PixelFormat::Mono16);
        assert!(message.contains("PixelFormat") && message.contains("Mono8, Mono12p"), "{message}");
        let line2 = AravisConfig { trigger_source: "Line2".into(), ..config.clone() };
        assert!(refused(sfnc(), &line2, PixelFormat::Mono8).contains("Software, Line0, Line1"));
        let wide = SensorRegion { x: 0, y: 0, width: 1601, height: 8 };
        let message = refused(sfnc(), &AravisConfig { region: Some(wide), ..config }, PixelFormat::Mono8);
        assert!(message.contains("Width: 1601 was asked for: must be from 8 to 1600"), "{message}");
    }
}
