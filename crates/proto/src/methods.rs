//! The table of all methods, and its description for programs.

use schemars::generate::SchemaSettings;
use schemars::{JsonSchema, Schema};
use serde::{Deserialize, Serialize};

use crate::live::{self, LiveLayout};
use crate::{
    CLIENTS_OF_OPERATORS, CalibrationInfo, CheckParams, CheckReport, DesignParams, DesignReport,
    DoctorParams, DoctorReport, ErrorCode, Event, MAX_CLIENTS, MAX_CLIENTS_PER_USER, MAX_MESSAGE_BYTES,
    ResumeParams, RunParams, SessionInfo, Started, Status, UseCalibrationParams, ViewfinderParams,
};

/// Role of a caller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// May read.
    Observer,
    /// May read and operate the rig.
    Operator,
}

/// No parameters, or a result without content: `{}`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Empty {}

/// The methods of the daemon.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// Returns this table.
    Describe,
    /// Returns what the daemon is doing.
    Status,
    /// Returns what a plan would do.
    Check,
    /// Returns a better plan.
    Design,
    /// Examines the rig and its host.
    Doctor,
    /// Starts a run.
    Run,
    /// Acquires what a session lacks.
    Resume,
    /// Pauses the run.
    Pause,
    /// Continues after a pause.
    Continue,
    /// Ends a run.
    Cancel,
    /// Permits light until the next boot.
    ArmLight,
    /// Lists the sessions on disk.
    Sessions,
    /// Lists the calibrations on disk.
    Calibrations,
    /// Chooses the calibration for later runs.
    UseCalibration,
    /// Changes what the running viewfinder shows.
    Viewfinder,
    /// Streams all events from now on.
    Subscribe,
}

struct Row {
    name: &'static str,
    role: Role,
    about: &'static str,
    params: fn() -> Schema,
    result: fn() -> Schema,
}

const fn row<P: JsonSchema, R: JsonSchema>(name: &'static str, role: Role, about: &'static str) -> Row {
    Row { name, role, about, params: accepted::<P>, result: sent::<R> }
}

fn accepted<T: JsonSchema>() -> Schema {
    SchemaSettings::default().into_generator().into_root_schema_for::<T>()
}

/// Requires fields that a reader does without: answers of earlier daemons lack them.
fn sent<T: JsonSchema>() -> Schema {
    SchemaSettings::default().for_serialize().into_generator().into_root_schema_for::<T>()
}

impl Method {
    /// Every method.
    pub const ALL: [Method; 16] = [
        Self::Describe,
        Self::Status,
        Self::Check,
        Self::Design,
        Self::Doctor,
        Self::Run,
        Self::Resume,
        Self::Pause,
        Self::Continue,
        Self::Cancel,
        Self::ArmLight,
        Self::Sessions,
        Self::Calibrations,
        Self::UseCalibration,
        Self::Viewfinder,
        Self::Subscribe,
    ];

    const fn row(self) -> Row {
        use Role::{Observer, Operator};
        match self {
            Self::Describe => row::<Empty, Description>(
                "describe",
                Observer,
                "The methods with their schemas, the events, the error codes and the limits.",
            ),
            Self::Status => row::<Empty, Status>("status", Observer, "What the daemon is doing."),
            Self::Check => row::<CheckParams, CheckReport>(
                "check",
                Observer,
                "What a plan would do, without moving anything.",
            ),
            Self::Design => row::<DesignParams, DesignReport>(
                "design",
                Observer,
                "Searches the settings of a sweep or film for a wanted error, or for a time of light.",
            ),
            Self::Doctor => row::<DoctorParams, DoctorReport>(
                "doctor",
                Operator,
                "Examines the rig and its host between runs: opens each device, watches the VSYNC line, takes frames in darkness; moves no mirror.",
            ),
            Self::Run => row::<RunParams, Started>(
                "run",
                Operator,
                "Starts a run and returns at once; the event `finished` reports its end.",
            ),
            Self::Resume => row::<ResumeParams, Started>(
                "resume",
                Operator,
                "Starts to acquire the missing points of a session, as `run` does.",
            ),
            Self::Pause => row::<Empty, Empty>("pause", Operator, "Pauses the run before its next point."),
            Self::Continue => row::<Empty, Empty>("continue", Operator, "Continues a paused run."),
            Self::Cancel => {
                row::<Empty, Empty>("cancel", Operator, "Cancels the run; what was acquired is kept.")
            }
            Self::ArmLight => row::<Empty, Empty>(
                "arm_light",
                Operator,
                "Permits light until the next boot, on a rig with a mirror but no interlock.",
            ),
            Self::Sessions => row::<Empty, Vec<SessionInfo>>(
                "sessions",
                Observer,
                "The sessions of the daemon's data folder, oldest first.",
            ),
            Self::Calibrations => row::<Empty, Vec<CalibrationInfo>>(
                "calibrations",
                Observer,
                "The calibrations in the daemon's data folder, oldest first.",
            ),
            Self::UseCalibration => row::<UseCalibrationParams, Empty>(
                "use_calibration",
                Operator,
                "Makes a session's calibration the one that later runs use.",
            ),
            Self::Viewfinder => row::<ViewfinderParams, Empty>(
                "viewfinder",
                Operator,
                "Changes what the running viewfinder shows; `run` starts one with a plan of kind \"viewfinder\".",
            ),
            Self::Subscribe => row::<Empty, Empty>(
                "subscribe",
                Observer,
                "Sends every event from now on, as notifications of method `event`, over this connection.",
            ),
        }
    }

