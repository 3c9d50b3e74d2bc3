//! Skeletons against the truth: the joints of reconstructed people of MakeHuman's data, and the people in another pose.
//!
//! ```sh
//! snapsnap prepare makehuman MAKEHUMAN_DATA -o made --subjects 60 --split test --seed 65 --config phone.toml
//! # NAME_front.png and NAME_back.png of views 0 and 1, before a background, become people/NAME.ply:
//! snapsnap reconstruct --pairs photographs -o people
//! cargo run --release --example skeletons -- people MAKEHUMAN_DATA makehuman/65/test
//! ```
//!
//! Surfaces are aligned by a similarity (iterative closest points) before they and their joints are compared.

use std::env;
use std::error::Error;
use std::path::Path;
use std::time::Instant;

use burn::tensor::Device;
use glam::Vec3;
use snapsnap_base::random::stream;
use snapsnap_eval::geometry::{Alignment, chamfer, icp, sampled};
use snapsnap_mesh::fuse::{Options, fuse};
use snapsnap_mesh::import;
use snapsnap_mesh::mesh::Mesh;
use snapsnap_people::makehuman::{Library, rigged};
use snapsnap_people::{Detail, Pose};
use snapsnap_rig::{Bone, Rig, pose_mesh};
use snapsnap_splat::scene::Stored;

/// Bones of the left side by Mixamo's and by MakeHuman's names.
const JOINTS: [(&str, &str); 6] = [
    ("Arm", "upperarm01"),
    ("ForeArm", "lowerarm01"),
    ("Hand", "wrist"),
    ("UpLeg", "upperleg01"),
    ("Leg", "lowerleg01"),
    ("Foot", "foot"),
];
/// Points of a surface.
const POINTS: usize = 20_000;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let [people, data, identities] = &arguments[..] else {
        return Err("expected PEOPLE DATA IDENTITIES".into());
    };
    let library = Library::open(Path::new(data))?;
    let (mut errors, mut uneven, mut surfaces) = (vec![Vec::new(); 6], Vec::new(), [Vec::new(), Vec::new()]);
    for index in 0.. {
        let path = Path::new(people).join(format!("{index:04}.ply"));
        if !path.exists() {
            break;
        }
        let scene = Stored::read(&path)?.load(&Device::flex());
        let mut mesh = fuse(&scene, Options::default(), &|_| {})?.mesh;
        let since = Instant::now();
        let rig = Rig::new(&scene, &mesh)?;
        let skin = rig.skin(&mesh);
        let seconds = since.elapsed().as_secs_f64();

        let identity = format!("{identities}/{index}");
        let truth = |pose| rigged(&library, &identity, None, pose, Detail::Coarse);
        let (true_mesh, true_bones) = truth(None)?;
        let (alignment, before) = compared(&mesh, &true_mesh)?;
        let mut apart = [0.0; 6];
        for (row, (ours, theirs)) in JOINTS.iter().enumerate() {
            for (side, letter) in [("Left", 'L'), ("Right", 'R')] {
                let found = start(&rig.bones, &format!("{side}{ours}"));
                let found = Vec3::from(alignment.apply(found.to_array()));
                let error = 1e3 * found.distance(place(&true_bones, &format!("{theirs}.{letter}")));
                errors[row].push(error);
                apart[row] += 0.5 * error;
            }
        }
        for names in [["Arm", "ForeArm"], ["ForeArm", "Hand"], ["UpLeg", "Leg"], ["Leg", "Foot"]] {
            let [left, right] = ["Left", "Right"].map(|side| {
                let [a, b] = names.map(|name| start(&rig.bones, &format!("{side}{name}")));
                a.distance(b)
            });
            uneven.push(200.0 * (left - right).abs() / (left + right));
        }
        let pose = Pose::draw(&mut stream(&format!("other pose/{identity}")));
        pose_mesh(&mut mesh, &skin.weights, &rig.transforms(&pose)?);
        let (_, after) = compared(&mesh, &truth(Some(&pose))?.0)?;
        surfaces[0].push(before);
        surfaces[1].push(after);
        let unsure: Vec<&str> = rig.bones.iter().filter(|bone| !bone.is_sure).map(Bone::short).collect();
        let apart = apart.map(|error| format!("{error:.0}")).join(" ");
        println!(
            "{index:04}: {apart} mm, surface {before:.1} mm, posed {after:.1} mm, {seconds:.2} s {unsure:?}"
        );
    }
    println!("joint: mean and median error in mm");
    let mut all = Vec::new();
    for ((name, _), errors) in JOINTS.iter().zip(&mut errors) {
        all.extend_from_slice(errors);
        println!("{name}: {}", figures(errors));
    }
    println!("all: {}", figures(&mut all));
    println!("left against right, percent: {}", figures(&mut uneven));
    let [mut before, mut after] = surfaces;
    println!("Chamfer distance, mm: {}; in another pose: {}", figures(&mut before), figures(&mut after));
    Ok(())
}

/// The similarity from one surface to another, and their distance in mm.
fn compared(mesh: &Mesh, truth: &Mesh) -> Result<(Alignment, f32), Box<dyn Error>> {
    let (points, onto) = (sampled(mesh, POINTS, 1)?, sampled(truth, POINTS, 2)?);
    let alignment = icp(&points, &onto, true)?;
    let moved: Vec<[f32; 3]> = points.into_iter().map(|point| alignment.apply(point)).collect();
    Ok((alignment, 1e3 * chamfer(&moved, &onto)?.mean() as f32))
}

fn start(bones: &[Bone], name: &str) -> Vec3 {
    bones.iter().find(|bone| bone.short() == name).expect("a bone of this name").ends[0]
}

fn place(bones: &[import::Bone], name: &str) -> Vec3 {
    bones.iter().find(|bone| bone.name == name).expect("a bone of this name").place
}

/// Mean and median.
fn figures(values: &mut [f32]) -> String {
    values.sort_by(f32::total_cmp);
    let mean = values.iter().sum::<f32>() / values.len() as f32;
    format!("{mean:.1}, {:.1}", values[values.len() / 2])
}
