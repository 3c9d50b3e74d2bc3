//! Scans from files: OBJ with MTL and textures, PLY with vertex colours or a texture, GLB.

mod glb;
mod glb_material;
mod obj;
mod ply;
mod skin;
#[cfg(test)]
mod tests;

use std::collections::HashMap;
use std::hash::Hash;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::{Vec2, Vec3};
use image::{DynamicImage, RgbImage};
use snapsnap_base::{FileError, file, folder, guarded, quoted};

use crate::mesh::Mesh;
use crate::picture::decode;
pub use glb::{Bone, Rigged, Weights};

/// File extensions that [`read`] accepts, in lower case.
pub const EXTENSIONS: [&str; 3] = ["obj", "ply", "glb"];

/// Largest file that is read; the largest published scans take a few hundred megabytes.
const MAX_BYTES: u64 = 4 << 30;

/// Memory limit of a decoded texture in bytes: 8192×8192 RGBA pixels of 16 bits per channel.
const MAX_TEXTURE: u64 = 512 << 20;
/// Memory limit of all textures of a scan in bytes, as 8-bit RGB.
const MAX_TEXTURES: u64 = 1 << 30;

/// Reads a scan. Positions are as in the file. Equal positions are merged, so that shading is smooth across texture
/// seams.
///
/// # Errors
/// [`FileError`] for a file or texture that is missing, damaged, too large or in another format, and for a mesh that
/// cannot be drawn: no triangle, NaN, references out of range.
pub fn read(path: &Path) -> Result<Mesh, FileError> {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    let reader: fn(&Path) -> Result<Mesh, FileError> = match extension.as_str() {
        "obj" => obj::read,
        "ply" => ply::read,
        "glb" => |path| Ok(glb::read_rigged(path)?.mesh),
        _ => return Err(FileError::unsuitable(path, "is no scan: expected a file .obj, .ply or .glb")),
    };
    let mut mesh = guarded(path, || reader(path))?;
    finish(&mut mesh, path)?;
    Ok(mesh)
}

/// Reads a GLB with its skeleton. The mesh is as [`read`] returns it.
///
/// # Errors
/// As [`read`], and for joints or weights that are missing or damaged. The error names the position.
pub fn read_rigged(path: &Path) -> Result<Rigged, FileError> {
    let mut rigged = guarded(path, || glb::read_rigged(path))?;
    let kept = finish(&mut rigged.mesh, path)?;
    rigged.weights = kept.iter().filter_map(|row| rigged.weights.get(*row).copied()).collect();
    Ok(rigged)
}

/// Checks a mesh, brings its colours into [0, 1] and merges equal positions. Returns the former index of each.
fn finish(mesh: &mut Mesh, path: &Path) -> Result<Vec<usize>, FileError> {
    mesh.check().map_err(|e| FileError::unsuitable(path, e))?;
    // The brightest value of a colour is 1 in some files and 255 in others.
    if mesh.colors.iter().any(|c| c.max_element() > 2.0) {
        mesh.colors.iter_mut().for_each(|c| *c /= 255.0);
    }
    mesh.colors.iter_mut().for_each(|c| *c = c.clamp(Vec3::ZERO, Vec3::ONE));
    Ok(mesh.weld())
}

