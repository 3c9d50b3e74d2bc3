//! Stage 1: two opposite photographs, and the points of four views.

use std::sync::Arc;

use burn::tensor::{Device, Tensor, TensorData};

use super::four_views::FourViews;
use super::{SampleConfig, Source, Stage};
use crate::dataset::{Folder, Split};
use snapsnap_base::FileError;

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
