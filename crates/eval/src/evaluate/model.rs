//! A model as it is judged: photographs of a person → Gaussians in the data set's world.

use std::time::{Duration, Instant};

use burn::tensor::{Device, Tensor};
use snapsnap_data::sample::TestItem;
use snapsnap_net::config::Config;
use snapsnap_net::gaussians::placed;
use snapsnap_net::weights::{WeightFile, WeightsError};
use snapsnap_net::{Reconstruction, Reconstructor};
use snapsnap_ops::host;
use snapsnap_splat::Gaussians;

use super::person::photograph;

/// Networks on a device.
pub struct Model {
    reconstructor: Reconstructor,
}

/// What it made of a person.
pub struct Made {
    /// In the data set's world.
    pub gaussians: Gaussians,
    /// Point maps `[S,S,3]` of the views in the first photograph's frame, by their places among
    /// [`crate::points::VIEWS`]; none where there are more than two photographs.
    pub maps: Vec<(usize, Vec<f32>)>,
    /// Pixels and Gaussians left out because they were not finite.
    pub lost: usize,
    /// From the photographs on their canvas to the Gaussians.
    pub time: Duration,
}

impl Model {
    /// Loads both networks; `sides` and `side_colors` say what runs.
    ///
    /// # Errors
    /// [`WeightsError`] if a part is absent or a value is not finite.
    pub fn load(
        weights: &WeightFile,
        device: &Device,
        sides: bool,
        side_colors: bool,
    ) -> Result<Self, WeightsError> {
        let mut reconstructor = Reconstructor::load(weights, device)?;
        if !sides {
            reconstructor = reconstructor.without_sides();
        }
        if !side_colors {
            reconstructor = reconstructor.without_side_colors();
        }
        Ok(Self { reconstructor })
    }

    /// The config in force.
    pub fn config(&self) -> &Config {
        self.reconstructor.config()
    }

    /// Side of the canvas.
    pub fn side(&self) -> usize {
        self.config().network.resolution
    }

    /// Gaussians of a person seen from the views `inputs`. Of more than two photographs each and the next, around the circle,
    /// are a pair, in the frame of its first one's known camera (SNAPSNAP §5.6).
    pub fn reconstruct(&self, item: &TestItem, inputs: &[usize]) -> Made {
        let side = self.side();
        let photographs: Vec<_> = (0..inputs.len()).map(|place| photograph(item, place, side)).collect();
        let start = Instant::now();
        let count = if inputs.len() == 2 { 1 } else { inputs.len() };
        let (mut parts, mut maps, mut lost) = (Vec::new(), Vec::new(), 0);
        for first in 0..count {
            let pair = [&photographs[first], &photographs[(first + 1) % inputs.len()]];
            let made = self.reconstructor.reconstruct(pair[0], pair[1], &|_| ());
            let to_world = item.cameras[inputs[first]].world_to_camera.inverse();
            parts.push(placed(self.config(), made.gaussians.clone(), &to_world));
            lost += made.lost;
            if count == 1 {
                maps = maps_of(&made, side);
            }
        }
        Made { gaussians: joined(parts), maps, lost, time: start.elapsed() }
    }
}

fn maps_of(made: &Reconstruction, side: usize) -> Vec<(usize, Vec<f32>)> {
    let points = host(made.maps.points.clone());
    let of_view = points.chunks_exact(3 * side * side).map(<[f32]>::to_vec);
    made.views.iter().map(|view| *view as usize).zip(of_view).collect()
}

/// All Gaussians of several sets.
pub fn joined(parts: Vec<Gaussians>) -> Gaussians {
    let rows = |of: fn(&Gaussians) -> &Tensor<2>| {
        Tensor::cat(parts.iter().map(|part| of(part).clone()).collect(), 0)
    };
    let opacities = Tensor::cat(parts.iter().map(|part| part.opacities.clone()).collect(), 0);
    Gaussians::new(
        rows(|part| &part.means),
        rows(|part| &part.rotations),
        rows(|part| &part.scales),
        opacities,
        rows(|part| &part.colors),
    )
    .expect("parts that fit")
}
