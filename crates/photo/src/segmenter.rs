//! The networks that look at photographs. The program contains their weights (docs/u2netp_convert.py and
//! docs/blazepose_convert.py). They run on the CPU: they are small, and a GPU's kernels would take longer to compile.

use std::sync::{Mutex, OnceLock, PoisonError};

use burn::tensor::Device;
use snapsnap_net::blazepose::BlazePose;
pub use snapsnap_net::blazepose::{Pose, SIDE};
use snapsnap_net::u2net::U2Net;
use snapsnap_net::weights::{Source, WeightsError};

const U2NET: &[u8] = include_bytes!("../../../assets/weights/u2netp.safetensors");
const BLAZEPOSE: &[u8] = include_bytes!("../../../assets/weights/blazepose.safetensors");

/// The probability of each pixel to belong to the person, `[SIDE, SIDE]`, from colours in [0, 1], `[3, SIDE, SIDE]`.
pub fn segment(rgb: &[f32]) -> Vec<f32> {
    static NETWORK: OnceLock<Mutex<U2Net>> = OnceLock::new();
    run(&NETWORK, U2NET, U2Net::load, |network, device| network.forward(rgb, device))
}

/// Joints and pixels of the person in a square picture, from colours in [0, 1], `[3, SIDE, SIDE]`.
pub fn pose(rgb: &[f32]) -> Pose {
    static NETWORK: OnceLock<Mutex<BlazePose>> = OnceLock::new();
    run(&NETWORK, BLAZEPOSE, BlazePose::load, |network, device| network.forward(rgb, device))
}

fn run<T, R>(
    network: &OnceLock<Mutex<T>>,
    weights: &'static [u8],
    load: impl FnOnce(&Source, &Device) -> Result<T, WeightsError>,
    forward: impl FnOnce(&T, &Device) -> R,
) -> R {
    let device = Device::flex();
    let loaded = network.get_or_init(|| {
        let source =
            Source::embedded("a network of the program", weights).expect("a file of the program's own");
        Mutex::new(load(&source, &device).expect("weights of the program's own"))
    });
    forward(&loaded.lock().unwrap_or_else(PoisonError::into_inner), &device)
}
