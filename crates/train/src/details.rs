//! Stage 1 of the network of details alone: it learns from small windows of the photographs, most of them where the
//! coarse points lack a relief (docs/method.md, "Losses of stage 1").

use burn::tensor::Tensor;
use rand::Rng;
use rayon::prelude::*;
use snapsnap_base::random::stream;
use snapsnap_data::sample::Stage1Batch;
use snapsnap_net::Window;
use snapsnap_net::config::{Config, Downsample};
use snapsnap_net::network::{Input, PointPredictor, without_mean};
use snapsnap_net::resample::shrink;
use snapsnap_ops::{host, mean_lengths};

use crate::config::Stage1Config;
use crate::points::offsets;
use crate::task::{Moment, Part};

/// Windows of each photograph.
const WINDOWS: usize = 8;
/// Side of a window, in pixels of the photographs' image. At 1024 pixels this is 44 cm.
const SIDE: usize = 192;
/// Side of the cells whose relief is measured.
const CELL: usize = 16;
/// Part of the person's height that counts as the head, and how many times more often its cells are drawn.
const HEAD: (f32, f32) = (0.125, 8.0);
/// Relief of a cell in metres above which windows are not drawn more often: a step between two limbs.
const MOST: f32 = 0.01;
/// Relief in metres that is added to a cell's own, so that windows show plain surfaces as well.
const LEAST: f32 = 0.001;

/// The losses of a batch: the mean error of depths in metres, and the mean error of their differences between pixels.
/// None if no sample shows a person.
pub fn losses(
    predictor: &PointPredictor,
    config: &Config,
    weights: &Stage1Config,
    batch: &Stage1Batch,
    seed: u64,
    at: &Moment,
) -> Vec<Part> {
    let Some(extent) = at.extent.clone() else { return Vec::new() };
    let window = Window::of_predictor(config, Some(extent));
    let [b, _, colors, side, _] = batch.images.dims();
    let photographs = batch.images.clone().swap_dims(0, 1).reshape([2 * b, colors, side, side]);
    let masks = batch.masks.clone().swap_dims(0, 1).reshape([2 * b, 1, side, side]);
    let decoded = predictor.decode(predictor.encode(Input::new(config, photographs, masks, &window)));
    let look = predictor.second_look(&predictor.heads(&decoded), &batch.images, &batch.masks, &window);
    // Pixels of the photographs' image, and of its patches.
    let [h, w] = look.size();
    let patch = h / look.images.dims()[2];

    // True points of the network's pixels, and their depths behind the coarse points.
    let small = |x: Tensor<4>| shrink(window.cut(x), window.rows.len() / h, Downsample::Area);
    let shares = [0, 1].map(|view| small(batch.valid.clone().narrow(1, view, 1)));
    let points = [0, 1].map(|view| {
        let points = batch.points.clone().narrow(1, view, 1).squeeze_dim::<4>(1).permute([0, 3, 1, 2]);
        let sum = small(points * batch.valid.clone().narrow(1, view, 1));
        (sum / shares[view].clone().clamp_min(1e-3)).permute([0, 2, 3, 1])
    });
    let delta = host(predictor.delta())[0];
    let inside = Tensor::cat(shares.to_vec(), 0).greater_equal_elem(0.5).float();
    // Whether a whole limb is too near can hardly be seen, and errors of this kind hide the smaller ones.
    let factor = h * config.network.resolution / (config.network.net_resolution * window.rows.len());
    let depths = without_mean(look.depths_behind(points, delta), &inside, factor);
    let (on_host, is_inside) = (host(depths.clone()), host(inside.clone()));

    // The draws of a photograph do not depend on the others: ranks share a batch.
    let images = on_host.par_chunks_exact(h * w).zip(is_inside.par_chunks_exact(h * w)).enumerate();
    let drawn = images.map(|(image, (depths, inside))| {
        let (sample, view) = (at.first + image % b, image / b);
        let mut random = stream(&format!("details/{seed}/{}/{sample}/{view}", at.step));
        draw(&cells(depths, inside, w), [h, w], patch, &mut random)
    });
    let places: Vec<_> = drawn.collect();
    let (rows, columns) = (SIDE.min(h), SIDE.min(w));
    let windows = |x: &Tensor<4>, scale: usize| {
        let of_image = |(image, places): (usize, &Vec<[usize; 2]>)| -> Vec<Tensor<4>> {
            let x = x.clone().narrow(0, image, 1);
            let window = |[row, column]: &[usize; 2]| {
                let x = x.clone().narrow(2, *row / scale, rows / scale);
                x.narrow(3, *column / scale, columns / scale)
            };
            places.iter().map(window).collect()
        };
        Tensor::cat(places.iter().enumerate().flat_map(of_image).collect(), 0)
    };
    let off =
        (predictor.relief(windows(&look.images, patch)) * delta - windows(&depths, 1)).permute([0, 2, 3, 1]);
    let zeros = off.zeros_like();
    let off = Tensor::cat(vec![off, zeros.clone(), zeros], 3);
    let lengths = mean_lengths(off, windows(&inside, 1).squeeze_dim(1), &offsets(rows, columns));
    let differences = lengths.dims()[1] - 1;
    vec![
        Part { name: "points", weight: 1.0, value: lengths.clone().narrow(1, 0, 1).mean() },
        Part {
            name: "relief",
            weight: weights.relief_weight,
            value: lengths.narrow(1, 1, differences).mean(),
        },
    ]
}

