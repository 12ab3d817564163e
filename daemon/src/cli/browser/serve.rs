//! Connections of browsers. Everybody on this machine can connect, so that they are few, none waits for long for a request,
//! and the guard ends those that it refuses.

use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;

/// Connections at once: a browser takes six at most, and each may need a few of the 1,024 files of a process.
const CONNECTIONS: usize = 128;
/// How long a connection may take for a request, also for its next one.
const REQUEST: Duration = Duration::from_secs(5);
/// Wait before the next connection is accepted when that failed.
const PACE: Duration = Duration::from_millis(100);

/// Serves connections for ever.
pub(super) async fn serve(listener: TcpListener, app: Router) {
    let places = Arc::new(Semaphore::new(CONNECTIONS));
    loop {
        // Later connections wait with the kernel, first come, first served.
        let Ok(place) = places.clone().acquire_owned().await else { return };
        let stream = match listener.accept().await {
            Ok((stream, _)) => stream,
            Err(error) => {
                eprintln!("a browser could not connect: {error}");
                tokio::time::sleep(PACE).await;
                continue;
            }
        };
        let service = TowerToHyperService::new(app.clone());
        tokio::spawn(async move {
            let _place = place;
            let mut http = http1::Builder::new();
            http.timer(TokioTimer::new()).header_read_timeout(REQUEST);
            // Browsers end connections in all kinds of ways.
            let _ = http.serve_connection(TokioIo::new(stream), service).await;
        });
    }
}
