//! MakeHuman's data: a base mesh of a few tubes with all the names that people are made by, clothes and hair bound to
//! it, and a motion file.

use std::path::Path;

use glam::Vec3;

use super::super::Format;
use super::{put, scans};

/// What all have in common. The person of this seed wears a suit, shoes and hair.
const PEOPLE: Format = Format {
    name: "",
    sample: write,
    changed: &[],
    command: "prepare makehuman in --subjects 1 --seed 2 -o out --set views.count=2 --set views.resolution=16 --set views.samples_per_axis=1",
    file: None,
    partial: false,
    kept: scans::DESCRIPTIONS,
    whole: scans::data_set,
    share: 8,
};

pub const FORMATS: &[Format] = &[
    Format { name: "makehuman", changed: &["base.obj", ".mhskel", ".mhw", ".target"], ..PEOPLE },
    Format { name: "mhclo", changed: &[".mhclo", "worn.obj"], ..PEOPLE },
    Format { name: "bvh", changed: &[".bvh"], ..PEOPLE },
];

/// Corners of a tube's rings.
const CORNERS: usize = 6;
/// Bones in the middle: name, head and tail in metres.
const BONES: [(&str, [f32; 3], [f32; 3]); 6] = [
    ("root", [0.0, 0.9, 0.0], [0.0, 1.0, 0.0]),
    ("spine03", [0.0, 1.0, 0.0], [0.0, 1.1, 0.0]),
    ("neck01", [0.0, 1.4, 0.0], [0.0, 1.45, 0.0]),
    ("head", [0.0, 1.5, 0.0], [0.0, 1.7, 0.0]),
    ("jaw", [0.0, 1.52, 0.05], [0.0, 1.48, 0.1]),
    ("oris01", [0.0, 1.53, 0.1], [0.0, 1.53, 0.11]),
];
/// Bones of the left side.
const SIDED: [(&str, [f32; 3], [f32; 3]); 9] = [
    ("eye", [0.03, 1.6, 0.08], [0.03, 1.6, 0.1]),
    ("clavicle", [0.05, 1.4, 0.0], [0.15, 1.42, 0.0]),
    ("upperarm01", [0.18, 1.4, 0.0], [0.3, 1.3, 0.0]),
    ("lowerarm01", [0.4, 1.15, 0.0], [0.5, 1.0, 0.03]),
    ("wrist", [0.55, 0.95, 0.05], [0.58, 0.9, 0.06]),
    ("finger3-3", [0.62, 0.85, 0.07], [0.65, 0.8, 0.08]),
    ("upperleg01", [0.1, 0.9, 0.0], [0.1, 0.7, 0.0]),
    ("lowerleg01", [0.1, 0.5, 0.01], [0.1, 0.3, 0.0]),
    ("foot", [0.1, 0.08, 0.0], [0.1, 0.03, 0.1]),
];
/// Folders of details.
const DETAILS: [&str; 8] = ["nose", "mouth", "chin", "head", "ears", "torso", "hip", "stomach"];

/// A base mesh in the making: text of its OBJ, and the bone of each vertex.
#[derive(Default)]
struct Base {
    text: String,
    bones: Vec<String>,
}

impl Base {
    fn vertex(&mut self, at: Vec3, bone: &str) -> usize {
        // MakeHuman counts in decimetres.
        let [x, y, z] = (10.0 * at).to_array();
        self.text += &format!("v {x} {y} {z}\n");
        self.bones.push(bone.to_owned());
        self.bones.len() - 1
    }

    /// A tube through these points, closed at both ends.
    fn tube(&mut self, points: &[Vec3], radius: f32, bone: &str) {
        let first = self.bones.len();
        let along = (points[points.len() - 1] - points[0]).normalize();
        let (u, v) = along.any_orthonormal_pair();
        for point in points {
            for corner in 0..CORNERS {
                let (sin, cos) = (corner as f32 * std::f32::consts::TAU / CORNERS as f32).sin_cos();
                self.vertex(*point + radius * (cos * u + sin * v), bone);
            }
        }
        let row = |ring: usize, corner: usize| first + ring * CORNERS + corner % CORNERS + 1;
        for ring in 0..points.len() - 1 {
            for corner in 0..CORNERS {
                let [a, b] = [corner, corner + 1].map(|corner| row(ring, corner));
                let [c, d] = [corner + 1, corner].map(|corner| row(ring + 1, corner));
                self.text += &format!("f {a}/1 {b}/1 {c}/1 {d}/1\n");
            }
        }
        for ring in [0, points.len() - 1] {
            for corner in 1..CORNERS - 1 {
                let [a, b, c] = [0, corner, corner + 1].map(|corner| row(ring, corner));
                self.text += &format!("f {a} {b} {c}\n");
            }
        }
    }
}

