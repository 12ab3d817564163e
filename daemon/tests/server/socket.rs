//! Methods, events, roles and limits.

use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::os::unix::net::UnixStream;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use raysweep::server::{Access, Limits, Peer};
use raysweep_proto::{
    Client, ClientError, DoctorParams, ErrorCode, Event, MAX_CLIENTS, MAX_MESSAGE_BYTES, Method, Role,
    RunParams, RunState, ViewfinderParams,
};
use serde_json::{Value, json};

use crate::fake::{Daemon, KEPT_EVENTS, bad_plan, listed, progress, report, session};
use crate::process::HUNG;

fn code(result: Result<impl std::fmt::Debug, ClientError>) -> ErrorCode {
    match result {
        Err(ClientError::Rpc(error)) => error.name().unwrap(),
        other => panic!("{other:?}"),
    }
}

#[test]
fn every_method_makes_the_round_trip() {
    let daemon = Daemon::start();
    let mut client = daemon.client();
    let mut events = daemon.client().subscribe().unwrap();

    assert_eq!(client.status().unwrap().state, RunState::Idle);
    assert_eq!(client.check("fine").unwrap(), report());
    let Err(ClientError::Rpc(error)) = client.check("bad plan") else { panic!("a bad plan passes") };
    assert_eq!(error, bad_plan(), "an error arrives as the daemon made it");
    assert_eq!(client.sessions().unwrap(), [listed()]);
    assert_eq!(code(client.pause()), ErrorCode::NotRunning);
    assert_eq!(code(client.go_on()), ErrorCode::NotRunning);
    assert_eq!(code(client.cancel()), ErrorCode::NotRunning);
    assert_eq!(code(client.resume("none")), ErrorCode::NoSession);

    let params =
        RunParams { plan: "hang".into(), tags: vec!["a".into(), "b".into()], ..RunParams::default() };
    assert_eq!(client.run(&params).unwrap().session, session());
    assert_eq!(daemon.fake.runs.lock().unwrap()[0].tags, ["a", "b"]);
    assert_eq!(code(client.run(&params)), ErrorCode::Busy);
    client.pause().unwrap();
    assert_eq!(client.status().unwrap().state, RunState::Paused);
    client.go_on().unwrap();
    client.cancel().unwrap();
    assert_eq!(client.resume("old").unwrap().session, session());
    assert_eq!(*daemon.fake.resumed.lock().unwrap(), [std::path::Path::new("old")]);

    let state = |state| Event::State { state, session: Some(session()) };
    assert_eq!(events.next().unwrap().unwrap(), state(RunState::Running));
    assert_eq!(events.next().unwrap().unwrap(), Event::Progress(progress()));
    assert!(matches!(events.next().unwrap().unwrap(), Event::Lost { point: 3, .. }));
    assert_eq!(events.next().unwrap().unwrap(), state(RunState::Paused));
    assert_eq!(events.next().unwrap().unwrap(), state(RunState::Running));
    assert_eq!(events.next().unwrap().unwrap(), state(RunState::Idle));
    assert!(matches!(events.next().unwrap().unwrap(), Event::Finished { missing: 38, .. }));
}

#[test]
fn describe_lists_every_method_with_its_schemas() {
    let daemon = Daemon::start();
    let description = daemon.client().describe().unwrap();
    let names: Vec<_> = description.methods.iter().map(|method| method.name.as_str()).collect();
    assert_eq!(names, Method::ALL.map(Method::name));
    for method in &description.methods {
        assert_eq!(method.params.get("type"), Some(&json!("object")), "{}", method.name);
        assert!(method.result.get("type").is_some(), "{}", method.name);
        assert!(!method.about.is_empty());
    }
    assert!(description.event.get("oneOf").is_some());
    assert_eq!(
        (description.limits.clients, description.limits.message_bytes),
        (MAX_CLIENTS, MAX_MESSAGE_BYTES)
    );
}

