//! Which points of a body lie on its closed surface, and which hang off it: the distance field of a mesh, only near the
//! points, from fewer and smaller pictures.

use std::collections::HashMap;

use glam::Vec3;
use rayon::prelude::*;

use super::grid::Grid;
use super::views::{self, FILLED, View};
use super::{FEWEST, LENGTHS, MARGIN, SMOOTHED, THICKNESS, TRUNCATION, distances, upper_end};

/// Rings of cameras: downward pitch in degrees, and number of cameras.
const RINGS: [(f64, usize); 4] = [(-50.0, 4), (-10.0, 8), (20.0, 8), (60.0, 4)];
/// Side in pixels of the pictures for distances.
const SIDE: u32 = 400;
/// Largest distance of a point from a corner at the surface, in cubes.
const NEAR: f32 = 2.0;
/// Corners up to this distance along each axis from a point have a distance, in cubes.
const BAND: usize = 2;
/// Distance of the points from the border of the field, in cubes: corners around a point have neighbours.
const BORDER: usize = BAND + 1;
/// Least share of the body's points in a piece that stays.
const PIECE: f64 = 0.01;

/// Whether points (metres) that lie some `spacing` apart on a body's surface are on its closed surface. Points that
/// hang off it, such as frays of a hem, and small pieces that float are not.
pub fn on_body(places: &[Vec3], spacing: f32) -> Vec<bool> {
    let Some((centre, size)) = body(places) else { return vec![true; places.len()] };
    let mut grid = Grid::around(size, BORDER as f32);
    let radius = f64::from(0.5 * size.length());
    let points: Vec<Vec3> = places.iter().map(|place| *place - centre).collect();
    let pixel = 2.0 * radius / (FILLED * f64::from(SIDE));
    let covered = (f64::from(spacing) / pixel).round() as usize;
    let cameras = views::cameras(&RINGS, radius, SIDE).into_par_iter();
    let mut views: Vec<View> = cameras.map(|camera| View::of_points(&points, camera, covered)).collect();
    views::distrust_inner_sides(&mut views, THICKNESS * grid.cell);

    let corners: Vec<Option<usize>> = points.iter().map(|place| grid.nearest(*place, BORDER)).collect();
    let near = fill(&mut grid, &corners, &views);
    for _ in 0..SMOOTHED {
        let smoothed: Vec<f32> = near.par_iter().map(|row| grid.smoothed(*row)).collect();
        near.iter().zip(smoothed).for_each(|(row, value)| grid.values[*row] = value);
    }
    let mut surface = vec![false; grid.values.len()];
    let found: Vec<usize> = near.into_par_iter().filter(|row| grid.is_at_surface(*row)).collect();
    found.iter().for_each(|row| surface[*row] = true);
    let of_point = |(place, corner): (&Vec3, &Option<usize>)| {
        let is_near = |row: &usize| surface[*row] && grid.place(*row).distance(*place) <= NEAR * grid.cell;
        (1..=BAND).find_map(|reach| grid.around_corner((*corner)?, reach).find(is_near))
    };
    let of_points: Vec<Option<usize>> = points.par_iter().zip(&corners).map(of_point).collect();

    let pieces = pieces(&grid, &surface, &found);
    let mut sizes = HashMap::new();
    of_points.iter().flatten().for_each(|row| *sizes.entry(pieces[*row]).or_insert(0_usize) += 1);
    let least = PIECE * places.len() as f64;
    of_points.iter().map(|row| row.is_some_and(|row| sizes[&pieces[row]] as f64 >= least)).collect()
}

/// Centre and size of the box of the points, metres, without outliers. `None` for what is no body.
fn body(places: &[Vec3]) -> Option<(Vec3, Vec3)> {
    if places.len() < FEWEST {
        return None;
    }
    let end = |place: &dyn Fn(&Vec3) -> f32| upper_end(places.iter().map(place));
    let (mut low, mut high) = (Vec3::ZERO, Vec3::ZERO);
    for axis in 0..3 {
        (low[axis], high[axis]) = (-end(&|p| -p[axis]), end(&|p| p[axis]));
    }
    let size = high - low;
    let longest = size.max_element();
    LENGTHS.contains(&longest).then(|| (low + 0.5 * size, size + 2.0 * MARGIN * longest))
}