/// All bones of both sides.
fn bones() -> Vec<(String, Vec3, Vec3)> {
    let whole =
        |name: &str, head: [f32; 3], tail: [f32; 3]| (name.to_owned(), Vec3::from(head), Vec3::from(tail));
    let mirror = Vec3::new(-1.0, 1.0, 1.0);
    let sided = SIDED.iter().flat_map(|(name, head, tail)| {
        let (_, head, tail) = whole(name, *head, *tail);
        [(format!("{name}.L"), head, tail), (format!("{name}.R"), mirror * head, mirror * tail)]
    });
    BONES.iter().map(|(name, head, tail)| whole(name, *head, *tail)).chain(sided).collect()
}

fn write(folder: &Path) {
    let bones = bones();
    let head = |name: &str| bones.iter().find(|(bone, ..)| bone == name).expect("a bone").1;
    let mut base = Base::default();
    for (group, more) in [("body", 0.0), ("helper-tights", 0.01)] {
        base.text += &format!("g {group}\n");
        let up = [0.85, 1.1, 1.42].map(|y| Vec3::new(0.0, y, 0.0));
        base.tube(&up, 0.14 + more, "spine03");
        base.tube(&[Vec3::new(0.0, 1.42, 0.0), Vec3::new(0.0, 1.72, 0.0)], 0.08 + more, "head");
        for side in ["L", "R"] {
            let joint = |name: &str| head(&format!("{name}.{side}"));
            base.tube(
                &["upperarm01", "lowerarm01", "wrist"].map(joint),
                0.04 + more,
                &format!("upperarm01.{side}"),
            );
            base.tube(&["wrist", "finger3-3"].map(joint), 0.03 + more, &format!("wrist.{side}"));
            base.tube(
                &["upperleg01", "lowerleg01", "foot"].map(joint),
                0.06 + more,
                &format!("upperleg01.{side}"),
            );
            let foot = joint("foot");
            base.tube(&[foot, foot + Vec3::new(0.0, -0.02, 0.15)], 0.04 + more, &format!("foot.{side}"));
        }
    }
    base.text += "g helper-skirt\n";
    base.tube(&[1.05, 0.8, 0.5].map(|y| Vec3::new(0.0, y, 0.0)), 0.2, "root");
    for (group, side) in [("helper-l-eye", "L"), ("helper-r-eye", "R")] {
        base.text += &format!("g {group}\n");
        let eye = head(&format!("eye.{side}"));
        base.tube(&[eye, eye + 0.02 * Vec3::Z], 0.012, "head");
    }
    // Joints are means of vertices: here each of one of its own.
    let mut joints = serde_json::Map::new();
    let mut rig = serde_json::Map::new();
    for (name, head, tail) in &bones {
        let ends = [("head", head), ("tail", tail)].map(|(end, at)| {
            let joint = format!("{name}____{end}");
            joints.insert(joint.clone(), serde_json::json!([base.vertex(*at, name)]));
            joint
        });
        let parent = (name != "root").then_some("root");
        let bone = serde_json::json!({"head": ends[0], "tail": ends[1], "parent": parent, "reference": null});
        rig.insert(name.clone(), bone);
    }
    let mut weights = serde_json::Map::new();
    for (name, ..) in &bones {
        let rows = (0..base.bones.len()).filter(|row| base.bones[*row] == *name);
        weights.insert(name.clone(), rows.map(|row| serde_json::json!([row, 1.0])).collect());
    }
    put(folder, "data/3dobjs/base.obj", &base.text);
    let pretty = |value: serde_json::Value| serde_json::to_vec_pretty(&value).expect("JSON");
    put(folder, "data/rigs/default.mhskel", pretty(serde_json::json!({"bones": rig, "joints": joints})));
    put(
        folder,
        "data/rigs/default_weights.mhw",
        pretty(serde_json::json!({"license": "CC0", "weights": weights})),
    );
    // The trunk's lowest ring is the first of the base mesh, the head's follows its three rings.
    wear(folder, "clothes/suit", "", 0);
    wear(folder, "clothes/shoes", "tag Shoes\n", CORNERS);
    wear(folder, "hair/long", "", 3 * CORNERS);
    put(folder, "data/poses/stand.bvh", motion(&bones));
    for name in targets() {
        put(folder, &format!("data/targets/{name}.target"), "# a target\n0 0 .1 0\n7 0.01 0 -0.02\n");
    }
}