    /// The name on the wire.
    pub const fn name(self) -> &'static str {
        self.row().name
    }

    /// The method with this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|method| method.name() == name)
    }

    /// The role that a caller needs.
    pub const fn role(self) -> Role {
        self.row().role
    }
}

/// Result of `describe`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Description {
    /// Version of the daemon.
    pub version: String,
    /// The methods.
    pub methods: Vec<MethodInfo>,
    /// JSON Schema of the `params` of the notification `event`.
    pub event: Schema,
    /// The error codes.
    pub errors: Vec<ErrorInfo>,
    /// The limits.
    pub limits: LimitsInfo,
    /// Layout of the live file that `status` names.
    pub live: LiveLayout,
}

/// Description of a method.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MethodInfo {
    /// Its name on the wire.
    pub name: String,
    /// The role that a caller needs.
    pub role: Role,
    /// What it does.
    pub about: String,
    /// JSON Schema of its `params`.
    pub params: Schema,
    /// JSON Schema of its `result`.
    pub result: Schema,
}

/// Description of an error code.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct ErrorInfo {
    /// `error.data.name`
    pub name: ErrorCode,
    /// `error.code`
    pub code: i64,
    /// What it means.
    pub meaning: String,
}

/// Limits of the daemon.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct LimitsInfo {
    /// Maximum bytes of a request, without its line feed; a longer one ends the connection.
    pub message_bytes: usize,
    /// Maximum number of connected clients.
    pub clients: usize,
    /// Maximum number of connections of one user; 0: the daemon is older and has no such limit.
    #[serde(default)]
    pub clients_per_user: usize,
    /// Number of connections that only operators may take.
    #[serde(default)]
    pub clients_of_operators: usize,
}

/// The result of `describe` for a daemon of this version.
pub fn describe(version: &str) -> Description {
    let methods = Method::ALL.map(|method| {
        let Row { name, role, about, params, result } = method.row();
        MethodInfo { name: name.into(), role, about: about.into(), params: params(), result: result() }
    });
    Description {
        version: version.into(),
        methods: methods.into(),
        event: sent::<Event>(),
        errors: error_codes(),
        limits: LimitsInfo {
            message_bytes: MAX_MESSAGE_BYTES,
            clients: MAX_CLIENTS,
            clients_per_user: MAX_CLIENTS_PER_USER,
            clients_of_operators: CLIENTS_OF_OPERATORS,
        },
        live: live::layout(),
    }
}

/// Names and meanings come from the schema that the type derives, so that no code can be missing here.
fn error_codes() -> Vec<ErrorInfo> {
    let schema = sent::<ErrorCode>();
    let variants = schema.get("oneOf").and_then(|variants| variants.as_array());
    let info = |variant: &serde_json::Value| {
        let name = ErrorCode::deserialize(variant.get("const")?).ok()?;
        let meaning = variant.get("description")?.as_str()?.to_owned();
        Some(ErrorInfo { name, code: name as i64, meaning })
    };
    variants.into_iter().flatten().filter_map(info).collect()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn names_lead_back_to_their_methods() {
        for method in Method::ALL {
            assert_eq!(Method::from_name(method.name()), Some(method));
        }
        assert_eq!(Method::from_name("go_on"), None);
    }

    #[test]
    fn who_only_observes_cannot_move_the_rig() {
        let drives =
            Method::ALL.into_iter().filter(|method| method.role() == Role::Operator).map(Method::name);
        assert_eq!(
            drives.collect::<Vec<_>>(),
            [
                "doctor",
                "run",
                "resume",
                "pause",
                "continue",
                "cancel",
                "arm_light",
                "use_calibration",
                "viewfinder"
            ]
        );
    }

    #[test]
    fn every_method_has_schemas_and_every_code_a_meaning() {
        let description = serde_json::to_value(describe("1")).unwrap();
        let methods = description["methods"].as_array().unwrap();
        assert_eq!(methods.len(), Method::ALL.len());
        for method in methods {
            assert_eq!(method["params"]["type"], "object", "{method}");
            assert!(["object", "array"].contains(&method["result"]["type"].as_str().unwrap()), "{method}");
        }
        let run = methods.iter().find(|method| method["name"] == "run").unwrap();
        assert_eq!(run["params"]["required"], json!(["plan"]));
        assert_eq!(run["params"]["additionalProperties"], false);
        let counts = &description["event"]["$defs"]["Counts"];
        assert!(counts["required"].as_array().unwrap().contains(&json!("lost")), "{counts}");

        let codes = describe("1").errors;
        assert_eq!(codes.len(), 14, "a code without a doc comment would be left out");
        assert!(codes.iter().all(|error| !error.meaning.is_empty()));
        assert!(codes.iter().any(|error| error.name == ErrorCode::Busy && error.code == 2));
    }
}
