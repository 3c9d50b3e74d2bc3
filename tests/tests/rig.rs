//! Skeletons: `rig`, and `reconstruct --rig`.

use std::io::Read;
use std::sync::LazyLock;

use burn::tensor::{Device, Tensor};
use glam::Vec3;
use serde_json::Value;
use snapsnap_mesh::import::{self, Bone};
use snapsnap_splat::{Gaussians, scene};
use snapsnap_tests::workplace::Workplace;
use snapsnap_tests::{data, sample, succeed, values};

/// Options of a mesh that is made soon.
const SMALL: &str = "--faces 20000 --texture 0";

/// The person of the sample pair: its Gaussians, and its mesh with a skeleton.
static PERSON: LazyLock<[Vec<u8>; 2]> = LazyLock::new(|| {
    let place = Workplace::empty();
    let mesh = place.path("human.glb");
    let mut command = sample::reconstruct(place.folder(), &sample::paths());
    succeed(command.arg("--mesh").arg(mesh).arg("--rig").args(SMALL.split(' ')));
    ["human.ply", "human.glb"].map(|name| place.read(name))
});

/// A folder with `human.ply` and `human.glb`.
fn with_person() -> Workplace {
    let place = Workplace::empty();
    for (name, bytes) in ["human.ply", "human.glb"].iter().zip(&*PERSON) {
        place.write(name, bytes);
    }
    place
}

/// `rig` of the person, on the CPU.
fn rig(place: &Workplace, line: &str) -> String {
    succeed(&mut place.run(&format!("rig human.ply --device cpu {line}")))
}

fn at(bones: &[Bone], name: &str) -> Vec3 {
    let name = format!("mixamorig:{name}");
    bones.iter().find(|bone| bone.name == name).unwrap_or_else(|| panic!("no bone {name}")).place
}

fn bones(place: &Workplace, name: &str) -> Vec<Bone> {
    import::read_rigged(&place.path(name)).expect("a character").bones
}

/// The description in a binary glTF.
fn description(bytes: &[u8]) -> Value {
    let length = u32::from_le_bytes(bytes[12..16].try_into().expect("4 bytes")) as usize;
    serde_json::from_slice(&bytes[20..20 + length]).expect("JSON")
}

fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    values(tensor)
}

fn gaussians(place: &Workplace, name: &str) -> Gaussians {
    scene::read(&place.path(name), &Device::flex()).expect("Gaussians").gaussians
}

#[test]
fn a_person_gets_the_bones_of_a_person_and_every_position_follows_them() {
    let place = with_person();
    let said = rig(&place, &format!("-o again.glb {SMALL}"));
    assert!(said.contains("22 bones"), "{said}");
    let character = import::read_rigged(&place.path("human.glb")).expect("a character");
    let bones = &character.bones;
    assert_eq!(bones.iter().filter(|bone| bone.name.starts_with("mixamorig:")).count(), 22);
    // `reconstruct --rig` makes the same, but for the rounding of the Gaussians' file, by which cells of 1 cm lie inside or not.
    for (a, b) in bones.iter().zip(self::bones(&place, "again.glb")) {
        assert!(a.name == b.name && a.place.distance(b.place) < 5e-3, "{a:?} {b:?}");
    }
    let (low, high) = character.mesh.bounds();
    let height = high.y - low.y;
    // Shares of the height, by anthropometry.
    for (name, share) in [("Head", 0.88), ("Neck", 0.83), ("Hips", 0.54)] {
        let found = (at(bones, name).y - low.y) / height;
        assert!((found - share).abs() < 0.05, "{name} at {found} of the height");
    }
    for (name, share) in [("Arm", 0.81), ("UpLeg", 0.51), ("Leg", 0.28), ("Foot", 0.05)] {
        let [left, right] = ["Left", "Right"].map(|side| at(bones, &format!("{side}{name}")));
        assert!(left.x > right.x + 0.05, "{name}: left {left}, right {right}");
        for found in [left, right].map(|joint| (joint.y - low.y) / height) {
            assert!((found - share).abs() < 0.05, "{name} at {found} of the height");
        }
    }
    for (row, weights) in character.weights.iter().enumerate() {
        let sum: f32 = weights.iter().map(|(_, weight)| weight).sum();
        assert!((sum - 1.0).abs() < 1e-5, "position {row}: {weights:?}");
        assert!(
            weights.iter().all(|(bone, weight)| *weight >= 0.0 && (*bone as usize) < bones.len()),
            "{weights:?}"
        );
    }
}

