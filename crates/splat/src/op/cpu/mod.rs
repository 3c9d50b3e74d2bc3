//! The splatting operation on the CPU: all cores through rayon, pixels in SIMD rows.
//!
//! A view goes through four steps: project every Gaussian ([`splats`]), order what is visible by depth, hand each
//! 16×16 tile the list of splats whose ellipse reaches one of its pixels ([`tiles`]), and blend tile by tile
//! ([`blend`]). Empty tiles have empty lists and cost nothing but the writing of their pixels. The backward pass walks
//! the same lists from the back ([`mod@backward`]).
//!
//! Whatever is shared out among threads is joined again in a fixed order, so results do not depend on their number.

#![allow(
    clippy::needless_range_loop,
    reason = "the same index walks several arrays; SIMD wants the plain loop"
)]

mod backward;
mod blend;
mod lanes;
mod splats;
mod tiles;

use super::job::{Counts, Job};
use crate::SplatError;

pub(super) use backward::{Gradients, backward};

/// The Gaussians of a call as contiguous f32 slices: `[N,3]`, `[N,4]`, `[N,3]`, `[N]`, `[N,3]`, `[3]`.
#[derive(Clone, Copy)]
pub struct Scene<'a> {
    pub means: &'a [f32],
    pub rotations: &'a [f32],
    pub scales: &'a [f32],
    pub opacities: &'a [f32],
    pub colors: &'a [f32],
    pub background: &'a [f32],
}

impl Scene<'_> {
    fn len(&self) -> usize {
        self.opacities.len()
    }

    fn background(&self) -> [f32; 3] {
        self.background.try_into().expect("`render` checks its shape")
    }
}

/// What the backward pass needs of each view.
#[derive(Debug, Default)]
pub struct State {
    views: Vec<ViewState>,
}

#[derive(Debug)]
struct ViewState {
    /// Visible splats, front to back.
    splats: Vec<splats::Splat>,
    lists: tiles::Lists,
    /// `[H,W]` transmittance behind the last splat.
    transmittance: Vec<f32>,
    /// `[H,W]` one more than the index, in the tile's list, of the last splat that the pixel took; 0 for none.
    last: Vec<u32>,
}

/// Renders all views of `job`: image `[V,H,W,C]`, what the backward pass needs (where `keep`), counts.
pub fn forward(scene: Scene, job: &Job, keep: bool) -> Result<(Vec<f32>, State, Counts), SplatError> {
    let pixels = job.width * job.height;
    let channels = job.channels();
    let mut image = Vec::new();
    let mut state = State::default();
    let mut counts = Counts::default();
    for (index, view) in job.views.iter().enumerate() {
        let splats = splats::visible(scene, view, job, &mut counts);
        let lists = tiles::lists(&splats, job, keep)?;
        if image.is_empty() {
            image = zeros("the image", job.views.len() * pixels * channels)?;
        }
        counts.intersections += lists.len() as u64;
        let kept = if keep { pixels } else { 0 };
        let transmittance = zeros("the state of all pixels", kept)?;
        let mut view = ViewState { splats, lists, transmittance, last: vec![0; kept] };
        let out = &mut image[index * pixels * channels..][..pixels * channels];
        blend::blend(&mut view, scene.background(), job, out);
        if keep {
            state.views.push(view);
        }
    }
    Ok((image, state, counts))
}

/// So many zeros, or an error where the system refuses the memory.
fn zeros(what: &'static str, n: usize) -> Result<Vec<f32>, SplatError> {
    // Asked for and given back: `vec!` gets its zeros from the system, page by page when they are first touched, but ends
    // the process where it gets none.
    let mut probe = Vec::<f32>::new();
    let bytes = (n as u64).saturating_mul(4);
    probe.try_reserve_exact(n).map_err(|_| SplatError::Memory { what, bytes })?;
    drop(probe);
    Ok(vec![0.0; n])
}
