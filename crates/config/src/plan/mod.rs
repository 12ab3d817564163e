//! `plan.toml`: what to acquire, and which products to make.

mod batches;
mod calibration;
mod darks;
mod film;
mod patterns;
mod response;
mod rows;
mod sweep;
mod tables;
mod viewfinder;

use serde::Deserialize;
use serde_json::Map;
use toml_edit::{DocumentMut, Item, Table, TomlError, Value};

pub use self::batches::{BatchesPlan, PathPlan, PlanePlan, Shape};
pub use self::calibration::CalibrationPlan;
pub use self::darks::DarksPlan;
pub use self::film::FilmPlan;
pub use self::patterns::{PatternPlan, PatternRefused, PatternsPlan};
pub use self::response::ResponsePlan;
pub use self::rows::{KnownRows, OwnRowEdges};
pub use self::sweep::{Axis, GridPlan, SweepPlan};
pub use self::tables::{ProductTable, StageTable, products_of_argument};
pub use self::viewfinder::{ALIGN_NEEDS_TRIGGER, FinderSubject, FinderTrigger, ViewfinderPlan};
use crate::document::{Document, ReadingPurpose};
use crate::{ConfigError, ConfigMistake, Places};

/// A plan.
#[derive(Debug, Clone)]
pub struct Plan {
    /// Name of the session; default: the plan's kind.
    pub name: String,
    /// `kind`, with the table of that name.
    pub procedure: Procedure,
    /// `[[stage]]`: in order; default: [`Procedure::default_stage`].
    pub stages: Vec<StageTable>,
    /// `[[product]]`: products to make from the transport; default: the procedure's own.
    pub products: Option<Vec<ProductTable>>,
    /// Positions of the values in the text.
    pub places: Places,
}

/// The measurement procedures.
#[derive(Debug, Clone, PartialEq)]
pub enum Procedure {
    /// A delay-exposure sweep of the plane rig.
    Sweep(SweepPlan),
    /// A repeated short sweep, with a light transport for each repetition.
    Film(FilmPlan),
    /// Batches of frames of a flying dot.
    Batches(BatchesPlan),
    /// Chirps of a mirror, from which its resonances are identified.
    Response(ResponsePlan),
    /// Dark images.
    Darks(DarksPlan),
    /// Images of a white board, from which a plane rig is calibrated.
    Calibration(CalibrationPlan),
    /// Images of a few settings under each of many pictures, from which direct and global light are separated.
    Patterns(PatternsPlan),
    /// Live pictures for focusing, aligning and exposing.
    Viewfinder(ViewfinderPlan),
}

/// The procedures, by their names in plans.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Kind {
    Sweep,
    Film,
    Batches,
    Response,
    Darks,
    Calibration,
    Patterns,
    Viewfinder,
}

impl Kind {
    const ALL: [Self; 8] = [
        Self::Sweep,
        Self::Film,
        Self::Batches,
        Self::Response,
        Self::Darks,
        Self::Calibration,
        Self::Patterns,
        Self::Viewfinder,
    ];

    /// Its name in plans, which is also the name of its table.
    fn name(self) -> &'static str {
        match self {
            Self::Sweep => "sweep",
            Self::Film => "film",
            Self::Batches => "batches",
            Self::Response => "response",
            Self::Darks => "darks",
            Self::Calibration => "calibration",
            Self::Patterns => "patterns",
            Self::Viewfinder => "viewfinder",
        }
    }

    /// Reads and checks its table.
    fn read(self, document: &mut Document<'_>) -> Option<Procedure> {
        let table = self.name();
        match self {
            Self::Sweep => read(document, table, SweepPlan::check, Procedure::Sweep),
            Self::Film => read(document, table, FilmPlan::check, Procedure::Film),
            Self::Batches => read(document, table, BatchesPlan::check, Procedure::Batches),
            Self::Response => read(document, table, ResponsePlan::check, Procedure::Response),
            Self::Darks => read(document, table, DarksPlan::check, Procedure::Darks),
            Self::Calibration => read(document, table, CalibrationPlan::check, Procedure::Calibration),
            Self::Patterns => {
                let patterns: Option<Vec<PatternPlan>> = document.take(PATTERN);
                let plan: PatternsPlan = document.take_or_default(table)?;
                let plan = plan.with_patterns(patterns);
                plan.check(document);
                Some(Procedure::Patterns(plan))
            }
            Self::Viewfinder => read(document, table, ViewfinderPlan::check, Procedure::Viewfinder),
        }
    }

    /// The default stage of a plan that names none.
    fn default_stage(self) -> Option<&'static str> {
        match self {
            Self::Sweep | Self::Film => Some(tables::DEMUX),
            Self::Batches => Some("denoise"),
            Self::Response | Self::Darks | Self::Calibration | Self::Patterns | Self::Viewfinder => None,
        }
    }
}

