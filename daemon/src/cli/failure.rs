//! Failures, as text for people, as JSON for programs, and as exit codes.

use std::io;
use std::path::{Path, PathBuf};

use miette::{Diagnostic, LabeledSpan, NamedSource};
use raysweep_core::io_text;
#[cfg(feature = "aravis")]
use raysweep_core::{DeviceError, DeviceErrorKind};
use raysweep_drivers::mirror::ParkError;
use raysweep_proto::{ClientError, ErrorCode, RpcError};
use serde_json::{Value, json};

use super::exit::Exit;
use super::printer::{is_unprintable, printable};
use crate::journal;
use crate::live::LiveError;
use crate::rig::RigError;
use raysweep_processing::ProcessError;

/// Why the command failed.
#[derive(Debug, thiserror::Error)]
pub(super) enum CommandFailure {
    #[error(transparent)]
    Client(#[from] ClientError),
    #[error("{0}")]
    Plan(Box<PlanProblem>),
    #[error("cannot read {}: {}", path.display(), io_text(source))]
    File { path: PathBuf, source: io::Error },
    #[error("cannot write {}: {}", path.display(), io_text(source))]
    Write { path: PathBuf, source: io::Error },
    #[error(
        "no live image yet: a run publishes its first after some points; `raysweep preview --follow` waits for it"
    )]
    NoLiveImage,
    #[error("{}: the picture is a PNG file: give a name that ends in .png", .0.display())]
    NotPng(PathBuf),
    #[error("{}: is no PNG file, and is not replaced by one: give another name", .0.display())]
    OtherFile(PathBuf),
    #[error("{}: lies in a session, to which nothing is added: give another folder", .0.display())]
    InSession(PathBuf),
    #[error(transparent)]
    Live(#[from] LiveError),
    #[error("{0}")]
    Calibration(String),
    #[error("{0}")]
    Sessions(String),
    #[error("{0}")]
    Trash(String),
    #[error("{0}")]
    Setup(String),
    #[error("{0}")]
    Exposure(String),
    #[error(transparent)]
    Rig(#[from] RigError),
    #[error(transparent)]
    Process(#[from] ProcessError),
    #[cfg(feature = "aravis")]
    #[error(transparent)]
    Device(#[from] DeviceError),
    #[cfg(feature = "aravis")]
    #[error("choose a camera with --camera:\n{0}")]
    WhichCamera(String),
    #[cfg(not(feature = "aravis"))]
    #[error(
        "this raysweep was built without the feature `aravis`; build it with `cargo build --release --features aravis`, which needs libaravis-dev and libusb-1.0-0-dev"
    )]
    WithoutAravis,
    #[error(transparent)]
    Park(#[from] ParkError),
    #[error("cannot handle Ctrl-C: {0}")]
    Signals(io::Error),
    #[cfg(feature = "view")]
    #[error("cannot serve the page: {}", io_text(.0))]
    View(io::Error),
    #[error("cannot print: {0}")]
    Output(io::Error),
}

/// A problem that the daemon found in a plan, with the plan's text.
#[derive(Debug, thiserror::Error, Diagnostic)]
#[error("{}", printable(&error.message))]
pub(super) struct PlanProblem {
    error: RpcError,
    #[source_code]
    plan: NamedSource<String>,
    #[label(collection, "here")]
    labels: Vec<LabeledSpan>,
    #[help]
    help: Option<String>,
}

impl CommandFailure {
    /// The failure of a call that sent a plan's text.
    pub fn of_plan(error: ClientError, path: &Path, text: &str) -> Self {
        match error {
            ClientError::Rpc(error) if error.name() == Some(ErrorCode::InvalidPlan) => {
                let data = error.data.clone();
                let places: Vec<_> = match &data {
                    Some(data) if data.mistakes.is_empty() => vec![(data.field.clone(), data.span)],
                    Some(data) => data.mistakes.iter().map(|one| (one.field.clone(), one.span)).collect(),
                    None => Vec::new(),
                };
                let labels = places.into_iter().filter_map(|(field, span)| {
                    let (start, end) = span?;
                    let start = start.min(text.len());
                    let label = field.unwrap_or_else(|| "here".into());
                    Some(LabeledSpan::new_with_span(
                        Some(printable(&label).into_owned()),
                        start..end.clamp(start, text.len()),
                    ))
                });
                let help = data.and_then(|data| data.help).map(|help| printable(&help).into_owned());
                let labels = labels.collect();
                let plan = NamedSource::new(printable(&path.display().to_string()), shown(text));
                Self::Plan(Box::new(PlanProblem { error, plan, labels, help }))
            }
            error => error.into(),
        }
    }

    /// Reports the failure and returns the exit code. If the reader has closed our output, nothing is printed.
    pub fn report(self, json: bool) -> Exit {
        let exit = self.exit();
        let gone = matches!(&self, Self::Output(error) if error.kind() == io::ErrorKind::BrokenPipe);
        match self {
            _ if gone => {}
            failure if json => {
                use io::Write as _;
                // If the output is gone too, only the exit code remains.
                let _ = writeln!(io::stdout(), "{}", json!({ "error": failure.for_programs() }));
            }
            Self::Plan(problem) => eprintln!("{:?}", miette::Report::new(*problem)),
            failure => {
                let text = failure.to_string();
                eprintln!("{}raysweep: {}", journal::error_prefix(), printable(&text));
            }
        }
        exit
    }

    fn for_programs(&self) -> Value {
        let rpc = match self {
            Self::Client(ClientError::Rpc(error)) => Some(error),
            Self::Plan(problem) => Some(&problem.error),
            _ => None,
        };
        let value = rpc.and_then(|error| serde_json::to_value(error).ok());
        value.unwrap_or_else(|| json!({ "message": self.to_string() }))
    }

    fn exit(&self) -> Exit {
        match self {
            Self::Client(ClientError::Rpc(error)) => match error.name() {
                Some(ErrorCode::Internal | ErrorCode::Device | ErrorCode::Storage) => Exit::Failed,
                _ => Exit::Refused,
            },
            Self::Client(_) => Exit::Unreachable,
            Self::Plan(_) => Exit::Refused,
            Self::File { .. }
            | Self::NotPng(_)
            | Self::OtherFile(_)
            | Self::InSession(_)
            | Self::Calibration(_)
            | Self::Sessions(_)
            | Self::Setup(_)
            | Self::Rig(RigError::Read { .. } | RigError::Config(_))
            | Self::Process(ProcessError::Product(_)) => Exit::Usage,
            #[cfg(feature = "aravis")]
            Self::WhichCamera(_) => Exit::Usage,
            #[cfg(feature = "aravis")]
            Self::Device(error) if error.kind == DeviceErrorKind::Busy => Exit::Refused,
            #[cfg(feature = "aravis")]
            Self::Device(_) => Exit::Failed,
            #[cfg(not(feature = "aravis"))]
            Self::WithoutAravis => Exit::Usage,
            Self::NoLiveImage => Exit::Refused,
            #[cfg(feature = "view")]
            Self::View(_) => Exit::Failed,
            Self::Write { .. }
            | Self::Live(_)
            | Self::Rig(_)
            | Self::Exposure(_)
            | Self::Trash(_)
            | Self::Process(_)
            | Self::Park(_)
            | Self::Signals(_)
            | Self::Output(_) => Exit::Failed,
        }
    }
}

/// A plan's text as it may be shown, with every character at its place: labels count bytes.
fn shown(plan: &str) -> String {
    let shown = |letter: char| match letter {
        // Of a line's end.
        '\r' => " ".into(),
        letter if is_unprintable(letter) => "?".repeat(letter.len_utf8()),
        letter => letter.into(),
    };
    plan.chars().map(shown).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn invalid(span: (usize, usize)) -> ClientError {
        let mut error = RpcError::new(ErrorCode::InvalidPlan, "count is 0").of_field("sweep.count");
        error.data.as_mut().unwrap().span = Some(span);
        error.into()
    }

    #[test]
    fn a_plans_error_shows_its_file_its_line_and_its_field() {
        let text = "kind = \"sweep\"\n[sweep]\ncount = 0\n";
        let start = text.find('0').unwrap();
        let failure = CommandFailure::of_plan(invalid((start, start + 1)), Path::new("night.toml"), text);
        assert_eq!(failure.exit(), Exit::Refused);
        let CommandFailure::Plan(problem) = failure else { panic!("{failure}") };
        let shown = format!("{:?}", miette::Report::new(*problem));
        for part in ["count is 0", "night.toml:3:9", "count = 0", "sweep.count"] {
            assert!(shown.contains(part), "{part} in {shown}");
        }
    }

    #[test]
    fn a_span_beyond_the_text_does_no_harm() {
        for span in [(0, 99), (99, 100), (5, 2)] {
            let failure = CommandFailure::of_plan(invalid(span), Path::new("p"), "é = 1");
            let CommandFailure::Plan(problem) = failure else { panic!("{failure}") };
            assert!(format!("{:?}", miette::Report::new(*problem)).contains("count is 0"));
        }
    }

    #[test]
    fn refusals_failures_and_silence_end_differently() {
        let rpc = |code| CommandFailure::from(ClientError::from(RpcError::new(code, "")));
        assert_eq!(rpc(ErrorCode::Forbidden).exit(), Exit::Refused);
        assert_eq!(rpc(ErrorCode::Busy).exit(), Exit::Refused);
        assert_eq!(rpc(ErrorCode::Device).exit(), Exit::Failed);
        let lost = ClientError::Lost { path: "s".into(), source: io::ErrorKind::UnexpectedEof.into() };
        assert_eq!(CommandFailure::from(lost).exit(), Exit::Unreachable);
    }
}
