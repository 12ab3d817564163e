//! Offline: products made again from what a session holds, and sessions copied out for others.

use std::path::{Path, PathBuf};

use raysweep_pipeline::Registry;
use raysweep_session::Session;
use raysweep_session::ledger::State;
use raysweep_session::stack::ArrayName;

use crate::config::{DotRigFile, Plan, PlanKind, RigFile, append_argument};
use crate::dots::{self, DotSpec, DotTask};
use crate::film;
use crate::memory::{MemoryNeed, available_bytes};
use crate::processing::Task;
use crate::response::{Findings, ResponseTask};
use crate::results::{self, Results};

/// Why a session cannot be processed.
#[derive(Debug, thiserror::Error)]
pub enum ProcessError {
    /// The session cannot be read or written.
    #[error(transparent)]
    Session(#[from] raysweep_session::Error),
    /// Its plan or rig file cannot be read.
    #[error("{0}")]
    Config(String),
    /// A product that was asked for cannot be had.
    #[error("{0}")]
    Product(String),
    /// The results do not fit into the memory, in strips either.
    #[error(
        "the results take {} MB of memory even some camera rows at a time, and {} MB may be used: raise --memory, make shorter sequences, or end other programs",
        needed_bytes / 1_000_000,
        available_bytes / 1_000_000
    )]
    Memory {
        /// What they take.
        needed_bytes: u64,
        /// What they may take.
        available_bytes: u64,
    },
    /// A file cannot be copied.
    #[error("cannot copy to {}: {source}", path.display())]
    Copy {
        /// Where to.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

/// What was made.
#[derive(Debug, Clone)]
pub struct Processed {
    /// The report.
    pub report: PathBuf,
    /// Points of the sweep, or cycles of the film, that went into it.
    pub stored: usize,
    /// All of them.
    pub points: usize,
    /// What could not be made, and why.
    pub problems: Vec<String>,
}

/// Products that are asked for beside a session's plan.
#[derive(Debug, Clone, Default)]
pub struct Asked {
    /// The keys of a `[[product]]` each, with commas between them.
    pub products: Vec<String>,
    /// Whether the plan's own products are left as they lie there.
    pub only: bool,
    /// Results that would take more memory than this are made some camera rows at a time, and are the same; none: more
    /// than is free.
    pub memory_limit_bytes: Option<u64>,
}

/// Makes the products of a session again, with the plan and the rig file that lie in it: the same bits as the run's.
///
/// # Errors
/// When the session is being written by a run, or cannot be read.
pub fn process(dir: &Path) -> Result<Processed, ProcessError> {
    process_asked(dir, &Asked::default())
}

/// [`process`], and products that the plan does not name. Files of products that are not made now stay.
///
/// # Errors
/// Those of [`process`]; and when a product cannot be had of this session, before anything is written.
pub fn process_asked(dir: &Path, asked: &Asked) -> Result<Processed, ProcessError> {
    let session = Session::open(dir)?;
    let ledger = session.resume()?;
    let read = |path: PathBuf| {
        std::fs::read_to_string(&path)
            .map(|text| (path.clone(), text))
            .map_err(|error| ProcessError::Config(format!("cannot read {}: {error}", path.display())))
    };
    let (plan_path, plan_text) = read(session.plan_path())?;
    let (rig_path, rig_text) = read(session.rig_path())?;
    let plan = Plan::parse(&plan_text)
        .map_err(|error| ProcessError::Config(error.render(&plan_path.display().to_string(), &plan_text)))?;
    if matches!(plan.kind, PlanKind::Batches | PlanKind::Response) {
        let rig = DotRigFile::parse(&rig_text).map_err(|error| {
            ProcessError::Config(error.render(&rig_path.display().to_string(), &rig_text))
        })?;
        let of = (plan, plan_text.as_str());
        return match of.0.kind {
            PlanKind::Response => process_response(&session, ledger.state(), of, &rig, asked),
            _ => process_batches(&session, ledger.state(), of, &rig, asked),
        };
    }
    let rig = RigFile::parse(&rig_text)
        .map_err(|error| ProcessError::Config(error.render(&rig_path.display().to_string(), &rig_text)))?;
    let state = ledger.state();
    let shape = state.session.shape;
    let task = Task::new(plan, &rig, state.session.first_row, (shape.rows, shape.columns));
    let mut processing = task
        .processing(&Registry::default(), &plan_text)
        .map_err(|error| ProcessError::Config(error.render(&plan_path.display().to_string(), &plan_text)))?;
    if asked.only {
        processing.products.clear();
    }
    for argument in &asked.products {
        append_argument(&mut processing.products, argument, &task.schedule, &task.geometry)
            .map_err(ProcessError::Product)?;
    }
    if task.is_film() {
        let mut problems = film::process(&session, &task, state, &processing)?;
        results::write_film_report(&session, state, &task, &problems)?;
        results::write_manifest(&session, state, &task, &rig)?;
        problems.append(&mut processing.problems);
        return Ok(Processed {
            report: session.report_path(),
            stored: state.stored_points(),
            points: shape.points,
            problems,
        });
    }
    let memory = MemoryNeed::of(&task, &processing.products)
        .map_err(|error| ProcessError::Config(error.to_string()))?;
    let available_bytes = available_bytes(asked.memory_limit_bytes);
    if memory.bytes(available_bytes) > available_bytes {
        return Err(ProcessError::Memory { needed_bytes: memory.bytes(available_bytes), available_bytes });
    }
    let in_strips = memory.in_strips(available_bytes);
    if in_strips {
        processing.keep_no_images();
    }
    processing.feed_stored(&task, state, &session.stack()?, &|| true);
    let mut results = match in_strips {
        true => Results::in_strips(processing, &session, state, &task, &|| true)?,
        false => Results::whole(processing, &session, &task, &|| true)?,
    };
    results.write_transport()?;
    let overview = results.overview();
    results::write_products(&session, &task, &results.products)?;
    results::write_report(&session, state, &task, &results, overview.as_ref())?;
    results::write_manifest(&session, state, &task, &rig)?;
    Ok(Processed {
        report: session.report_path(),
        stored: state.stored(ArrayName::Sum).count(),
        points: shape.points,
        problems: results.problems,
    })
}

/// The products of a flying dot's batches.
fn process_batches(
    session: &Session,
    state: &State,
    (plan, plan_text): (Plan, &str),
    rig: &DotRigFile,
    asked: &Asked,
) -> Result<Processed, ProcessError> {
    let shape = state.session.shape;
    let size = (shape.rows, shape.columns);
    let task = DotTask::new(plan, plan_text, rig, rig.camera.pixel_format, size, session.dir())
        .map_err(|error| ProcessError::Config(error.to_string()))?;
    let mut specs = if asked.only { Vec::new() } else { task.specs.clone() };
    for argument in &asked.products {
        let spec = DotSpec::from_argument(argument).map_err(ProcessError::Product)?;
        specs.retain(|other| other.name != spec.name);
        specs.push(spec);
    }
    let made = dots::make(session, state, &task, rig, &specs, Vec::new(), &|| true)?;
    Ok(Processed {
        report: session.report_path(),
        stored: state.stored_points(),
        points: shape.points,
        problems: made.problems,
    })
}

/// What the records of a mirror's chirps show. The rig's own file is left alone: it is the newest run's.
fn process_response(
    session: &Session,
    state: &State,
    (plan, plan_text): (Plan, &str),
    rig: &DotRigFile,
    asked: &Asked,
) -> Result<Processed, ProcessError> {
    if !asked.products.is_empty() {
        let message = "a session of kind \"response\" has no products to ask for: leave --product out";
        return Err(ProcessError::Product(message.into()));
    }
    let (stored, points) = (state.stored_points(), state.session.shape.points);
    if stored < points {
        let message = format!(
            "{} has the records of {stored} of {points} axes: its run was ended early, and an axis alone makes no response; run the plan again",
            session.dir().display()
        );
        return Err(ProcessError::Config(message));
    }
    let size = (state.session.shape.rows, state.session.shape.columns);
    let task = ResponseTask::new(plan, plan_text, rig, rig.camera.pixel_format, size)
        .map_err(|error| ProcessError::Config(error.to_string()))?;
    let findings = Findings::of(session, state, &task)?;
    findings.keep(session, state, None)?;
    findings.write(session, state, &task, rig)?;
    Ok(Processed {
        report: session.report_path(),
        stored,
        points,
        problems: findings
            .refusal()
            .map(ToString::to_string)
            .into_iter()
            .chain(findings.warnings())
            .collect(),
    })
}

/// Copies a session's products, report and manifest into `to`, a folder that is made and must not exist.
///
/// # Errors
/// When the session cannot be read or `to` cannot be written.
pub fn export(dir: &Path, to: &Path) -> Result<usize, ProcessError> {
    let session = Session::open(dir)?;
    if to.exists() {
        return Err(ProcessError::Config(format!("{} exists: give a folder that does not", to.display())));
    }
    std::fs::create_dir(to).map_err(|source| ProcessError::Copy { path: to.to_owned(), source })?;
    let mut files =
        vec![session.report_path(), session.manifest_path(), session.plan_path(), session.rig_path()];
    let listed = |dir: &Path| {
        let entries = std::fs::read_dir(dir).into_iter().flatten().flatten();
        entries.map(|entry| entry.path()).collect::<Vec<_>>()
    };
    // Videos have folders of their own.
    let products = listed(&session.products_path());
    files.extend(products.iter().filter(|path| path.is_dir()).flat_map(|dir| listed(dir)));
    files.extend(products);
    files.push(session.ledger_path());
    let mut copied = 0;
    for file in files.iter().filter(|file| file.is_file()) {
        let parent = file.parent().filter(|parent| parent.parent() == Some(&session.products_path()));
        let folder = parent.and_then(Path::file_name).map_or_else(|| to.to_owned(), |name| to.join(name));
        let Some(name) = file.file_name() else { continue };
        let target = folder.join(name);
        std::fs::create_dir_all(&folder)
            .map_err(|source| ProcessError::Copy { path: folder.clone(), source })?;
        std::fs::copy(file, &target).map_err(|source| ProcessError::Copy { path: target, source })?;
        copied += 1;
    }
    Ok(copied)
}