#[test]
fn motions_become_animations_of_every_bone() {
    let place = with_person();
    let mut motion = String::new();
    let file = std::fs::File::open(data("makehuman.zip")).expect("test data");
    let mut archive = zip::ZipArchive::new(file).expect("a ZIP");
    let mut entry = archive.by_name("data/poses/stand.bvh").expect("a motion file");
    entry.read_to_string(&mut motion).expect("text");
    let (head, numbers) = motion.split_once("Frames: 1\n").expect("one frame");
    let (time, frame) = numbers.split_once('\n').expect("lines");
    place.write("two.bvh", format!("{head}Frames: 2\n{time}\n{frame}\n{frame}"));
    rig(&place, &format!("-o human.glb --motion walk --motion two.bvh {SMALL}"));
    let json = description(&place.read("human.glb"));
    let animations = json["animations"].as_array().expect("animations");
    assert_eq!(animations.iter().map(|one| &one["name"]).collect::<Vec<_>>(), ["walk", "two"]);
    for (one, seconds) in animations.iter().zip([1.1, 0.04]) {
        assert_eq!(one["channels"].as_array().expect("channels").len(), 23);
        let times = one["samplers"][0]["input"].as_u64().expect("an index") as usize;
        let last = json["accessors"][times]["max"][0].as_f64().expect("seconds");
        assert!((last - seconds).abs() < 1e-6, "{last}");
    }

    place.write("still.bvh", format!("{head}Frames: 2\nFrame Time: 0\n{frame}\n{frame}"));
    place.write("none.bvh", format!("{head}Frames: 0\nFrame Time: 0.04\n"));
    place.write("endless.bvh", format!("{head}Frames: 99999999999\n{time}\n{frame}"));
    for (line, expected) in [
        ("-o a.glb --motion still.bvh", "still.bvh: has no time between its frames"),
        ("-o a.glb --motion none.bvh", "none.bvh: has no frames"),
        ("-o a.glb --motion endless.bvh", "endless.bvh: has more than"),
        ("-o a.glb --motion fly", "fly: is no .bvh, and no pose or motion of this name exists"),
        ("-o a.glb --pose walk --frame 99", "walk: has 34 frames"),
        ("-o a.glb --pose two.bvh --frame 2", "has 2 frames, numbered from 0: no frame 2"),
        ("-o two.bvh --pose two.bvh", "two.bvh: is no .glb, .ply, .spz or .sog"),
        ("-o human.ply --pose t", "human.ply"),
        ("-o human.glb --pose human.glb", "human.glb"),
        ("-o a.ply", "a.ply: Gaussians have no skeleton"),
        ("-o a.ply --pose t --faces 900", "only a .glb has a surface"),
        ("-o no/a.glb", "no/a.glb"),
    ] {
        let message = place.refusal(&mut place.run(&format!("rig human.ply --device cpu {line}")));
        assert!(message.contains(expected), "{line}: {message}");
    }
}

#[test]
fn in_the_pose_of_game_engines_the_arms_are_level_and_bones_keep_their_lengths() {
    let place = with_person();
    rig(&place, &format!("-o t.glb --pose t {SMALL}"));
    let (before, after) = (bones(&place, "human.glb"), bones(&place, "t.glb"));
    for side in ["Left", "Right"] {
        let joint = |bones: &[Bone], name: &str| at(bones, &format!("{side}{name}"));
        let arm = joint(&after, "Hand") - joint(&after, "Arm");
        assert!(arm.y.abs() < 0.02 && arm.x.abs() > 0.35, "{side}: {arm}");
        for (a, b) in [("Arm", "ForeArm"), ("ForeArm", "Hand"), ("UpLeg", "Leg"), ("Leg", "Foot")] {
            let [was, is] = [&before, &after].map(|bones| joint(bones, a).distance(joint(bones, b)));
            assert!((was - is).abs() < 1e-3, "{side}{a}: {was} m, then {is} m");
        }
    }
    // The Gaussians follow the same bones.
    rig(&place, "-o t.ply --pose t");
    let [was, is] = ["human.ply", "t.ply"].map(|name| gaussians(&place, name));
    assert_eq!(host(was.scales), host(is.scales.clone()));
    let span = |gaussians: &Gaussians, axis: usize| {
        let means = host(gaussians.means.clone());
        let along: Vec<f32> = means.iter().skip(axis).step_by(3).copied().collect();
        along.iter().copied().fold(f32::MIN, f32::max) - along.iter().copied().fold(f32::MAX, f32::min)
    };
    let reach = at(&after, "LeftHand").x - at(&after, "RightHand").x;
    let span = span(&is, 0);
    assert!(span > reach + 0.1 && span < reach + 0.5, "{span} m wide, wrists {reach} m apart");
}