#[test]
fn one_clients_long_call_does_not_hold_another() {
    let daemon = Daemon::start();
    let mut other = daemon.client();
    let gate = daemon.fake.gate.lock().unwrap();
    let mut waiting = UnixStream::connect(&daemon.path).unwrap();
    waiting
        .write_all(
            b"{\"jsonrpc\":\"2.0\",\"id\":\"slow\",\"method\":\"check\",\"params\":{\"plan\":\"wait\"}}\n",
        )
        .unwrap();
    // The call blocks until the gate opens, so this answer comes first.
    assert!(other.status().is_ok());
    drop(gate);
    let mut line = String::new();
    BufReader::new(waiting).read_line(&mut line).unwrap();
    assert_eq!(serde_json::from_str::<Value>(&line).unwrap()["id"], "slow");
}

#[test]
fn a_slow_subscriber_skips_and_the_others_do_not_wait() {
    // No time-out, so the speed of the quick subscriber does not matter.
    let limits = Limits { write_timeout: Duration::from_secs(3600), ..Limits::default() };
    let daemon = Daemon::with(limits, Access::new(None));
    let mut slow = daemon.client().subscribe().unwrap();
    let mut quick = daemon.client().subscribe().unwrap();
    // 400 events of 8 KiB exceed the capacity of the socket's buffers and the fake's event queue.
    let event = |number: usize| {
        let session = Some(format!("{number}/{}", "x".repeat(8192)).into());
        Event::State { state: RunState::Running, session }
    };
    let total = 400;
    for number in 0..total {
        daemon.fake.publish(event(number));
        assert_eq!(quick.next().unwrap().unwrap(), event(number));
    }
    let (mut seen, mut skipped) = (0, 0);
    while seen + skipped < total {
        match slow.next_within(HUNG).unwrap() {
            Some(Event::Skipped { events }) => skipped += events as usize,
            Some(_) => seen += 1,
            None => panic!("{seen} seen, {skipped} skipped, and no more comes"),
        }
    }
    assert!(skipped > total / 2 && seen > KEPT_EVENTS, "{seen} seen, {skipped} skipped");
}

#[test]
fn a_client_that_does_not_read_is_dropped() {
    let limits = Limits { write_timeout: Duration::from_millis(20), clients: 1, ..Limits::default() };
    let daemon = Daemon::with(limits, Access::new(None));
    let mut deaf = UnixStream::connect(&daemon.path).unwrap();
    // The server stops reading when its answers find no room, and then closes the connection, so that writing fails.
    deaf.set_write_timeout(Some(HUNG)).unwrap();
    let ask = b"{\"jsonrpc\":\"2.0\",\"id\":1,\"method\":\"describe\"}\n".repeat(100);
    let end = loop {
        if let Err(error) = deaf.write_all(&ask) {
            break error.kind();
        }
    };
    assert!(matches!(end, ErrorKind::BrokenPipe | ErrorKind::ConnectionReset), "{end:?}");
    // The client's slot is free again.
    come_in(&daemon);
}

/// Connects and calls until there is a free slot: the server does not notice a closed connection immediately.
fn come_in(daemon: &Daemon) {
    let since = Instant::now();
    while let Err(error) = daemon.client().status() {
        assert!(since.elapsed() < HUNG, "no place gets free");
        assert_eq!(code(Err::<(), _>(error)), ErrorCode::TooManyClients);
    }
}

#[test]
fn a_run_that_is_attached_to_its_client_ends_with_it_and_no_other_does() {
    let daemon = Daemon::with(Limits::default(), Access::new(None));
    let abandoned = || daemon.fake.abandoned.lock().unwrap().len();
    for (attached, expected) in [(false, 0), (true, 1)] {
        let mut other = daemon.client();
        other.status().unwrap();
        let mut client = daemon.client();
        client.run(&RunParams { plan: "fine".into(), attached, ..RunParams::default() }).unwrap();
        drop(other);
        // Whoever is served later may still not be: a connection's end is noticed whenever its task gets to run.
        client.status().unwrap();
        assert_eq!(abandoned(), 0);
        drop(client);
        let since = Instant::now();
        while abandoned() < expected && since.elapsed() < HUNG {
            daemon.client().status().unwrap();
        }
        assert_eq!(abandoned(), expected);
    }
    assert_eq!(*daemon.fake.abandoned.lock().unwrap(), [session()]);
}

