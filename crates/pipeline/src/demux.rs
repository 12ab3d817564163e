//! Fold `demux`: from the averaged images of a sweep to its light transport.

use std::collections::BTreeMap;

use ndarray::{Array2, Array3, ArrayView2, Axis};
use raysweep_transport::plane::{Demux, PlaneError, Prior, RowTiming, Setting};
use serde::Deserialize;

use crate::registry::RegistryError;
use crate::schedule::{Role, Schedule, SweepGeometry};
use crate::stage::{Fold, FoldError, Product};
use crate::unit::Unit;

/// Options of `demux` in a plan.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DemuxOptions {
    /// Which prior: `split` (direct light is a spike at u = 0) or `paper`.
    pub prior: PriorName,
    /// Weight of smoothness over rows; left out: the prior's own.
    pub alpha: Option<f64>,
    /// Weight of sparsity; left out: the prior's own.
    pub beta: Option<f64>,
}

impl Default for DemuxOptions {
    fn default() -> Self {
        Self { prior: PriorName::Split, alpha: None, beta: None }
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
    fn prior(&self) -> Prior {
        let prior = match self.prior {
            PriorName::Split => Prior::SPLIT,
            PriorName::Paper => Prior::PAPER,
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

/// One image of the sweep, as it was taken.
struct Taken {
    setting: Setting,
    /// Mean counts.
    image: Array2<f32>,
}

/// Collects a sweep and demultiplexes it.
pub struct DemuxFold {
    prior: Prior,
    schedule: Schedule,
    geometry: SweepGeometry,
    timing: RowTiming,
    taken: BTreeMap<Role, Taken>,
}

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
        let prior = options.prior();
        prior.check().map_err(invalid)?;
        let raster = &geometry.raster;
        let timing = RowTiming::new(raster.rows, raster.row_time_us, raster.period_us)
            .and_then(|timing| timing.window(geometry.first_row, geometry.height))
            .map_err(invalid)?;
        let fold =
            Self { prior, schedule: schedule.clone(), geometry: *geometry, timing, taken: BTreeMap::new() };
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
        Demux::new(self.timing, planned, self.prior)
    }

    fn error(&self, what: impl Into<String>) -> FoldError {
        FoldError { fold: self.name().into(), what: what.into() }
    }

    /// An image minus its dark image, in the scene's units, and which of its pixels are not saturated.
    fn light(&self, role: Role, taken: &Taken) -> Option<(Array2<f32>, Array2<bool>)> {
        let nominal_us = self.schedule.points.iter().find(|point| point.role == role)?.exposure_us;
        let dark = self.taken.get(&self.schedule.dark_of(nominal_us)?)?;
        let scale = (1.0 / self.geometry.white_dn) as f32;
        let light = (&taken.image - &dark.image) * scale;
        let valid = taken.image.mapv(|counts| f64::from(counts) < self.geometry.saturation_dn);
        Some((light, valid))
    }
}

impl Fold for DemuxFold {
    fn name(&self) -> &str {
        "demux"
    }

    fn push(&mut self, unit: &Unit, image: ArrayView2<'_, f32>) {
        let Some(point) = self.schedule.points.get(unit.id.point as usize) else { return };
        let setting = Setting { delays_us: unit.delays_us.clone(), exposure_us: unit.exposure_us };
        self.taken.insert(point.role, Taken { setting, image: image.to_owned() });
    }

    fn finish(&mut self) -> Result<Vec<Product>, FoldError> {
        let (mut settings, mut lights, mut valids) = (Vec::new(), Vec::new(), Vec::new());
        for (&role, taken) in &self.taken {
            if matches!(role, Role::Sweep(_))
                && let Some((light, valid)) = self.light(role, taken)
            {
                settings.push(taken.setting.clone());
                lights.push(light);
                valids.push(valid);
            }
        }
        if lights.is_empty() {
            return Err(self.error(
                "no point of the sweep, with the dark image of its exposure, is there: resume the run",
            ));
        }
        let plane = |error: PlaneError| self.error(error.to_string());
        // The reach is the plan's, so that jitter does not change the shape of the result.
        let demux = self.demux().and_then(|demux| demux.with_settings(settings)).map_err(plane)?;
        let stack = stacked(&lights);
        let saturated = valids.iter().any(|valid| valid.iter().any(|&valid| !valid));
        let valid = saturated.then(|| stacked(&valids));
        let transport = demux.solve(stack.view(), valid.as_ref().map(|valid| valid.view())).map_err(plane)?;

        let mut products = vec![
            Product::Image {
                name: "epipolar",
                about: "light from the pixel's own projector row (u = 0)",
                image: transport.epipolar(1),
            },
            Product::Image {
                name: "non_epipolar",
                about: "light from all other rows within the sweep's reach",
                image: transport.non_epipolar(1),
            },
            Product::Figure { name: "images demultiplexed", value: lights.len() as f64 },
            Product::Figure {
                name: "saturated pixels",
                value: transport.saturated.iter().filter(|&&saturated| saturated).count() as f64,
            },
        ];
        if let Some((regular, valid)) =
            self.taken.get(&Role::Regular).and_then(|taken| self.light(Role::Regular, taken))
        {
            let predicted = transport.total();
            let (mut seen, mut expected) = (0.0, 0.0);
            for ((&seen_here, &expected_here), _) in
                regular.iter().zip(&predicted).zip(&valid).filter(|&(_, &valid)| valid)
            {
                seen += f64::from(seen_here);
                expected += f64::from(expected_here);
            }
            products.push(Product::Image {
                name: "regular",
                about: "a captured exposure of one whole VSYNC period: every row lit once",
                image: regular,
            });
            products
                .push(Product::Figure { name: "predicted / captured regular light", value: expected / seen });
        }
        products.push(Product::Transport(Box::new(transport)));
        Ok(products)
    }
}

/// Images along a new first axis.
fn stacked<T: Copy + Default>(images: &[Array2<T>]) -> Array3<T> {
    let (height, width) = images.first().map_or((0, 0), Array2::dim);
    let mut stack = Array3::default((images.len(), height, width));
    for (mut plane, image) in stack.axis_iter_mut(Axis(0)).zip(images) {
        plane.assign(image);
    }
    stack
}
