//! Fold `demux`: from the averaged images of a sweep to its light transport.

use std::collections::BTreeMap;
use std::sync::Arc;

use ndarray::{Array2, Array3, ArrayView2, Axis};
use raysweep_transport::plane::{Demux, PlaneError, Prior, RowTiming, Setting, Transport};
use serde::Deserialize;

use crate::findings::{self, Prepared};
use crate::products::SweepStack;
use crate::registry::RegistryError;
use crate::schedule::{Role, Schedule, SweepGeometry};
use crate::stage::{Fold, FoldError, Product, Snapshot};
use crate::unit::Unit;

/// Options of `demux` in a plan.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DemuxOptions {
    /// Which prior: `split` (direct light is a spike at u = 0) or `paper`; left out, with its weights: the one that
    /// predicts held-out settings best, `split` in doubt.
    pub prior: Option<PriorName>,
    /// Weight of smoothness over rows; left out: the prior's own.
    pub alpha: Option<f64>,
    /// Weight of sparsity; left out: the prior's own.
    pub beta: Option<f64>,
    /// Whether neighbouring pixels that see the same kind of light are averaged before they are solved.
    pub coupling: bool,
}

impl Default for DemuxOptions {
    fn default() -> Self {
        Self { prior: None, alpha: None, beta: None, coupling: true }
    }
}

/// The priors by their names in plans.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PriorName {
    /// Scale-free smoothness that leaves u = 0 alone.
    Split,
    /// The printed objective.
    Paper,
}

impl DemuxOptions {
    /// Whether a plan leaves nothing of the prior open.
    pub(crate) fn states_prior(&self) -> bool {
        self.prior.is_some() || self.alpha.is_some() || self.beta.is_some()
    }

    fn prior(&self) -> Prior {
        let prior = match self.prior {
            None | Some(PriorName::Split) => Prior::SPLIT,
            Some(PriorName::Paper) => Prior::PAPER,
        };
        match prior {
            Prior::Split { alpha, beta } => {
                Prior::Split { alpha: self.alpha.unwrap_or(alpha), beta: self.beta.unwrap_or(beta) }
            }
            Prior::Paper { alpha, beta } => {
                Prior::Paper { alpha: self.alpha.unwrap_or(alpha), beta: self.beta.unwrap_or(beta) }
            }
        }
    }
}

/// Name of the figure that closes the circle: the light of the regular image, by the model over by the camera.
pub const PREDICTED_SHARE: &str = "predicted / captured regular light";

/// So well the transport must predict the regular image.
const CLOSE_SHARE: f64 = 0.02;
/// More saturated pixels than this deserve a warning: highlights are normal, fields are not.
const SATURATED_SHARE: f64 = 0.01;

fn too_many_saturated(what: &str, saturated: usize, pixels: usize) -> Option<Product> {
    let share = saturated as f64 / pixels as f64;
    (share > SATURATED_SHARE).then(|| {
        Product::Warning(format!(
            "{:.1} % of the pixels of {what} are saturated: take less gain, a smaller aperture or less ambient light",
            share * 100.0
        ))
    })
}

/// One image of the sweep, as it was taken.
struct Taken {
    setting: Setting,
    /// Mean counts.
    image: Array2<f32>,
}

/// Collects a sweep and demultiplexes it. A copy shares the images.
#[derive(Clone)]
pub struct DemuxFold {
    options: DemuxOptions,
    schedule: Arc<Schedule>,
    geometry: Arc<SweepGeometry>,
    timing: RowTiming,
    taken: BTreeMap<Role, Arc<Taken>>,
}

/// Fewer points than this make no estimate worth a look.
const MIN_LIVE_POINTS: usize = 5;

impl DemuxFold {
    /// A fold for the sweep of `schedule`.
    ///
    /// # Errors
    /// When the options or the geometry make no model.
    pub fn new(
        options: DemuxOptions,
        schedule: &Schedule,
        geometry: &SweepGeometry,
    ) -> Result<Self, RegistryError> {
        let invalid =
            |error: PlaneError| RegistryError::Invalid { name: "demux".into(), what: error.to_string() };
        options.prior().check().map_err(invalid)?;
        let timing = geometry.timing().map_err(invalid)?;
        let (schedule, geometry) = (Arc::new(schedule.clone()), Arc::new(geometry.clone()));
        let fold = Self { options, schedule, geometry, timing, taken: BTreeMap::new() };
        fold.demux().map_err(invalid)?;
        Ok(fold)
    }

