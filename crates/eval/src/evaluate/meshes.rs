//! Meshes of any method, compared with the ground truth of a test set.

use std::path::{Path, PathBuf};

use glam::Vec3;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use snapsnap_base::FileError;
use snapsnap_data::scan::{Collection, normalise};
use snapsnap_mesh::import::{self, EXTENSIONS};
use snapsnap_mesh::mesh::Mesh;

use super::config::EvalConfig;
use super::person::People;
use super::shared::{LeftOut, everybody, missing, name_of};
use super::surface::truth as truth_of;
use crate::geometry::{ALIGNED, Align, chamfer, icp, point_to_surface, sampled, thinned};
use crate::{EvalError, Result};

/// Points drawn from each surface.
const POINTS: usize = 50_000;
/// Seeds of the points of a mesh and of the scan. With one seed, equal meshes would get equal points.
const SEEDS: [u64; 2] = [1, 2];

/// Figures of a person's mesh, centimetres.
#[derive(Debug, Clone, Serialize)]
pub struct MeshFigures {
    /// The person.
    pub name: String,
    /// From points of the mesh to the nearest ground-truth point.
    pub to_truth: f64,
    /// From ground-truth points to the nearest point of the mesh.
    pub from_truth: f64,
    /// Mean of `to_truth` and `from_truth`.
    pub chamfer: f64,
    /// From ground-truth points to the mesh's triangles.
    pub truth_to_surface: f64,
    /// From points of the mesh to the scan's triangles, if there is a scan.
    pub surface_to_scan: Option<f64>,
    /// Mean cosine of normals from the views nearest to 0, 90, 180 and 270°, at pixels with both normals.
    pub normal_consistency: Option<f64>,
    /// Rotation in degrees, shift of the middle in cm and scale of the alignment, if there was one.
    pub aligned: Option<[f64; 3]>,
}

/// Compares the meshes NAME.obj, .ply or .glb of a folder with the ground truth. With several data sets, files are
/// SET/NAME.…. `progress` is called with the number of finished people and their total.
pub fn evaluate_meshes(
    config: &EvalConfig,
    sets: &[People],
    folder: &Path,
    progress: &dyn Fn(usize, usize),
) -> (Vec<MeshFigures>, Vec<LeftOut>) {
    let total = everybody(sets).count();
    let (mut figures, mut left_out) = (Vec::new(), Vec::new());
    for (done, (people, row)) in everybody(sets).enumerate() {
        let name = name_of(sets, people, row);
        let own = people.test.name(row);
        // A file needs the data set's name only if several data sets have a person of this name.
        let is_alone = everybody(sets).filter(|(set, row)| set.test.name(*row) == own).count() == 1;
        let names: Vec<&str> = [&*name].into_iter().chain(is_alone.then_some(own)).collect();
        match one(config, people, row, &names, folder) {
            Ok(found) => figures.push(found),
            Err(e) => left_out.push(LeftOut::new(name, e)),
        }
        progress(done + 1, total);
    }
    left_out.extend(missing(config, sets));
    (figures, left_out)
}

fn one(
    config: &EvalConfig,
    people: &People,
    row: usize,
    names: &[&str],
    folder: &Path,
) -> Result<MeshFigures> {
    let mut mesh = import::read(&find(folder, names)?)?;
    let seen = truth_of(people, row)?;
    let scan = |scans: &PathBuf| -> Result<Mesh> {
        let path = find(scans, names)?;
        let mut scan = import::read(&path)?;
        // The scan gets the pose that `prepare` gave it. Test people are not moved sideways.
        normalise(&mut scan, Collection::Other, None::<&mut ChaCha8Rng>)
            .map_err(|e| FileError::unsuitable(&path, e.to_string()))?;
        Ok(scan)
    };
    let scan = config.data.scans.as_ref().map(scan).transpose()?;
    // A scan is complete; the points of the views are not.
    let truth = match &scan {
        Some(scan) => sampled(scan, POINTS, SEEDS[1])?,
        None => seen.points.clone(),
    };
    let mut aligned = None;
    if config.metrics.align != Align::None {
        let points = sampled(&mesh, ALIGNED, SEEDS[0])?;
        let scale = config.metrics.align == Align::Similarity;
        let motion = icp(&points, &thinned(&truth, 10 * ALIGNED), scale)?;
        mesh.positions.iter_mut().for_each(|p| *p = Vec3::from_array(motion.apply(p.to_array())));
        aligned = Some(motion.figures(&points));
    }
    let surface = sampled(&mesh, POINTS, SEEDS[0])?;
    let apart = chamfer(&surface, &truth)?;
    let to_scan = scan.map(|scan| point_to_surface(&surface, &scan)).transpose()?;
    Ok(MeshFigures {
        name: names[0].to_owned(),
        to_truth: 1e2 * apart.forward,
        from_truth: 1e2 * apart.backward,
        chamfer: 1e2 * apart.mean(),
        truth_to_surface: 1e2 * point_to_surface(&truth, &mesh)?,
        surface_to_scan: to_scan.map(|distance| 1e2 * distance),
        normal_consistency: seen.agreement_of_mesh(&mesh)?,
        aligned,
    })
}

/// The mesh of a person in a folder: the first file that exists under one of the names.
fn find(folder: &Path, names: &[&str]) -> Result<PathBuf> {
    let files = names.iter().flat_map(|name| {
        // Collections of scans have a folder for each scan.
        let in_folder = format!("{name}/{}", name.rsplit('/').next().unwrap_or(name));
        let stems = [(*name).to_owned(), in_folder].into_iter();
        stems.flat_map(|stem| EXTENSIONS.map(|end| format!("{stem}.{end}")))
    });
    let found = files.map(|file| folder.join(file)).find(|file| file.is_file());
    found.ok_or_else(|| {
        let last = names[0].rsplit('/').next().unwrap_or(names[0]);
        let message = format!("has no mesh {0}.obj, .ply or .glb, nor {0}/{last}.…", names[0]);
        EvalError::File(FileError::unsuitable(folder, message))
    })
}
