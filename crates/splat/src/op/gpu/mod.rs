//! The splatting operation as CubeCL kernels: the same source for WGSL, SPIR-V, Metal and CUDA.
//!
//! 1. Project every Gaussian into every view, cull, count the tiles that each splat reaches.
//! 2. Sort the splats of all views by depth, sum up their tile counts, read the counts back (the only read-back).
//! 3. Write one intersection per splat and tile, in depth order, and sort these by tile; the sort is stable, so each
//!    tile's list is front to back.
//! 4. Blend, one cube per tile.
//!
//! Backward: the cube of a tile writes one record of sums per intersection; then each Gaussian adds up its own records,
//! which lie side by side, and applies the VJP of its projection.

mod backward;
mod blend;
mod buffers;
mod project;
mod scan;
mod sort;
#[cfg(test)]
mod tests;

use std::sync::Arc;

use burn::backend::TensorMetadata;
use burn::backend::ops::FloatTensorOps;
use burn::backend::tensor::Device;
use burn::tensor::{DType, FloatDType, Shape, Slice};
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::ops::into_data_sync;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

use super::gradient::Record;
use super::inputs::{Inputs, Upstream, Wanted};
use super::job::{Counts, Job};
use super::splat::{FATES, SPLAT, UniformsLaunch};
use super::{CHANNELS, Forward, SplatBackend, SplatInputs, SplatKernels, SplatOutput, splat_untracked};
use crate::SplatError;
use blend::TileListsLaunch;
use buffers::{Buffers, arg};
use project::{ParametersLaunch, REACH, STATISTICS};

/// Units of a cube where each unit has work of its own.
const UNITS: u32 = 256;
/// Most numbers in a record of the backward pass.
const RECORD: u64 = 10;

/// Values that the backward pass needs.
#[derive(Debug, Clone)]
pub struct State {
    views: CubeTensor,
    splats: CubeTensor,
    reach: CubeTensor,
    lists: Lists,
    transmittance: CubeTensor,
    last: CubeTensor,
}

/// One list of splats per tile and view, one after the other.
#[derive(Debug, Clone)]
struct Lists {
    /// Splat of each entry.
    entries: CubeTensor,
    /// Number of each entry's intersection, in the order in which `emit` writes the intersections.
    slots: CubeTensor,
    starts: CubeTensor,
    ends: CubeTensor,
    len: usize,
}

impl Lists {
    fn launch(&self) -> TileListsLaunch {
        TileListsLaunch::new(arg(&self.entries), arg(&self.starts), arg(&self.ends))
    }
}

impl SplatBackend for CubeBackend {
    fn splat(inputs: SplatInputs<Self>, job: Arc<Job>) -> SplatOutput<Self> {
        splat_untracked(inputs.tensors(), &job)
    }
}

impl SplatKernels for CubeBackend {
    type State = State;

    fn forward(inputs: &Inputs<CubeTensor>, job: &Job, keep: bool) -> Forward<Self> {
        let buffers = Buffers::of(&inputs.means);
        let scene = Scene::of(inputs, &buffers);
        let views = buffers.upload(bytemuck::cast_slice(&job.views), DType::F32);
        let (splats, reach, lists, counts) = lists(&buffers, &scene, &views, job, keep)?;

        let shape = [job.views.len(), job.height, job.width, job.channels()];
        buffers.check("the image", shape.iter().product())?;
        let image = buffers.empty(shape, DType::F32);
        let kept = if keep { job.views.len() * job.height * job.width } else { 1 };
        let (transmittance, last) = (buffers.f32(kept), buffers.u32(kept));
        let all_tiles = job.views.len() * job.tiles_x() * job.tiles_y();
        blend::blend::launch(
            &buffers.client,
            buffers.cubes(all_tiles),
            CubeDim::new_1d(blend::UNITS as u32),
            arg(&splats),
            arg(&scene.inputs.colors),
            lists.launch(),
            arg(&image),
            arg(&transmittance),
            arg(&last),
            scene.uniforms(job),
            job.options.depth,
            keep,
        );
        let state = State { views, splats, reach, lists, transmittance, last };
        Ok((image, keep.then_some(state), counts))
    }

