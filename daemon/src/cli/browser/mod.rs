//! `raysweep view`: a page in the browser that shows what the rig does and what it did.
//!
//! The view is a client like any other: it asks the daemon through its socket, with the rights of the user who started
//! it, and reads the live file and the sessions as that user. Nothing here runs in the daemon. Data flow one way, from
//! the [`hub`] that follows the daemon to any number of browsers; only `call` goes back.

mod barred;
mod guard;
mod hub;
mod pictures;
mod serve;
mod stored;

use std::fs::File;
use std::io::{self, Read};
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::{DefaultBodyLimit, Path as Segment, Query, State};
use axum::http::{StatusCode, header};
use axum::response::sse::{KeepAlive, Sse};
use axum::response::{IntoResponse, Redirect, Response};
use axum::routing::{get, post};
use axum::{Json, Router, middleware};
use raysweep_proto::{Client, ClientError, ErrorCode, Method, Role, RpcError, Status};
use serde::Deserialize;
use serde_json::{Map, Value, json};
use tokio::net::TcpListener;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::task::spawn_blocking;

use self::barred::barred;
use self::guard::Guard;
use self::hub::Hub;
use super::exit::Exit;
use super::failure::CommandFailure;
use super::folders::why_gone;
use super::printer::Printer;
use super::show;

/// Calls that all browsers together may have with the daemon at once: it gives one user few connections.
const CALLS_AT_ONCE: usize = 4;
/// Largest message of a browser: as large as the socket takes.
const MESSAGE_BYTES: usize = 1 << 20;

/// What the page may call: what it has buttons for.
const CALLS: [Method; 9] = [
    Method::Status,
    Method::Check,
    Method::Run,
    Method::Resume,
    Method::Pause,
    Method::Continue,
    Method::Cancel,
    Method::Viewfinder,
    Method::Sessions,
];

/// The files of the page, with their types.
const FILES: [(&str, &str, &[u8]); 11] = [
    ("", "text/html; charset=utf-8", include_bytes!("page/index.html")),
    ("style.css", "text/css; charset=utf-8", include_bytes!("page/style.css")),
    ("main.js", "text/javascript; charset=utf-8", include_bytes!("page/main.js")),
    ("picture.js", "text/javascript; charset=utf-8", include_bytes!("page/picture.js")),
    ("plots.js", "text/javascript; charset=utf-8", include_bytes!("page/plots.js")),
    ("delays.js", "text/javascript; charset=utf-8", include_bytes!("page/delays.js")),
    ("run.js", "text/javascript; charset=utf-8", include_bytes!("page/run.js")),
    ("finder.js", "text/javascript; charset=utf-8", include_bytes!("page/finder.js")),
    ("sessions.js", "text/javascript; charset=utf-8", include_bytes!("page/sessions.js")),
    ("uplot.js", "text/javascript; charset=utf-8", include_bytes!("page/uplot.js")),
    ("uplot.css", "text/css; charset=utf-8", include_bytes!("page/uplot.css")),
];

/// What the handlers share.
struct View {
    socket: PathBuf,
    hub: Hub,
    turns: Arc<Semaphore>,
}

impl View {
    /// Waits for a turn to ask the daemon. It lasts as long as what it is given to, even if the browser has gone.
    async fn turn(&self) -> Option<OwnedSemaphorePermit> {
        self.turns.clone().acquire_owned().await.ok()
    }
}

/// Serves the page on 127.0.0.1 until Ctrl-C; prints its address first. Port 0: any free one.
pub(super) fn view(socket: &Path, port: u16, printer: Printer) -> Result<Exit, CommandFailure> {
    let token = token().map_err(CommandFailure::View)?;
    warn_observers(socket);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
    let runtime = runtime.map_err(CommandFailure::View)?;
    let served = runtime.block_on(async {
        let listener = TcpListener::bind(SocketAddr::from((Ipv4Addr::LOCALHOST, port)));
        let listener = listener.await.map_err(CommandFailure::View)?;
        let port = listener.local_addr().map_err(CommandFailure::View)?.port();
        let hub = Hub::start(socket).map_err(CommandFailure::View)?;
        let view =
            Arc::new(View { socket: socket.to_owned(), hub, turns: Arc::new(Semaphore::new(CALLS_AT_ONCE)) });
        let address = format!("http://127.0.0.1:{port}/{token}/");
        printer
            .print(&json!({ "address": address }), |_| format!("open {address} in a browser; Ctrl-C ends"))?;
        let app = routes(view, Guard { token, port });
        let ended = async {
            // Without a handler of signals, the process ends as it would anyway.
            let _ = tokio::signal::ctrl_c().await;
        };
        // Streams of events never end, so connections are not waited for.
        tokio::select! {
            () = serve::serve(listener, app) => {}
            () = ended => {}
        }
        Ok(())
    });
    // Reads that are still under way are not waited for.
    runtime.shutdown_background();
    served.map(|()| Exit::Done)
}

