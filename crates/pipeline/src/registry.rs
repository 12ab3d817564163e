//! Stages and folds by their names in plans.

mod error;

use std::collections::BTreeMap;

use serde_json::Value;

pub use self::error::RegistryError;
use crate::demux::{DemuxFold, DemuxOptions};
use crate::dots::DotStages;
use crate::schedule::{Schedule, SweepGeometry};
use crate::stage::{Fold, HotPixels, Stage};

/// The entry of a name.
pub enum Entry {
    /// Processes each unit independently.
    Stage(Box<dyn Stage>),
    /// Processes all units in order.
    Fold(Box<dyn Fold>),
}

type Make = Box<dyn Fn(Value, &Schedule, &SweepGeometry) -> Result<Entry, RegistryError> + Send + Sync>;

/// All stages and folds available to plans.
pub struct Registry {
    makers: BTreeMap<&'static str, Make>,
    /// The column stages of the dot rig.
    pub dots: DotStages,
}

impl Default for Registry {
    /// The stages and folds of the plane rig.
    fn default() -> Self {
        let mut registry = Self { makers: BTreeMap::new(), dots: DotStages::default() };
        registry.register("hot-pixels", |options, _, _| {
            let stage: HotPixels = parse("hot-pixels", options)?;
            stage.check().map_err(|what| RegistryError::Invalid { name: "hot-pixels".into(), what })?;
            Ok(Entry::Stage(Box::new(stage)))
        });
        registry.register("demux", |options, schedule, geometry| {
            let options: DemuxOptions = parse("demux", options)?;
            let fold = DemuxFold::new(options, schedule, geometry)?;
            Ok(Entry::Fold(Box::new(fold)))
        });
        registry
    }
}

fn parse<T: serde::de::DeserializeOwned>(name: &str, options: Value) -> Result<T, RegistryError> {
    serde_json::from_value(options).map_err(|source| RegistryError::Options { name: name.into(), source })
}

impl Registry {
    /// Registers an entry; replaces an existing one of that name.
    pub fn register(
        &mut self,
        name: &'static str,
        make: impl Fn(Value, &Schedule, &SweepGeometry) -> Result<Entry, RegistryError> + Send + Sync + 'static,
    ) {
        self.makers.insert(name, Box::new(make));
    }

    /// Creates the entry of `name` with the plan's options (a JSON object).
    ///
    /// # Errors
    /// For unknown names, and for options that the stage rejects.
    pub fn make(
        &self,
        name: &str,
        options: Value,
        schedule: &Schedule,
        geometry: &SweepGeometry,
    ) -> Result<Entry, RegistryError> {
        let make = self.makers.get(name).ok_or_else(|| RegistryError::Unknown {
            name: name.into(),
            known: self.makers.keys().copied().collect::<Vec<_>>().join(", "),
        })?;
        make(options, schedule, geometry)
    }
}
