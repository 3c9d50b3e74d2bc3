//! The splatting operation on the CPU: all cores through rayon, pixels in SIMD rows.
//!
//! A view takes four steps: project every Gaussian ([`splats`]), sort the visible ones by depth, list for each 16×16
//! tile the splats whose ellipse reaches one of its pixels ([`tiles`]), and blend tile by tile ([`blend`]). Empty tiles
//! only cost the writing of their pixels. The backward pass visits the same lists back to front ([`mod@backward`]).
//!
//! Results of tasks are joined in a fixed order, so the output does not depend on the number of threads.

#![allow(
    clippy::needless_range_loop,
    reason = "the same index walks several arrays; SIMD wants the plain loop"
)]

mod backward;
mod blend;
mod lanes;
mod splats;
mod tiles;

use super::inputs::Inputs;
use super::job::{Counts, Job};
use super::splat::{FATES, Gaussian, gaussian};
use crate::SplatError;

pub(super) use backward::backward;

/// The Gaussians of a call as contiguous f32 slices: `[N,3]`, `[N,4]`, `[N,3]`, `[N]`, `[N,3]`.
pub type Scene<'a> = Inputs<&'a [f32]>;

impl Scene<'_> {
    fn len(&self) -> usize {
        self.opacities.len()
    }

    fn gaussian(&self, g: usize) -> Gaussian {
        gaussian(self.means, self.rotations, self.scales, self.opacities, g)
    }
}

/// The values of each view for the backward pass.
#[derive(Debug, Default)]
pub struct State {
    views: Vec<ViewState>,
}

#[derive(Debug)]
struct ViewState {
    /// Visible splats, front to back.
    splats: Vec<splats::Visible>,
    lists: tiles::Lists,
    /// `[H,W]` transmittance behind the last splat; 0 in tiles without splats.
    transmittance: Vec<f32>,
    /// `[H,W]` one more than the index, in the tile's list, of the last splat that the pixel took; 0 for none.
    last: Vec<u32>,
}

/// Renders all views of `job`: image `[V,H,W,C]`, the state for the backward pass (with `keep`), counts.
pub fn forward(scene: Scene, job: &Job, keep: bool) -> Result<(Vec<f32>, State, Counts), SplatError> {
    let pixels = job.width * job.height;
    let channels = job.channels();
    let mut image = Vec::new();
    let mut state = State::default();
    let (mut fates, mut intersections) = ([0; FATES], 0);
    for (index, view) in job.views.iter().enumerate() {
        let splats = splats::visible(scene, view, job, &mut fates);
        let lists = tiles::lists(&splats, job, keep)?;
        if image.is_empty() {
            image = zeros("the image", job.views.len() * pixels * channels)?;
        }
        intersections += lists.len() as u64;
        let kept = if keep { pixels } else { 0 };
        let transmittance = zeros("the state of all pixels", kept)?;
        let mut view = ViewState { splats, lists, transmittance, last: vec![0; kept] };
        let out = &mut image[index * pixels * channels..][..pixels * channels];
        blend::blend(&mut view, job, out);
        if keep {
            state.views.push(view);
        }
    }
    Ok((image, state, Counts::new(fates, intersections)))
}

/// `n` zeros, or an error if the system refuses the memory.
fn zeros(what: &'static str, n: usize) -> Result<Vec<f32>, SplatError> {
    // A trial allocation, since `vec!` aborts the process if it gets no memory. `vec!` is still used for the result:
    // its zeros come from the system, page by page when they are first touched.
    let mut probe = Vec::<f32>::new();
    let bytes = (n as u64).saturating_mul(4);
    probe.try_reserve_exact(n).map_err(|_| SplatError::Memory { what, bytes })?;
    drop(probe);
    Ok(vec![0.0; n])
}