    /// The plan's demultiplexer, before anything is taken: its reach and its conditioning.
    ///
    /// # Errors
    /// When delays and exposures make no model on this rig.
    pub fn demux(&self) -> Result<Demux, PlaneError> {
        let sweep = self.schedule.points.iter().filter(|point| matches!(point.role, Role::Sweep(_)));
        let planned = sweep.map(|point| Setting::new(point.delay_us, point.exposure_us)).collect();
        Demux::new(self.timing.clone(), planned, self.options.prior())
    }

    /// The dark image that belongs to the exposure of a role's image, if it was taken.
    fn dark_of(&self, taken: &BTreeMap<Role, Arc<Taken>>, role: Role) -> Option<Arc<Taken>> {
        let point = self.schedule.points.iter().find(|point| point.role == role)?;
        taken.get(&self.schedule.dark_of(point.exposure_us)?).cloned()
    }

    /// The sweep in these images, without those whose dark image is not among them. Each image is given up as soon as
    /// it is in the stack: unless a copy of the fold shares it, a sweep is held once, not twice.
    fn stack(&self, mut taken: BTreeMap<Role, Arc<Taken>>) -> Result<SweepStack, FoldError> {
        let darks = taken.extract_if(.., |role, _| matches!(role, Role::Dark(_))).collect();
        taken.retain(|role, _| matches!(role, Role::Sweep(_)) && self.dark_of(&darks, *role).is_some());
        if taken.is_empty() {
            return Err(FoldError {
                fold: "demux".into(),
                what: "no point of the sweep is there with the dark image of its exposure: resume the run"
                    .into(),
            });
        }
        let scale = (1.0 / self.geometry.white_dn) as f32;
        let saturates = |taken: &Arc<Taken>| self.valid(&taken.image).iter().any(|valid| !valid);
        let shape = (taken.len(), self.geometry.height, self.geometry.width);
        let mut valid = taken.values().any(saturates).then(|| Array3::from_elem(shape, true));
        let mut images = Array3::zeros(shape);
        let mut settings = Vec::with_capacity(taken.len());
        let point_of = |role: &Role| self.schedule.points.iter().find(|point| point.role == *role);
        let exposures_us = taken.keys().filter_map(point_of).map(|point| point.exposure_us).collect();
        for (index, (role, sample)) in taken.into_iter().enumerate() {
            if let Some(valid) = &mut valid {
                valid.index_axis_mut(Axis(0), index).assign(&self.valid(&sample.image));
            }
            if let Some(dark) = self.dark_of(&darks, role) {
                images.index_axis_mut(Axis(0), index).assign(&((&sample.image - &dark.image) * scale));
            }
            settings.push(sample.setting.clone());
        }
        Ok(SweepStack {
            timing: self.timing.clone(),
            prior: self.options.prior(),
            exposures_us,
            settings,
            images,
            valid,
            regular: None,
            noise: None,
            variance_ratio: None,
        })
    }

    /// How well the transport predicts the light of the regular image (counts: `image`) where it is not saturated.
    fn check_regular(&self, image: &Array2<f32>, light: &Array2<f32>, transport: &Transport) -> Vec<Product> {
        let valid = self.valid(image);
        let saturated = valid.iter().filter(|valid| !**valid).count();
        let sum = |image: &Array2<f32>| -> f64 {
            let pixels = image.iter().zip(&valid).filter(|&(_, &valid)| valid);
            pixels.map(|(&light, _)| f64::from(light)).sum()
        };
        let (captured, predicted) = (sum(light), sum(&transport.total()));
        let mut products: Vec<Product> =
            too_many_saturated("the regular image (a whole VSYNC period long)", saturated, valid.len())
                .into_iter()
                .collect();
        if products.is_empty() && captured > 0.0 {
            let share = predicted / captured;
            products.push(Product::Figure { name: PREDICTED_SHARE, value: share });
            if (share - 1.0).abs() > CLOSE_SHARE {
                products.push(Product::Warning(format!(
                    "the transport predicts {:.1} % of the light of the regular image: light from beyond the sweep's reach, or a wrong row time, white_dn or dark image",
                    share * 100.0
                )));
            }
        }
        products
    }

