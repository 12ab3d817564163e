//! The daemon in real time while 64 clients call it as fast as they can. Takes a minute, and needs a machine that has
//! nothing else to do: `cargo test --release -p raysweep --test load -- --ignored --nocapture`.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use ndarray::Array2;
use raysweep::control::Control;
use raysweep::rig::Rig;
use raysweep::server::{Access, Limits, Listening, Peer, serve_within};
use raysweep::{Probes, Runner};
use raysweep_core::Clock;
use raysweep_pipeline::{Stage, StageError, Unit};
use raysweep_proto::{Client, Event, RunParams};

const RIG: &str = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n[projector]\ndriver = \"sim\"\n\
                   [sim]\nscene = \"v-groove\"\nscene_rows = 128\nscene_columns = 128\nseed = 1\nrealtime = true\n";
const PLAN: &str = "kind = \"sweep\"\n[sweep]\ndelay_us = { start = -1500, stop = 1500, count = 15 }\n\
                    exposure_us = { start = 600, stop = 1200, count = 5 }\naverage = 8\n";
const CLIENTS: usize = 64;

/// Time from the exposure of a unit's last frame to its image in the stages, in microseconds.
#[derive(Clone)]
struct Stopwatch(std::sync::mpsc::Sender<f64>);

impl Stage for Stopwatch {
    fn name(&self) -> &str {
        "stopwatch"
    }

    fn apply(&self, unit: &Unit, image: Array2<f32>) -> Result<Array2<f32>, StageError> {
        if let Some(exposed_ns) = unit.starts_ns.last() {
            let _ = self.0.send((Clock::real().now_ns() - exposed_ns) as f64 * 1e-3);
        }
        Ok(image)
    }
}

struct Swept {
    lost: u64,
    run_s: f64,
    p50_ms: f64,
    p99_ms: f64,
    calls: u64,
}

fn sweep(folder: &Path, clients: usize) -> Swept {
    let (send, latencies) = std::sync::mpsc::channel();
    let probes = Probes { stages: vec![Arc::new(Stopwatch(send))], ..Probes::default() };
    let rig = Rig::load(&folder.join("rig.toml")).unwrap();
    let data = folder.join(clients.to_string());
    let runner = Arc::new(Runner::new(rig, data).unwrap().with_probes(probes));
    runner.check(PLAN).unwrap();
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
    let socket = folder.join("socket");
    let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
    // Each connection is of another of eight users, half of them operators.
    let identify = |_: &tokio::net::UnixStream| {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        let uid = (NEXT.fetch_add(1, Ordering::Relaxed) % 8) as u32;
        Ok(Peer { uid: 100_000 + uid, gid: if uid.is_multiple_of(2) { 0 } else { 65534 } })
    };
    let listening = {
        let _within = runtime.enter();
        Listening::bind(&socket).unwrap()
    };
    let access = Access::identified_by(Some("root".into()), identify);
    let served = runtime.spawn({
        let control = runner.clone();
        async move {
            serve_within(Limits::default(), listening.listener, control, access, async {
                drop(stopped.await)
            })
            .await
        }
    });
    let (begun, ended, calls) = (AtomicBool::new(false), AtomicBool::new(false), AtomicU64::new(0));
    let began = std::time::Instant::now();
    let lost = std::thread::scope(|scope| {
        for client in 0..clients {
            let (socket, begun, ended, calls) = (&socket, &begun, &ended, &calls);
            scope.spawn(move || hammer(client, socket, [begun, ended], calls));
        }
        let mut events = runner.events();
        // The clients are at it when the run begins.
        std::thread::sleep(Duration::from_millis(300));
        runner.run(RunParams { plan: PLAN.into(), ..RunParams::default() }).unwrap();
        begun.store(true, Ordering::Relaxed);
        let session = loop {
            match events.blocking_recv() {
                Ok(Event::Finished { session, state, error, .. }) => {
                    assert_eq!(state, "complete", "{error:?}");
                    break session;
                }
                Ok(_) | Err(tokio::sync::broadcast::error::RecvError::Lagged(_)) => {}
                Err(closed) => panic!("{closed}"),
            }
        };
        ended.store(true, Ordering::Relaxed);
        raysweep_session::Session::open(&session).unwrap().state().unwrap().counts.lost_total()
    });
    let run_s = began.elapsed().as_secs_f64();
    drop(stop);
    runtime.block_on(served).unwrap().unwrap();
    drop(listening.file);
    runner.shut_down();
    drop(runner);
    let mut ms: Vec<f64> = latencies.try_iter().map(|us| us * 1e-3).collect();
    ms.sort_by(f64::total_cmp);
    let at = |share: f64| ms[((ms.len() - 1) as f64 * share).round() as usize];
    Swept { lost, run_s, p50_ms: at(0.5), p99_ms: at(0.99), calls: calls.into_inner() }
}

/// Calls everything that a client can call without ending the run, or beginning another one before it.
fn hammer(client: usize, socket: &Path, [begun, ended]: [&AtomicBool; 2], calls: &AtomicU64) {
    let mut connection = Client::connect(socket).ok();
    let mut number = client;
    while !ended.load(Ordering::Relaxed) {
        let Some(open) = &mut connection else {
            connection = Client::connect(socket).ok();
            continue;
        };
        number += 1;
        let own = PLAN.replace("average = 8", &format!("average = {}", 1 + number % 100));
        let answered = match number % 6 {
            0 => open.check(PLAN).map(drop),
            1 => open.check(&own).map(drop),
            2 => open.sessions().map(drop),
            3 => open.describe().map(drop),
            4 if begun.load(Ordering::Relaxed) => {
                open.run(&RunParams { plan: own, ..RunParams::default() }).map(drop)
            }
            _ => open.status().map(drop),
        };
        calls.fetch_add(1, Ordering::Relaxed);
        if let Err(raysweep_proto::ClientError::Lost { .. }) = answered {
            connection = None;
        }
    }
}

#[test]
#[ignore = "in real time: it takes a minute, and the machine must have nothing else to do"]
fn clients_cost_a_run_no_frame() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("rig.toml"), RIG).unwrap();
    let swept = [0, CLIENTS].map(|clients| {
        let swept = sweep(folder.path(), clients);
        let Swept { lost, run_s, p50_ms, p99_ms, calls } = swept;
        println!(
            "{clients} clients: {calls} calls, run {run_s:.1} s, {lost} frames lost, from exposure to image {p50_ms:.2} ms, 99 % {p99_ms:.2} ms"
        );
        swept
    });
    println!("{CLIENTS} clients over none, 99 %: {:.2}", swept[1].p99_ms / swept[0].p99_ms);
    assert_eq!(swept[1].lost, 0);
}
