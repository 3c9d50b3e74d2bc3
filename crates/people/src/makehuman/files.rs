//! MakeHuman's files: base mesh, morph targets, rig and skin weights.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::{Arc, Mutex, PoisonError};

use glam::{Vec2, Vec3};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use snapsnap_base::{FileError, file, folder, quoted};

use super::proxy::{Proxy, wardrobe};
use crate::poses::Poses;

/// Metres per unit of MakeHuman's files, a decimetre.
pub const METRES: f32 = 0.1;
/// Size limit of a file. The largest of MakeHuman's files has a few megabytes.
const MAX_BYTES: u64 = 256 << 20;
/// Largest coordinate, decimetres.
const LARGEST: f32 = 1000.0;
/// Required groups of the base mesh and bones of the rig.
const GROUPS: [&str; 5] = ["body", "helper-tights", "helper-skirt", "helper-l-eye", "helper-r-eye"];
const BONES: [&str; 5] = ["spine03", "neck01", "head", "jaw", "oris01"];
const SIDED_BONES: [&str; 9] =
    ["eye", "upperarm01", "lowerarm01", "wrist", "finger3-3", "upperleg01", "lowerleg01", "foot", "clavicle"];

/// Morph target: index and displacement in metres of each vertex that moves.
pub type Target = Arc<Vec<(u32, Vec3)>>;

/// A face of an OBJ with three or four corners.
#[derive(Debug, Clone)]
pub struct Face {
    pub group: String,
    pub rows: Vec<u32>,
    /// 0 where the file has none.
    pub texcoords: Vec<Vec2>,
}

/// Faces of each group of the base mesh. Triangles repeat their last corner.
type Groups = HashMap<String, Vec<[u32; 4]>>;

/// A bone: its name, its parent's index, and the vertices whose means are its head and its tail.
#[derive(Debug, Clone)]
pub struct RigBone {
    pub name: String,
    pub parent: Option<usize>,
    pub head: Vec<u32>,
    pub tail: Vec<u32>,
}

/// The data of a MakeHuman installation.
pub struct Library {
    root: PathBuf,
    /// Vertices of the base mesh, metres.
    pub positions: Vec<Vec3>,
    /// Contains all of `GROUPS`.
    pub groups: Groups,
    /// Parents before children.
    pub bones: Vec<RigBone>,
    /// Bones that move each vertex, with shares that add up to 1.
    pub weights: Vec<Vec<(u32, f32)>>,
    targets: Mutex<HashMap<PathBuf, Target>>,
    /// Poses of the folder `poses`, if there is one.
    pub poses: Option<Poses>,
    /// Clothes and hair.
    pub wardrobe: Vec<Arc<Proxy>>,
}

impl Library {
    /// MakeHuman's folder `data`.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Opens `folder`: MakeHuman's `data`, or a checkout that contains it.
    ///
    /// # Errors
    /// [`FileError`] naming the file that is missing or damaged.
    pub fn open(folder: &Path) -> Result<Self, FileError> {
        let candidates = [folder.to_owned(), folder.join("data"), folder.join("makehuman/data")];
        let base = Path::new("3dobjs/base.obj");
        let root = candidates.into_iter().find(|root| root.join(base).is_file()).ok_or_else(|| {
            let message = "is no MakeHuman data: neither it nor its folder `data` has 3dobjs/base.obj";
            FileError::unsuitable(folder, message)
        })?;
        let (positions, faces) = read_obj(&root.join(base))?;
        let mut groups = Groups::new();
        for Face { group, rows, .. } in faces {
            let corners = [0, 1, 2, 3].map(|i: usize| rows[i.min(rows.len() - 1)]);
            groups.entry(group).or_default().push(corners);
        }
        if let Some(group) = GROUPS.iter().find(|group| !groups.contains_key(**group)) {
            return Err(FileError::unsuitable(&root.join(base), format!("has no group `{group}`")));
        }
        let (bones, weights) = read_rig(&root.join("rigs"), positions.len())?;
        let sided = SIDED_BONES.iter().flat_map(|name| ["L", "R"].map(|side| format!("{name}.{side}")));
        let mut needed = BONES.iter().map(|name| (*name).to_owned()).chain(sided);
        if let Some(bone) = needed.find(|needed| !bones.iter().any(|bone| bone.name == *needed)) {
            let path = root.join("rigs/default.mhskel");
            return Err(FileError::unsuitable(&path, format!("has no bone `{bone}`")));
        }
        let wardrobe = wardrobe(&root, positions.len())?;
        let folder = root.join("poses");
        let poses = if folder.is_dir() { Poses::open(&folder)? } else { None };
        let targets = Mutex::default();
        Ok(Self { root, positions, groups, bones, weights, targets, poses, wardrobe })
    }