    fn backward(
        inputs: &Inputs<CubeTensor>,
        job: &Job,
        state: &State,
        upstream: Upstream<CubeTensor>,
        wanted: Wanted,
    ) -> Inputs<Option<CubeTensor>> {
        let buffers = Buffers::of(&inputs.means);
        let scene = Scene::of(inputs, &buffers);
        let upstream = whole(upstream, job, &buffers.device);
        let gradients = inputs.as_ref().with(wanted, |input, wanted| wanted.then(|| like(input, &buffers)));
        let record = Record::new(wanted, job);
        if record.len() > 0 && scene.len > 0 {
            // One record of sums per intersection.
            let records = buffers.f32(state.lists.len * record.len());
            let all_tiles = job.tiles_x() * job.tiles_y() * job.views.len();
            backward::pixels::launch(
                &buffers.client,
                buffers.cubes(all_tiles),
                CubeDim::new_1d(blend::UNITS as u32),
                arg(&state.splats),
                arg(&scene.inputs.colors),
                state.lists.launch(),
                arg(&state.lists.slots),
                arg(&state.transmittance),
                arg(&state.last),
                upstream.into_buffer_arg(),
                arg(&records),
                scene.uniforms(job),
                job.options.depth,
                record,
            );
            let unused = |tensor: &Option<CubeTensor>| {
                tensor.clone().unwrap_or_else(|| buffers.f32(1)).into_buffer_arg()
            };
            backward::gather::launch(
                &buffers.client,
                buffers.cubes(scene.len.div_ceil(UNITS as usize)),
                CubeDim::new_1d(UNITS),
                scene.parameters(),
                arg(&state.views),
                arg(&state.reach),
                records.into_buffer_arg(),
                unused(&gradients.means),
                unused(&gradients.rotations),
                unused(&gradients.scales),
                unused(&gradients.opacities),
                unused(&gradients.colors),
                scene.uniforms(job),
                job.options.antialiased,
                record,
                wanted,
            );
        }
        gradients
    }
}

/// ∂L/∂image `[V,H,W,C]`: the gradients of all outputs, 0 for outputs without a gradient.
fn whole(upstream: Upstream<CubeTensor>, job: &Job, device: &Device<CubeBackend>) -> CubeTensor {
    let shape = Shape::new([job.views.len(), job.height, job.width, job.channels()]);
    let Upstream { color, alpha, depth } = upstream;
    let mut image = CubeBackend::float_zeros(shape, device, FloatDType::F32);
    for (part, range) in [color, alpha, depth].into_iter().zip(CHANNELS) {
        if let Some(part) = part {
            let full = Slice::from(..);
            let place = [full, full, full, Slice::from(range)];
            image = CubeBackend::float_slice_assign(image, &place, part);
        }
    }
    into_contiguous(image)
}

/// A tensor for the gradient of `input`. Its shape may be empty; the buffer has at least one number, as kernels
/// require.
fn like(input: &CubeTensor, buffers: &Buffers) -> CubeTensor {
    let shape = input.shape();
    let CubeTensor { client, device, handle, .. } = buffers.f32(shape.num_elements());
    CubeTensor::new_contiguous(client, device, shape, handle, DType::F32)
}

/// Contiguous inputs, and the number of Gaussians. Without Gaussians each buffer has one number, which is not read.
struct Scene {
    inputs: Inputs<CubeTensor>,
    len: usize,
}

impl Scene {
    fn of(inputs: &Inputs<CubeTensor>, buffers: &Buffers) -> Self {
        let len = inputs.opacities.meta.num_elements();
        let contiguous = |tensor: &CubeTensor| {
            if len == 0 { buffers.f32(1) } else { into_contiguous(tensor.clone()) }
        };
        Self { inputs: inputs.as_ref().map(contiguous), len }
    }

    fn parameters(&self) -> ParametersLaunch {
        let Inputs { means, rotations, scales, opacities, .. } = &self.inputs;
        ParametersLaunch::new(arg(means), arg(rotations), arg(scales), arg(opacities))
    }

