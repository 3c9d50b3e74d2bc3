//! Scans of people: the collections' files and splits, and the normalisation of scans.

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use glam::{Mat3, Vec3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::dataset::Split;
use snapsnap_base::{FileError, folder};
use snapsnap_mesh::import;
use snapsnap_mesh::mesh::{Mesh, MeshError};

/// Height of a normalised subject in metres (docs/method.md, "Scans"). The real height is dropped on purpose: two
/// photographs do not show it.
pub const HEIGHT: f32 = 1.8;
/// Largest random change of a training subject's height, in metres.
const HEIGHT_JITTER: f32 = 0.05;

/// A collection of scans with its conventions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Collection {
    /// THuman2.0: subjects 0 to 525.
    Thuman20,
    /// THuman2.1: THuman2.0 and the subjects from 526 on.
    Thuman21,
    /// CustomHumans.
    CustomHumans,
    /// 2K2K.
    TwoK2K,
    /// 4D-Dress.
    FourDDress,
    /// Other scans: y up, facing +z.
    Other,
}

impl Collection {
    /// The split of a subject, which is number `place` of its set, from 0. THuman follows the published lists. The
    /// first 100 of 2K2K and all of 4D-Dress are for testing, the others for training (docs/method.md, "Scans").
    pub fn split(self, subject: &str, place: usize) -> Split {
        match (self.of(subject), subject.parse::<u32>()) {
            (Self::FourDDress, _) => Split::Test,
            (Self::TwoK2K, _) if place < TESTED_2K2K => Split::Test,
            (Self::Thuman20, Ok(id)) if VALIDATION.contains(&id) || id <= 516 && id.is_multiple_of(6) => {
                Split::Val
            }
            (Self::Thuman21, Ok(id)) if LOOSE.contains(&id) => Split::Test,
            _ => Split::Train,
        }
    }

    /// The collection of one subject. THuman2.1 includes THuman2.0, which has other axes.
    pub fn of(self, subject: &str) -> Self {
        match (self, subject.parse::<u32>()) {
            (Self::Thuman21, Ok(id)) if id < 526 => Self::Thuman20,
            _ => self,
        }
    }

    /// Whether the SMPL-X parameters of a subject contain the direction that it faces. Subjects of other collections
    /// face +z (docs/method.md, "Cameras").
    pub fn has_orientation(self) -> bool {
        matches!(self, Self::Thuman20 | Self::Thuman21)
    }

    /// Rotation from the collection's axes to y up.
    fn axes(self) -> Mat3 {
        match self {
            // The matrix with rows (0, −1, 0), (0, 0, 1), (−1, 0, 0) (docs/method.md, "Scans").
            Self::Thuman21 => Mat3::from_cols(Vec3::NEG_Z, Vec3::NEG_X, Vec3::Y),
            _ => Mat3::IDENTITY,
        }
    }

    /// Whether subjects are moved so that the mean of their vertices is on the y axis.
    fn is_centred(self) -> bool {
        matches!(self, Self::TwoK2K | Self::FourDDress)
    }
}

/// Subjects of THuman2.0 for validation, besides every sixth up to 516.
const VALIDATION: [u32; 13] = [1, 2, 3, 9, 19, 21, 23, 25, 68, 302, 518, 522, 523];

/// Subjects of THuman2.1 in loose clothes, for testing.
const LOOSE: [u32; 50] = [
    2397, 1685, 2396, 2398, 2414, 2403, 1678, 2252, 835, 1403, 2251, 836, 951, 1321, 2410, 1679, 2199, 1391,
    2264, 1350, 1982, 1981, 1122, 2413, 1819, 1043, 1267, 2186, 865, 2148, 1392, 2092, 2198, 2409, 839, 2250,
    1681, 837, 2109, 1398, 1115, 659, 1123, 1816, 2230, 1693, 1367, 713, 2258, 1124,
];

/// Number of subjects at the beginning of 2K2K's training set that are for testing.
const TESTED_2K2K: usize = 100;

