//! From products to files.

use std::collections::BTreeMap;

use raysweep_pipeline::{Findings, Product, Role, Schedule, Strip};
use raysweep_session::ledger::{EndState, State};
use raysweep_session::products::VolumeWriter;
use raysweep_session::{Result, Session, manifest, transport};
use raysweep_transport::plane::Transport;
use serde_json::{Map, Value, json};

use crate::config::RigFile;
use crate::film;
use crate::processing::{Processing, Task};
use crate::report;
use crate::strips::{Overview, StoredImages};

/// A run's end in a word.
pub fn name_of(state: EndState) -> &'static str {
    match state {
        EndState::Complete => "complete",
        EndState::Cancelled => "cancelled",
        EndState::Faulted => "faulted",
    }
}

/// What was made of a sweep.
pub struct Results {
    /// Everything; the transport only if it was made in one piece.
    pub products: Vec<Product>,
    /// What could not be made, and why.
    pub problems: Vec<String>,
    /// The transport's files, not in place yet.
    writer: Option<TransportWriter>,
    /// The sums of a transport that was made in strips.
    overview: Option<Overview>,
}

impl Results {
    /// Makes them in one piece; ends early, and short of results, soon after `go_on` says no.
    ///
    /// # Errors
    /// When the disk refuses the transport.
    pub fn whole(
        mut processing: Processing,
        session: &Session,
        task: &Task,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Self> {
        let mut products = processing.finish(go_on);
        let write = || {
            let Some(transport) = transport_in(&products) else { return Ok(None) };
            let mut writer = TransportWriter::create(session, task, findings_in(&products), transport)?;
            writer.append(transport)?;
            Ok(Some(writer))
        };
        // Somebody may be waiting for the transport, and the disk is slower than what is made of it.
        let (writer, named) = rayon::join(write, || processing.make_named(&products, go_on));
        products.extend(named);
        products.retain(|product| !matches!(product, Product::Stack(_)));
        Ok(Self { products, problems: processing.problems, writer: writer?, overview: None })
    }

    /// Makes them strip by strip from what is stored, of folds that have kept no images; otherwise as [`Self::whole`].
    ///
    /// # Errors
    /// When the stack cannot be opened or the disk refuses the transport.
    pub fn in_strips(
        processing: Processing,
        session: &Session,
        state: &State,
        task: &Task,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Self> {
        let (stack, stages) = (session.stack()?, processing.stages.clone());
        let images = StoredImages { task, state, stack: &stack, stages: &stages };
        let mut written: Option<(TransportWriter, Overview)> = None;
        let mut append = |findings: &Findings, Strip { first_row, transport, .. }: &Strip| {
            let (writer, overview) = match &mut written {
                Some(written) => written,
                None => written.insert((
                    TransportWriter::create(session, task, Some(findings), transport)?,
                    Overview::empty(task.geometry.height, transport),
                )),
            };
            overview.put(*first_row, transport);
            writer.append(transport)
        };
        let mut refused = None;
        let mut write = |findings: &Findings, strip: &Strip| {
            append(findings, strip).map_err(|error| {
                let what = error.to_string();
                refused = Some(error);
                what
            })
        };
        let (products, problems) = processing.finish_in_strips(&images, go_on, &mut write);
        if let Some(error) = refused {
            return Err(error);
        }
        // Where the fold broke off, rows are missing.
        let (writer, overview) = written.filter(|(writer, _)| writer.is_whole()).unzip();
        Ok(Self { products, problems, writer, overview })
    }

    /// Puts the transport in its place, as NPY and Zarr at the same time: somebody may be waiting for it.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn write_transport(&mut self) -> Result<()> {
        self.writer.take().map_or(Ok(()), TransportWriter::commit)
    }

    /// The transport's sums, if there is one.
    pub fn overview(&mut self) -> Option<Overview> {
        self.overview.take().or_else(|| transport_in(&self.products).map(Overview::of))
    }
}

fn transport_in(products: &[Product]) -> Option<&Transport> {
    products.iter().find_map(|product| match product {
        Product::Transport(transport) => Some(&**transport),
        _ => None,
    })
}

fn findings_in(products: &[Product]) -> Option<&Findings> {
    products.iter().find_map(|product| match product {
        Product::Findings(findings) => Some(&**findings),
        _ => None,
    })
}

/// Writes a transport from its first camera row to its last, as NPY and Zarr; nothing is seen of it before the end.
struct TransportWriter {
    npy: VolumeWriter,
    zarr: transport::Writer,
    rows_left: usize,
}

impl TransportWriter {
    /// For a transport of which this is all, or some rows.
    fn create(
        session: &Session,
        task: &Task,
        findings: Option<&Findings>,
        found: &Transport,
    ) -> Result<Self> {
        let mut metadata = common(task);
        metadata.extend(findings.map(model).unwrap_or_default());
        metadata.insert("axes".into(), json!(["u", "t", "s"]));
        metadata.insert("u_min".into(), json!(found.u_min));
        metadata.insert("u_max".into(), json!(found.u_max()));
        metadata.insert(
            "about".into(),
            json!("light from projector row v = u + round(first_row + row_pitch t) to camera pixel (t, s); 0 where the projector has no such row"),
        );
        let (depth, _, columns) = found.t.dim();
        let shape = (depth, task.geometry.height, columns);
        Ok(Self {
            npy: session.products().volume_writer("transport", shape, &metadata)?,
            zarr: transport::Writer::create(&session.transport_path(), shape, &metadata)?,
            rows_left: task.geometry.height,
        })
    }