#[test]
fn one_client_more_than_allowed_is_turned_away() {
    let daemon = Daemon::with(Limits { clients: 2, ..Limits::default() }, Access::new(None));
    let mut first = daemon.client();
    let mut second = daemon.client();
    first.status().unwrap();
    second.status().unwrap();
    assert_eq!(code(daemon.client().status()), ErrorCode::TooManyClients);
    first.status().unwrap();
    drop(second);
    come_in(&daemon);
}

/// Users 0, 1, 2 and so on, one for each connection; user 0 is root.
fn users_in_turn(_: &tokio::net::UnixStream) -> std::io::Result<Peer> {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    Ok(Peer { uid: NEXT.fetch_add(1, Ordering::Relaxed), gid: 65534 })
}

#[test]
fn idle_observers_leave_places_for_operators() {
    static ROOT: AtomicBool = AtomicBool::new(false);
    // Each connection is of another observer, until the operator comes.
    let identify = |stream: &tokio::net::UnixStream| match ROOT.load(Ordering::Relaxed) {
        true => Ok(Peer { uid: 0, gid: 0 }),
        false => users_in_turn(stream).map(|peer| Peer { uid: 100_000 + peer.uid, ..peer }),
    };
    let limits = Limits { clients: 6, clients_of_operators: 2, ..Limits::default() };
    let daemon = Daemon::with(limits, Access::identified_by(None, identify));
    let mut observers: Vec<_> = (0..4).map(|_| daemon.client()).collect();
    observers.iter_mut().for_each(|client| drop(client.status().unwrap()));
    assert_eq!(code(daemon.client().status()), ErrorCode::TooManyClients);
    ROOT.store(true, Ordering::Relaxed);
    come_in(&daemon);
    let mut operator = daemon.client();
    operator.run(&RunParams { plan: "hang".into(), ..RunParams::default() }).unwrap();
    operator.cancel().unwrap();
}

#[test]
fn one_user_does_not_take_all_places() {
    static OTHER: AtomicBool = AtomicBool::new(false);
    let identify = |_: &tokio::net::UnixStream| {
        Ok(Peer { uid: 100_000 + u32::from(OTHER.load(Ordering::Relaxed)), gid: 65534 })
    };
    let limits = Limits { clients_per_user: 3, ..Limits::default() };
    let daemon = Daemon::with(limits, Access::identified_by(None, identify));
    let mut clients: Vec<_> = (0..3).map(|_| daemon.client()).collect();
    clients.iter_mut().for_each(|client| drop(client.status().unwrap()));
    let error = daemon.client().status();
    assert!(error.as_ref().is_err_and(|error| error.to_string().contains("100000")), "{error:?}");
    OTHER.store(true, Ordering::Relaxed);
    daemon.client().status().unwrap();
    OTHER.store(false, Ordering::Relaxed);
    clients.pop();
    come_in(&daemon);
}

#[test]
fn a_user_who_waits_for_a_computation_does_not_hold_another() {
    static OTHER: AtomicBool = AtomicBool::new(false);
    static IDENTIFIED: AtomicUsize = AtomicUsize::new(0);
    let identify = |_: &tokio::net::UnixStream| {
        IDENTIFIED.fetch_add(1, Ordering::SeqCst);
        Ok(Peer { uid: 100_000 + u32::from(OTHER.load(Ordering::Relaxed)), gid: 65534 })
    };
    let daemon = Daemon::with(Limits::default(), Access::identified_by(None, identify));
    let gate = daemon.fake.gate.lock().unwrap();
    let before = IDENTIFIED.load(Ordering::SeqCst);
    let ask = b"{\"jsonrpc\":\"2.0\",\"id\":1,\"method\":\"check\",\"params\":{\"plan\":\"wait\"}}\n";
    let asking: Vec<_> = (0..4)
        .map(|_| {
            let mut client = UnixStream::connect(&daemon.path).unwrap();
            client.write_all(ask).unwrap();
            client
        })
        .collect();
    // One of the four computes, and the others wait without a thread of the daemon.
    while daemon.fake.checks.load(Ordering::SeqCst) == 0 || IDENTIFIED.load(Ordering::SeqCst) < before + 4 {
        std::thread::sleep(Duration::from_millis(1));
    }
    OTHER.store(true, Ordering::Relaxed);
    daemon.client().check("fine").unwrap();
    assert_eq!(daemon.fake.checks.load(Ordering::SeqCst), 2, "one of each user");
    drop(gate);
    for client in asking {
        let mut line = String::new();
        BufReader::new(client).read_line(&mut line).unwrap();
        assert!(line.contains("result"), "{line}");
    }
}

