//! Two photographs of a person become Gaussians in a PLY file, with the default weights.
//!
//! ```sh
//! cargo run --release --example reconstruct                            # the sample pair → human.ply
//! cargo run --release --example reconstruct -- FRONT.png BACK.png OUT.ply
//! ```
//!
//! The photographs need transparent backgrounds. The result has the same bytes as the result of `snapsnap reconstruct`.

use std::error::Error;
use std::path::{Path, PathBuf};

use burn::tensor::Device;
use snapsnap_net::Reconstructor;
use snapsnap_net::weights::WeightFile;
use snapsnap_photo::{Cutting, Source, Told, person, read};
use snapsnap_splat::scene;

fn main() -> Result<(), Box<dyn Error>> {
    let assets = Path::new(env!("CARGO_MANIFEST_DIR")).join("../assets");
    let mut arguments = std::env::args().skip(1).map(PathBuf::from);
    let mut argument = |default: PathBuf| arguments.next().unwrap_or(default);
    let photographs = [argument(assets.join("sample/front.png")), argument(assets.join("sample/back.png"))];
    let output = argument("human.ply".into());

    let weights = WeightFile::open(&assets.join("weights/default.safetensors"), None)?;
    let networks = Reconstructor::load(&weights, &Device::flex())?;
    let config = networks.config();

    // Each person is scaled and moved to the place that the networks were trained for.
    let told = Told::default();
    let sources = photographs.each_ref().map(|path| Source::file(path));
    let placement = told.placement(config);
    let photographs = read(&sources, Cutting::Given, config.network.resolution, placement, told.focal)?;

    let person = person(&photographs, &networks, &told, &|module| println!("{module}"))?;
    for (module, time) in &person.made.times {
        println!("{module:<26} {:>8.1} ms", 1e3 * time.as_secs_f64());
    }
    scene::write(&person.gaussians, &output)?;
    println!("{} Gaussians: {}", person.gaussians.len(), output.display());
    Ok(())
}