    /// The morph target `name`: a path below `targets` without extension. Each file is read once.
    ///
    /// # Errors
    /// [`FileError`] if it is missing or damaged.
    pub fn target(&self, name: &str) -> Result<Target, FileError> {
        let path = self.root.join("targets").join(format!("{name}.target"));
        let targets = || self.targets.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(target) = targets().get(&path) {
            return Ok(target.clone());
        }
        let text = read_text(&path)?;
        let mut moves = Vec::new();
        for (number, line) in text.lines().enumerate() {
            let mut words = line.split_ascii_whitespace();
            let Some(first) = words.next().filter(|word| !word.starts_with('#')) else { continue };
            let row = first.parse().ok().filter(|row: &u32| (*row as usize) < self.positions.len());
            moves.push(row.zip(vector(words)).ok_or_else(|| wrong(&path, number, line))?);
        }
        let target = Arc::new(moves);
        targets().insert(path, target.clone());
        Ok(target)
    }

    /// Names of the targets in a folder below `targets`, in order.
    ///
    /// # Errors
    /// [`FileError::Read`] if it is missing.
    pub fn targets_in(&self, folder: &str) -> Result<Vec<String>, FileError> {
        let files = folder::with_ending(&self.root.join("targets").join(folder), "target")?;
        // A target is opened by its stem and the ending in small letters.
        let targets = files.iter().filter(|file| file.extension().is_some_and(|ending| ending == "target"));
        let stems = targets.filter_map(|file| file.file_stem());
        let mut names: Vec<String> = stems.map(|stem| stem.to_string_lossy().into_owned()).collect();
        names.sort_unstable();
        Ok(names)
    }
}

pub fn read_text(path: &Path) -> Result<String, FileError> {
    file::read_text(path, MAX_BYTES).map_err(FileError::read(path))
}

pub fn wrong(path: &Path, line: usize, text: &str) -> FileError {
    FileError::unsuitable(path, format!("line {}, `{}`: not understood", line + 1, quoted(text)))
}

/// Three numbers within ±`LARGEST`, converted to metres.
pub fn vector<'a>(mut words: impl Iterator<Item = &'a str>) -> Option<Vec3> {
    let mut next = || words.next()?.parse().ok().filter(|v: &f32| v.abs() < LARGEST);
    Some(METRES * Vec3::new(next()?, next()?, next()?))
}

pub fn numbers<'a, T: FromStr, const N: usize>(words: &mut impl Iterator<Item = &'a str>) -> Option<[T; N]> {
    let values: Option<Vec<T>> = (0..N).map(|_| words.next()?.parse().ok()).collect();
    values?.try_into().ok()
}

fn read_json<T: DeserializeOwned>(path: &Path) -> Result<T, FileError> {
    serde_json::from_str(&read_text(path)?).map_err(|e| FileError::unsuitable(path, e))
}

