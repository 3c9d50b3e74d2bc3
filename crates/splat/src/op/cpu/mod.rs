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

use super::job::{Counts, Job};
use super::splat::{FATES, Gaussian, gaussian};
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

    fn gaussian(&self, g: usize) -> Gaussian {
        gaussian(self.means, self.rotations, self.scales, self.opacities, g)
    }

    fn background(&self) -> [f32; 3] {
        self.background.try_into().expect("`render` checks its shape")
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
    /// `[H,W]` transmittance behind the last splat.
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
        blend::blend(&mut view, scene.background(), job, out);
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

#[cfg(test)]
mod tests {
    use super::super::Upstream;
    use super::super::job::Wanted;
    use super::*;
    use crate::{Camera, RenderOptions};

    const N: usize = 6000;
    const EVERYTHING: Wanted = Wanted {
        means: true,
        rotations: true,
        scales: true,
        opacities: true,
        colors: true,
        background: true,
    };

    /// Values in [0, 1).
    fn noise(n: usize, seed: u64) -> Vec<f32> {
        (0..n as u64).map(|i| ((i * 7919 + seed * 104_729 + 13) % 1009) as f32 / 1009.0).collect()
    }

    /// Image and gradients of 6,000 Gaussians in two views.
    fn pass(wanted: Wanted) -> (Vec<f32>, Gradients) {
        let means: Vec<f32> = noise(3 * N, 1).iter().map(|v| 1.2 * v - 0.2).collect();
        let scales: Vec<f32> = noise(3 * N, 2).iter().map(|v| 0.002 + 0.02 * v).collect();
        let (rotations, opacities, colors) = (noise(4 * N, 3), noise(N, 4), noise(3 * N, 5));
        let scene = Scene {
            means: &means,
            rotations: &rotations,
            scales: &scales,
            opacities: &opacities,
            colors: &colors,
            background: &[0.2, 0.4, 0.6],
        };
        let options = RenderOptions { antialiased: true, depth: true, ..RenderOptions::inria() };
        let job = Job::new(&Camera::orbit(2, 150, 130), &options).expect("sound cameras");
        let (image, state, _) = forward(scene, &job, true).expect("renders");
        let pixels = 2 * 150 * 130;
        let (color, alpha, depth) = (noise(3 * pixels, 6), noise(pixels, 7), noise(pixels, 8));
        let upstream = Upstream { color: Some(&color[..]), alpha: Some(&alpha[..]), depth: Some(&depth[..]) };
        let gradients = backward(scene, &job, &state, &upstream, wanted);
        (image, gradients)
    }

    fn fields(g: &Gradients) -> [&Vec<f32>; 6] {
        [&g.means, &g.rotations, &g.scales, &g.opacities, &g.colors, &g.background]
    }

    #[test]
    fn results_do_not_depend_on_the_number_of_threads() {
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
            pool.install(|| pass(EVERYTHING))
        };
        let (image, gradients) = with(1);
        assert!(fields(&gradients).iter().all(|g| g.iter().any(|v| *v != 0.0)));
        for threads in [2, 5] {
            let (other_image, other) = with(threads);
            assert!(image == other_image, "{threads} threads: image");
            assert!(fields(&gradients) == fields(&other), "{threads} threads: gradients");
        }
    }

    /// Unwanted gradients take no memory, and a wanted gradient does not depend on the other ones.
    #[test]
    fn only_what_is_wanted_is_made() {
        let full = pass(EVERYTHING).1;
        for index in 0..6 {
            let is = |place: usize| place == index;
            let wanted = Wanted {
                means: is(0),
                rotations: is(1),
                scales: is(2),
                opacities: is(3),
                colors: is(4),
                background: is(5),
            };
            let part = pass(wanted).1;
            for (place, (found, expected)) in fields(&part).into_iter().zip(fields(&full)).enumerate() {
                let expected: &[f32] = if is(place) { expected } else { &[] };
                assert!(found == expected, "{index}: field {place}");
            }
        }
    }
}