/// A scan's file and its subject.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Source {
    /// Name of the subject.
    pub subject: String,
    /// The scan.
    pub path: PathBuf,
}

/// Largest depth of folders in the search for scans.
const MAX_DEPTH: usize = 4;

/// The scans below `root`, or `root` itself, in the order of their paths. In a folder with a scan of its own name
/// (`0001/0001.obj`), other files are ignored. A subject has the name of its file, or, if that is no number, of its
/// folder and its file. Numbers get four digits, as in the authors' loader.
///
/// # Errors
/// [`FileError`] if `root` cannot be read, contains no scan, or contains two scans of one subject.
pub fn find(root: &Path) -> Result<Vec<Source>, FileError> {
    let mut paths = Vec::new();
    if root.is_file() {
        paths.push(root.to_owned());
    } else {
        search(root, 0, &mut HashSet::new(), &mut paths)?;
    }
    if paths.is_empty() {
        let message = format!("holds no scan: no file .{}", import::EXTENSIONS.join(", ."));
        return Err(FileError::unsuitable(root, message));
    }
    let stem = |path: &Path| path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let mut sources: Vec<Source> = Vec::new();
    for path in &paths {
        let (name, folder) = (stem(path), path.parent().unwrap_or(root));
        let is_unique = folder == root || root == path || stem(folder) == name || name.parse::<u32>().is_ok();
        let name = if is_unique { name } else { format!("{}-{name}", stem(folder)) };
        let subject =
            name.parse::<u32>().map_or_else(|_| subject_name(&name), |number| format!("{number:04}"));
        if let Some(other) = sources.iter().find(|other| other.subject == subject) {
            let message = format!("and {} would both be subject {subject}", other.path.display());
            return Err(FileError::unsuitable(path, message));
        }
        sources.push(Source { subject, path: path.clone() });
    }
    Ok(sources)
}

/// Makes a folder name that is valid on every system and not hidden.
fn subject_name(name: &str) -> String {
    let fine = |c: char| c.is_alphanumeric() || "-_. ".contains(c);
    let name: String = name.chars().take(60).map(|c| if fine(c) { c } else { '_' }).collect();
    let rest = name.trim_start_matches('.');
    let start = "_".repeat(name.len() - rest.len());
    if name.is_empty() { "_".into() } else { start + rest }
}

fn search(
    folder: &Path,
    depth: usize,
    visited: &mut HashSet<PathBuf>,
    found: &mut Vec<PathBuf>,
) -> Result<(), FileError> {
    // Links may form a circle.
    if !visited.insert(folder.canonicalize().unwrap_or_else(|_| folder.to_owned())) {
        return Ok(());
    }
    let entries = folder::entries(folder)?;
    let is_scan = |path: &Path| {
        let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        path.is_file() && extension.is_some_and(|e| import::EXTENSIONS.contains(&e.as_str()))
    };
    let own = entries.iter().find(|path| is_scan(path) && path.file_stem() == folder.file_name());
    if let Some(own) = own {
        found.push(own.clone());
        return Ok(());
    }
    for path in entries {
        if is_scan(&path) {
            found.push(path);
        } else if path.is_dir() && depth < MAX_DEPTH {
            search(&path, depth + 1, visited, found)?;
        }
    }
    Ok(())
}

