//! Samples of stage 1, two opposite photographs and the points of four views, and of stage 2, the photographs and target
//! views for the renders.

use std::sync::Arc;

use burn::tensor::{Device, Tensor, TensorData};
use rand::Rng;
use snapsnap_base::FileError;
use snapsnap_net::Photograph;
use snapsnap_photo::Restoration;
use snapsnap_splat::Camera;

use super::four_views::FourViews;
use super::{SampleConfig, Source, Stage};
use crate::dataset::{Folder, Split};

/// Samples of stage 1 (docs/method.md, "Samples"). Any view is the front, the opposite view the back. Views at right
/// angles are the sides.
pub type Stage1 = Stage<Stage1Item>;

/// One sample; H and W are the side of the data set's views.
#[derive(Debug, Clone)]
pub struct Stage1Item {
    /// Data set, subject and front view, for messages.
    pub name: String,
    /// H and W.
    pub side: usize,
    /// `[2,3,H,W]` front and back in [−1, 1] times the mask.
    pub images: Vec<f32>,
    /// `[2,H,W]` input masks: the person's share of each pixel; 1 or 0 with `compat`.
    pub masks: Vec<f32>,
    /// `[V,H,W,3]` points in the front camera's frame, metres. V is 4: front, back, right and left. It is 2 without sides,
    /// and 6 with the second surfaces that face the cameras of right and left (`network.second_layer`).
    pub points: Vec<f32>,
    /// `[V,H,W]`: 1 for pixels that have a point, 0 for others.
    pub valid: Vec<f32>,
}

/// A batch of B samples on a device.
#[derive(Debug, Clone)]
pub struct Stage1Batch {
    /// `[B,2,3,H,W]`.
    pub images: Tensor<5>,
    /// `[B,2,H,W]`.
    pub masks: Tensor<4>,
    /// `[B,V,H,W,3]`: V is 4, 6 with the second surfaces of right and left, or 2 without sides.
    pub points: Tensor<5>,
    /// `[B,V,H,W]`.
    pub valid: Tensor<4>,
}

impl Stage1 {
    /// The samples of a split.
    ///
    /// # Errors
    /// [`FileError`] if the split has no subject, the number of views is no multiple of 4, or the config contradicts
    /// itself or the data set.
    pub fn new(folder: Arc<Folder>, split: Option<Split>, config: SampleConfig) -> Result<Self, FileError> {
        // Only stage 2 has targets of high resolution, and samples without points.
        let config = SampleConfig { high_resolution: false, points: true, ..config };
        Ok(Self { source: Source::new(folder, split, config, 4)?, make: Stage1Item::new })
    }
}

impl Stage1Item {
    /// True points `[H,W,3]` of a view, and their validity `[H,W]`. Views 0 to 3 are front, back, right and left; 4 and
    /// 5 are the second surfaces of right and left. `None` for a view that the sample does not contain.
    pub fn truth(&self, view: usize) -> Option<(&[f32], &[f32])> {
        let area = self.side * self.side;
        let (first, end) = (view * area, (view + 1) * area);
        Some((self.points.get(3 * first..3 * end)?, self.valid.get(first..end)?))
    }

    fn new(source: &Source, index: usize) -> Result<Self, FileError> {
        let (person, mut random) = source.person(1, index);
        let front = source.front(&mut random);
        let side = source.folder.description().resolution as usize;
        let views = source.four_views(person, source.order(front), &mut random)?;
        let FourViews { photographs, points: (points, valid), .. } = views;
        let images = photographs.each_ref().map(|photo| &*photo.rgb).concat();
        let masks = photographs.each_ref().map(|photo| &*photo.mask).concat();
        let name = format!("{}: {}, view {front}", source.folder.root().display(), person.name);
        Ok(Self { name, side, images, masks, points, valid })
    }
}

impl Stage1Batch {
    /// A batch of samples with the same views.
    pub fn new(items: Vec<Stage1Item>, device: &Device) -> Self {
        let (b, side) = (items.len(), items.first().map_or(0, |item| item.side));
        let views = items.first().map_or(0, |item| item.valid.len()) / (side * side).max(1);
        Self {
            images: stacked(&items, |item| &item.images, [b, 2, 3, side, side], device),
            masks: stacked(&items, |item| &item.masks, [b, 2, side, side], device),
            points: stacked(&items, |item| &item.points, [b, views, side, side, 3], device),
            valid: stacked(&items, |item| &item.valid, [b, views, side, side], device),
        }
    }
}

/// A tensor with a field of each item.
fn stacked<const D: usize>(
    items: &[Stage1Item],
    field: impl Fn(&Stage1Item) -> &[f32],
    shape: [usize; D],
    device: &Device,
) -> Tensor<D> {
    let values: Vec<&[f32]> = items.iter().map(field).collect();
    Tensor::from_data(TensorData::new(values.concat(), shape), device)
}

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
    /// As [`Stage1::new`].
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
