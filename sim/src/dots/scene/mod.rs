//! Subjects in front of the dot rig's camera, and their images under one spot of light.

mod error;
mod file;
mod glow;
mod model;
mod still;

use std::path::Path;
use std::sync::Arc;

use raysweep_core::Mosaic;

pub use self::error::DotSceneError;
use self::file::FileScene;
use self::model::{SceneModel, Surface};
pub use self::still::{BUILTIN_NAMES, SpotImages, Still};
use super::view::CameraView;
use raysweep_config::sim::DotsConfig;

/// A scene that may move, and the planes that can replace it.
pub struct DotScene {
    kind: Kind,
    planes: Vec<Arc<dyn Still>>,
    view: CameraView,
    mosaic: Mosaic,
    seed: u64,
}

enum Kind {
    File(Arc<dyn Still>),
    Builtin(&'static str),
}

impl DotScene {
    /// Loads or computes a scene; file paths are relative to `folder`.
    ///
    /// # Errors
    /// When it cannot be read, or when the name or the size is invalid.
    pub fn new(
        config: &DotsConfig,
        half: [f64; 2],
        mosaic: Mosaic,
        folder: &Path,
    ) -> Result<Self, DotSceneError> {
        let extension = config.scene.extension().and_then(|extension| extension.to_str());
        let traced = |view| {
            let planes = config.plane_depths.iter().map(move |&depth| {
                Arc::new(Surface::trace(SceneModel::plane(depth), view, mosaic)) as Arc<dyn Still>
            });
            planes.collect::<Vec<_>>()
        };
        let (kind, planes, size): (Kind, _, _) = if let Some("npz" | "npy") = extension {
            let scene = FileScene::load(&folder.join(&config.scene), half, mosaic)?;
            let size = scene.size();
            let mut planes: Vec<Arc<dyn Still>> = Vec::new();
            for file in &config.plane_files {
                for plane in scene.load_planes(&folder.join(file), mosaic)? {
                    planes.push(Arc::new(plane));
                }
            }
            if planes.is_empty() {
                planes = traced(CameraView { size, half });
            }
            (Kind::File(Arc::new(scene)), planes, size)
        } else {
            let name = config.scene.to_string_lossy();
            let builtin = BUILTIN_NAMES.into_iter().find(|known| *known == name);
            let Some(builtin) = builtin else {
                return Err(DotSceneError::UnknownName { name: name.into_owned() });
            };
            if !config.plane_files.is_empty() {
                return Err(DotSceneError::PlanesOfFiles { name: builtin });
            }
            let size = (config.rows, config.columns);
            (Kind::Builtin(builtin), traced(CameraView { size, half }), size)
        };
        let view = CameraView { size, half };
        Ok(Self { kind, planes, view, mosaic, seed: config.seed })
    }

    /// The camera's view of the scene.
    pub fn view(&self) -> CameraView {
        self.view
    }

    /// Number of planes.
    pub fn planes(&self) -> usize {
        self.planes.len()
    }

    /// The plane with this index.
    pub fn plane(&self, number: usize) -> Option<Arc<dyn Still>> {
        self.planes.get(number).cloned()
    }

    /// The scene at a position of its swing, -1..=1.
    pub fn at(&self, swing: f64) -> Arc<dyn Still> {
        match &self.kind {
            Kind::File(still) => still.clone(),
            Kind::Builtin(name) => {
                let model = SceneModel::builtin(name, self.view.half, swing, self.seed);
                Arc::new(Surface::trace(model, self.view, self.mosaic))
            }
        }
    }
}
