//! People from rigged characters: GLB files of one skeleton with the joint names of Mixamo or MakeHuman. Each person
//! gets a random pose, slightly other proportions, and other colours of cloth and hair.

mod colors;
mod joints;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use glam::{Mat3, Vec3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use snapsnap_base::{FileError, folder, random};
use snapsnap_mesh::import::{self, Rigged};
use snapsnap_mesh::mesh::Mesh;

use crate::figure::{Build, Figure, Pose};
use crate::math::rotate_y;
use crate::poses::Poses;
use crate::skeleton::{self, Owner, Placed};
use crate::synth::stand;
use joints::{Region, Skeleton};

/// Accepted heights of characters in metres. Other heights mean another unit.
const HEIGHTS: std::ops::RangeInclusive<f32> = 0.5..=3.0;
/// Most positions and triangles of a character.
const LARGEST: usize = 1_000_000;
/// Metres between a hand and the body.
const GAP: f32 = 0.012;

/// A posed character.
pub struct Character {
    /// Its mesh.
    pub mesh: Mesh,
    /// Whether the file has morph targets or animations, which are ignored.
    pub has_animations: bool,
}

/// The characters of a folder.
pub struct Avatars {
    files: Vec<PathBuf>,
}

impl Avatars {
    /// The GLB files directly in `folder` that belong to chosen people. `is_chosen` receives the index of a person.
    /// Files whose names are equal up to the last `_` show one person.
    ///
    /// # Errors
    /// [`FileError`] if the folder cannot be read, or has no such file.
    pub fn open(folder: &Path, is_chosen: impl Fn(usize) -> bool) -> Result<Self, FileError> {
        let mut files = folder::with_ending(folder, "glb")?;
        if files.is_empty() {
            return Err(FileError::unsuitable(folder, "holds no character: no file .glb"));
        }
        let people = Vec::from_iter(files.iter().map(|path| person_of(path)).collect::<BTreeSet<String>>());
        let index = |path: &Path| people.binary_search(&person_of(path)).unwrap_or(0);
        files.retain(|path| is_chosen(index(path)));
        if files.is_empty() {
            let message = format!("its {} people are too few to share among the splits", people.len());
            return Err(FileError::unsuitable(folder, message));
        }
        Ok(Self { files })
    }