#[test]
fn a_defect_of_the_daemon_costs_one_answer() {
    let daemon = Daemon::start();
    let (mut client, mut other) = (daemon.client(), daemon.client());
    assert_eq!(code(client.check("panic")), ErrorCode::Internal);
    assert_eq!(client.check("fine").unwrap(), report());
    other.status().unwrap();
}

#[test]
fn who_only_observes_is_forbidden_to_drive() {
    let access = Access::identified_by(Some("raysweep".into()), |_| Ok(Peer { uid: 65534, gid: 65534 }));
    let daemon = Daemon::with(Limits::default(), access);
    let mut client = daemon.client();
    let driving = [
        client.doctor(&DoctorParams::default()).map(drop),
        client.run(&RunParams::default()).map(drop),
        client.resume("old").map(drop),
        client.pause(),
        client.go_on(),
        client.cancel(),
        client.arm_light(),
        client.use_calibration("old"),
        client.viewfinder(&ViewfinderParams::default()),
    ];
    assert_eq!(driving.len(), Method::ALL.iter().filter(|method| method.role() == Role::Operator).count());
    for result in driving {
        let Err(ClientError::Rpc(error)) = result else { panic!("{result:?}") };
        assert_eq!(error.name(), Some(ErrorCode::Forbidden));
        assert!(error.data.is_some_and(|data| data.help.is_some()), "it says which group to join");
    }
    assert!(daemon.fake.runs.lock().unwrap().is_empty() && daemon.fake.resumed.lock().unwrap().is_empty());
    client.describe().unwrap();
    client.status().unwrap();
    client.check("fine").unwrap();
    client.sessions().unwrap();
    client.subscribe().unwrap();
}

#[test]
fn the_end_of_the_daemon_reaches_subscribers_after_their_events() {
    let mut daemon = Daemon::start();
    let mut events = daemon.client().subscribe().unwrap();
    let idle = daemon.client();
    // Enough events that most are still queued when the daemon stops.
    let event =
        |number: usize| Event::State { state: RunState::Idle, session: Some(number.to_string().into()) };
    for number in 0..KEPT_EVENTS {
        daemon.fake.publish(event(number));
    }
    daemon.stop();
    for number in 0..KEPT_EVENTS {
        assert_eq!(events.next().unwrap().unwrap(), event(number));
    }
    assert!(matches!(events.next(), Some(Err(ClientError::Lost { .. }))));
    drop(idle);
    assert!(
        matches!(Client::connect(&daemon.path), Err(ClientError::NotRunning { .. })),
        "the socket is removed"
    );
}

#[test]
fn requests_sent_together_are_answered_in_order_and_notifications_not_at_all() {
    let daemon = Daemon::start();
    let mut stream = UnixStream::connect(&daemon.path).unwrap();
    let text = concat!(
        r#"{"jsonrpc":"2.0","id":1,"method":"status"}"#,
        "\n",
        r#"{"jsonrpc":"2.0","method":"run","params":{"plan":"hang"}}"#,
        "\r\n",
        r#"{"jsonrpc":"2.0","id":null,"method":"pause"}"#,
        "\n",
        r#"{"jsonrpc":"2.0","id":"last","method":"status"}"#,
    );
    stream.write_all(text.as_bytes()).unwrap();
    stream.shutdown(std::net::Shutdown::Write).unwrap();
    let mut answers = String::new();
    stream.read_to_string(&mut answers).unwrap();
    let answers: Vec<Value> = answers.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(
        answers.iter().map(|answer| &answer["id"]).collect::<Vec<_>>(),
        [&json!(1), &Value::Null, &json!("last")]
    );
    assert_eq!(answers[1]["result"], json!({}));
    assert_eq!(answers[2]["result"]["state"], "paused", "the notification was carried out");
}