/// Tells observers on the terminal what the page will not show or do.
fn warn_observers(socket: &Path) {
    // A daemon that does not listen yet is waited for by the hub.
    let Ok(mut client) = Client::connect(socket) else { return };
    let Ok(Status { role: Some(Role::Observer), operators, .. }) = client.status() else { return };
    eprintln!("you are an observer: you see what the rig does, and cannot operate it");
    if let Some(group) = operators {
        eprintln!(
            "to operate it, have root add you to the group `{group}` (`usermod -aG {group} USER`) and log in again"
        );
    }
    let newest = client.sessions().ok().and_then(|sessions| sessions.into_iter().next_back());
    if let Some(why) = newest.and_then(|newest| barred(&newest.session)) {
        eprintln!("you do not see what sessions contain: {why}");
    }
}

fn routes(view: Arc<View>, guard: Guard) -> Router {
    let mut pages = Router::new();
    for (name, kind, content) in FILES {
        let answer = move || async move { ([(header::CONTENT_TYPE, kind)], content) };
        pages = pages.route(&format!("/{{token}}/{name}"), get(answer));
    }
    // Files of the page are named relative to its folder.
    let folder = |Segment(token): Segment<String>| async move { Redirect::permanent(&format!("/{token}/")) };
    pages
        .route("/{token}", get(folder))
        .route("/{token}/call", post(call))
        .route("/{token}/events", get(events))
        .route("/{token}/live", get(live))
        .route("/{token}/live/{name}", get(live_picture))
        .route("/{token}/session/{session}", get(session))
        .route("/{token}/session/{session}/report", get(report))
        .route("/{token}/session/{session}/thumbnail", get(thumbnail))
        .route("/{token}/session/{session}/picture/{product}", get(product))
        .route("/{token}/session/{session}/pixel/{row}/{column}", get(pixel))
        .route("/{token}/session/{session}/delays/{row}/{column}", get(delays))
        .layer(DefaultBodyLimit::max(MESSAGE_BYTES))
        .layer(middleware::from_fn_with_state(Arc::new(guard), guard::admit))
        .with_state(view)
}

/// 128 random bits, in hexadecimal digits.
fn token() -> io::Result<String> {
    let mut bytes = [0; 16];
    File::open("/dev/urandom")?.read_exact(&mut bytes)?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

/// A call of the page.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Call {
    method: String,
    #[serde(default)]
    params: Map<String, Value>,
}

/// Carries out a call of the daemon: `{"result": ...}` or `{"error": {"code": ..., "message": ...}}`, with `checked`, the
/// rows and tables of `check`, or `barred`, why the files of `sessions` may not be read.
async fn call(State(view): State<Arc<View>>, body: Bytes) -> Response {
    let call: Call = match serde_json::from_slice(&body) {
        Ok(call) => call,
        Err(error) => return refused(StatusCode::BAD_REQUEST, &format!("not a call: {error}")),
    };
    let Some(method) = CALLS.into_iter().find(|method| method.name() == call.method) else {
        return refused(StatusCode::FORBIDDEN, &format!("the page may not call `{}`", call.method));
    };
    let (turn, socket) = (view.turn().await, view.socket.clone());
    let answer = spawn_blocking(move || {
        let _turn = turn;
        let result: Value = Client::connect(&socket)?.call(method, &call.params)?;
        Ok::<_, ClientError>(match method {
            Method::Check => {
                let checked =
                    serde_json::from_value(result.clone()).ok().map(|report| show::check_text(&report));
                json!({ "result": result, "checked": checked })
            }
            Method::Sessions => {
                let newest = result.as_array().and_then(|sessions| sessions.last()?["session"].as_str());
                let barred = newest.and_then(|session| barred(Path::new(session)));
                json!({ "result": result, "barred": barred })
            }
            _ => json!({ "result": result }),
        })
    });
    match answer.await {
        Ok(Ok(told)) => Json(told).into_response(),
        Ok(Err(ClientError::Rpc(error))) => Json(json!({ "error": error })).into_response(),
        Ok(Err(error)) => Json(json!({ "error": { "message": error.to_string() } })).into_response(),
        Err(_) => {
            Json(json!({ "error": RpcError::new(ErrorCode::Internal, "the call failed") })).into_response()
        }
    }
}

/// The daemon's events, and `{"event": "connection"}` when the daemon is lost and found.
async fn events(State(view): State<Arc<View>>) -> impl IntoResponse {
    Sse::new(view.hub.follow()).keep_alive(KeepAlive::default())
}