    fn append(&mut self, rows: &Transport) -> Result<()> {
        let (npy, zarr) = (&mut self.npy, &mut self.zarr);
        let (npy, zarr) = rayon::join(|| npy.append(rows.t.view()), || zarr.append(rows.t.view()));
        npy.and(zarr)?;
        self.rows_left = self.rows_left.saturating_sub(rows.exists.ncols());
        Ok(())
    }

    fn is_whole(&self) -> bool {
        self.rows_left == 0
    }

    fn commit(self) -> Result<()> {
        let (npy, zarr) = rayon::join(|| self.npy.commit(), || self.zarr.commit());
        npy.and(zarr)
    }
}

/// Writes everything but the transport: images (EXR, NPY), sequences (EXR, NPY), profiles (CSV, NPY).
///
/// # Errors
/// When the disk refuses.
pub fn write_products(session: &Session, task: &Task, products: &[Product]) -> Result<()> {
    let files = session.products();
    for product in products {
        match product {
            Product::Image { name, about, image } => {
                let mut metadata = common(task);
                metadata.insert("axes".into(), json!(["t", "s"]));
                metadata.insert("about".into(), json!(about));
                files.image(name, image.view(), &metadata)?;
            }
            Product::Sequence { name, about, axis, at, images } => {
                let layers: Vec<String> = (0..at.len()).map(|k| format!("k{k:04}")).collect();
                let mut metadata = common(task);
                metadata.insert("axes".into(), json!(["k", "t", "s"]));
                metadata.insert("about".into(), json!(about));
                metadata.insert("k".into(), json!({ "is": axis, "at": at }));
                metadata.insert("layers".into(), json!(layers));
                files.sequence(name, images.view(), &layers, &metadata)?;
            }
            Product::Profile(profile) => {
                let columns = profile.columns();
                let mut metadata = common(task);
                metadata.insert("axes".into(), json!(["delay", "column"]));
                metadata.insert("about".into(), json!(profile.about));
                metadata.insert("exposure_us".into(), json!(profile.exposure_us));
                metadata.insert(
                    "columns".into(),
                    json!(columns.iter().map(|(name, _)| name).collect::<Vec<_>>()),
                );
                files.table(&profile.name, &columns, &metadata)?;
            }
            Product::Transport(_)
            | Product::Stack(_)
            | Product::Findings(_)
            | Product::Figure { .. }
            | Product::Warning(_) => {}
        }
    }
    Ok(())
}

/// What the transport was found with.
fn model(found: &Findings) -> Map<String, Value> {
    let remarks: Map<String, Value> =
        found.remarks.iter().map(|(key, said)| ((*key).to_owned(), json!(said))).collect();
    let entries = [
        (
            "prior",
            json!({ "name": found.prior.name(), "alpha": found.prior.alpha(), "beta": found.prior.beta() }),
        ),
        ("beam_sigma_rows", json!(found.beam_sigma_rows)),
        ("u0_rows", json!(found.u0_rows)),
        ("left_out_us", json!(found.left_out_us)),
        ("findings", json!(remarks)),
    ];
    entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
}

/// What every product says of itself.
pub(crate) fn common(task: &Task) -> Map<String, Value> {
    let geometry = &task.geometry;
    let prior = task.plan.stage.iter().find(|stage| stage.name == "demux");
    let entries = [
        ("units", json!("1 = a white pixel lit by its own projector row")),
        ("plan", json!(task.plan.name)),
        ("demux", json!(prior.map(|stage| &stage.options))),
        ("row_time_us", json!(geometry.raster.row_time_us)),
        ("row_table", json!(geometry.row_table_us.is_some())),
        ("beam_sigma_rows", json!(geometry.beam_sigma_rows)),
        ("first_row", json!(geometry.first_row)),
        ("row_pitch", json!(geometry.row_pitch)),
        ("camera_row_time_us", json!(geometry.camera_row_time_us)),
        ("white_dn", json!(geometry.white_dn)),
        ("software", json!(crate::SOFTWARE)),
    ];
    entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
}

/// What the products say against themselves.
pub fn warnings(products: &[Product]) -> Vec<String> {
    let warning = |product: &Product| match product {
        Product::Warning(text) => Some(text.clone()),
        _ => None,
    };
    products.iter().filter_map(warning).collect()
}

/// Writes the report.
///
/// # Errors
/// When the stack cannot be read or the disk refuses.
pub fn write_report(
    session: &Session,
    state: &State,
    task: &Task,
    results: &Results,
    overview: Option<&Overview>,
) -> Result<()> {
    let Results { products, problems, .. } = results;
    let page = report::make(session, state, task, overview, products, problems)?.to_html()?;
    raysweep_session::durable::write(&session.report_path(), page.as_bytes())
}

/// Writes the report of a film.
///
/// # Errors
/// When its transports cannot be read or the disk refuses.
pub fn write_film_report(session: &Session, state: &State, task: &Task, problems: &[String]) -> Result<()> {
    let page = film::make_report(session, state, task, problems)?.to_html()?;
    raysweep_session::durable::write(&session.report_path(), page.as_bytes())
}

/// Writes the manifest, which comes last.
///
/// # Errors
/// When the disk refuses.
pub fn write_manifest(session: &Session, state: &State, task: &Task, rig: &RigFile) -> Result<()> {
    let software = BTreeMap::from([("raysweep".to_owned(), env!("CARGO_PKG_VERSION").to_owned())]);
    let mut settings = Map::new();
    settings.insert(
        "rig".into(),
        json!({
            "pixel_format": rig.camera.pixel_format,
            "white_dn": rig.camera.white_dn(),
            "black_dn": rig.camera.black_dn(),
            "period_us": rig.vsync.period_us,
            "rows": rig.projector.rows,
            "row_time_us": rig.projector.row_time_us,
            "first_row_us": rig.projector.first_row_us,
            "row_table_us": rig.projector.row_table,
            "beam_sigma_rows": rig.projector.beam_sigma_rows,
            "first_row": task.geometry.first_row,
            "row_pitch": rig.camera.row_pitch,
            "camera_row_time_us": rig.camera_row_time_us(),
        }),
    );
    settings.insert("exposures_us".into(), json!(taken_exposures(state, &task.schedule)));
    settings.insert("latency".into(), json!(state.end.as_ref().and_then(|end| end.settings_latency)));
    manifest::write(session, state, software, settings)?;
    Ok(())
}

/// The exposures of the sweep as the hardware took them.
fn taken_exposures(state: &State, schedule: &Schedule) -> Vec<f64> {
    let mut exposures: Vec<f64> = schedule
        .points
        .iter()
        .filter(|point| matches!(point.role, Role::Sweep(_)))
        .filter_map(|point| {
            let (array, index) = crate::processing::place(point.role);
            state.point(array, index).map(|entry| entry.exposure_us)
        })
        .collect();
    exposures.sort_by(f64::total_cmp);
    exposures.dedup();
    exposures
}