/// Positions in metres and faces of an OBJ. The importer of `snapsnap_mesh` would renumber vertices, to which targets,
/// weights and bindings refer.
pub fn read_obj(path: &Path) -> Result<(Vec<Vec3>, Vec<Face>), FileError> {
    let text = read_text(path)?;
    let (mut positions, mut places, mut faces, mut group) = (Vec::new(), Vec::new(), Vec::new(), "");
    for (number, line) in text.lines().enumerate() {
        let mut words = line.split_ascii_whitespace();
        let bad = || wrong(path, number, line);
        match words.next() {
            Some("v") => positions.push(vector(words).ok_or_else(bad)?),
            Some("vt") => {
                let at = numbers(&mut words).filter(|at: &[f32; 2]| at.iter().all(|v| v.abs() < LARGEST));
                places.push(Vec2::from(at.ok_or_else(bad)?));
            }
            Some("g") => group = words.next().unwrap_or_default(),
            Some("f") => {
                let corner = |word: &str| {
                    let mut parts = word.split('/');
                    let row: usize = parts.next()?.parse().ok()?;
                    let is_vertex = (1..=positions.len()).contains(&row);
                    let place = match parts.next().filter(|part| !part.is_empty() && !places.is_empty()) {
                        Some(part) => *places.get(part.parse::<usize>().ok()?.checked_sub(1)?)?,
                        None => Vec2::ZERO,
                    };
                    is_vertex.then(|| (row as u32 - 1, place))
                };
                let corners: Option<Vec<(u32, Vec2)>> = words.map(corner).collect();
                let corners = corners.filter(|corners| (3..=4).contains(&corners.len())).ok_or_else(bad)?;
                let (rows, texcoords) = corners.into_iter().unzip();
                faces.push(Face { group: group.to_owned(), rows, texcoords });
            }
            _ => {}
        }
    }
    Ok((positions, faces))
}

#[derive(Deserialize)]
struct RigFile {
    bones: BTreeMap<String, BoneFile>,
    joints: HashMap<String, Vec<u32>>,
}

#[derive(Deserialize)]
struct BoneFile {
    parent: Option<String>,
    head: String,
    tail: String,
}

#[derive(Deserialize)]
struct WeightsFile {
    weights: BTreeMap<String, Vec<(u32, f32)>>,
}

type Rig = (Vec<RigBone>, Vec<Vec<(u32, f32)>>);

fn read_rig(folder: &Path, vertices: usize) -> Result<Rig, FileError> {
    let path = folder.join("default.mhskel");
    let file: RigFile = read_json(&path)?;
    let mut bones: Vec<RigBone> = Vec::new();
    let mut rows: HashMap<&str, usize> = HashMap::new();
    // Parents first: each round adds the bones whose parent is there.
    while bones.len() < file.bones.len() {
        let before = bones.len();
        for (name, bone) in &file.bones {
            let parent = bone.parent.as_deref().map(|parent| rows.get(parent).copied());
            if rows.contains_key(name.as_str()) || parent == Some(None) {
                continue;
            }
            let joint = |joint: &String| {
                let rows = file.joints.get(joint).filter(|rows| !rows.is_empty());
                rows.filter(|rows| rows.iter().all(|row| (*row as usize) < vertices)).cloned().ok_or_else(
                    || FileError::unsuitable(&path, format!("joint `{}` is missing or wrong", quoted(joint))),
                )
            };
            rows.insert(name, bones.len());
            let (head, tail) = (joint(&bone.head)?, joint(&bone.tail)?);
            bones.push(RigBone { name: name.clone(), parent: parent.flatten(), head, tail });
        }
        if bones.len() == before {
            return Err(FileError::unsuitable(&path, "a bone's parent is missing, or bones form a loop"));
        }
    }

    let path = folder.join("default_weights.mhw");
    let file: WeightsFile = read_json(&path)?;
    let mut weights: Vec<Vec<(u32, f32)>> = vec![Vec::new(); vertices];
    for (name, list) in &file.weights {
        let unknown = || FileError::unsuitable(&path, format!("bone `{}` is not in the rig", quoted(name)));
        let bone = *rows.get(name.as_str()).ok_or_else(unknown)? as u32;
        for (row, weight) in list {
            let vertex = weights.get_mut(*row as usize).filter(|_| *weight >= 0.0 && weight.is_finite());
            let message = || format!("bone `{}` has a wrong weight for vertex {row}", quoted(name));
            vertex.ok_or_else(|| FileError::unsuitable(&path, message()))?.push((bone, *weight));
        }
    }
    for (row, shares) in weights.iter_mut().enumerate() {
        let sum: f32 = shares.iter().map(|(_, weight)| weight).sum();
        if sum <= 0.0 {
            return Err(FileError::unsuitable(&path, format!("vertex {row} has no weight")));
        }
        shares.iter_mut().for_each(|(_, weight)| *weight /= sum);
    }
    Ok((bones, weights))
}
