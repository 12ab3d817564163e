//! Clients of a soak: one asks and measures, the others misbehave.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

const STATUS: &[u8] = b"{\"jsonrpc\":\"2.0\",\"id\":1,\"method\":\"status\"}\n";
const SUBSCRIBE: &[u8] = b"{\"jsonrpc\":\"2.0\",\"id\":1,\"method\":\"subscribe\"}\n";
const ASK_EVERY: Duration = Duration::from_millis(50);

/// An answer that takes longer counts as none.
const PATIENCE: Duration = Duration::from_secs(10);

/// Clients at work.
pub struct Clients {
    over: Arc<AtomicBool>,
    asker: JoinHandle<Vec<f64>>,
    nuisance: JoinHandle<()>,
}

impl Clients {
    /// Starts them.
    pub fn start(socket: &Path) -> Self {
        let over = Arc::new(AtomicBool::new(false));
        let (asker_over, asker_socket) = (Arc::clone(&over), socket.to_owned());
        let (nuisance_over, nuisance_socket) = (Arc::clone(&over), socket.to_owned());
        Self {
            over,
            asker: std::thread::spawn(move || ask(&asker_socket, &asker_over)),
            nuisance: std::thread::spawn(move || misbehave(&nuisance_socket, &nuisance_over)),
        }
    }

    /// Ends them; returns how long the answers to `status` took, in milliseconds. An answer that never came is infinite.
    pub fn stop(self) -> Vec<f64> {
        self.over.store(true, Ordering::Relaxed);
        let _ = self.nuisance.join();
        self.asker.join().unwrap_or_default()
    }
}

fn ask(socket: &Path, over: &AtomicBool) -> Vec<f64> {
    let mut latencies_ms = Vec::new();
    let Ok(mut stream) = UnixStream::connect(socket) else { return vec![f64::INFINITY] };
    let Ok(answers) = stream.try_clone() else { return vec![f64::INFINITY] };
    let _ = answers.set_read_timeout(Some(PATIENCE));
    let mut answers = BufReader::new(answers);
    let mut answer = String::new();
    while !over.load(Ordering::Relaxed) {
        let began = Instant::now();
        answer.clear();
        let answered = stream.write_all(STATUS).and_then(|()| answers.read_line(&mut answer));
        let is_status = answered.is_ok() && answer.contains("\"state\"");
        latencies_ms.push(if is_status { began.elapsed().as_secs_f64() * 1e3 } else { f64::INFINITY });
        std::thread::sleep(ASK_EVERY);
    }
    latencies_ms
}

/// Connects and goes, sends what is no request, half a request, and more than is allowed, and subscribes without
/// reading. The daemon may answer or hang up as it likes.
fn misbehave(socket: &Path, over: &AtomicBool) {
    let long = vec![b'['; 2 << 20];
    let deep = [b"[".repeat(100_000), b"\n".to_vec()].concat();
    let messages: [&[u8]; 7] =
        [b"", b"\n\n\0\xff\n", b"{\"jsonrpc\":\"2.0\",\"id\":", STATUS, SUBSCRIBE, &long, &deep];
    // One that never reads, and others that stay for a while.
    let subscriber =
        UnixStream::connect(socket).and_then(|mut stream| stream.write_all(SUBSCRIBE).map(|()| stream));
    let mut idle = Vec::new();
    for message in messages.iter().cycle() {
        if over.load(Ordering::Relaxed) {
            drop(subscriber);
            return;
        }
        if let Ok(mut stream) = UnixStream::connect(socket) {
            let _ = stream.set_write_timeout(Some(Duration::from_millis(200)));
            let _ = stream.write_all(message);
            idle.push(stream);
        }
        if idle.len() > 8 {
            idle.remove(0);
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}