/// Names of the live images, with the sequence number of the newest of each.
async fn live(State(view): State<Arc<View>>) -> Response {
    let file = view.hub.live_file();
    read(move || match file.as_deref().and_then(barred) {
        Some(why) => Ok(refused(StatusCode::FORBIDDEN, &why)),
        None => pictures::names(file.as_deref()).map(|names| Json(names).into_response()),
    })
    .await
}

#[derive(Deserialize)]
struct Newer {
    /// Only a picture with a larger sequence number is wanted.
    #[serde(default)]
    after: u64,
}

/// The newest picture of a name; "no content" if none came within a while.
async fn live_picture(
    State(view): State<Arc<View>>,
    Segment((_, name)): Segment<(String, String)>,
    Query(Newer { after }): Query<Newer>,
) -> Response {
    for _ in 0..pictures::LOOKS {
        let (file, name) = (view.hub.live_file(), name.clone());
        let answer = read(move || {
            let newest = pictures::newest(file.as_deref(), &name, after)?;
            Ok(newest.map_or(StatusCode::NO_CONTENT.into_response(), IntoResponse::into_response))
        });
        let answer = answer.await;
        if answer.status() != StatusCode::NO_CONTENT {
            return answer;
        }
        tokio::time::sleep(pictures::PACE).await;
    }
    StatusCode::NO_CONTENT.into_response()
}

/// A session as `raysweep show` shows it, with the names of its pictures.
async fn session(
    State(view): State<Arc<View>>,
    Segment((_, session)): Segment<(String, String)>,
) -> Response {
    read_session(view, session, |folder| Ok(Json(stored::session(folder)?).into_response())).await
}

/// The report, which contains its pictures and no script.
async fn report(State(view): State<Arc<View>>, Segment((_, session)): Segment<(String, String)>) -> Response {
    read_session(view, session, |folder| {
        let page = stored::report(folder)?;
        Ok(([(header::CONTENT_TYPE, "text/html; charset=utf-8"), guard::OF_REPORTS], page).into_response())
    })
    .await
}

/// A small PNG file; "no content" for a session without pictures.
async fn thumbnail(
    State(view): State<Arc<View>>,
    Segment((_, session)): Segment<(String, String)>,
) -> Response {
    read_session(view, session, |folder| {
        let png = stored::thumbnail(folder)?;
        Ok(png.map_or(StatusCode::NO_CONTENT.into_response(), |png| {
            ([(header::CONTENT_TYPE, "image/png")], png).into_response()
        }))
    })
    .await
}

#[derive(Deserialize)]
struct Image {
    /// Which of a product's images, counted from 0.
    #[serde(default)]
    k: usize,
}

async fn product(
    State(view): State<Arc<View>>,
    Segment((_, session, product)): Segment<(String, String, String)>,
    Query(Image { k }): Query<Image>,
) -> Response {
    read_session(view, session, move |folder| Ok(stored::picture(folder, &product, k)?.into_response())).await
}

/// Light from each projector row to a pixel.
async fn pixel(
    State(view): State<Arc<View>>,
    Segment((_, session, row, column)): Segment<(String, String, usize, usize)>,
) -> Response {
    read_session(view, session, move |folder| Ok(Json(stored::pixel(folder, row, column)?).into_response()))
        .await
}

/// Light of a pixel over the delays, from what a sweep has stored so far.
async fn delays(
    State(view): State<Arc<View>>,
    Segment((_, session, row, column)): Segment<(String, String, usize, usize)>,
) -> Response {
    read_session(view, session, move |folder| Ok(Json(stored::delays(folder, row, column)?).into_response()))
        .await
}

/// Reads a session that the daemon lists, if this user may.
async fn read_session(
    view: Arc<View>,
    session: String,
    reading: impl FnOnce(&Path) -> Result<Response, String> + Send + 'static,
) -> Response {
    let listing = match view.hub.known_session(&session) {
        Some(folder) => Ok(folder),
        None => Err(view.turn().await),
    };
    read(move || {
        let folder = listing.or_else(|_turn| view.hub.session(&session))?;
        if let Some(why) = barred(&folder) {
            return Ok(refused(StatusCode::FORBIDDEN, &why));
        }
        why_gone(&folder).map_or_else(|| reading(&folder), Err)
    })
    .await
}

/// Reads files without holding up other requests; an error becomes a text.
async fn read(reading: impl FnOnce() -> Result<Response, String> + Send + 'static) -> Response {
    match spawn_blocking(reading).await {
        Ok(Ok(answer)) => answer,
        Ok(Err(why)) => refused(StatusCode::NOT_FOUND, &why),
        Err(_) => refused(StatusCode::INTERNAL_SERVER_ERROR, "reading failed"),
    }
}

fn refused(status: StatusCode, why: &str) -> Response {
    (status, why.to_owned()).into_response()
}
