//! Writes the products to files.

use raysweep_pipeline::{Findings, Product, Solved, Strip, SweepSummary, mask};
use raysweep_session::STRIP_ROWS;
use raysweep_session::ledger::State;
use raysweep_session::products::{Products, VolumeWriter};
use raysweep_session::{Result, Session, transport};
use raysweep_transport::plane::Transport;
use serde_json::{Map, Value, json};

use super::strips::{Overview, StoredImages};
use crate::plane::colour::{Values, axes, in_colour, mask_in_colour, sequence_in_colour};
use crate::plane::{PlaneTask, Processing, mask_bits};
use crate::video::Encoder;

/// Pace of the video of a sequence.
const IMAGES_PER_S: f64 = 10.0;

/// The results of a sweep.
#[derive(Default)]
pub struct Results {
    /// The products that the plan names.
    pub products: Vec<Product>,
    /// What there is to say about the transport, if it was made.
    pub summary: Option<SweepSummary>,
    /// What could not be made, and why.
    pub problems: Vec<String>,
    /// Writer of the transport's files, which are not in place yet.
    writer: Option<TransportWriter>,
    /// The transport, if it was made in one piece.
    transport: Option<Transport>,
    /// Sums of a transport that was made in strips.
    overview: Option<Overview>,
}

impl Results {
    /// Makes the results in one piece. Soon after `go_on` returns false, it returns early with incomplete results.
    ///
    /// # Errors
    /// When the transport cannot be written.
    pub fn whole(
        mut processing: Processing,
        session: &Session,
        task: &PlaneTask,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Self> {
        let Some(Solved { stack, transport, summary }) = processing.finish(go_on) else {
            return Ok(Self { problems: processing.problems, ..Self::default() });
        };
        let write = || {
            let mut writer = TransportWriter::create(session, task, &summary.findings, &transport)?;
            writer.append(&transport)?;
            Ok(writer)
        };
        // Write the transport while its products are made: it may be needed soon, and the disk is slower than the
        // computation.
        let (writer, products) = rayon::join(write, || processing.make_named(&stack, &transport, go_on));
        Ok(Self {
            products,
            summary: Some(summary),
            problems: processing.problems,
            writer: Some(writer?),
            transport: Some(transport),
            overview: None,
        })
    }

    /// Makes the results strip by strip from stored images, if the demultiplexer keeps none; otherwise as
    /// [`Self::whole`].
    ///
    /// # Errors
    /// When the stack cannot be opened or the transport cannot be written.
    pub fn in_strips(
        processing: Processing,
        session: &Session,
        state: &State,
        task: &PlaneTask,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Self> {
        let (stack, stages) = (session.stack()?, processing.stages.clone());
        let images = StoredImages { task, state, stack: &stack, stages: &stages };
        let mut written: Option<(TransportWriter, Overview)> = None;
        let mut append = |findings: &Findings, Strip { first_row, transport, .. }: &Strip| {
            let (writer, overview) = match &mut written {
                Some(written) => written,
                None => written.insert((
                    TransportWriter::create(session, task, findings, transport)?,
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
        let (summary, products, problems) = processing.finish_in_strips(&images, go_on, &mut write);
        if let Some(error) = refused {
            return Err(error);
        }
        // Rows are missing if the demultiplexer stopped early.
        let (writer, overview) = written.filter(|(writer, _)| writer.is_whole()).unzip();
        Ok(Self { products, summary, problems, writer, transport: None, overview })
    }

    /// Moves the transport into place, as NPY and Zarr at the same time: it may be needed soon.
    ///
    /// # Errors
    /// When the session cannot be written.
    pub fn write_transport(&mut self) -> Result<()> {
        self.writer.take().map_or(Ok(()), TransportWriter::commit)
    }

    /// The transport's sums, if there is one.
    pub fn overview(&mut self) -> Option<Overview> {
        self.overview.take().or_else(|| self.transport.as_ref().map(Overview::of))
    }

    /// What could not be made, and what makes the products worse than they look.
    pub fn warnings(&self) -> impl Iterator<Item = &String> {
        self.problems.iter().chain(self.summary.iter().flat_map(|summary| &summary.warnings))
    }
}

/// Writes a transport from its first camera row to its last, as NPY and Zarr; the files become visible only at the
/// end.
struct TransportWriter {
    npy: VolumeWriter,
    zarr: transport::Writer,
    rows_left: usize,
}

impl TransportWriter {
    /// Creates a writer; `transport` is the whole transport or some rows of it.
    fn create(session: &Session, task: &PlaneTask, findings: &Findings, found: &Transport) -> Result<Self> {
        let mut metadata = task.metadata();
        metadata.extend(model(findings));
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
        let write_zarr = || {
            zarr.append(rows.t.view())?;
            let height = rows.exists.ncols();
            (0..height).step_by(STRIP_ROWS).try_for_each(|first_row| {
                let mask = mask::of_transport(rows, first_row..height.min(first_row + STRIP_ROWS));
                zarr.append_mask(mask.view(), &mask_bits())
            })
        };
        let (npy, zarr) = rayon::join(|| npy.append(rows.t.view()), write_zarr);
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

/// Writes everything but the transport: images (EXR, NPY), sequences (EXR, NPY, PNG, MP4), tables (CSV, NPY). Of the
/// products, only those with a wanted name are written; the report shows all of them. Soon after `go_on` returns false,
/// no more MP4 files are made.
///
/// # Errors
/// When the session cannot be written.
pub fn write_products(
    session: &Session,
    task: &PlaneTask,
    results: &mut Results,
    is_wanted: &dyn Fn(&str) -> bool,
    go_on: &dyn Fn() -> bool,
) -> Result<()> {
    let (mut encoder, mosaic) = (Encoder::default(), task.mosaic);
    let files = session.products();
    let mut common = task.metadata();
    // As it was found, if the rig file does not state it.
    let found = results.summary.as_ref().and_then(|summary| summary.findings.beam_sigma_rows);
    common.extend(found.map(|sigma_rows| ("beam_sigma_rows".to_owned(), json!(sigma_rows))));
    for product in results.products.iter().filter(|product| is_wanted(product.name())) {
        match product {
            Product::Image { name, about, is_light, image, mask } => {
                let values = if *is_light { Values::Light } else { Values::Errors };
                let (image, mask) =
                    (in_colour(image.view(), mosaic, values), mask_in_colour(mask.clone(), mosaic));
                let mut metadata = common.clone();
                metadata.insert("axes".into(), json!(axes(mosaic)));
                metadata.insert("about".into(), json!(about));
                metadata.insert("mask".into(), mask_bits());
                files.masked_image(name, image.view(), mask.view(), &metadata)?;
                files.remove_others(name, &[".exr", "_mask.npy"])?;
            }
            Product::Sequence { name, about, axis, at, images, mask } => {
                let layers: Vec<String> = (0..at.len()).map(|k| format!("k{k:04}")).collect();
                let (images, mask) =
                    (sequence_in_colour(images.view(), mosaic), mask_in_colour(mask.clone(), mosaic));
                let mut metadata = common.clone();
                metadata.insert("axes".into(), json!([&["k"], axes(mosaic)].concat()));
                metadata.insert("about".into(), json!(about));
                metadata.insert("k".into(), json!({ "is": axis, "at": at }));
                metadata.insert("layers".into(), json!(layers));
                metadata.insert("mask".into(), mask_bits());
                files.masked_sequence(name, images.view(), &layers, mask.view(), &metadata)?;
                files.remove_others(name, &[".exr", ".mp4", "_mask.npy", ""])?;
                encoder.encode(files.dir(), name, IMAGES_PER_S, go_on)?;
            }
            Product::Profile(profile) => {
                let mut metadata = common.clone();
                metadata.insert("exposure_us".into(), json!(profile.exposure_us));
                let table = (profile.name.as_str(), profile.about.as_str());
                write_table(&files, table, "delay", &profile.columns(), metadata)?;
            }
            Product::CrossSection(section) => {
                let table = (section.name.as_str(), section.about.as_str());
                write_table(&files, table, section.along, &section.columns(), common.clone())?;
            }
        }
    }
    results.problems.append(&mut encoder.problems);
    Ok(())
}

fn write_table(
    files: &Products,
    (name, about): (&str, &str),
    along: &str,
    columns: &[(&str, Vec<f64>)],
    mut metadata: Map<String, Value>,
) -> Result<()> {
    metadata.insert("axes".into(), json!([along, "column"]));
    metadata.insert("about".into(), json!(about));
    metadata.insert("columns".into(), json!(columns.iter().map(|(name, _)| name).collect::<Vec<_>>()));
    files.table(name, columns, &metadata)?;
    files.remove_others(name, &[".csv"])
}

/// The model and settings that the transport was estimated with.
fn model(found: &Findings) -> Map<String, Value> {
    let remarks: Map<String, Value> =
        found.remarks.iter().map(|(key, said)| ((*key).to_owned(), json!(said))).collect();
    let mut entries = vec![
        (
            "prior",
            json!({ "name": found.prior.name(), "alpha": found.prior.alpha(), "beta": found.prior.beta() }),
        ),
        ("u0_rows", json!(found.u0_rows)),
        ("left_out_us", json!(found.left_out_us)),
        ("findings", json!(remarks)),
    ];
    entries.extend(found.beam_sigma_rows.map(|sigma_rows| ("beam_sigma_rows", json!(sigma_rows))));
    entries.extend(found.late_us.map(|late_us| ("late_us", json!(late_us))));
    entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
}
