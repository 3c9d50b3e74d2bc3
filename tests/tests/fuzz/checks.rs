//! What must hold of the outputs of commands that succeed.

use std::error::Error;
use std::fs;
use std::path::Path;

use burn::tensor::Device;
use safetensors::SafeTensors;
use snapsnap_base::config::Schema;
use snapsnap_data::dataset;
use snapsnap_mesh::import;
use snapsnap_net::config::Config;
use snapsnap_net::weights::{Source, WeightFile};
use snapsnap_splat::{camera_file, scene};

/// Reads what a command wrote into a folder.
///
/// # Errors
/// If it is not whole.
pub fn check(command: &str, folder: &Path) -> Result<(), Box<dyn Error>> {
    let [ply, weights] = ["out.ply", "out.safetensors"].map(|name| folder.join(name));
    match command.split_whitespace().next() {
        Some("reconstruct") => {
            gaussians(&ply)?;
            Config::from_file(&folder.join("out.ply.config.toml"), &[])?;
        }
        Some("convert") => gaussians(&ply)?,
        Some("mesh") => import::read(&ply)?.check()?,
        Some("render") => pictures(&folder.join("out"))?,
        Some("export-weights") => drop(SafeTensors::deserialize(&fs::read(weights)?)?),
        Some("import-weights") => finite(&weights)?,
        Some("prepare") if !command.contains("prepare check") => data_set(&folder.join("out"))?,
        Some("evaluate") if command.contains("--mesh-dir") => report(folder, "geometry_cm")?,
        Some("evaluate") => report(folder, "protocols")?,
        Some("bench") => report(folder, "settings")?,
        _ => {}
    }
    Ok(())
}

/// Whether there are Gaussians.
fn gaussians(path: &Path) -> Result<(), Box<dyn Error>> {
    let loaded = scene::read(path, &Device::flex())?;
    if loaded.gaussians.is_empty() { Err("no Gaussian".into()) } else { Ok(()) }
}

/// Whether the pictures have the sizes of their cameras.
fn pictures(folder: &Path) -> Result<(), Box<dyn Error>> {
    for (view, camera) in camera_file::read(&folder.join("cameras.json"))?.iter().enumerate() {
        let picture = image::open(folder.join(format!("{view:03}.png")))?;
        if (picture.width(), picture.height()) != (camera.width, camera.height) {
            return Err(format!("picture {view} has another size than its camera").into());
        }
    }
    Ok(())
}

/// Whether the weight file fits its own config and all numbers are finite.
fn finite(path: &Path) -> Result<(), Box<dyn Error>> {
    WeightFile::open(path, None)?;
    let source = Source::open(path)?;
    for name in source.tensors().keys() {
        if source.read_f32(name)?.iter().any(|value| !value.is_finite()) {
            return Err(format!("`{name}` is not finite").into());
        }
    }
    Ok(())
}

/// Whether the data set has no fault; a set without people is one.
fn data_set(folder: &Path) -> Result<(), Box<dyn Error>> {
    let checked = dataset::check(folder, |_, _| ())?;
    checked.problems.first().map_or(Ok(()), |problem| Err(problem.as_str().into()))
}

/// Whether there is a report with this key.
fn report(folder: &Path, key: &str) -> Result<(), Box<dyn Error>> {
    let report: serde_json::Value = serde_json::from_slice(&fs::read(folder.join("out/report.json"))?)?;
    match ["command", "left_out", key].into_iter().find(|key| report[*key].is_null()) {
        Some(key) => Err(format!("report.json has no `{key}`").into()),
        None => Ok(()),
    }
}