/// Triangles of a polygon, as places in `corners`. A concave polygon is cut into ears, so that its gaps stay open.
fn triangles(corners: &[Vec3]) -> Vec<[usize; 3]> {
    /// Most corners of a polygon that is cut into ears, which takes their third power.
    const MOST: usize = 512;
    let n = corners.len();
    let fan = |rows: &[usize]| (2..rows.len()).map(|i| [rows[0], rows[i - 1], rows[i]]).collect::<Vec<_>>();
    let mut left: Vec<usize> = (0..n).collect();
    let normal: Vec3 = (2..n).map(|i| (corners[i - 1] - corners[0]).cross(corners[i] - corners[0])).sum();
    let Some(normal) = normal.try_normalize().filter(|_| (4..=MOST).contains(&n)) else { return fan(&left) };
    let (x, y) = normal.any_orthonormal_pair();
    let flat = corners.iter().map(|corner| {
        let corner = *corner - corners[0];
        Vec2::new(corner.dot(x), corner.dot(y))
    });
    let flat: Vec<Vec2> = flat.collect();
    let turn = |[a, b, c]: [usize; 3]| (flat[b] - flat[a]).perp_dot(flat[c] - flat[b]);
    if (0..n).all(|i| turn([i, (i + 1) % n, (i + 2) % n]) >= 0.0) {
        return fan(&left);
    }
    let mut cut = Vec::new();
    while left.len() > 3 {
        let m = left.len();
        let around = |i: usize| [left[(i + m - 1) % m], left[i], left[(i + 1) % m]];
        let is_ear = |i: &usize| {
            let [a, b, c] = around(*i);
            let is_within =
                |p: &usize| [[a, b, *p], [b, c, *p], [c, a, *p]].into_iter().all(|t| turn(t) >= 0.0);
            turn([a, b, c]) > 0.0 && !left.iter().any(|p| ![a, b, c].contains(p) && is_within(p))
        };
        // The outline of a polygon that crosses itself has no ear.
        let Some(ear) = (0..m).find(is_ear) else { break };
        cut.push(around(ear));
        left.remove(ear);
    }
    cut.extend(fan(&left));
    cut
}

/// Textures of one scan, each decoded once.
#[derive(Default)]
struct Textures<K> {
    loaded: HashMap<K, Arc<RgbImage>>,
    /// Bytes that the textures take.
    taken: u64,
}

impl<K: Eq + Hash> Textures<K> {
    /// The texture with this key. `decode` is called at the first use and receives the memory limit in bytes.
    fn load(
        &mut self,
        key: K,
        decode: impl FnOnce(u64) -> Result<DynamicImage, FileError>,
    ) -> Result<Arc<RgbImage>, FileError> {
        if let Some(texture) = self.loaded.get(&key) {
            return Ok(texture.clone());
        }
        let left = MAX_TEXTURES.saturating_sub(self.taken);
        let texture = match decode(MAX_TEXTURE.min(left)) {
            Err(FileError::Unsuitable { path, message }) if left < MAX_TEXTURE => {
                let all = MAX_TEXTURES >> 20;
                let message = format!("{message} (all textures of a scan together may take {all} MiB)");
                return Err(FileError::Unsuitable { path, message });
            }
            decoded => Arc::new(decoded?.into_rgb8()),
        };
        self.taken += texture.len() as u64;
        self.loaded.insert(key, texture.clone());
        Ok(texture)
    }
}

impl Textures<PathBuf> {
    /// The texture to which `owner` refers as `name`.
    fn beside(&mut self, owner: &Path, name: &str) -> Result<Arc<RgbImage>, FileError> {
        let path = beside(owner, "texture", name)?;
        self.load(path.clone(), |most| decode(&path, most))
    }
}

/// The file to which `owner` refers as `name`: relative to the folder of `owner`, or else the file name alone in this
/// folder, since scans contain paths of other machines.
fn beside(owner: &Path, kind: &str, name: &str) -> Result<PathBuf, FileError> {
    let folder = file::folder_of(owner);
    let slashes = name.replace('\\', "/");
    let last = slashes.rsplit('/').next().unwrap_or_default();
    let mut paths = [name, &slashes, last].into_iter().map(|name| folder.join(name));
    // Other systems do not distinguish capitals.
    let alike = || {
        let mut names = folder::entries(folder).ok()?.into_iter();
        names.find(|path| path.file_name().is_some_and(|found| found.eq_ignore_ascii_case(last)))
    };
    paths
        .find(|path| path.is_file())
        .or_else(alike)
        .ok_or_else(|| FileError::unsuitable(owner, format!("its {kind} `{}` is missing", quoted(name))))
}
