//! Stage 1 of the network of details alone: it learns from small windows of the photographs, most of them where the
//! coarse points lack a relief (docs/method.md, "Losses of stage 1").

use burn::tensor::Tensor;
use rand::Rng;
use snapsnap_base::random::stream;
use snapsnap_data::sample::Stage1Batch;
use snapsnap_net::Window;
use snapsnap_net::config::{Config, Downsample};
use snapsnap_net::network::{Input, PointPredictor};
use snapsnap_net::resample::shrink;
use snapsnap_ops::{host, mean_lengths};

use crate::points::offsets;
use crate::task::{Moment, Part};

/// Windows of each photograph.
const WINDOWS: usize = 3;
/// Side of a window, in pixels of the network of details. At 512 pixels this is 44 cm.
const SIDE: usize = 96;
/// Side of the cells whose relief is measured.
const CELL: usize = 8;
/// Relief of a cell in metres above which windows are not drawn more often: a step between two limbs.
const MOST: f32 = 0.01;
/// Relief in metres that is added to a cell's own, so that windows show plain surfaces as well.
const LEAST: f32 = 0.001;

/// The losses of a batch: the mean error of depths in metres, and the mean error of their differences between pixels.
pub fn losses(
    predictor: &PointPredictor,
    config: &Config,
    batch: &Stage1Batch,
    at: &Moment,
    (seed, relief_weight): (u64, f64),
) -> Vec<Part> {
    let Some(extent) = at.extent.clone() else { return Vec::new() };
    let window = Window::of_predictor(config, Some(extent));
    let [b, _, colors, side, _] = batch.images.dims();
    let photographs = batch.images.clone().swap_dims(0, 1).reshape([2 * b, colors, side, side]);
    let masks = batch.masks.clone().swap_dims(0, 1).reshape([2 * b, 1, side, side]);
    let decoded = predictor.decode(predictor.encode(Input::new(config, photographs, masks, &window)));
    let look = predictor.second_look(&predictor.heads(&decoded), &batch.images, &batch.masks, &window);
    let [_, _, h, w] = look.images.dims();

    let small = |x: Tensor<4>| shrink(window.cut(x), window.rows.len() / h, Downsample::Area);
    let shares = [0, 1].map(|view| small(batch.valid.clone().narrow(1, view, 1)));
    let points = [0, 1].map(|view| {
        let points = batch.points.clone().narrow(1, view, 1).squeeze_dim::<4>(1).permute([0, 3, 1, 2]);
        let sum = small(points * batch.valid.clone().narrow(1, view, 1));
        (sum / shares[view].clone().clamp_min(1e-3)).permute([0, 2, 3, 1])
    });
    let delta = host(predictor.delta())[0];
    let behind = look.depths_behind(points, delta);
    let inside = Tensor::cat(shares.to_vec(), 0).greater_equal_elem(0.5).float();

    let (on_host, there) = (host(behind.clone()), host(inside.clone()));
    let mut random = stream(&format!("details/{seed}/{}/{}", at.step, at.first));
    let mut places = Vec::new();
    for (image, (behind, there)) in on_host.chunks_exact(h * w).zip(there.chunks_exact(h * w)).enumerate() {
        let cells = cells(behind, there, w);
        let all: f32 = cells.iter().map(|(_, relief)| relief).sum();
        for _ in 0..WINDOWS {
            let mut left = all * random.random::<f32>();
            let is_drawn = |(_, relief): &&([usize; 2], f32)| {
                left -= relief;
                left <= 0.0
            };
            let Some((place, _)) = cells.iter().find(is_drawn).or(cells.last()) else { break };
            let start = |middle: usize, length: usize, random: &mut dyn rand::RngCore| {
                let shift = random.random_range(0..SIDE / 2);
                (middle + shift).saturating_sub(3 * SIDE / 4).min(length.saturating_sub(SIDE))
            };
            places.push((image, start(place[0], h, &mut random), start(place[1], w, &mut random)));
        }
    }
    if places.is_empty() {
        return Vec::new();
    }
    let (rows, columns) = (SIDE.min(h), SIDE.min(w));
    let windows = |x: &Tensor<4>| {
        let one = |&(image, row, column): &(usize, usize, usize)| {
            x.clone().narrow(0, image, 1).narrow(2, row, rows).narrow(3, column, columns)
        };
        Tensor::cat(places.iter().map(one).collect(), 0)
    };
    let (images, behind, inside) = (windows(&look.images), windows(&behind), windows(&inside));
    let off = (predictor.relief(images) * delta - behind).permute([0, 2, 3, 1]);
    let zeros = off.zeros_like();
    let lengths = mean_lengths(Tensor::cat(vec![off, zeros.clone(), zeros], 3), inside.squeeze_dim(1), &offsets(rows, columns));
    let differences = lengths.dims()[1] - 1;
    vec![
        Part { name: "points", weight: 1.0, value: lengths.clone().narrow(1, 0, 1).mean() },
        Part { name: "relief", weight: relief_weight, value: lengths.narrow(1, 1, differences).mean() },
    ]
}

/// The middle of each cell of [`CELL`]² pixels that shows the person, and the mean deviation of its depths from their
/// mean, limited to `LEAST..MOST + LEAST`.
fn cells(behind: &[f32], there: &[f32], w: usize) -> Vec<([usize; 2], f32)> {
    let h = there.len() / w;
    let mut found = Vec::new();
    for row in (0..h).step_by(CELL) {
        for column in (0..w).step_by(CELL) {
            let rows = row..(row + CELL).min(h);
            let pixels = rows.flat_map(|y| (column..(column + CELL).min(w)).map(move |x| y * w + x));
            let depths: Vec<f32> = pixels.filter(|i| there[*i] > 0.5).map(|i| behind[i]).collect();
            if 2 * depths.len() < CELL * CELL {
                continue;
            }
            let mean = depths.iter().sum::<f32>() / depths.len() as f32;
            let relief = depths.iter().map(|depth| (depth - mean).abs()).sum::<f32>() / depths.len() as f32;
            if relief.is_finite() {
                found.push(([row + CELL / 2, column + CELL / 2], relief.min(MOST) + LEAST));
            }
        }
    }
    found
}
