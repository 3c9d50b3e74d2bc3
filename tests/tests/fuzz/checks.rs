//! What must hold of the outputs of commands that succeed.

use std::fs;
use std::path::Path;

use burn::tensor::Device;
use safetensors::SafeTensors;
use snapsnap_base::config::Schema;
use snapsnap_data::dataset;
use snapsnap_mesh::import;
use snapsnap_net::config::Config;
use snapsnap_net::weights::{Source, WeightFile};
use snapsnap_splat::scene;

/// Whether `reconstruct` wrote a PLY that can be read again, and its config.
pub fn person(folder: &Path) -> Result<(), String> {
    scene(folder)?;
    Config::from_file(&folder.join("out.ply.config.toml"), &[]).map(drop).map_err(|e| e.to_string())
}

/// Whether there are Gaussians.
pub fn scene(folder: &Path) -> Result<(), String> {
    let loaded = scene::read(&folder.join("out.ply"), &Device::flex()).map_err(|e| e.to_string())?;
    if loaded.gaussians.is_empty() { Err("no Gaussian".into()) } else { Ok(()) }
}

pub fn mesh(folder: &Path) -> Result<(), String> {
    let mesh = import::read(&folder.join("out.ply")).map_err(|e| e.to_string())?;
    mesh.check().map_err(|e| e.to_string())
}

/// Whether `render` wrote pictures of the sizes of its own two cameras.
pub fn rendered(folder: &Path) -> Result<(), String> {
    pictures_of(folder, &folder.join("out/cameras.json"))
}

/// Whether `render` wrote pictures of the sizes of the given cameras, whatever the folder of inputs is called.
pub fn rendered_by_cameras(folder: &Path) -> Result<(), String> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let given = entries.map(|entry| entry.path().join("cameras.json")).find(|path| path.is_file());
    pictures_of(folder, &given.unwrap_or_default())
}

fn pictures_of(folder: &Path, cameras: &Path) -> Result<(), String> {
    let views = snapsnap_splat::camera_file::read(cameras).map_err(|e| e.to_string())?;
    for (view, camera) in views.iter().enumerate() {
        let picture = image::open(folder.join(format!("out/{view:03}.png")));
        let picture = picture.map_err(|e| format!("picture {view}: {e}"))?;
        if (picture.width(), picture.height()) != (camera.width, camera.height) {
            return Err(format!("picture {view} has another size than its camera"));
        }
    }
    Ok(())
}

pub fn tensors(folder: &Path) -> Result<(), String> {
    let bytes = fs::read(folder.join("out.safetensors")).map_err(|e| e.to_string())?;
    SafeTensors::deserialize(&bytes).map(drop).map_err(|e| e.to_string())
}

/// Whether the weight file fits its own config and all numbers are finite.
pub fn weight_file(folder: &Path) -> Result<(), String> {
    let path = folder.join("out.safetensors");
    WeightFile::open(&path, None).map_err(|e| e.to_string())?;
    let source = Source::open(&path).map_err(|e| e.to_string())?;
    for name in source.tensors().keys() {
        let values = source.read_f32(name).map_err(|e| e.to_string())?;
        if values.iter().any(|value| !value.is_finite()) {
            return Err(format!("`{name}` is not finite"));
        }
    }
    Ok(())
}

/// Whether the data set in `out` has no fault, and a subject.
pub fn data_set(folder: &Path) -> Result<(), String> {
    let checked = dataset::check(&folder.join("out"), |_, _| ()).map_err(|e| e.to_string())?;
    match checked.problems.first() {
        Some(problem) => Err(problem.clone()),
        None if checked.subjects == 0 => Err("no subject".into()),
        None => Ok(()),
    }
}

/// Whether there is a report of a command, with this key.
pub fn report(folder: &Path, key: &str) -> Result<(), String> {
    let text = fs::read_to_string(folder.join("out/report.json")).map_err(|e| format!("report.json: {e}"))?;
    let report: serde_json::Value = serde_json::from_str(&text).map_err(|e| format!("report.json: {e}"))?;
    match ["command", "left_out", key].iter().find(|key| report[**key].is_null()) {
        Some(key) => Err(format!("report.json has no `{key}`")),
        None => Ok(()),
    }
}
