//! JSON-RPC 2.0 (<https://www.jsonrpc.org/specification>) as used here: one object per line, parameters by
//! name, no batches.

use raysweep_core::decoding_message;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Number, Value};

use crate::{ErrorCode, Event, RpcError};

/// The only supported version of JSON-RPC.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
enum Version {
    #[default]
    #[serde(rename = "2.0")]
    V2,
}

/// Links an answer to its request; chosen by the caller.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Id {
    /// A number, returned unchanged.
    Number(Number),
    /// A string.
    String(String),
    /// Only in answers: the id of the request could not be read.
    Null,
}

/// A call of a method.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Request {
    jsonrpc: Version,
    /// Absent in a notification, which is executed but not answered.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub id: Option<Id>,
    /// The method's name.
    pub method: String,
    /// Its parameters, by name.
    #[serde(skip_serializing_if = "Map::is_empty")]
    pub params: Map<String, Value>,
}

impl Request {
    /// A call that expects an answer.
    pub fn new(id: u64, method: impl Into<String>, params: Map<String, Value>) -> Self {
        let id = Some(Id::Number(id.into()));
        Self { jsonrpc: Version::V2, id, method: method.into(), params }
    }

    /// Reads one line.
    ///
    /// # Errors
    /// The answer to send back: `ParseError`, `InvalidRequest` or `InvalidParams`, with the request's id if it is
    /// readable.
    pub fn parse(line: &str) -> Result<Self, Box<Response>> {
        let value: Value = serde_json::from_str(line).map_err(|error| {
            let message = if line.trim().is_empty() {
                "an empty line is not a request: send one JSON object per line".to_owned()
            } else if error.is_eof() {
                "not JSON: the line ends within the object; send one whole JSON object per line".to_owned()
            } else {
                format!("not JSON: {error}; send one JSON object per line")
            };
            Response::error(Id::Null, RpcError::new(ErrorCode::ParseError, message))
        })?;
        let mut object = match value {
            Value::Object(object) => object,
            Value::Array(_) => {
                let message = "batches (arrays of requests) are not supported: send one request per line";
                return Err(
                    Response::error(Id::Null, RpcError::new(ErrorCode::InvalidRequest, message)).into()
                );
            }
            other => {
                let message =
                    format!("{other} is not a request; send an object with jsonrpc, id, method, params");
                return Err(
                    Response::error(Id::Null, RpcError::new(ErrorCode::InvalidRequest, message)).into()
                );
            }
        };
        let id = match object.remove("id") {
            None => None,
            Some(Value::Null) => Some(Id::Null),
            Some(Value::Number(number)) => Some(Id::Number(number)),
            Some(Value::String(text)) => Some(Id::String(text)),
            Some(other) => {
                let error = invalid("id", format!("id = {other}: give a number, a string or null"));
                return Err(Response::error(Id::Null, error).into());
            }
        };
        Self::from_members(id.clone(), object)
            .map_err(|error| Response::error(id.unwrap_or(Id::Null), error).into())
    }

    fn from_members(id: Option<Id>, mut object: Map<String, Value>) -> Result<Self, RpcError> {
        match object.remove("jsonrpc") {
            Some(Value::String(version)) if version == "2.0" => {}
            Some(other) => {
                return Err(invalid("jsonrpc", format!("jsonrpc = {other}: only \"2.0\" is supported")));
            }
            None => return Err(invalid("jsonrpc", "jsonrpc is missing: add \"jsonrpc\": \"2.0\"")),
        }
        let method = match object.remove("method") {
            Some(Value::String(method)) => method,
            Some(other) => return Err(invalid("method", format!("method = {other}: give a string"))),
            None => return Err(invalid("method", "method is missing; `describe` lists the methods")),
        };
        let params = match object.remove("params") {
            None => Map::new(),
            Some(Value::Object(params)) => params,
            Some(other) => {
                let message = format!("params = {other}: give an object with the parameters by name");
                return Err(RpcError::new(ErrorCode::InvalidParams, message).of_field("params"));
            }
        };
        match object.keys().next() {
            None => Ok(Self { jsonrpc: Version::V2, id, method, params }),
            Some(key) => Err(invalid(
                key,
                format!("unknown member `{key}`: allowed are jsonrpc, id, method and params"),
            )),
        }
    }
}

fn invalid(member: &str, message: impl Into<String>) -> RpcError {
    RpcError::new(ErrorCode::InvalidRequest, message).of_field(member)
}

/// Reads a method's parameters.
///
/// # Errors
/// `InvalidParams`, with the field that is missing, unknown or of the wrong type.
pub fn params<T: DeserializeOwned>(params: Map<String, Value>) -> Result<T, RpcError> {
    serde_path_to_error::deserialize(Value::Object(params)).map_err(|error| {
        let path = error.path().to_string();
        let reason = decoding_message(&error.into_inner().to_string(), "object");
        // The path of an error about the object as a whole (a field missing) is ".".
        if path == "." {
            let refused = RpcError::new(ErrorCode::InvalidParams, format!("params: {reason}"));
            let missing = reason.split_once("missing key `").and_then(|(_, rest)| rest.strip_suffix('`'));
            return match missing {
                Some(key) => refused.of_field(key),
                None => refused,
            };
        }
        RpcError::new(ErrorCode::InvalidParams, format!("params.{path}: {reason}")).of_field(path)
    })
}

/// The answer to a request.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Response {
    jsonrpc: Version,
    /// The id of the request.
    pub id: Id,
    /// Result or error.
    #[serde(flatten)]
    pub outcome: Outcome,
}

/// The outcome of a request.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Outcome {
    /// The request succeeded.
    Result(Value),
    /// The request failed.
    Error(RpcError),
}