    fn uniforms(&self, job: &Job) -> UniformsLaunch {
        // Kernels divide by the number of Gaussians.
        let u = job.uniforms(self.len.max(1));
        UniformsLaunch::new(u.n, u.views, u.width, u.height, u.tiles_x, u.tiles, u.near, u.blur, u.max_alpha)
    }
}

/// Steps 1 to 3: splats, their reach, the tiles' lists, and the counts.
fn lists(
    buffers: &Buffers,
    scene: &Scene,
    views: &CubeTensor,
    job: &Job,
    keep: bool,
) -> Result<(CubeTensor, CubeTensor, Lists, Counts), SplatError> {
    let (n, tiles) = (scene.len, job.tiles_x() * job.tiles_y());
    let total = n * job.views.len();
    let all_tiles = tiles * job.views.len();
    let (client, dim) = (&buffers.client, CubeDim::new_1d(UNITS));
    let one_each = |n: usize| buffers.cubes(n.div_ceil(UNITS as usize));
    // The largest array has one record of the backward pass, or one number, per intersection.
    let numbers = if keep { RECORD } else { 1 };
    let limit = (buffers.largest() / 4).min(u32::MAX.into()) / numbers;

    buffers.check("the list of splats", total.saturating_mul(SPLAT))?;
    buffers.check("the list of tiles", all_tiles.saturating_add(1))?;
    let splats = buffers.f32(total * SPLAT);
    let reach = buffers.u32(total * REACH);
    let keys = buffers.u32(total);
    let statistics = buffers.zeros(STATISTICS);
    // One more for the tile that does not exist (see `emit`).
    let (starts, ends) = (buffers.zeros(all_tiles + 1), buffers.zeros(all_tiles + 1));
    if total == 0 {
        let lists = Lists { entries: buffers.u32(1), slots: buffers.u32(1), starts, ends, len: 0 };
        return Ok((splats, reach, lists, Counts::default()));
    }
    project::project_all::launch(
        client,
        one_each(total),
        dim,
        scene.parameters(),
        arg(&scene.inputs.colors),
        arg(views),
        arg(&splats),
        arg(&reach),
        arg(&keys),
        arg(&statistics),
        scene.uniforms(job),
        job.options.antialiased,
    );
    let (_, order) = sort::sort(buffers, keys, total, u32::BITS);
    let sorted = buffers.u32(total);
    project::sort_counts::launch(client, one_each(total), dim, arg(&reach), arg(&order), arg(&sorted), total);
    let offsets = scan::exclusive_sum(buffers, &sorted, total);
    let s: Vec<u32> = into_data_sync(statistics).try_into_vec().expect("u32 as allocated");
    let [low, middle, high] = [0, 1, 2].map(|limb| u64::from(s[FATES + limb]));
    let found = low + (middle << 10) + (high << 20);
    let limit = limit.min(job.options.max_intersections.saturating_mul(job.views.len() as u64));
    if found > limit {
        return Err(SplatError::TooManyIntersections { found, limit });
    }
    let counts = Counts::new(std::array::from_fn(|fate| u64::from(s[fate])), found);

    let len = found as usize;
    let (tile_of, splat_of) = (buffers.u32(len), buffers.u32(len));
    let entries = buffers.u32(len);
    if len == 0 {
        let lists = Lists { entries, slots: splat_of, starts, ends, len };
        return Ok((splats, reach, lists, counts));
    }
    project::emit::launch(
        client,
        one_each(total),
        dim,
        arg(&splats),
        order.into_buffer_arg(),
        offsets.into_buffer_arg(),
        arg(&reach),
        arg(&tile_of),
        arg(&splat_of),
        scene.uniforms(job),
    );
    let bits = usize::BITS - all_tiles.leading_zeros();
    let (sorted_tiles, slots) = sort::sort(buffers, tile_of, len, bits);
    project::lists::launch(
        client,
        one_each(len),
        dim,
        sorted_tiles.into_buffer_arg(),
        arg(&slots),
        splat_of.into_buffer_arg(),
        arg(&entries),
        arg(&starts),
        arg(&ends),
        len,
    );
    Ok((splats, reach, Lists { entries, slots, starts, ends, len }, counts))
}
