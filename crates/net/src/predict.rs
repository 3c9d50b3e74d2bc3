//! Photographs on their canvases → predicted points on the canvas, for trainings and for the reconstruction.

use std::ops::Range;

use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use snapsnap_ops::has_kernels;

use crate::config::{CELL, Config, NetworkConfig, PATCH, Sides};
use crate::network::{Input, PointMap, PointPredictor, View};
use crate::photograph::Photograph;
use crate::steps::{Record, Step};
use crate::window::Window;

/// Point maps of all views on the predictor's window of the canvas.
#[derive(Debug, Clone)]
pub struct Prediction {
    /// The window.
    pub window: Window,
    /// `[B,h,w,3]` and `[B,h,w]` of every view.
    pub maps: Vec<(View, PointMap)>,
}

impl Prediction {
    /// Predicted point maps of one front and back, in the window around the person.
    ///
    /// # Panics
    /// If a photograph's arrays do not have the canvas size.
    pub fn of_pair(
        predictor: &PointPredictor,
        config: &Config,
        photographs: [&Photograph; 2],
        device: &Device,
        record: &mut Record,
    ) -> Self {
        let side = config.network.resolution;
        let masks = photographs.map(|photo| &*photo.mask).concat();
        let person = Window::around_person(&masks, side);
        let images = photographs.map(|photo| &*photo.rgb).concat();
        let images = Tensor::from_data(TensorData::new(images, [1, 2, 3, side, side]), device);
        let masks = Tensor::from_data(TensorData::new(masks, [1, 2, side, side]), device);
        Self::new(predictor, config, images, &masks, person, record)
    }

    /// Predicted point maps of fronts and backs `[B,2,3,S,S]` in [−1, 1] with masks `[B,2,S,S]`. `person` is the box of all
    /// pixels with a mask above 0.
    pub fn new(
        predictor: &PointPredictor,
        config: &Config,
        images: Tensor<5>,
        masks: &Tensor<4>,
        person: Option<Window>,
        record: &mut Record,
    ) -> Self {
        let [b, _, colors, side, _] = images.dims();
        let window = Window::of_predictor(config, person.clone());
        let input = record.timed("input", |_| {
            // All fronts, then all backs.
            let photographs = images.clone().swap_dims(0, 1).reshape([2 * b, colors, side, side]);
            let of_input = masks.clone().swap_dims(0, 1).reshape([2 * b, 1, side, side]);
            Input::new(config, photographs, of_input, &window)
        });
        let [_, channels, height, width] = input.images.dims();
        record.steps.push(Step::PointPredictor {
            window: window.clone(),
            canvas: side,
            size: [width, height],
            downsample: config.downsample(),
            tokens: input.grid.iter().product(),
            channels,
        });
        let input_images = input.images.clone();
        let encoded = record.timed("encoder", |_| predictor.encode(input));
        let decoded = record.timed("decoders", |_| predictor.decode(encoded));
        let has_side_heads = predictor.views().len() > 2 && config.network.sides == Sides::Predicted;
        let heads = if has_side_heads { "heads (4)" } else { "heads (2)" };
        let mut maps = record.timed(heads, |_| predictor.heads(&decoded));
        let mut fine = Vec::new();
        match config.network.details.as_ref().map(|details| details.resolution) {
            Some(size) if size <= side => {
                let columns = details_columns(person.as_ref(), &window, side, size);
                let width = columns.len();
                fine = record
                    .timed("details", |_| predictor.detailed(&mut maps, &images, masks, &window, columns));
                record.steps.push(Step::Details { size: [width, window.rows.len() * size / side] });
            }
            // The predictor sees as much.
            Some(_) => record.steps.push(Step::NoDetails { canvas: side }),
            None => {}
        }
        if maps.len() < predictor.views().len() {
            maps = record
                .timed("completed sides", |_| predictor.complete(maps, &decoded, &input_images, &window));
        }
        maps.splice(..fine.len(), fine);
        let finished = |(view, map): (View, PointMap)| {
            // The sides have no mask.
            let mask = ((view as usize) < 2).then(|| masks.clone().narrow(1, view as usize, 1));
            (view, predictor.finished(config, view, map, &window, mask.as_ref()))
        };
        let maps = record.timed("up-sampling", |_| each_view(maps, finished));
        Self { maps, window }
    }

    /// The maps on the whole canvas, 0 outside the window.
    pub fn pasted(self, config: &NetworkConfig) -> Vec<(View, PointMap)> {
        each_view(self.maps, |(view, map)| (view, map.pasted(config, view, &self.window)))
    }
}

/// Columns of the window that the network of details receives, in pixels of its image of a canvas of `side`² pixels: the
/// person's, symmetric about the middle, in whole cells.
fn details_columns(person: Option<&Window>, window: &Window, side: usize, image: usize) -> Range<usize> {
    /// Pixels beside the person.
    const MARGIN: usize = 32;
    let width = window.columns.len() * image / side;
    let beside = person.map_or(0, |person| {
        let beside = person.columns.start.min(side - person.columns.end);
        (beside.saturating_sub(window.columns.start) * image / side).saturating_sub(MARGIN)
    });
    let beside = beside / (PATCH * CELL) * (PATCH * CELL);
    beside..width - beside
}

/// Applies `change` to the map of each view. On a CPU, the operations of a map run on one thread each.
fn each_view<T: Send>(
    maps: Vec<(View, PointMap)>,
    change: impl Fn((View, PointMap)) -> T + Send + Sync,
) -> Vec<T> {
    let conf = &maps[0].1.conf;
    // The order of tracked operations decides the order of their gradients' sums.
    match has_kernels(conf) && !conf.device().is_autodiff() {
        true => maps.into_par_iter().map(change).collect(),
        false => maps.into_iter().map(change).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_of_details_hold_the_person_symmetrically_in_whole_cells() {
        let window = Window { rows: 0..1024, columns: 256..768 };
        let columns = |person: Option<Range<usize>>, image: usize| {
            let person = person.map(|columns| Window { rows: 100..900, columns });
            details_columns(person.as_ref(), &window, 1024, image)
        };
        // A cell has 16 pixels. The narrower side has 300 − 256 − 32 = 12 pixels, 400 − 256 − 32 = 112, or half of 144, less 32.
        assert_eq!(columns(Some(400..724), 1024), 0..512);
        assert_eq!(columns(Some(400..624), 1024), 112..400);
        assert_eq!(columns(Some(400..624), 512), 32..224);
        assert_eq!(columns(None, 1024), 0..512);
    }
}