    /// Where an image is not saturated.
    fn valid(&self, image: &Array2<f32>) -> Array2<bool> {
        image.mapv(|counts| f64::from(counts) < self.geometry.saturation_dn)
    }
}

impl Fold for DemuxFold {
    fn name(&self) -> &str {
        "demux"
    }

    fn push(&mut self, unit: &Unit, image: ArrayView2<'_, f32>) {
        let Some(point) = self.schedule.points.get(unit.id.point as usize) else { return };
        let setting = Setting { delays_us: unit.delays_us.clone(), exposure_us: unit.exposure_us };
        self.taken.insert(point.role, Arc::new(Taken { setting, image: image.to_owned() }));
    }

    fn snapshot(&self) -> Option<Box<dyn Snapshot>> {
        (self.points() >= MIN_LIVE_POINTS).then(|| Box::new(self.clone()) as Box<dyn Snapshot>)
    }

    fn finish(&mut self, go_on: &(dyn Fn() -> bool + Sync)) -> Result<Vec<Product>, FoldError> {
        let taken = std::mem::take(&mut self.taken);
        let regular = taken.get(&Role::Regular).cloned();
        let regular = regular.zip(self.dark_of(&taken, Role::Regular));
        let mut stack = self.stack(taken)?;
        let prepared = self
            .demux()
            .and_then(|planned| findings::prepare(&planned, &self.options, &self.geometry, &mut stack))
            .map_err(refused)?;
        let Prepared { demux, coupled, findings } = prepared;
        let images = coupled.as_ref().unwrap_or(&stack.images);
        let valid = stack.valid.as_ref().map(|valid| valid.view());
        let transport = demux.solve_while(images.view(), valid, go_on).map_err(refused)?;

        let saturated = transport.saturated.iter().filter(|&&saturated| saturated).count();
        let mut products = vec![
            Product::Figure { name: "images demultiplexed", value: stack.settings.len() as f64 },
            Product::Figure { name: "saturated pixels", value: saturated as f64 },
        ];
        products.extend(too_many_saturated("the sweep", saturated, transport.saturated.len()));
        if let Some((regular, dark)) = regular {
            let light = (&regular.image - &dark.image) / self.geometry.white_dn as f32;
            products.extend(self.check_regular(&regular.image, &light, &transport));
            stack.regular = Some(light);
        }
        products.extend(findings.warnings.iter().cloned().map(Product::Warning));
        products.push(Product::Findings(Box::new(findings)));
        products.push(Product::Transport(Box::new(transport)));
        products.push(Product::Stack(Box::new(stack)));
        Ok(products)
    }
}

impl Snapshot for DemuxFold {
    fn points(&self) -> usize {
        let taken = |role: Role| self.taken.contains_key(&role);
        let lit = self.schedule.points.iter().filter(|point| matches!(point.role, Role::Sweep(_)));
        lit.filter(|point| taken(point.role) && self.schedule.dark_of(point.exposure_us).is_some_and(taken))
            .count()
    }

    fn estimate(
        &self,
        before: Option<&Transport>,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Transport, FoldError> {
        let SweepStack { settings, images, valid, .. } = self.stack(self.taken.clone())?;
        let valid = valid.as_ref().map(|valid| valid.view());
        self.demux()
            .and_then(|demux| demux.with_settings(settings))
            .and_then(|demux| match before {
                Some(before) => demux.solve_from(before, images.view(), valid, go_on),
                None => demux.solve_while(images.view(), valid, go_on),
            })
            .map_err(refused)
    }
}

fn refused(error: PlaneError) -> FoldError {
    FoldError { fold: "demux".into(), what: error.to_string() }
}
