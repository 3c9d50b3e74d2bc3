//! Which splats each tile must look at, front to back.

use rayon::prelude::*;

use super::super::job::Job;
use super::splats::Splat;
use crate::SplatError;
use crate::options::TILE;
use crate::vjp::least_form;

/// Splats per task.
const CHUNK: usize = 4096;

/// One list of splats per tile, back to back in one array, tiles row by row.
#[derive(Debug, Default)]
pub struct Lists {
    /// Splat of each entry.
    pub entries: Vec<u32>,
    /// Where each tile's list starts in `entries`, and at last its length.
    pub starts: Vec<u32>,
    /// Where in `entries` the entries of a splat went, splat by splat. Empty where no gradient is wanted.
    pub places: Vec<u32>,
    /// Where each splat's places start in `places`, and at last their number. Empty where no gradient is wanted.
    pub first_place: Vec<u32>,
}

impl Lists {
    /// Number of pairs of a splat and a tile.
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// The splats of a tile, front to back.
    pub fn tile(&self, tile: usize) -> &[u32] {
        &self.entries[self.starts[tile] as usize..self.starts[tile + 1] as usize]
    }
}

/// Calls `found` with every tile in which a pixel centre may lie inside the splat's ellipse, until that returns false.
#[inline]
fn for_each_tile(splat: &Splat, job: &Job, mut found: impl FnMut(u32) -> bool) {
    let [x0, x1] = splat.columns.map(|x| usize::from(x) / TILE);
    let [y0, y1] = splat.rows.map(|y| usize::from(y) / TILE);
    let alone = x0 == x1 && y0 == y1;
    // Pixel centres of a tile along one axis, relative to the splat.
    let span = |tile: usize, side: usize, centre: f32| {
        let (first, last) = (tile * TILE, (tile * TILE + TILE - 1).min(side - 1));
        (first as f32 + 0.5 - centre, last as f32 + 0.5 - centre)
    };
    for y in y0..=y1 {
        let (top, bottom) = span(y, job.height, splat.v);
        for x in x0..=x1 {
            let (left, right) = span(x, job.width, splat.u);
            let inside = alone
                || least_form(splat.l0, splat.k, splat.l1, left, right, top, bottom) <= splat.radius_squared;
            if inside && !found((y * job.tiles_x() + x) as u32) {
                return;
            }
        }
    }
}

/// At least as many tiles as the splat reaches.
fn bound(splat: &Splat) -> u64 {
    let tiles = |[first, last]: [u16; 2]| u64::from(last) / TILE as u64 - u64::from(first) / TILE as u64 + 1;
    tiles(splat.columns) * tiles(splat.rows)
}

/// Whether the splat is in any tile's list.
pub fn reaches_a_tile(splat: &Splat, job: &Job) -> bool {
    let mut reached = false;
    for_each_tile(splat, job, |_| {
        reached = true;
        false
    });
    reached
}

/// The lists of all tiles for `splats`, which are ordered front to back.
///
/// # Errors
/// [`SplatError::TooManyIntersections`] beyond 2³¹ entries.
pub fn lists(splats: &[Splat], job: &Job, keep_places: bool) -> Result<Lists, SplatError> {
    // Counted before anything is stored, where it could be too much.
    let limit = i32::MAX as u64;
    if splats.iter().map(bound).sum::<u64>() > limit {
        let count = |splat: &Splat| {
            let mut count = 0_u64;
            for_each_tile(splat, job, |_| {
                count += 1;
                true
            });
            count
        };
        let found = splats.par_iter().map(count).sum();
        if found > limit {
            return Err(SplatError::TooManyIntersections { found, limit });
        }
    }
    // Per task: the tiles of its splats in order, and how many each splat has.
    let chunks: Vec<(Vec<u32>, Vec<u32>)> = splats
        .par_chunks(CHUNK)
        .map(|splats| {
            let mut tiles = Vec::with_capacity(3 * splats.len());
            let mut counts = Vec::with_capacity(splats.len());
            for splat in splats {
                let before = tiles.len();
                for_each_tile(splat, job, |tile| {
                    tiles.push(tile);
                    true
                });
                counts.push((tiles.len() - before) as u32);
            }
            (tiles, counts)
        })
        .collect();
    let total: usize = chunks.iter().map(|(tiles, _)| tiles.len()).sum();

    let mut starts = vec![0_u32; job.tiles_x() * job.tiles_y() + 1];
    for (tiles, _) in &chunks {
        for &tile in tiles {
            starts[tile as usize + 1] += 1;
        }
    }
    for tile in 1..starts.len() {
        starts[tile] += starts[tile - 1];
    }

    let mut next = starts.clone();
    let mut lists = Lists { entries: vec![0; total], ..Lists::default() };
    if keep_places {
        lists.places = Vec::with_capacity(total);
        lists.first_place = Vec::with_capacity(splats.len() + 1);
    }
    let mut splat = 0;
    for (tiles, counts) in &chunks {
        let mut tiles = tiles.iter();
        for &count in counts {
            if keep_places {
                lists.first_place.push(lists.places.len() as u32);
            }
            for &tile in tiles.by_ref().take(count as usize) {
                let place = next[tile as usize];
                next[tile as usize] += 1;
                lists.entries[place as usize] = splat;
                if keep_places {
                    lists.places.push(place);
                }
            }
            splat += 1;
        }
    }
    if keep_places {
        lists.first_place.push(lists.places.len() as u32);
    }
    lists.starts = starts;
    Ok(lists)
}