/// Fills the grid with distances from the surface and returns the corners near the points' `corners`. Only they are
/// computed. Between them, corners of a line along x have the sign of the corner before.
fn fill(grid: &mut Grid, corners: &[Option<usize>], views: &[View]) -> Vec<usize> {
    let reach = TRUNCATION * grid.cell;
    let [_, line, sheet] = grid.strides();
    let mut is_near = vec![false; grid.counts.element_product()];
    let mut is_seen = is_near.clone();
    for corner in corners.iter().flatten() {
        if !std::mem::replace(&mut is_seen[*corner], true) {
            grid.around_corner(*corner, BAND).for_each(|row| is_near[row] = true);
        }
    }
    let near: Vec<usize> = (0..is_near.len()).filter(|row| is_near[*row]).collect();
    let sheets: Vec<&[usize]> = near.chunk_by(|a, b| a / sheet == b / sheet).collect();
    let found: Vec<f32> = sheets.par_iter().flat_map_iter(|rows| distances(grid, rows, views)).collect();
    grid.values = vec![reach; is_near.len()];
    near.iter().zip(found).for_each(|(row, distance)| grid.values[*row] = distance);
    for pair in near.windows(2).filter(|pair| pair[0] / line == pair[1] / line) {
        let before = grid.values[pair[0]];
        grid.values[pair[0] + 1..pair[1]].fill(reach.copysign(before));
    }
    near
}

/// The number of the connected piece of every corner at the surface; 0 elsewhere.
fn pieces(grid: &Grid, is_surface: &[bool], surface: &[usize]) -> Vec<u32> {
    let mut pieces = vec![0; is_surface.len()];
    let (mut waiting, mut count) = (Vec::new(), 0);
    for first in surface {
        if pieces[*first] > 0 {
            continue;
        }
        count += 1;
        pieces[*first] = count;
        waiting.push(*first);
        while let Some(row) = waiting.pop() {
            for next in grid.around_corner(row, 1).filter(|next| is_surface[*next]) {
                if std::mem::replace(&mut pieces[next], count) == 0 {
                    waiting.push(next);
                }
            }
        }
    }
    pieces
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points some `spacing` apart on an ellipsoid at `centre`.
    fn ellipsoid(centre: Vec3, radii: Vec3, spacing: f32) -> Vec<Vec3> {
        let rings = (std::f32::consts::PI * radii.max_element() / spacing) as usize;
        let ring = |i: usize| {
            let tilt = std::f32::consts::PI * (i as f32 + 0.5) / rings as f32;
            let count = (2.0 * rings as f32 * tilt.sin()).ceil() as usize;
            (0..count).map(move |j| {
                let turn = std::f32::consts::TAU * j as f32 / count as f32;
                centre + radii * Vec3::new(tilt.sin() * turn.cos(), tilt.cos(), tilt.sin() * turn.sin())
            })
        };
        (0..rings).flat_map(ring).collect()
    }

    /// A body with a hand beyond a narrow gap, a sheet that hangs off it, a bead that floats and points far away.
    #[test]
    fn frays_and_floating_pieces_are_not_on_the_body() {
        for spacing in [0.002, 0.008] {
            let trunk = ellipsoid(Vec3::ZERO, Vec3::new(0.2, 0.9, 0.15), spacing);
            let hand = ellipsoid(Vec3::new(0.27, 0.0, 0.0), Vec3::splat(0.06), spacing);
            let sheet = (0..100).flat_map(|i| {
                (0..20).map(move |j| Vec3::new(-0.23 - 0.002 * i as f32, 0.002 * j as f32, 0.0))
            });
            let bead = ellipsoid(Vec3::new(0.0, 0.0, 0.3), Vec3::splat(0.015), spacing);
            let far = [Vec3::splat(1e30), Vec3::new(0.0, -5.0, 0.0)];
            let groups: Vec<Vec<Vec3>> = vec![trunk, hand, sheet.collect(), bead, far.to_vec()];
            let found = on_body(&groups.concat(), spacing);
            let mut rest = found.as_slice();
            let shares = groups.iter().map(|group| {
                let (own, others) = rest.split_at(group.len());
                rest = others;
                own.iter().filter(|on| **on).count() as f32 / group.len() as f32
            });
            let shares: Vec<f32> = shares.collect();
            assert!(shares[0] > 0.99 && shares[1] > 0.95, "{spacing}: {shares:?}");
            assert_eq!(shares[3..], [0.0; 2], "{spacing}");
            // Where points are 8 mm apart, a sheet of 2 mm is thick.
            assert_eq!(shares[2], if spacing > 0.002 { 1.0 } else { 0.0 });
        }
    }

    #[test]
    fn what_has_no_body_does_no_harm() {
        for places in
            [vec![], vec![Vec3::ONE], vec![Vec3::ONE; 300], vec![Vec3::splat(1e30), Vec3::splat(-1e30)]]
        {
            assert_eq!(on_body(&places, 0.002).len(), places.len());
        }
    }
}