impl Response {
    /// The answer to the request with this id.
    pub fn new(id: Id, outcome: Result<Value, RpcError>) -> Self {
        let outcome = match outcome {
            Ok(value) => Outcome::Result(value),
            Err(error) => Outcome::Error(error),
        };
        Self { jsonrpc: Version::V2, id, outcome }
    }

    /// An error answer to the request with this id.
    pub fn error(id: Id, error: RpcError) -> Self {
        Self::new(id, Err(error))
    }
}

/// The notification that carries an event to a subscriber.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EventNotice {
    jsonrpc: Version,
    method: EventMethod,
    /// The event.
    pub params: Event,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum EventMethod {
    Event,
}

impl EventNotice {
    /// The notification for an event.
    pub fn new(event: Event) -> Self {
        Self { jsonrpc: Version::V2, method: EventMethod::Event, params: event }
    }
}

/// What a daemon sends to a client.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(untagged)]
pub enum Incoming {
    /// The answer to a request.
    Response(Response),
    /// An event.
    Event(Box<EventNotice>),
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::RunParams;

    fn refused(line: &str) -> (Value, i64, Option<String>, String) {
        let response = Request::parse(line).unwrap_err();
        let Outcome::Error(error) = response.outcome else { panic!("an error is an error") };
        let field = error.data.and_then(|data| data.field);
        (serde_json::to_value(response.id).unwrap(), error.code, field, error.message)
    }

    #[test]
    fn a_request_keeps_its_id_as_it_came() {
        for (text, id) in [
            ("7", Some(Id::Number(7.into()))),
            ("\"a\"", Some(Id::String("a".into()))),
            ("null", Some(Id::Null)),
        ] {
            let request =
                Request::parse(&format!(r#"{{"jsonrpc":"2.0","id":{text},"method":"status"}}"#)).unwrap();
            assert_eq!(request.id, id);
        }
        assert_eq!(
            Request::parse(r#"{"jsonrpc":"2.0","method":"status"}"#).unwrap().id,
            None,
            "a notification"
        );
    }

    #[test]
    fn a_request_survives_its_own_text() {
        let params = json!({"plan": "kind = \"sweep\"\n"}).as_object().unwrap().clone();
        let request = Request::new(3, "check", params);
        let line = serde_json::to_string(&request).unwrap();
        assert!(!line.contains('\n'), "one line");
        assert_eq!(Request::parse(&line).unwrap(), request);
    }

    #[test]
    fn what_is_no_request_is_told_what_is_wrong_with_it() {
        for (line, id, code, field) in [
            ("", Value::Null, -32700, None),
            ("{\"jsonrpc\":", Value::Null, -32700, None),
            ("[]", Value::Null, -32600, None),
            ("17", Value::Null, -32600, None),
            (r#"{"id":1,"method":"status"}"#, json!(1), -32600, Some("jsonrpc")),
            (r#"{"jsonrpc":2.0,"id":1,"method":"status"}"#, json!(1), -32600, Some("jsonrpc")),
            (r#"{"jsonrpc":"1.0","id":1,"method":"status"}"#, json!(1), -32600, Some("jsonrpc")),
            (r#"{"jsonrpc":"2.0","id":"x"}"#, json!("x"), -32600, Some("method")),
            (r#"{"jsonrpc":"2.0","id":1,"method":5}"#, json!(1), -32600, Some("method")),
            (r#"{"jsonrpc":"2.0","id":{},"method":"status"}"#, Value::Null, -32600, Some("id")),
            (r#"{"jsonrpc":"2.0","id":1,"method":"status","extra":0}"#, json!(1), -32600, Some("extra")),
            (r#"{"jsonrpc":"2.0","id":1,"method":"check","params":["p"]}"#, json!(1), -32602, Some("params")),
        ] {
            let (got_id, got_code, got_field, message) = refused(line);
            assert_eq!((got_id, got_code, got_field.as_deref()), (id, code, field), "{line}: {message}");
        }
    }

    #[test]
    fn wrong_parameters_are_named() {
        let read = |value: Value| params::<RunParams>(value.as_object().unwrap().clone()).unwrap_err();
        let wrong_type = read(json!({"plan": "", "tags": ["a", 5]}));
        assert_eq!(wrong_type.data.unwrap().field.as_deref(), Some("tags[1]"));
        let unknown = read(json!({"plan": "", "plann": ""}));
        assert_eq!(unknown.data.unwrap().field.as_deref(), Some("plann"));
        let missing = read(json!({}));
        assert_eq!(missing.name(), Some(ErrorCode::InvalidParams));
        assert_eq!(missing.data.unwrap().field.as_deref(), Some("plan"));
    }

    #[test]
    fn answers_and_events_are_told_apart() {
        let answer = r#"{"jsonrpc":"2.0","id":1,"result":{}}"#;
        let failure = r#"{"jsonrpc":"2.0","id":null,"error":{"code":2,"message":"busy"}}"#;
        let event = r#"{"jsonrpc":"2.0","method":"event","params":{"event":"skipped","events":4}}"#;
        for line in [answer, failure] {
            let Incoming::Response(response) = serde_json::from_str(line).unwrap() else { panic!("{line}") };
            assert_eq!(serde_json::to_string(&response).unwrap(), line);
        }
        let Incoming::Event(notice) = serde_json::from_str(event).unwrap() else { panic!("{event}") };
        assert_eq!(notice.params, Event::Skipped { events: 4 });
        assert_eq!(serde_json::to_string(&notice).unwrap(), event);
        for line in [r#"{"jsonrpc":"1.0","id":1,"result":{}}"#, r#"{"jsonrpc":"2.0","id":1}"#, "{}"] {
            assert!(serde_json::from_str::<Incoming>(line).is_err(), "{line}");
        }
    }
}
