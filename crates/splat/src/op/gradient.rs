//! Sums over the pixels of a splat, and which of them the backward pass keeps.

use cubecl::prelude::*;

use super::inputs::Wanted;
use super::job::Job;
use crate::linear::{Vec3, add3, load3};
use crate::projection::FootprintGradient;

/// The sums over pixels that the backward pass keeps of one intersection, in this order: colour (3), opacity (1),
/// geometry (5), depth (1). Unwanted sums have no place.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct Record {
    pub colors: bool,
    pub opacities: bool,
    pub geometry: bool,
    pub depth: bool,
}

impl Record {
    pub fn new(wanted: Wanted, job: &Job) -> Self {
        let (colors, geometry) = (wanted.colors, wanted.geometry());
        // The compensation of antialiasing carries the opacity's gradient on to the geometry.
        let opacities = wanted.opacities || (geometry && job.options.antialiased);
        Self { colors, opacities, geometry, depth: geometry && job.options.depth }
    }

    /// f32 per intersection.
    pub fn len(self) -> usize {
        self.depth_at() + usize::from(self.depth)
    }

    pub fn opacity_at(self) -> usize {
        3 * usize::from(self.colors)
    }

    pub fn geometry_at(self) -> usize {
        self.opacity_at() + usize::from(self.opacities)
    }

    pub fn depth_at(self) -> usize {
        self.geometry_at() + 5 * usize::from(self.geometry)
    }
}

/// Sums over the pixels of one splat. The backward pass keeps them for each intersection, as a [`Record`].
#[derive(CubeType, Clone, Copy, Debug)]
pub struct SplatGradient {
    /// ∂L/∂colour.
    pub color: Vec3,
    /// ∂L/∂opacity after antialiasing.
    pub opacity: f32,
    pub footprint: FootprintGradient,
}

#[cube]
impl SplatGradient {
    /// No gradient.
    pub fn zero() -> SplatGradient {
        SplatGradient {
            color: Vec3 { x: 0.0f32, y: 0.0f32, z: 0.0f32 },
            opacity: 0.0f32,
            footprint: FootprintGradient {
                r0: 0.0f32,
                r1: 0.0f32,
                s00: 0.0f32,
                s01: 0.0f32,
                s11: 0.0f32,
                depth: 0.0f32,
            },
        }
    }

    /// Adds the record that starts at index `at`.
    pub fn add(&mut self, records: &[f32], at: usize, #[comptime] record: Record) {
        if comptime!(record.colors) {
            add3(&mut self.color, &load3(records, at));
        }
        if comptime!(record.opacities) {
            self.opacity += records[at + comptime!(record.opacity_at())];
        }
        if comptime!(record.geometry) {
            let at = at + comptime!(record.geometry_at());
            self.footprint.r0 += records[at];
            self.footprint.r1 += records[at + 1];
            self.footprint.s00 += records[at + 2];
            self.footprint.s01 += records[at + 3];
            self.footprint.s11 += records[at + 4];
        }
        if comptime!(record.depth) {
            self.footprint.depth += records[at + comptime!(record.depth_at())];
        }
    }

    /// Writes a record from index `at` on, with `stride` from one number to the next.
    pub fn store(&self, out: &mut [f32], at: usize, #[comptime] stride: usize, #[comptime] record: Record) {
        if comptime!(record.colors) {
            out[at] = self.color.x;
            out[at + stride] = self.color.y;
            out[at + comptime!(2 * stride)] = self.color.z;
        }
        if comptime!(record.opacities) {
            out[at + comptime!(record.opacity_at() * stride)] = self.opacity;
        }
        if comptime!(record.geometry) {
            let at = at + comptime!(record.geometry_at() * stride);
            out[at] = self.footprint.r0;
            out[at + stride] = self.footprint.r1;
            out[at + comptime!(2 * stride)] = self.footprint.s00;
            out[at + comptime!(3 * stride)] = self.footprint.s01;
            out[at + comptime!(4 * stride)] = self.footprint.s11;
        }
        if comptime!(record.depth) {
            out[at + comptime!(record.depth_at() * stride)] = self.footprint.depth;
        }
    }
}