    /// The person of this name: one of the characters, life-size in metres, standing on y = 0 and facing +z. Often in
    /// one of `poses`.
    ///
    /// # Errors
    /// [`FileError`] naming a file that is damaged or no character, and why.
    pub fn person(&self, name: &str, poses: Option<&Poses>) -> Result<Character, FileError> {
        let mut random = random::stream(&format!("avatars/{name}"));
        let path = &self.files[random.random_range(0..self.files.len())];
        character(path, poses, &mut random)
    }
}

/// Transforms of the bones of a character that faces +z, with the joint names of Mixamo or MakeHuman, in a pose.
///
/// # Errors
/// A sentence that names a missing joint, or a bone that is not below the hips.
pub fn placed(bones: &[import::Bone], pose: &Pose) -> Result<Vec<Placed>, String> {
    let skeleton = Skeleton::new(bones)?;
    // The axes of a figure do not depend on its proportions.
    let goal = Figure::new(Build::default(), pose);
    let placed = skeleton::placed(&skeleton.bones, &skeleton.rest, pose, &goal);
    let row = |(bone, row): (&import::Bone, &Option<usize>)| {
        row.map(|row| placed[row]).ok_or_else(|| format!("`{}` is not below the hips", bone.name))
    };
    bones.iter().zip(&skeleton.rows).map(row).collect()
}

/// The person that a file shows: its name up to the last `_`.
fn person_of(path: &Path) -> String {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    stem.rsplit_once('_').map_or(&*stem, |(person, _)| person).to_owned()
}

fn character(path: &Path, poses: Option<&Poses>, random: &mut ChaCha8Rng) -> Result<Character, FileError> {
    let wrong = |message: String| FileError::unsuitable(path, message);
    let Rigged { mut mesh, mut bones, weights, has_animations } = import::read_rigged(path)?;
    if weights.is_empty() {
        return Err(wrong("has no skin".into()));
    }
    if mesh.positions.len() + mesh.faces.len() > LARGEST {
        let (positions, faces) = (mesh.positions.len(), mesh.faces.len());
        let message = format!("has {positions} positions and {faces} triangles, more than {LARGEST} in all");
        return Err(wrong(message));
    }
    let facing = joints::facing(&bones).map_err(wrong)?;
    let turn = rotate_y(-facing);
    mesh.positions.iter_mut().for_each(|p| *p = turn * *p);
    bones.iter_mut().for_each(|bone| bone.place = turn * bone.place);
    let (low, high) = mesh.bounds();
    let height = high.y - low.y;
    if !HEIGHTS.contains(&height) {
        let (low, high) = (HEIGHTS.start(), HEIGHTS.end());
        return Err(wrong(format!("is {height} m high, expected {low} to {high}: glTF's unit is the metre")));
    }
    let mut skeleton = Skeleton::new(&bones).map_err(wrong)?;
    for (position, weights) in weights.iter().enumerate() {
        let outside = |(bone, share): &&(u32, f32)| *share > 0.0 && skeleton.rows[*bone as usize].is_none();
        if let Some((bone, _)) = weights.iter().find(outside) {
            let name = snapsnap_base::quoted(&bones[*bone as usize].name);
            return Err(wrong(format!("position {position} follows `{name}`, which is not below the hips")));
        }
    }
    skeleton.vary(random);

    let main = |weights: &import::Weights| {
        let (bone, _) = weights.iter().max_by(|a, b| a.1.total_cmp(&b.1)).copied().unwrap_or_default();
        skeleton.rows[bone as usize].map_or(Region::Trunk, |row| skeleton.regions[row])
    };
    let regions: Vec<Region> = weights.iter().map(main).collect();
    let owners = regions.iter().map(|region| match region {
        Region::Trunk | Region::Leg => Owner::Solid,
        Region::Hand(side) => Owner::Hand(*side),
        _ => Owner::Other,
    });
    let owners: Vec<Owner> = owners.collect();
    let build = Build { stature: height, ..Build::draw(random) };
    let mut pose = Poses::any(poses, random);
    pose.spread_arms(0.0);
    let rest = mesh.positions.clone();
    let posed = |pose: &Pose| {
        let goal = Figure::new(build.clone(), pose);
        let placed = skeleton::placed(&skeleton.bones, &skeleton.rest, pose, &goal);
        let moved = |(p, weights): (&Vec3, &import::Weights)| {
            let parts = weights
                .iter()
                .filter(|(_, share)| *share > 0.0)
                .filter_map(|(bone, share)| Some(*share * placed[skeleton.rows[*bone as usize]?].apply(*p)));
            parts.sum()
        };
        rest.iter().zip(&weights).map(moved).collect::<Vec<Vec3>>()
    };
    let faces = mesh.faces.clone();
    let sunk = |positions: &Vec<Vec3>| {
        let body = Mesh { positions: positions.clone(), faces: faces.clone(), ..Mesh::default() };
        skeleton::sunk_hands(positions, &body.normals(), &owners, GAP)
    };
    mesh.positions = pose.free_hands(posed, sunk);
    colors::vary(&mut mesh, &regions, random);
    stand(&mut mesh);
    Ok(Character { mesh, has_animations })
}

impl Skeleton {
    /// Randomly scales lengths and girths of trunk, arms and legs, and sizes of head, hands and feet.
    fn vary(&mut self, random: &mut ChaCha8Rng) {
        let mut between = |range: f32| 1.0 + range * random.random_range(-1.0..1.0_f32);
        let girth = between(0.06);
        let limbs = [(); 3].map(|()| (between(0.05), girth * between(0.05)));
        let ends = [(); 3].map(|()| between(0.03));
        for (bone, (region, axis)) in self.bones.iter_mut().zip(self.regions.iter().zip(&self.axes)) {
            let (along, across) = match region {
                Region::Trunk => limbs[0],
                Region::Arm => limbs[1],
                Region::Leg => limbs[2],
                Region::Head => (ends[0], ends[0]),
                Region::Hand(_) => (ends[1], ends[1]),
                Region::Foot => (ends[2], ends[2]),
            };
            let axes = Mat3::from_cols(*axis * axis.x, *axis * axis.y, *axis * axis.z);
            bone.scale = across * Mat3::IDENTITY + (along - across) * axes;
        }
    }
}
