//! The questions about a camera.

use raysweep_core::{Packing, PixelFormat};
use raysweep_drivers::camera::CameraFacts;
use toml::{Table, Value};

use super::found::ConnectedDevices;
use super::questions::{AnswerChoice, Questions};
use super::text::RigText;
use crate::cli::failure::CommandFailure;
use crate::cli::printer::printable;

const GENICAM: &str = "genicam";
const V4L2: &str = "v4l2";
const SIM: &str = "sim";
/// The longest side of a frame.
const MOST_PX: u32 = 65_536;

/// Names and values of controls.
type Controls = Vec<(String, i64)>;

/// The camera of the new rig.
pub(super) enum ChosenCamera {
    Sim,
    Genicam {
        address: AddressOrName,
        format: PixelFormat,
        /// What is read of the sensor, if not all.
        region: Option<[u32; 4]>,
        trigger: TriggerSetup,
        size: (usize, usize),
    },
    V4l2 {
        device: String,
        format: PixelFormat,
        size: (usize, usize),
        controls: Controls,
        /// Written after them by a viewfinder without the trigger.
        free_running: Controls,
        delay: Option<String>,
    },
}

/// How a GenICam camera is named.
pub(super) enum AddressOrName {
    Address(String),
    Name(String),
}

/// A GenICam camera's trigger.
pub(super) struct TriggerSetup {
    source: String,
    activation: String,
    latency_us: f64,
}

impl ChosenCamera {
    /// Asks which camera, and how it is set.
    pub fn ask(
        questions: &mut Questions,
        connected: &ConnectedDevices,
        most_rows: Option<usize>,
    ) -> Result<Self, CommandFailure> {
        let mut choices: Vec<AnswerChoice> =
            connected.cameras.iter().map(|camera| AnswerChoice::new(&camera.value, &camera.about)).collect();
        choices.push(AnswerChoice::new(SIM, "simulated, to rehearse"));
        let default = choices[0].value.clone();
        let forms = ["genicam:NAME or ADDRESS", "v4l2:NODE"];
        loop {
            let chosen = questions.choose("camera", "Which camera?", &choices, &forms, Some(&default))?;
            let known = connected.cameras.iter().find(|camera| camera.is(&chosen));
            let chosen = known.map_or(chosen, |camera| camera.value.clone());
            let known = known.and_then(|camera| camera.facts.clone());
            return match chosen.split_once(':') {
                Some((GENICAM, named)) => match known.map_or_else(|| offered_by_genicam(named), Ok) {
                    Ok(facts) => Self::genicam(questions, named, &facts, most_rows),
                    Err(error) if matches!(questions, Questions::Terminal) => {
                        println!("{}", printable(&error.to_string()));
                        continue;
                    }
                    Err(error) => Err(error),
                },
                Some((V4L2, device)) => Self::v4l2(questions, device, &known.unwrap_or_default(), most_rows),
                _ => Ok(Self::Sim),
            };
        }
    }

    fn genicam(
        questions: &mut Questions,
        named: &str,
        facts: &CameraFacts,
        most_rows: Option<usize>,
    ) -> Result<Self, CommandFailure> {
        let format = ask_format(questions, facts)?;
        let (asked_rows, columns) = ask_size(questions, facts, format, MOST_PX)?;
        // A camera may see more rows than the projector draws.
        let rows = most_rows.unwrap_or(usize::MAX).min(asked_rows);
        let region = region_in(largest_size(facts, format).unwrap_or((asked_rows, columns)), (rows, columns));
        let sources: Vec<AnswerChoice> =
            facts.trigger_sources.iter().map(|source| AnswerChoice::new(source, "")).collect();
        let is_line = |source: &&String| source.starts_with("Line");
        let first = facts.trigger_sources.iter().find(is_line).or(facts.trigger_sources.first());
        let first = first.map_or("Line0", |source| source);
        let question = match most_rows {
            Some(_) => "Which input of the camera does the VSYNC reach?",
            None => "Which input of the camera does the mirror's sample clock reach?",
        };
        let source = match sources.is_empty() {
            true => questions.text("trigger_source", question, first)?,
            false => questions.choose("trigger_source", question, &sources, &[], Some(first))?,
        };
        let activation = questions.choose(
            "trigger_activation",
            "Which edge of the pulse begins a frame? (Levels inverted on the way turn it round.)",
            &[AnswerChoice::new("RisingEdge", ""), AnswerChoice::new("FallingEdge", "")],
            &[],
            Some("RisingEdge"),
        )?;
        let latency_us = questions.number(
            "trigger_latency_us",
            "Microseconds from the edge to the first row's exposure, by the camera's data sheet (0 if unknown)",
            0.0,
            0.0..=1e6,
        )?;
        let address = match named.parse::<std::net::IpAddr>() {
            Ok(_) => AddressOrName::Address(named.into()),
            Err(_) => AddressOrName::Name(named.into()),
        };
        let trigger = TriggerSetup { source, activation, latency_us };
        Ok(Self::Genicam { address, format, region, trigger, size: (rows, columns) })
    }