/// Upper left corners of a photograph's windows, at multiples of `patch`, around random cells, each with the probability of its weight. Without a
/// cell, the windows are the first one, which shows nobody and has no error.
fn draw(
    cells: &[([usize; 2], f32)],
    size: [usize; 2],
    patch: usize,
    random: &mut impl Rng,
) -> Vec<[usize; 2]> {
    let all: f32 = cells.iter().map(|(_, weight)| weight).sum();
    let mut one = || {
        let mut left = all * random.random::<f32>();
        let is_drawn = |(_, weight): &&([usize; 2], f32)| {
            left -= weight;
            left <= 0.0
        };
        let cell = cells.iter().find(is_drawn).or(cells.last());
        let shifts = [(); 2].map(|()| random.random_range(SIDE / 4..3 * SIDE / 4));
        cell.map_or([0; 2], |(middle, _)| {
            let first =
                |axis: usize| middle[axis].saturating_sub(shifts[axis]).min(size[axis].saturating_sub(SIDE));
            [0, 1].map(|axis| first(axis) / patch * patch)
        })
    };
    (0..WINDOWS).map(|_| one()).collect()
}

/// The middle of each cell of [`CELL`]² pixels that shows the person, and the mean deviation of its depths from their
/// mean, limited to `LEAST..MOST + LEAST`; for cells of the head more.
fn cells(behind: &[f32], there: &[f32], w: usize) -> Vec<([usize; 2], f32)> {
    let h = there.len() / w;
    let mut found = Vec::new();
    let mut rows = (0..h).filter(|row| there[row * w..(row + 1) * w].iter().any(|share| *share > 0.5));
    let (Some(top), bottom) = (rows.next(), rows.next_back().unwrap_or(0)) else { return found };
    let chin = top + (HEAD.0 * bottom.saturating_sub(top) as f32) as usize;
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
                let times = if row < chin { HEAD.1 } else { 1.0 };
                found.push(([row + CELL / 2, column + CELL / 2], times * (relief.min(MOST) + LEAST)));
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A plane with a bump.
    #[test]
    fn windows_show_details() {
        let (h, w) = (320, 260);
        let is_inside = |i: usize| (40..240).contains(&(i % w)) && (20..300).contains(&(i / w));
        let inside: Vec<f32> = (0..h * w).map(|i| f32::from(u8::from(is_inside(i)))).collect();
        let bump = |i: usize| {
            let (x, y) = ((i % w) as f32 - 120.0, (i / w) as f32 - 200.0);
            0.01 * (-(x * x + y * y) / 72.0).exp()
        };
        let found: Vec<f32> = (0..h * w).map(|i| if is_inside(i) { bump(i) } else { 0.0 }).collect();
        let cells = cells(&found, &inside, w);
        let weight = |x: usize, y: usize| {
            let middle = [y / CELL * CELL + CELL / 2, x / CELL * CELL + CELL / 2];
            cells.iter().find(|(place, _)| *place == middle).map(|(_, weight)| *weight)
        };
        assert_eq!(weight(0, 0), None);
        // The head counts more often, then the bump.
        assert!(weight(120, 40).is_some_and(|head| (head - HEAD.1 * LEAST).abs() < 1e-5));
        assert!(weight(120, 200) > weight(60, 280).map(|plain| 2.0 * plain));
        let mut random = stream("a test of windows");
        let places: Vec<_> = (0..200).flat_map(|_| draw(&cells, [h, w], 2, &mut random)).collect();
        assert!(places.iter().all(|[row, column]| row % 2 == 0 && row + SIDE <= h && column + SIDE <= w));
        let of_head = places.iter().filter(|[row, _]| *row < 20).count() as f64 / places.len() as f64;
        assert!((0.4..0.9).contains(&of_head), "{of_head}");
        // Smaller pictures, and pictures of nobody.
        assert_eq!(draw(&cells, [64, 64], 2, &mut random), [[0; 2]; WINDOWS]);
        assert_eq!(draw(&[], [h, w], 2, &mut random), [[0; 2]; WINDOWS]);
    }
}
