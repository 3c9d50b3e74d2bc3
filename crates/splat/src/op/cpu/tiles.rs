//! The splats of each tile, front to back.

use rayon::prelude::*;

use super::super::job::Job;
use super::super::splat::{tiles_in_row, tiles_of};
use super::splats::Visible;
use crate::SplatError;

/// Splats per task.
const CHUNK: usize = 4096;

/// Largest number of entries in all lists: 2 GiB, and 2 GiB more while the lists are built.
const MAX_ENTRIES: u64 = 1 << 29;
/// Largest number of entries with gradients, whose records take 40 bytes per entry.
const MAX_KEPT: u64 = 1 << 28;

/// One list of splats per tile, one after the other in one array, tiles row by row.
#[derive(Debug, Default)]
pub struct Lists {
    /// Splat of each entry.
    pub entries: Vec<u32>,
    /// Start of each tile's list in `entries`, then the length of `entries`.
    pub starts: Vec<u32>,
    /// Indices into `entries` of each splat's entries, splat by splat. Empty without gradients.
    pub places: Vec<u32>,
    /// Start of each splat's part of `places`, then the length of `places`. Empty without gradients.
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

/// The lists of all tiles for `splats`, which are ordered front to back.
///
/// # Errors
/// [`SplatError::TooManyIntersections`] beyond [`MAX_ENTRIES`], [`MAX_KEPT`] or the job's own limit.
pub fn lists(splats: &[Visible], job: &Job, keep_places: bool) -> Result<Lists, SplatError> {
    let limit = if keep_places { MAX_KEPT } else { MAX_ENTRIES }.min(job.options.max_intersections);
    let found = splats.iter().map(|splat| u64::from(splat.tiles)).sum();
    if found > limit {
        return Err(SplatError::TooManyIntersections { found, limit });
    }
    let uniforms = job.uniforms(splats.len());
    // Per task: the tiles of its splats in order.
    let chunks: Vec<Vec<u32>> = splats
        .par_chunks(CHUNK)
        .map(|splats| {
            let mut tiles = Vec::with_capacity(splats.iter().map(|splat| splat.tiles as usize).sum());
            for splat in splats {
                let rows = tiles_of(&splat.rows);
                for y in rows.first..rows.end {
                    let row = tiles_in_row(&splat.splat, y, &uniforms);
                    tiles.extend((row.first..row.end).map(|x| y * uniforms.tiles_x + x));
                }
            }
            tiles
        })
        .collect();
    let total = found as usize;

    let mut starts = vec![0_u32; job.tiles_x() * job.tiles_y() + 1];
    for tiles in &chunks {
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
    let mut tiles = chunks.iter().flatten();
    for (index, splat) in (0..).zip(splats) {
        if keep_places {
            lists.first_place.push(lists.places.len() as u32);
        }
        for &tile in tiles.by_ref().take(splat.tiles as usize) {
            let place = next[tile as usize];
            next[tile as usize] += 1;
            lists.entries[place as usize] = index;
            if keep_places {
                lists.places.push(place);
            }
        }
    }
    if keep_places {
        lists.first_place.push(lists.places.len() as u32);
    }
    lists.starts = starts;
    Ok(lists)
}