/// The tables of pictures.
const PATTERN: &str = "pattern";

/// Whether plans have this kind.
pub(crate) fn is_kind(name: &str) -> bool {
    Kind::ALL.iter().any(|kind| kind.name() == name)
}

fn read<'a, T: Deserialize<'a> + Default>(
    document: &mut Document<'a>,
    table: &str,
    check: impl FnOnce(&T, &mut Document<'a>),
    procedure: impl FnOnce(T) -> Procedure,
) -> Option<Procedure> {
    let plan: T = document.take_or_default(table)?;
    check(&plan, document);
    Some(procedure(plan))
}

impl Procedure {
    /// Its name in plans and sessions.
    pub fn kind(&self) -> &'static str {
        let kind = match self {
            Self::Sweep(_) => Kind::Sweep,
            Self::Film(_) => Kind::Film,
            Self::Batches(_) => Kind::Batches,
            Self::Response(_) => Kind::Response,
            Self::Darks(_) => Kind::Darks,
            Self::Calibration(_) => Kind::Calibration,
            Self::Patterns(_) => Kind::Patterns,
            Self::Viewfinder(_) => Kind::Viewfinder,
        };
        kind.name()
    }
}

impl Plan {
    /// Reads a plan for a new run.
    ///
    /// # Errors
    /// Everything that makes the plan invalid, with positions in the text.
    pub fn parse(text: &str) -> Result<Self, ConfigError> {
        Self::read(Document::parse(text)?)
    }

    /// Reads the plan of a session, which an earlier version may have accepted although new runs may not repeat a delay
    /// or an exposure, or have a stage after `demux`.
    ///
    /// # Errors
    /// Everything that keeps the session from being processed, with positions in the text.
    pub fn parse_stored(text: &str) -> Result<Self, ConfigError> {
        Self::read(Document::parse(text)?.read_for(ReadingPurpose::StoredSession))
    }

    fn read(mut document: Document<'_>) -> Result<Self, ConfigError> {
        if let Some(rig @ ("plane" | "dots")) = document.string("kind") {
            let message =
                format!("kind = {rig:?}: this is a rig file; give a plan, such as one with kind = \"sweep\"");
            document.refuse(&["kind"], message);
            return document.finish(None);
        }
        let Some(kind) = document.require::<Kind>("kind", "kind = \"sweep\", for example") else {
            return document.finish(None);
        };
        let own = kind.name();
        for other in Kind::ALL.map(Kind::name).into_iter().filter(|other| *other != own) {
            if document.places().has(&[other]) {
                let message =
                    format!("[{other}] does not belong to kind = \"{own}\": use [{own}], or change the kind");
                document.refuse(&[other], message);
            }
        }
        let procedure = kind.read(&mut document);
        let name = document.take::<String>("name").unwrap_or_else(|| own.to_owned());
        if name.trim().is_empty() {
            document.refuse(&["name"], "name is empty: give the session a name");
        }
        let default_stages =
            kind.default_stage().map(|name| StageTable { name: name.into(), options: Map::new() });
        let (mut stages, mut products): (Option<Vec<StageTable>>, Option<Vec<ProductTable>>) = (None, None);
        if default_stages.is_some() {
            (stages, products) = (document.take("stage"), document.take("product"));
        } else {
            for key in
                ["stage", "product"].into_iter().filter(|key| document.drop_key(key)).collect::<Vec<_>>()
            {
                document.refuse(&[key], format!("kind = \"{own}\" takes no [[{key}]]: leave it out"));
            }
        }
        if document.drop_key(PATTERN) {
            let message = format!("kind = \"{own}\" takes no [[{PATTERN}]]: use kind = \"patterns\"");
            document.refuse(&[PATTERN], message);
        }
        tables::check_stages(stages.iter().flatten(), &mut document);
        tables::check_products(products.iter().flatten(), &mut document);
        let stages = stages.unwrap_or_else(|| default_stages.into_iter().collect());
        let known =
            ["kind", "name", "stage", "product", PATTERN].into_iter().chain(Kind::ALL.map(Kind::name));
        document.refuse_others(&known.collect::<Vec<_>>());
        let places = document.places().clone();
        document.finish(procedure.map(|procedure| Self { name, procedure, stages, products, places }))
    }
}

