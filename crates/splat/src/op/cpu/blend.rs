//! Front-to-back compositing of one view.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::super::job::Job;
use super::lanes::{BATCH, Lanes, fetch, row, rows};
use super::{ViewState, splats::Visible, tiles::Lists};
use crate::options::{MIN_ALPHA, MIN_TRANSMITTANCE, TILE};

/// Composites `view` over black into `image` `[H,W,C]`, which is zero before. If the buffers of `view` are not empty,
/// stores each pixel's final transmittance and last splat in them, but not for tiles without splats.
pub fn blend(view: &mut ViewState, job: &Job, image: &mut [f32]) {
    let band = TILE * job.width;
    let keep = !view.last.is_empty();
    let mut transmittance = view.transmittance.chunks_mut(band);
    let mut last = view.last.chunks_mut(band);
    let bands: Vec<Band> = image
        .chunks_mut(band * job.channels())
        .enumerate()
        .map(|(y, image)| Band {
            splats: &view.splats,
            lists: &view.lists,
            job,
            y,
            image,
            kept: keep.then(|| transmittance.next().zip(last.next())).flatten(),
        })
        .collect();
    let arch = Arch::new();
    bands.into_par_iter().for_each(|band| arch.dispatch(band));
}

/// One row of tiles.
struct Band<'a> {
    splats: &'a [Visible],
    lists: &'a Lists,
    job: &'a Job,
    /// Number of the row of tiles.
    y: usize,
    /// `[≤16,W,C]`.
    image: &'a mut [f32],
    /// `[≤16,W]` each.
    kept: Option<(&'a mut [f32], &'a mut [u32])>,
}

impl WithSimd for Band<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, _simd: S) {
        for x in 0..self.job.tiles_x() {
            let list = self.lists.tile(self.y * self.job.tiles_x() + x);
            if list.is_empty() {
                continue;
            }
            if self.job.options.depth {
                self.tile::<true>(x, list);
            } else {
                self.tile::<false>(x, list);
            }
        }
    }
}

/// A tile's pixels while splats are added to them.
struct Pixels {
    /// Transmittance; 0 once the pixel takes no more.
    open: [Lanes; TILE],
    /// Transmittance behind the last splat that the pixel took.
    transmittance: [Lanes; TILE],
    /// Red, green, blue, depth.
    sums: [[Lanes; TILE]; 4],
    last: [[u32; TILE]; TILE],
    /// Whether any pixel of the row still takes splats.
    alive: [bool; TILE],
}

impl Band<'_> {
    fn height(&self) -> usize {
        self.image.len() / (self.job.width * self.job.channels())
    }

    fn columns(&self, x: usize) -> usize {
        TILE.min(self.job.width - x * TILE)
    }

    #[inline(always)]
    fn tile<const DEPTH: bool>(&mut self, x: usize, list: &[u32]) {
        let (columns, height) = (self.columns(x), self.height());
        let mut p = Pixels {
            open: [[0.0; TILE]; TILE],
            transmittance: [[1.0; TILE]; TILE],
            sums: [[[0.0; TILE]; TILE]; 4],
            last: [[0; TILE]; TILE],
            alive: [false; TILE],
        };
        for y in 0..height {
            p.open[y][..columns].fill(1.0);
            p.alive[y] = true;
        }
        let mut rows_alive = height;
        let (left, top) = ((x * TILE) as f32, self.y * TILE);
        let max_alpha = self.job.options.max_alpha;
        let mut batch = [Visible::default(); BATCH];
        for (first, entries) in (0..).step_by(BATCH).zip(list.chunks(BATCH)) {
            fetch(self.splats, entries, &mut batch);
            for (n, splat) in (first + 1..).zip(&batch[..entries.len()]) {
                for y in rows(splat, top) {
                    if p.alive[y] && add::<DEPTH>(&mut p, splat, n, left, top, y, max_alpha) {
                        p.alive[y] = p.open[y].iter().any(|&t| t > 0.0);
                        rows_alive -= usize::from(!p.alive[y]);
                    }
                }
            }
            if rows_alive == 0 {
                break;
            }
        }
        self.write(&p, x);
    }

    #[inline(always)]
    fn write(&mut self, p: &Pixels, x: usize) {
        let (columns, channels) = (self.columns(x), self.job.channels());
        for y in 0..self.height() {
            let first = y * self.job.width + x * TILE;
            let pixels = &mut self.image[first * channels..(first + columns) * channels];
            for (i, pixel) in pixels.chunks_exact_mut(channels).enumerate() {
                for c in 0..3 {
                    pixel[c] = p.sums[c][y][i];
                }
                pixel[3] = 1.0 - p.transmittance[y][i];
                if let Some(depth) = pixel.get_mut(4) {
                    *depth = p.sums[3][y][i];
                }
            }
            if let Some((transmittance, last)) = &mut self.kept {
                transmittance[first..first + columns].copy_from_slice(&p.transmittance[y][..columns]);
                last[first..first + columns].copy_from_slice(&p.last[y][..columns]);
            }
        }
    }
}

/// Adds the splat, number `n` of the tile counted from 1, to row `y`. Returns whether it closed a pixel.
#[inline(always)]
fn add<const DEPTH: bool>(
    p: &mut Pixels,
    visible: &Visible,
    n: u32,
    left: f32,
    top: usize,
    y: usize,
    max_alpha: f32,
) -> bool {
    let row = row(&visible.splat, left, (top + y) as f32 + 0.5);
    let open = &mut p.open[y];
    let (transmittance, last) = (&mut p.transmittance[y], &mut p.last[y]);
    let mut weight = [0.0; TILE];
    let mut closed = 0_u32;
    for i in 0..TILE {
        let alpha = row.alpha[i].min(max_alpha);
        let t = open[i];
        let next = t * (1.0 - alpha);
        let hit = (alpha >= MIN_ALPHA) & (t > 0.0);
        let take = hit & (next >= MIN_TRANSMITTANCE);
        weight[i] = if take { alpha * t } else { 0.0 };
        transmittance[i] = if take { next } else { transmittance[i] };
        last[i] = if take { n } else { last[i] };
        let after = if take { next } else { 0.0 };
        open[i] = if hit { after } else { t };
        closed |= u32::from(hit & !take);
    }
    for c in 0..3 {
        let sum = &mut p.sums[c][y];
        for i in 0..TILE {
            sum[i] += weight[i] * visible.color[c];
        }
    }
    if DEPTH {
        let sum = &mut p.sums[3][y];
        for i in 0..TILE {
            sum[i] += weight[i] * visible.splat.depth;
        }
    }
    closed != 0
}
