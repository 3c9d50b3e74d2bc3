//! A person's Gaussians on one closed surface, in the photographs' colours and with a backing (docs/method.md, "One
//! surface", "Own colours", "Backing").

use std::time::Instant;

use glam::Vec3;
use snapsnap_mesh::fuse::on_body;
use snapsnap_net::{Photograph, Reconstruction, Reconstructor, pixel_width};
use snapsnap_ops::host;

/// Least share of the Gaussians on the surface of a body. Below it the networks made no body.
const BODY: f64 = 0.5;

/// The Gaussians of a front and a back photograph, without Gaussians that hang off the person's surface, sharp in the
/// photographs' views, and with a backing. With the published weights and without sides, the Gaussians are as the networks made them.
///
/// # Panics
/// If a photograph's arrays do not have the canvas size.
pub fn reconstruct(
    networks: &Reconstructor,
    photographs: [&Photograph; 2],
    stage: &dyn Fn(&'static str),
) -> Reconstruction {
    const STAGE: &str = "one surface";
    let mut made = networks.reconstruct(photographs, stage);
    let config = networks.config();
    if config.mode.compat || made.views.len() <= 2 {
        return made;
    }
    stage(STAGE);
    let since = Instant::now();
    let means = host(made.gaussians.means.clone());
    let means: Vec<Vec3> = means.as_chunks().0.iter().map(|mean| Vec3::from_array(*mean)).collect();
    let is_on = on_body(&means, pixel_width(config.network.resolution));
    let count = is_on.iter().filter(|is_on| **is_on).count();
    if count as f64 >= BODY * is_on.len() as f64 {
        made.drop_off_surface(&is_on);
    }
    made.restore_own_colors(config, photographs);
    made.add_backing(config);
    made.times.push((STAGE, since.elapsed()));
    made
}