    fn v4l2(
        questions: &mut Questions,
        device: &str,
        facts: &CameraFacts,
        most_rows: Option<usize>,
    ) -> Result<Self, CommandFailure> {
        let format = ask_format(questions, facts)?;
        let is_plane = most_rows.is_some();
        let most_rows = most_rows.and_then(|rows| u32::try_from(rows).ok()).unwrap_or(MOST_PX);
        let size = ask_size(questions, facts, format, most_rows)?;
        let controls = questions.read(
            "controls",
            "Controls that set the external trigger and fix the gain, as `v4l2-ctl --list-ctrls` spells them: NAME=VALUE, ... (empty: none)",
            "",
            parse_controls,
        )?;
        let free_running = match is_plane && !controls.is_empty() {
            true => questions.read(
                "free_running",
                "Controls that end the external trigger, for a viewfinder before the VSYNC is wired: NAME=VALUE, ... (empty: none)",
                &without_trigger(&controls),
                parse_controls,
            )?,
            false => Controls::new(),
        };
        let delay = questions.text(
            "trigger_delay",
            "The control that delays the trigger, in microseconds (empty: none; delays can then not be swept)",
            "",
        )?;
        let delay = (!delay.is_empty()).then_some(delay);
        Ok(Self::V4l2 { device: device.into(), format, size, controls, free_running, delay })
    }

    /// Whether it is simulated.
    pub fn is_simulated(&self) -> bool {
        matches!(self, Self::Sim)
    }

    /// Rows and columns of its frames, if they are known.
    pub fn size(&self) -> Option<(usize, usize)> {
        match self {
            Self::Sim => None,
            Self::Genicam { size, .. } | Self::V4l2 { size, .. } => Some(*size),
        }
    }

    /// Its tables in the rig file.
    pub fn write(&self, text: RigText) -> RigText {
        let text = text.table("camera");
        match self {
            Self::Sim => text.key("driver", SIM),
            Self::Genicam { address, format, region, trigger, .. } => {
                let text = levels(text.key("driver", "aravis").key("pixel_format", format.to_string()));
                let text = text.table("camera.aravis");
                let text = match address {
                    AddressOrName::Address(address) => text.key("address", address.as_str()),
                    AddressOrName::Name(name) => text.key("name", name.as_str()),
                };
                let text = match region {
                    Some(region) => text.key_with("region", region_of(*region), "the middle of the sensor"),
                    None => text,
                };
                text.key_with("trigger_source", trigger.source.as_str(), "where the trigger comes in")
                    .key("trigger_activation", trigger.activation.as_str())
                    .key_with(
                        "trigger_latency_us",
                        trigger.latency_us,
                        "[A] unless from the data sheet; from the edge to the first row's exposure",
                    )
                    .key_with(
                        "timestamp_at",
                        "exposure_start",
                        "[A] what the camera's time stamps refer to; see its data sheet",
                    )
            }
            Self::V4l2 { device, format, size: (rows, columns), controls, free_running, delay } => {
                let text = levels(text.key("driver", V4L2).key("pixel_format", format.to_string()));
                let pair =
                    |(name, value): &(String, i64)| vec![Value::from(name.as_str()), (*value).into()].into();
                let list = |controls: &Controls| controls.iter().map(pair).collect::<Vec<Value>>();
                let text = text
                    .table("camera.v4l2")
                    .key_with("device", device.as_str(), "a path below /dev/v4l/by-id stays with the camera")
                    .key("width", *columns as i64)
                    .key("height", *rows as i64)
                    .key_with(
                        "controls",
                        list(controls),
                        "written in this order; also switch automatic functions off here",
                    );
                let text = match free_running.is_empty() {
                    true => text,
                    false => text.key_with(
                        "free_running",
                        list(free_running),
                        "of a viewfinder before the VSYNC is wired",
                    ),
                };
                match delay {
                    Some(control) => {
                        let table = Table::from_iter([
                            ("control".to_owned(), Value::from(control.as_str())),
                            ("unit_us".to_owned(), Value::from(1)),
                        ]);
                        text.key("trigger_delay", table)
                    }
                    None => text,
                }
            }
        }
    }
}

