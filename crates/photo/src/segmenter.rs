//! The network that tells a person from the background. The program contains its weights (docs/u2netp_convert.py).

use std::sync::{Mutex, OnceLock, PoisonError};

use burn::tensor::Device;
use snapsnap_net::u2net::U2Net;
use snapsnap_net::weights::Source;

const WEIGHTS: &[u8] = include_bytes!("../../../assets/weights/u2netp.safetensors");

/// The probability of each pixel to belong to the person, `[SIDE, SIDE]`, from colours in [0, 1], `[3, SIDE, SIDE]`.
/// It is computed on the CPU: the network is small, and a GPU's kernels would take longer to compile.
pub fn segment(rgb: &[f32]) -> Vec<f32> {
    static NETWORK: OnceLock<Mutex<U2Net>> = OnceLock::new();
    let device = Device::flex();
    let load = || {
        let source = Source::embedded("U²-Net", WEIGHTS).expect("a file of the program's own");
        Mutex::new(U2Net::load(&source, &device).expect("weights of the program's own"))
    };
    let network = NETWORK.get_or_init(load).lock().unwrap_or_else(PoisonError::into_inner);
    network.forward(rgb, &device)
}
