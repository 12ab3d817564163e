//! Invalid messages: each gets its error, and other clients continue to be served.

use std::io::{ErrorKind, Read, Write};
use std::net::Shutdown;
use std::os::unix::net::UnixStream;
use std::path::Path;

use raysweep_proto::MAX_MESSAGE_BYTES;
use serde_json::{Value, json};

use crate::fake::Daemon;

/// Sends bytes, then returns all messages received until the server closes the connection.
fn exchange(path: &Path, bytes: &[u8]) -> Vec<Value> {
    let mut stream = UnixStream::connect(path).unwrap();
    // The server may close the connection while we are still writing.
    let _ = stream.write_all(bytes).and_then(|()| stream.shutdown(Shutdown::Write));
    let mut answers = Vec::new();
    match stream.read_to_end(&mut answers) {
        Err(error) if error.kind() != ErrorKind::ConnectionReset => panic!("{error}"),
        _ => {}
    }
    let text = String::from_utf8(answers).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[test]
fn each_kind_gets_its_error_and_the_next_request_is_answered() {
    let daemon = Daemon::start();
    let mut bystander = daemon.client();
    let next = "{\"jsonrpc\":\"2.0\",\"id\":\"next\",\"method\":\"status\"}\n";
    let kinds: [(&str, &[u8], i64, Value); 13] = [
        ("not JSON", b"status please", -32700, Value::Null),
        ("an empty line", b"", -32700, Value::Null),
        ("nested without end", &[b'['; 10_000], -32700, Value::Null),
        (
            "invalid UTF-8",
            b"{\"jsonrpc\":\"2.0\",\"id\":1,\"method\":\"st\xff\xfeatus\"}",
            -32700,
            Value::Null,
        ),
        ("wrong version", br#"{"jsonrpc":"1.0","id":1,"method":"status"}"#, -32600, json!(1)),
        ("batch", br#"[{"jsonrpc":"2.0","id":1,"method":"status"}]"#, -32600, Value::Null),
        ("no method", br#"{"jsonrpc":"2.0","id":1}"#, -32600, json!(1)),
        ("unknown member", br#"{"jsonrpc":"2.0","id":1,"method":"status","auth":"x"}"#, -32600, json!(1)),
        ("unknown method", br#"{"jsonrpc":"2.0","id":1,"method":"reboot"}"#, -32601, json!(1)),
        (
            "params by position",
            br#"{"jsonrpc":"2.0","id":1,"method":"check","params":["p"]}"#,
            -32602,
            json!(1),
        ),
        (
            "params of wrong type",
            br#"{"jsonrpc":"2.0","id":1,"method":"check","params":{"plan":5}}"#,
            -32602,
            json!(1),
        ),
        (
            "unknown field",
            br#"{"jsonrpc":"2.0","id":1,"method":"run","params":{"plan":"","now":1}}"#,
            -32602,
            json!(1),
        ),
        (
            "params where none are",
            br#"{"jsonrpc":"2.0","id":1,"method":"cancel","params":{"why":""}}"#,
            -32602,
            json!(1),
        ),
    ];
    for (kind, message, code, id) in kinds {
        let answers = exchange(&daemon.path, &[message, b"\n", next.as_bytes()].concat());
        let [refused, served] = answers.as_slice() else { panic!("{kind}: {answers:?}") };
        assert_eq!((&refused["error"]["code"], &refused["id"]), (&json!(code), &id), "{kind}: {refused}");
        assert!(!refused["error"]["message"].as_str().unwrap().is_empty());
        assert_eq!(served["result"]["state"], "idle", "{kind}: {served}");
        bystander.status().unwrap();
    }
    assert!(daemon.fake.runs.lock().unwrap().is_empty());
}

#[test]
fn a_line_may_be_as_long_as_allowed_and_one_byte_more_ends_the_connection() {
    let daemon = Daemon::start();
    let mut bystander = daemon.client();
    let request = br#"{"jsonrpc":"2.0","id":1,"method":"status"}"#;
    let mut line = vec![b' '; MAX_MESSAGE_BYTES - request.len()];
    line.extend_from_slice(request);
    line.push(b'\n');
    let answers = exchange(&daemon.path, &line);
    assert_eq!(answers[0]["result"]["state"], "idle");

    line.insert(0, b' ');
    line.extend_from_slice(request);
    let answers = exchange(&daemon.path, &line);
    assert_eq!(answers.len(), 1, "nothing that follows is read: {answers:?}");
    assert_eq!((&answers[0]["error"]["code"], &answers[0]["id"]), (&json!(8), &Value::Null));
    bystander.status().unwrap();
}

#[test]
fn half_a_message_and_a_hang_up_harm_nobody() {
    let daemon = Daemon::start();
    let mut bystander = daemon.client();
    let half = br#"{"jsonrpc":"2.0","id":1,"method":"run","par"#;
    let answers = exchange(&daemon.path, half);
    assert_eq!(answers.len(), 1);
    assert_eq!(answers[0]["error"]["code"], -32700);
    for _ in 0..100 {
        let mut stream = UnixStream::connect(&daemon.path).unwrap();
        stream.write_all(half).unwrap();
        drop(stream);
        bystander.status().unwrap();
    }
    assert!(exchange(&daemon.path, b"").is_empty(), "a connection without a word");
    assert!(daemon.fake.runs.lock().unwrap().is_empty());
}