/// What is left out.
fn levels(text: RigText) -> RigText {
    text.comment(
        "white_dn and black_dn, counts of white and of darkness: a plane rig's calibration measures them.",
    )
}

/// Rows and columns of the largest frame of a format.
fn largest_size(facts: &CameraFacts, format: PixelFormat) -> Option<(usize, usize)> {
    let (_, sizes) = facts.formats.iter().find(|(of, _)| *of == format)?;
    let (rows, columns) =
        sizes.iter().max_by_key(|(rows, columns)| u64::from(*rows) * u64::from(*columns))?;
    Some((*rows as usize, *columns as usize))
}

/// The middle of a sensor, `[x, y, width, height]`; `None` for all of it. Sensors begin at multiples of some pixels.
fn region_in(sensor: (usize, usize), size: (usize, usize)) -> Option<[u32; 4]> {
    const STEP: usize = 16;
    let side = |pixels: usize| u32::try_from(pixels).unwrap_or(u32::MAX);
    let before = |all: usize, part: usize| side(all.saturating_sub(part) / 2 / STEP * STEP);
    let (rows, columns) = size;
    (size != sensor).then(|| [before(sensor.1, columns), before(sensor.0, rows), side(columns), side(rows)])
}

fn region_of([x, y, width, height]: [u32; 4]) -> Table {
    let sides = [("x", x), ("y", y), ("width", width), ("height", height)];
    sides.into_iter().map(|(name, pixels)| (name.to_owned(), Value::from(i64::from(pixels)))).collect()
}

/// The controls of a trigger, switched off as most makers do it.
fn without_trigger(controls: &Controls) -> String {
    let of_trigger = controls.iter().filter(|(name, value)| name.contains("trigger_mode") && *value != 0);
    of_trigger.map(|(name, _)| format!("{name}=0")).collect::<Vec<_>>().join(", ")
}

fn parse_controls(text: &str) -> Result<Controls, String> {
    let control = |part: &str| {
        let parsed = part
            .split_once('=')
            .and_then(|(name, value)| Some((name.trim().to_owned(), value.trim().parse().ok()?)));
        parsed.ok_or_else(|| format!("{part:?} is not NAME=WHOLE NUMBER; separate several by commas"))
    };
    text.split(',').map(str::trim).filter(|part| !part.is_empty()).map(control).collect()
}

/// The format with the most bits in the fewest bytes is the best.
fn ask_format(questions: &mut Questions, facts: &CameraFacts) -> Result<PixelFormat, CommandFailure> {
    let rank = |format: &PixelFormat| match format.packing {
        Packing::Bits12p | Packing::Bits12g24 => 0,
        Packing::Bits12Packed => 1,
        Packing::Bits12 => 2,
        Packing::Bits16 => 3,
        Packing::Bits10p | Packing::Bits10g40 | Packing::Bits10Packed => 4,
        Packing::Bits10 => 5,
        Packing::Bits8 => 6,
    };
    let mut formats: Vec<PixelFormat> = facts.formats.iter().map(|(format, _)| *format).collect();
    formats.sort_by_key(rank);
    let choices: Vec<AnswerChoice> =
        formats.iter().map(|format| AnswerChoice::new(format.to_string(), "")).collect();
    const KEY: &str = "pixel_format";
    let question = "Which pixel format? 12 bits are best; packed ones need less of the link";
    let known =
        |name: &str| name.parse().map_err(|error: raysweep_core::UnknownPixelFormat| error.to_string());
    match choices.first() {
        Some(first) => {
            let name = questions.choose(KEY, question, &choices, &[], Some(&first.value))?;
            known(&name).map_err(CommandFailure::Setup)
        }
        None => questions.read(KEY, question, "Mono12", known),
    }
}