/// Normalises a scan: axes, height, and feet on y = 0 (docs/method.md, "Scans"). For training, `jitter` changes the
/// height a little and moves the scan sideways.
///
/// # Errors
/// [`MeshError::NoHeight`].
pub fn normalise(
    mesh: &mut Mesh,
    collection: Collection,
    jitter: Option<&mut ChaCha8Rng>,
) -> Result<(), MeshError> {
    let axes = collection.axes();
    mesh.positions.iter_mut().for_each(|p| *p = axes * *p);
    let (low, high) = mesh.bounds();
    // The condition also fails for NaN and for an empty mesh.
    if !(high.y - low.y > 0.0 && (high - low).is_finite()) {
        return Err(MeshError::NoHeight);
    }
    let mut height = HEIGHT;
    let mut move_by = Vec3::ZERO;
    if let Some(random) = jitter {
        height += random.random_range(-HEIGHT_JITTER..HEIGHT_JITTER);
        let size = (high - low) * height / (high.y - low.y);
        let reach = match height {
            _ if size.x > 1.0 || size.z > 1.0 => 0.01,
            height if height < HEIGHT => 0.1,
            _ => 0.05,
        };
        move_by = Vec3::new(random.random_range(-reach..reach), 0.0, random.random_range(-reach..reach));
    }
    let scale = height / (high.y - low.y);
    let mut origin = Vec3::new(0.0, low.y, 0.0);
    if collection.is_centred() {
        let sum: glam::DVec3 = mesh.positions.iter().map(|p| p.as_dvec3()).sum();
        let mean = (sum / mesh.positions.len() as f64).as_vec3();
        (origin.x, origin.z) = (mean.x, mean.z);
    }
    mesh.positions.iter_mut().for_each(|p| *p = (*p - origin) * scale + move_by);
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::fs;

    use rand::SeedableRng;

    use super::*;

    fn cloud(positions: &[[f32; 3]]) -> Mesh {
        Mesh { positions: positions.iter().map(|p| Vec3::from_array(*p)).collect(), ..Mesh::default() }
    }

    #[test]
    fn scans_are_found_in_the_layouts_of_the_known_sets() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let root = folder.path();
        let touch = |name: &str| {
            let path = root.join(name);
            fs::create_dir_all(path.parent().expect("in the folder")).expect("make");
            fs::write(path, "").expect("write");
        };
        let subjects = |below: &str| -> Vec<String> {
            find(&root.join(below)).expect("finds").into_iter().map(|source| source.subject).collect()
        };
        ["th/0007/0007.obj", "th/0007/other.ply", "th/12/12.OBJ"].into_iter().for_each(touch);
        ["th/.x/a.obj", "th/notes.txt", "th/._7.obj"].into_iter().for_each(touch);
        assert_eq!(subjects("th"), ["0007", "0012"]);
        ["ch/a/mesh-f00011.obj", "ch/a/mesh-f00021.obj", "ch/b/mesh-f00011.obj"].into_iter().for_each(touch);
        assert_eq!(subjects("ch"), ["a-mesh-f00011", "a-mesh-f00021", "b-mesh-f00011"]);
        touch("2k/Training/00003/00003.ply");
        assert_eq!(subjects("2k"), ["0003"]);
        assert_eq!(subjects("2k/Training/00003/00003.ply"), ["0003"]);
        ["twice/0001.obj", "twice/1.ply"].into_iter().for_each(touch);
        assert!(find(&root.join("twice")).expect_err("same").to_string().contains("both be subject 0001"));
        fs::create_dir(root.join("empty")).expect("make");
        assert!(find(&root.join("empty")).expect_err("empty").to_string().contains("holds no scan"));
        assert!(find(&root.join("absent")).is_err());
    }

    #[test]
    fn names_of_subjects_are_valid_names_of_folders() {
        let names = ["a.b", ".hid", ".", "..", "...", "", "a/b", "ä 人-1", "\u{1b}[31m"];
        let expected = ["a.b", "_hid", "_", "__", "___", "_", "a_b", "ä 人-1", "__31m"];
        assert_eq!(names.map(subject_name), expected);
        let folder = tempfile::tempdir().expect("temporary folder");
        for (file, expected) in [(".hid.obj", "_hid"), ("..obj", "_"), ("...obj", "__")] {
            let path = folder.path().join(file);
            fs::write(&path, "").expect("write");
            assert_eq!(find(&path).expect("finds")[0].subject, expected);
        }
    }

    #[test]
    fn subjects_go_where_the_published_lists_say() {
        let train = (0..526).filter(|id| Collection::Thuman20.split(&id.to_string(), 0) == Split::Train);
        assert_eq!(train.count(), 426);
        assert_eq!(LOOSE.iter().collect::<HashSet<_>>().len(), 50);
        assert!(LOOSE.iter().all(|id| (526..2500).contains(id)));
        let collection = Collection::Thuman21;
        assert_eq!((collection.of("0525"), collection.of("0526")), (Collection::Thuman20, collection));
        for (collection, subject, place, split) in [
            (Collection::Thuman20, "0006", 7, Split::Val),
            (Collection::Thuman20, "0004", 7, Split::Train),
            (collection, "0659", 7, Split::Test),
            // THuman2.1 includes THuman2.0.
            (collection, "0006", 7, Split::Val),
            (Collection::TwoK2K, "0100", 99, Split::Test),
            (Collection::TwoK2K, "0101", 100, Split::Train),
            (Collection::FourDDress, "00185-f00021", 700, Split::Test),
        ] {
            assert_eq!(collection.split(subject, place), split, "{collection:?} {subject}");
        }
    }

    #[test]
    fn scans_without_height_are_refused() {
        for positions in [&[][..], &[[1.0, 2.0, 3.0]], &[[0.0, 1.0, 0.0], [1.0, 1.0, 0.0]]] {
            let result = normalise(&mut cloud(positions), Collection::Other, None);
            assert_eq!(result, Err(MeshError::NoHeight));
        }
    }

    /// Feet on the floor, and a height of 1.8 m.
    #[test]
    fn normalised_scans_have_the_places_and_axes_of_their_sets() {
        let normalised = |positions: &[[f32; 3]], collection: Collection| {
            let mut mesh = cloud(positions);
            normalise(&mut mesh, collection, None).expect("has height");
            mesh.positions
        };
        // Not moved sideways, only scaled by 0.15.
        let [low, high] = [Vec3::new(0.03, 0.0, 0.015), Vec3::new(0.06, 1.8, -0.045)];
        let found = normalised(&[[0.2, -3.0, 0.1], [0.4, 9.0, -0.3]], Collection::Thuman20);
        assert!((found[0] - low).length() < 1e-6 && (found[1] - high).length() < 1e-6, "{found:?}");
        // M·(a, b, c) = (−b, c, −a): height runs along the third axis.
        let found = normalised(&[[1.0, 2.0, 0.0], [1.0, 2.0, 3.6]], Collection::Thuman21);
        assert!((found[1] - Vec3::new(-1.0, 1.8, -0.5)).length() < 1e-6, "{found:?}");
        let found = normalised(&[[5.0, 0.0, 7.0], [5.4, 1.8, 7.2], [5.2, 0.9, 7.4]], Collection::TwoK2K);
        let mean = found.iter().sum::<Vec3>() / 3.0;
        assert!(mean.x.abs() < 1e-5 && mean.z.abs() < 1e-5);
    }

    #[test]
    fn training_scans_vary_within_the_published_ranges() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let (mut lowest, mut highest, mut furthest) = (9.0_f32, 0.0_f32, 0.0_f32);
        for wide in [false, true] {
            for _ in 0..300 {
                let x = if wide { 0.7 } else { 0.2 };
                let mut mesh = cloud(&[[-x, 0.0, -0.1], [x, 1.8, 0.1]]);
                normalise(&mut mesh, Collection::Thuman20, Some(&mut random)).expect("has height");
                let (low, high) = mesh.bounds();
                let middle = (low + high) / 2.0;
                let reach = match wide {
                    true => 0.01,
                    false if high.y < 1.8 => 0.1,
                    false => 0.05,
                };
                assert!(middle.x.abs() <= reach + 1e-6 && middle.z.abs() <= reach + 1e-6);
                assert!(low.y.abs() < 1e-6);
                (lowest, highest) = (lowest.min(high.y), highest.max(high.y));
                furthest = furthest.max(middle.x.abs());
            }
        }
        assert!((1.75..1.76).contains(&lowest) && (1.84..1.85).contains(&highest), "{lowest} {highest}");
        assert!(furthest > 0.09);
    }
}
