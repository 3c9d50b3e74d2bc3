//! Skeletons against the truth: the joints of reconstructed people of MakeHuman's data, and the people in another pose.
//!
//! ```sh
//! snapsnap prepare makehuman MAKEHUMAN_DATA -o made --subjects 60 --split test --seed 65 --config phone.toml
//! # NAME_front.png and NAME_back.png of views 0 and 1, before a background, become people/NAME.ply:
//! snapsnap reconstruct --pairs photographs -o people
//! cargo run --release --example skeletons -- people MAKEHUMAN_DATA makehuman/65/test
//! ```
//!
//! A second row of errors has the joints of Gaussians on the true surface: what remains is the skeleton's own error. Surfaces are aligned by a similarity (iterative closest points) before they and their joints are compared.

use std::env;
use std::error::Error;
use std::path::Path;
use std::time::Instant;

use burn::tensor::{Device, Tensor, TensorData};
use glam::Vec3;
use rand::Rng;
use snapsnap_base::random::stream;
use snapsnap_eval::geometry::{Alignment, chamfer, icp, sampled};
use snapsnap_mesh::fuse::{Options, fuse};
use snapsnap_mesh::import;
use snapsnap_mesh::mesh::Mesh;
use snapsnap_people::makehuman::{Library, rigged};
use snapsnap_people::{Detail, Pose};
use snapsnap_rig::{Bone, Rig, pose_mesh};
use snapsnap_splat::Gaussians;
use snapsnap_splat::scene::{Loaded, Stored};

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
/// Distance between Gaussians of a true surface, metres.
const SPACING: f32 = 0.003;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let [people, data, identities] = &arguments[..] else {
        return Err("expected PEOPLE DATA IDENTITIES".into());
    };
    let library = Library::open(Path::new(data))?;
    let mut errors = [vec![Vec::new(); 6], vec![Vec::new(); 6]];
    let (mut uneven, mut surfaces) = (Vec::new(), [Vec::new(), Vec::new()]);
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
        let truly = on_surface(&true_mesh, &mut stream(&identity))?;
        let own = Rig::new(&truly, &fuse(&truly, Options::default(), &|_| {})?.mesh)?;
        let mut apart = [[0.0; 6]; 2];
        for (kind, rig) in [&rig, &own].into_iter().enumerate() {
            for (row, (ours, theirs)) in JOINTS.iter().enumerate() {
                for (side, letter) in [("Left", 'L'), ("Right", 'R')] {
                    let found = start(&rig.bones, &format!("{side}{ours}"));
                    let found = if kind == 0 { Vec3::from(alignment.apply(found.to_array())) } else { found };
                    let error = 1e3 * found.distance(place(&true_bones, &format!("{theirs}.{letter}")));
                    errors[kind][row].push(error);
                    apart[kind][row] += 0.5 * error;
                }
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
        let [apart, own] = apart.map(|errors| errors.map(|error| format!("{error:.0}")).join(" "));
        println!(
            "{index:04}: {apart} mm, on the true surface {own} mm, surface {before:.1} mm, posed {after:.1} mm, {seconds:.2} s {unsure:?}"
        );
    }
    println!("joint: mean and median error in mm; of Gaussians on the true surface");
    let mut all = [Vec::new(), Vec::new()];
    for (row, (name, _)) in JOINTS.iter().enumerate() {
        let figures = [0, 1].map(|kind| {
            all[kind].extend_from_slice(&errors[kind][row]);
            figures(&mut errors[kind][row])
        });
        println!("{name}: {}", figures.join("; "));
    }
    println!("all: {}", all.map(|mut all| figures(&mut all)).join("; "));
    println!("left against right, percent: {}", figures(&mut uneven));
    let [mut before, mut after] = surfaces;
    println!("Chamfer distance, mm: {}; in another pose: {}", figures(&mut before), figures(&mut after));
    Ok(())
}

/// Gaussians everywhere on a surface, in its colours.
fn on_surface(mesh: &Mesh, random: &mut impl Rng) -> Result<Loaded, Box<dyn Error>> {
    let (mut means, mut colors) = (Vec::new(), Vec::new());
    for face in &mesh.faces {
        let [a, b, c] = face.positions.map(|row| mesh.positions[row as usize]);
        let count = 0.5 * (b - a).cross(c - a).length() / (SPACING * SPACING);
        let material = &mesh.materials[face.material as usize];
        for _ in 0..(count + random.random::<f32>()) as usize {
            let (u, v) = (random.random::<f32>(), random.random::<f32>());
            let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
            let mut color =
                material.color * mesh.colors.get(face.positions[0] as usize).copied().unwrap_or(Vec3::ONE);
            if let (Some(rows), Some(texture)) = (face.texcoords, &material.texture) {
                let [a, b, c] = rows.map(|row| mesh.texcoords[row as usize]);
                let at = (a + u * (b - a) + v * (c - a)).rem_euclid(glam::Vec2::ONE);
                let (width, height) = texture.dimensions();
                let pixel = [at.x * width as f32, (1.0 - at.y) * height as f32].map(|x| x as u32);
                let texel = texture.get_pixel(pixel[0].min(width - 1), pixel[1].min(height - 1));
                color *= Vec3::from(texel.0.map(|byte| f32::from(byte) / 255.0));
            }
            means.extend((a + u * (b - a) + v * (c - a)).to_array());
            colors.extend(color.to_array());
        }
    }
    let n = means.len() / 3;
    let device = Device::flex();
    let rows =
        |values: Vec<f32>, width: usize| Tensor::<2>::from_data(TensorData::new(values, [n, width]), &device);
    let turns = rows([1.0, 0.0, 0.0, 0.0].repeat(n), 4);
    let scales = rows(vec![0.7 * SPACING; 3 * n], 3);
    let gaussians =
        Gaussians::new(rows(means, 3), turns, scales, Tensor::full([n], 0.99, &device), rows(colors, 3))?;
    Ok(Stored::of(&gaussians)?.load(&device))
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