/// Rows and columns of a frame of this format: by default its first size that does not have too many rows, and of the
/// chosen width.
fn ask_size(
    questions: &mut Questions,
    facts: &CameraFacts,
    format: PixelFormat,
    most_rows: u32,
) -> Result<(usize, usize), CommandFailure> {
    let sizes = facts.formats.iter().find(|(of, _)| *of == format).map_or(&[][..], |(_, sizes)| sizes);
    let mut fitting = sizes.iter().filter(|(rows, _)| *rows <= most_rows);
    let first = fitting.clone().next().or(sizes.first()).copied();
    let (rows, columns) = first.unwrap_or((720, 1280));
    let most_columns = sizes.iter().map(|(_, columns)| *columns).max().unwrap_or(MOST_PX);
    let width = questions.whole("width", "Columns of a frame", columns, 1..=most_columns)?;
    let rows = fitting.find(|(_, columns)| *columns == width).map_or(rows, |(rows, _)| *rows);
    let question = match first.is_some() && rows > most_rows {
        false => "Rows of a frame",
        true => {
            "Rows of a frame. The camera lists no size with as few rows as the projector draws: crop it to them, or choose another format"
        }
    };
    let of_width = sizes.iter().filter(|(_, columns)| *columns >= width).map(|(rows, _)| *rows);
    let most_rows = most_rows.min(of_width.max().unwrap_or(MOST_PX));
    let height = questions.whole("height", question, rows.min(most_rows), 1..=most_rows)?;
    Ok((height as usize, width as usize))
}

#[cfg(feature = "aravis")]
fn offered_by_genicam(named: &str) -> Result<CameraFacts, CommandFailure> {
    Ok(raysweep_drivers::camera::aravis::facts(named)?)
}

#[cfg(not(feature = "aravis"))]
fn offered_by_genicam(_: &str) -> Result<CameraFacts, CommandFailure> {
    Err(CommandFailure::WithoutAravis)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_smaller_frame_is_the_middle_of_the_sensor() {
        let mono12: PixelFormat = "Mono12".parse().unwrap();
        let formats = vec![(mono12, vec![(720, 1280), (1080, 1920)])];
        let facts = CameraFacts { formats, ..CameraFacts::default() };
        let sensor = largest_size(&facts, mono12).unwrap();
        assert_eq!(sensor, (1080, 1920));
        assert_eq!(region_in(sensor, (1080, 1920)), None);
        assert_eq!(region_in(sensor, (720, 1920)), Some([0, 176, 1920, 720]));
        assert_eq!(region_in(sensor, (1080, 640)), Some([640, 0, 640, 1080]));
        assert_eq!(largest_size(&facts, "Mono8".parse().unwrap()), None);
    }

    #[test]
    fn the_default_size_is_one_of_the_chosen_format_with_no_more_rows_than_the_projector_draws() {
        let (mono8, mono10): (PixelFormat, PixelFormat) =
            ("Mono8".parse().unwrap(), "Mono10".parse().unwrap());
        let formats = vec![(mono8, vec![(480, 640)]), (mono10, vec![(1080, 1920), (720, 1280)])];
        let facts = CameraFacts { formats, ..CameraFacts::default() };
        let size = |format, most_rows, answers: &str| {
            let answers = answers.parse().unwrap();
            let mut questions =
                Questions::File { path: "answers.toml".into(), answers, mistakes: Vec::new() };
            let size = ask_size(&mut questions, &facts, format, most_rows)?;
            questions.finish().map(|()| size)
        };
        assert_eq!(size(mono8, 720, "").unwrap(), (480, 640));
        assert_eq!(size(mono10, 720, "").unwrap(), (720, 1280));
        assert_eq!(size(mono10, MOST_PX, "").unwrap(), (1080, 1920));
        assert_eq!(size(mono10, MOST_PX, "width = 1280").unwrap(), (720, 1280), "the rows of that width");
        let refused = size(mono10, 720, "height = 1080").unwrap_err().to_string();
        assert!(refused.contains("height = 1080; allowed: 1 to 720"), "{refused}");
        let refused = size(mono8, 720, "width = 4000\nheight = 700").unwrap_err().to_string();
        assert!(
            refused.contains("width = 4000; allowed: 1 to 640") && refused.contains("1 to 480"),
            "{refused}"
        );
        assert_eq!(size("Mono12".parse().unwrap(), 480, "").unwrap(), (480, 1280), "nothing is known of it");
    }
}
