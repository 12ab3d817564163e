//! What the page shows of sessions on disk.

use std::path::Path;

use raysweep_session::ledger::PointEntry;
use raysweep_session::stack::{ArrayName, Contents};
use raysweep_session::{Session, transport};
use serde_json::{Value, json};

use super::super::sessions::SessionView;
use super::super::thumbnails::{about, image, pictures, small};
use super::pictures::Encoded;

/// Largest report, in bytes.
const MOST_REPORT_BYTES: u64 = 1 << 28;

fn told(error: impl std::fmt::Display) -> String {
    error.to_string()
}

/// A session as `raysweep show --json` shows it, with the names of the products that are pictures, the best first.
pub(super) fn session(folder: &Path) -> Result<Value, String> {
    let mut view = SessionView::read(folder).map_err(told)?;
    let session = Session::open(folder).map_err(told)?;
    let images = pictures(&session);
    view.check_products(&session, &images).map_err(told)?;
    let mut view = serde_json::to_value(view).map_err(told)?;
    view["images"] = json!(images);
    view["has_transport"] = json!(session.transport_path().exists());
    view["can_resume"] = json!(session.state().map_err(told)?.can_resume());
    Ok(view)
}

/// The report.
pub(super) fn report(folder: &Path) -> Result<Vec<u8>, String> {
    let session = Session::open(folder).map_err(told)?;
    let path = session.report_path();
    if !path.exists() {
        return Err("this session has no report: `raysweep process` makes one of what is stored".to_owned());
    }
    session.read(&path, MOST_REPORT_BYTES).map_err(told)
}

/// Image `k` of a product that is a picture or several, with their number `of`.
pub(super) fn picture(folder: &Path, product: &str, k: usize) -> Result<Encoded, String> {
    // Names come from a browser: only those that exist are opened.
    let session = Session::open(folder).map_err(told)?;
    if !pictures(&session).iter().any(|name| name == product) {
        return Err(format!("this session has no picture called {product:?}"));
    }
    let (image, of) = image(&session, product, k).map_err(told)?;
    let about = about(&session.products().dir().join(format!("{product}.npy")));
    Ok(Encoded::new(image.view(), json!({ "name": product, "about": about, "of": of })))
}

/// The picture that says most of a session, as a small PNG file, if it has any.
pub(super) fn thumbnail(folder: &Path) -> Result<Option<Vec<u8>>, String> {
    let session = Session::open(folder).map_err(told)?;
    let best = pictures(&session).into_iter().next();
    best.map(|name| small(&session, &name)).transpose().map_err(told)
}

/// Light from each relative projector row u to a pixel, with the first u.
pub(super) fn pixel(folder: &Path, row: usize, column: usize) -> Result<Value, String> {
    let path = Session::open(folder).map_err(told)?.transport_path();
    let ([_, rows, columns], attributes) = transport::describe(&path).map_err(told)?;
    if row >= rows || column >= columns {
        return Err(outside(rows, columns));
    }
    let u_min = attributes.get("u_min").and_then(Value::as_i64);
    let u_min = u_min.ok_or("the transport does not say its u_min; `raysweep process` makes it again")?;
    let profiles = transport::read_profiles(&path, &[[row, column]]).map_err(told)?;
    Ok(json!({ "u_min": u_min, "light": profiles.first().map(|light| light.to_vec()) }))
}

fn outside(rows: usize, columns: usize) -> String {
    format!("the image has {rows} rows and {columns} columns, counted from 0")
}

/// Light of a pixel over the delays of a sweep, from what is stored so far: `{delay_us: [...], exposures: [{exposure_us,
/// light_dn: [...]}]}`, in counts of one frame without its dark image; null where nothing is stored, empty for other runs.
pub(super) fn delays(folder: &Path, row: usize, column: usize) -> Result<Value, String> {
    let session = Session::open(folder).map_err(told)?;
    let state = session.state().map_err(told)?;
    if !matches!(state.session.shape.contents, Contents::Sweep { .. }) {
        return Ok(json!({ "delay_us": [], "exposures": [] }));
    }
    let stack = session.stack().map_err(told)?;
    let shape = stack.shape();
    if row >= shape.rows || column >= shape.columns {
        return Err(outside(shape.rows, shape.columns));
    }
    let counts = |array, point: &PointEntry| {
        let part = stack.read_rows(array, point.index, row..row + 1).map_err(told)?;
        Ok::<_, String>(f64::from(part[[0, column]]) / f64::from(point.frames.max(1)))
    };
    let mut darks = Vec::new();
    for dark in state.stored(ArrayName::Dark) {
        darks.push((dark.exposure_us, counts(ArrayName::Dark, dark)?));
    }
    let points: Vec<&PointEntry> = state.stored(ArrayName::Sum).collect();
    let ascending = |values: &mut Vec<f64>| {
        values.sort_by(f64::total_cmp);
        values.dedup();
    };
    let mut delay_us: Vec<f64> = points.iter().map(|point| point.delay_us).collect();
    ascending(&mut delay_us);
    let mut exposure_us: Vec<f64> = points.iter().map(|point| point.exposure_us).collect();
    ascending(&mut exposure_us);
    let mut light_dn = vec![vec![None; delay_us.len()]; exposure_us.len()];
    for point in points {
        let of = |values: &[f64], value| values.iter().position(|known| *known == value);
        let places = of(&exposure_us, point.exposure_us).zip(of(&delay_us, point.delay_us));
        let dark = darks.iter().find(|(exposure_us, _)| *exposure_us == point.exposure_us);
        if let (Some((exposure, delay)), Some((_, dark))) = (places, dark) {
            light_dn[exposure][delay] = Some(counts(ArrayName::Sum, point)? - dark);
        }
    }
    let exposures = exposure_us.iter().zip(light_dn);
    let exposures =
        exposures.map(|(exposure_us, light)| json!({ "exposure_us": exposure_us, "light_dn": light }));
    Ok(json!({ "delay_us": delay_us, "exposures": exposures.collect::<Vec<_>>() }))
}
