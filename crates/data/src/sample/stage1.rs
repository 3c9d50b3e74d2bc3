//! Stage 1: two opposite photographs, and the points of four views.

use std::sync::Arc;

use burn::data::dataloader::batcher::Batcher;
use burn::tensor::{Device, Tensor, TensorData};
use rand::Rng;

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
    /// `[4,H,W,3]` points of front, back, right and left in the front camera's frame, metres; `[2,H,W,3]` without
    /// sides.
    pub points: Vec<f32>,
    /// `[4,H,W]` or `[2,H,W]`: 1 for pixels that have a point, 0 for others.
    pub valid: Vec<f32>,
    /// `[2,H,W,3]` points of the second surfaces that face the cameras of right and left, as `points`. Empty without
    /// `network.second_layer`.
    pub second_points: Vec<f32>,
    /// `[2,H,W]` as `valid`, for `second_points`.
    pub second_valid: Vec<f32>,
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
        let (points, valid, row) = match view {
            0..4 => (&self.points, &self.valid, view),
            _ => (&self.second_points, &self.second_valid, view - 4),
        };
        Some((points.get(3 * row * area..3 * (row + 1) * area)?, valid.get(row * area..(row + 1) * area)?))
    }

    fn new(source: &Source, index: usize) -> Result<Self, FileError> {
        let (person, mut random) = source.person(1, index);
        let front = source.front(&mut random);
        let side = source.folder.description().resolution as usize;
        let views = source.four_views(person, source.order(front), &mut random)?;
        let FourViews { photographs, first: (points, valid), second, .. } = views;
        let images = photographs.each_ref().map(|photo| &*photo.rgb).concat();
        let masks = photographs.each_ref().map(|photo| &*photo.mask).concat();
        let (second_points, second_valid) = second;
        let name = format!("{}: {}, view {front}", source.folder.root().display(), person.name);
        let mut item = Self { name, side, images, masks, points, valid, second_points, second_valid };
        if source.config.augment.flip && random.random() {
            item.flip();
        }
        Ok(item)
    }

    /// Mirrors the sample in x, and swaps the two sides.
    fn flip(&mut self) {
        let (side, area) = (self.side, self.side * self.side);
        for image in [&mut self.images, &mut self.masks, &mut self.valid, &mut self.second_valid] {
            image.chunks_exact_mut(side).for_each(<[f32]>::reverse);
        }
        let lines = self.points.chunks_exact_mut(3 * side);
        for line in lines.chain(self.second_points.chunks_exact_mut(3 * side)) {
            let (points, _) = line.as_chunks_mut::<3>();
            points.reverse();
            points.iter_mut().for_each(|point| point[0] = -point[0]);
        }
        // Views 2 and 3 are right and left.
        let maps = [&mut self.points[6 * area..], &mut self.valid[2 * area..]];
        for map in maps.into_iter().chain([&mut self.second_points[..], &mut self.second_valid[..]]) {
            let (right, left) = map.split_at_mut(map.len() / 2);
            right.swap_with_slice(left);
        }
    }
}

/// Makes batches of samples.
#[derive(Debug, Clone, Copy)]
pub struct Stage1Batcher;

impl Batcher<Stage1Item, Stage1Batch> for Stage1Batcher {
    fn batch(&self, items: Vec<Stage1Item>, device: &Device) -> Stage1Batch {
        let (b, side) = (items.len(), items.first().map_or(0, |item| item.side));
        let values = items.first().map_or(0, |item| item.valid.len() + item.second_valid.len());
        let views = values / (side * side).max(1);
        let none: &[f32] = &[];
        Stage1Batch {
            images: stacked(&items, |item| [&item.images, none], [b, 2, 3, side, side], device),
            masks: stacked(&items, |item| [&item.masks, none], [b, 2, side, side], device),
            points: stacked(
                &items,
                |item| [&item.points, &item.second_points],
                [b, views, side, side, 3],
                device,
            ),
            valid: stacked(&items, |item| [&item.valid, &item.second_valid], [b, views, side, side], device),
        }
    }
}

/// A tensor with the two fields of each item, one after the other.
fn stacked<const D: usize>(
    items: &[Stage1Item],
    of: impl Fn(&Stage1Item) -> [&[f32]; 2],
    shape: [usize; D],
    device: &Device,
) -> Tensor<D> {
    let parts: Vec<&[f32]> = items.iter().flat_map(of).collect();
    let values = parts.concat();
    Tensor::from_data(TensorData::new(values, shape), device)
}
