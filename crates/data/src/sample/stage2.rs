//! Stage 2: front and back photographs, and target views for the renders.

use std::sync::Arc;

use rand::Rng;
use snapsnap_net::Photograph;
use snapsnap_photo::Restoration;
use snapsnap_splat::Camera;

use super::four_views::FourViews;
use super::{SampleConfig, Source, Stage};
use crate::dataset::{Folder, Split};
use snapsnap_base::FileError;

/// Samples of stage 2 (docs/method.md, "Samples"). The front is the first view with `compat`, else any view that the
/// config allows. The back is the opposite view. Targets are random views and the sides.
pub type Stage2 = Stage<Stage2Item>;

/// One sample; H and W are the side of the data set's views, h and w the side of the targets.
#[derive(Debug, Clone)]
pub struct Stage2Item {
    /// Data set, subject and front view, for messages.
    pub name: String,
    /// H and W.
    pub side: usize,
    /// Front and back on canvases of H and W pixels; masks are 1 or 0 with `compat`.
    pub photographs: [Photograph; 2],
    /// Cameras of front, back, right and left, side H. The front camera of an upright sample is moved with its points.
    pub cameras: [Camera; 4],
    /// Moves an upright person to where the photographs' cameras saw it.
    pub restoration: Option<Restoration>,
    /// `[4,H,W,3]` points of the views of `cameras`, in metres in the front camera's frame; `[2,H,W,3]` without sides.
    /// Rectified if people are upright; empty without `points` of the config.
    pub points: Vec<f32>,
    /// `[4,H,W]` or `[2,H,W]`: 1 for pixels that have a point, 0 for others; empty like `points`.
    pub valid: Vec<f32>,
    /// h and w.
    pub target_side: usize,
    /// `[V,3,h,w]` targets in [0, 1] over `background`: random views, then right and left.
    pub targets: Vec<f32>,
    /// `[V,h,w]` share of the person in each pixel of the targets.
    pub target_masks: Vec<f32>,
    /// Cameras of the targets.
    pub target_cameras: Vec<Camera>,
    /// Colour behind the person.
    pub background: [f32; 3],
}

impl Stage2 {
    /// The samples of a split.
    ///
    /// # Errors
    /// As [`super::Stage1::new`].
    pub fn new(folder: Arc<Folder>, split: Option<Split>, config: SampleConfig) -> Result<Self, FileError> {
        // Only stage 1 has second surfaces.
        let config = SampleConfig { second_depth: false, ..config };
        Ok(Self { source: Source::new(folder, split, config, 4)?, make: Stage2Item::new })
    }
}

impl Stage2Item {
    fn new(source: &Source, index: usize) -> Result<Self, FileError> {
        let Source { folder, config, .. } = source;
        let (person, mut random) = source.person(2, index);
        let description = folder.description();
        let count = description.views;
        let front = if config.compat { 0 } else { source.front(&mut random) };
        let order = source.order(front);
        let random_views =
            (0..config.random_targets).map(|_| random.random_range(0..count)).collect::<Vec<_>>();
        let background =
            if config.augment.is_photographic { [(); 3].map(|()| random.random()) } else { [0.0; 3] };
        let target_side = description.resolution * if config.high_resolution { 2 } else { 1 };
        let (mut targets, mut target_masks, mut target_cameras) = (Vec::new(), Vec::new(), Vec::new());
        for view in random_views.into_iter().chain([order[2], order[3]]) {
            let (target, mask) = source.target(person, view, config.high_resolution, background)?;
            targets.extend(target);
            target_masks.extend(mask);
            // The camera at the size of the stored picture.
            let stored = person.camera(view)?.resized(target_side, target_side);
            target_cameras.push(source.camera(&stored));
        }
        let views = source.four_views(person, order, &mut random)?;
        let FourViews { photographs, mut cameras, points: (points, valid), restoration } = views;
        if let Some(restoration) = &restoration {
            cameras[0] = restoration.front;
        }
        Ok(Self {
            name: format!("{}: {}, view {front}", folder.root().display(), person.name),
            side: description.resolution as usize,
            photographs,
            cameras,
            restoration,
            points,
            valid,
            target_side: target_side as usize,
            targets,
            target_masks,
            target_cameras,
            background,
        })
    }
}