/// A plan's text with other tables, those of the text `tables`, in place of its own. Comments stay, except those above and
/// in tables that get tables of their own, those of keys that the other tables do not have, and those beside values that
/// are others then.
///
/// # Errors
/// If one of the texts is not TOML.
pub fn with_tables(text: &str, tables: &str) -> Result<String, ConfigError> {
    let read = |text: &str| -> Result<DocumentMut, ConfigError> {
        text.parse().map_err(|error: TomlError| {
            ConfigMistake { message: error.message().into(), field: None, span: error.span() }.into()
        })
    };
    let (mut plan, mut tables) = (read(text)?, read(tables)?);
    for (key, table) in tables.clone().iter() {
        let own = plan.get_mut(key).and_then(Item::as_table_mut).filter(|own| !own.is_dotted());
        match (own, table.as_table()) {
            (Some(own), Some(table)) if !table.iter().any(|(_, item)| item.is_array_of_tables()) => {
                tables.remove(key);
                replace_values(own, table);
            }
            _ => {
                plan.remove(key);
            }
        }
    }
    let (plan, rest) = (plan.to_string(), tables.to_string());
    Ok(if rest.trim().is_empty() { plan } else { format!("{}\n\n{rest}", plan.trim_end()) })
}

/// Gives a table the keys and values of another one.
fn replace_values(own: &mut Table, other: &Table) {
    own.retain(|key, _| other.contains_key(key));
    for (key, item) in other {
        match (own.get_mut(key).and_then(Item::as_value_mut), item.as_value()) {
            (Some(own), Some(value)) => {
                if !is_same(own, value) {
                    let mut decor = own.decor().clone();
                    decor.set_suffix("");
                    *own = value.clone();
                    *own.decor_mut() = decor;
                }
            }
            _ => {
                own.insert(key, item.clone());
            }
        }
    }
}

/// Whether two values are the same, however they are written.
fn is_same(a: &Value, b: &Value) -> bool {
    let number = |value: &Value| value.as_float().or(value.as_integer().map(|whole| whole as f64));
    let text = |value: &Value| -> String {
        value.clone().decorated("", "").to_string().split_whitespace().collect()
    };
    match (number(a), number(b), a.as_array(), b.as_array()) {
        (Some(a), Some(b), ..) => a == b,
        (.., Some(a), Some(b)) => a.len() == b.len() && a.iter().zip(b).all(|(a, b)| is_same(a, b)),
        _ => text(a) == text(b),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_are_replaced_and_the_rest_of_a_plan_stays() {
        let text = "kind = \"sweep\"\nname = \"a\" # why\n[sweep]\naverage = 2\n[[sweep.extra]]\ndelay_us = [0]\nexposure_us = [1]\n[[stage]]\nname = \"demux\"\nalpha = 0.5\n";
        let other = Plan::parse(&with_tables(text, "[sweep]\naverage = 3\n").unwrap()).unwrap();
        let Procedure::Sweep(sweep) = other.procedure else { panic!("{other:?}") };
        assert_eq!(sweep, SweepPlan { average: 3, ..SweepPlan::default() });
        assert_eq!((other.name.as_str(), &other.stages), ("a", &Plan::parse(text).unwrap().stages));
        let commented = "kind = \"sweep\" # why\n# The grid.\n[sweep]\naverage = 2 # few\n\n[[stage]]\nname = \"demux\"\n";
        let (few, extra) =
            ("[sweep]\naverage = 3\n", "\n[[sweep.extra]]\ndelay_us = [0]\nexposure_us = [1]\n");
        assert_eq!(with_tables(commented, few).unwrap(), commented.replace("2 # few", "3"));
        assert_eq!(with_tables(commented, "[sweep]\naverage = 2.0\n").unwrap(), commented);
        let listed = "kind = \"sweep\"\n[sweep]\ndelay_us = [-20, 0, 20] # near\n";
        assert_eq!(with_tables(listed, "[sweep]\ndelay_us = [-20.0, 0.0, 20.0]\n").unwrap(), listed);
        let longer = with_tables(listed, "[sweep]\ndelay_us = [-20.0, 0.0, 20.0, 40.0]\n").unwrap();
        assert!(longer.contains("40.0") && !longer.contains("near"), "{longer}");
        for own in [
            commented,
            "kind = \"sweep\" # why\nsweep.average = 2\n",
            "kind = \"sweep\" # why\nsweep = { average = 2 }\n",
        ] {
            for tables in [few.to_owned(), format!("{few}{extra}")] {
                let text = with_tables(own, &tables).unwrap();
                let Procedure::Sweep(found) = Plan::parse(&text).unwrap().procedure else { panic!("{text}") };
                let Procedure::Sweep(wanted) =
                    Plan::parse(&format!("kind = \"sweep\"\n{tables}")).unwrap().procedure
                else {
                    panic!()
                };
                assert_eq!(found, wanted, "{text}");
                assert!(text.contains("# why"), "{text}");
            }
        }
    }

    pub(super) fn parse(text: &str) -> Result<Plan, ConfigError> {
        Plan::parse(text)
    }

    /// The example of a kind in the reference.
    pub(super) fn documented(kind: &str) -> &'static str {
        let page = include_str!("../../../../docs/reference/plan.md");
        let mut blocks = page.split("```toml\n").filter_map(|rest| rest.split("```").next());
        blocks.find(|block| block.contains(&format!("kind = \"{kind}\""))).unwrap()
    }
}