/// A tube of clothes or hair around the trunk or the head. Its vertices are bound to one vertex of the base mesh, or to
/// three.
fn wear(folder: &Path, asset: &str, tags: &str, first: usize) {
    // What is hidden may be missing, so it stands before the vertices: a file that was cut then lacks some of these.
    let hidden = format!("delete_verts\n{first} - {} {}\n", first + 2, first + CORNERS);
    let mut clothes =
        format!("# CC0\nname {asset}\n{tags}obj_file worn.obj\nx_scale 0 3 2.8\n{hidden}verts 0\n");
    let mut mesh = String::new();
    for row in 0..2 * CORNERS {
        let at = first + row;
        clothes += &match row % 2 {
            0 => format!("{at}\n"),
            _ => format!("{at} {first} {} 0.8 0.1 0.1 0.0 0.05 -0.02\n", first + 1),
        };
        mesh += &format!("v 0 0 {row}\nvt 0.{row} 0.5\n");
    }
    for corner in 1..=CORNERS {
        let next = corner % CORNERS + 1;
        let [c, d] = [next, corner].map(|row| row + CORNERS);
        mesh += &format!("f {corner}/{corner} {next}/{next} {c}/{c} {d}/{d}\n");
    }
    put(folder, &format!("data/{asset}/worn.mhclo"), clothes);
    put(folder, &format!("data/{asset}/worn.obj"), mesh);
}

/// A motion file of one frame in which the bones rest.
fn motion(bones: &[(String, Vec3, Vec3)]) -> String {
    let mut text =
        String::from("HIERARCHY\nROOT root\n{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition ");
    text += "Zrotation Xrotation Yrotation\n";
    for (name, head, _) in &bones[1..] {
        let Vec3 { x, y, z } = *head - bones[0].1;
        text += &format!(
            "JOINT {name}\n{{\nOFFSET {x} {y} {z}\nCHANNELS 3 Zrotation Xrotation Yrotation\nEnd Site\n{{\nOFFSET 0 0 0\n}}\n}}\n"
        );
    }
    let numbers = "0 ".repeat(6 + 3 * (bones.len() - 1));
    text + &format!("}}\nMOTION\nFrames: 1\nFrame Time: 0.04\n{numbers}\n")
}

/// Names of all targets that a person may be mixed from.
fn targets() -> Vec<String> {
    let mut names: Vec<String> = DETAILS.iter().map(|folder| format!("{folder}/{folder}-a")).collect();
    let each = |words: [&'static str; 3]| words.into_iter();
    for sex in ["female", "male"] {
        for age in ["child", "young", "old"] {
            names.extend(
                each(["african", "asian", "caucasian"]).map(|of| format!("macrodetails/{of}-{sex}-{age}")),
            );
            for muscle in ["minmuscle", "averagemuscle", "maxmuscle"] {
                for weight in ["minweight", "averageweight", "maxweight"] {
                    let build = format!("{sex}-{age}-{muscle}-{weight}");
                    names.push(format!("macrodetails/universal-{build}"));
                    names.extend(
                        ["minheight", "maxheight"].map(|h| format!("macrodetails/height/{build}-{h}")),
                    );
                    names.extend(
                        ["uncommonproportions", "idealproportions"]
                            .map(|p| format!("macrodetails/proportions/{build}-{p}")),
                    );
                }
            }
        }
    }
    names
}
