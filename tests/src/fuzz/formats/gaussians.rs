//! Files of Gaussians, PLY, SPZ and GLB, and the cameras that they are rendered from.

use std::fs;
use std::path::Path;

use burn::tensor::{Device, Tensor};
use snapsnap_base::config::Schema;
use snapsnap_mesh::import;
use snapsnap_net::config::Config;
use snapsnap_splat::{Camera, Gaussians, cameras, ply, scene};

use super::super::Format;
use super::put;
use crate::data;
use crate::ply::balls;

/// What all have in common.
const RENDER: Format = Format {
    name: "",
    sample: |_| (),
    changed: &["h.ply"],
    command: "render in/h.ply --orbit 2 --size 16x24 --device cpu -o out --raw out.safetensors",
    file: Some("out.safetensors"),
    partial: false,
    kept: &[],
    whole: pictures,
    share: 28,
};

pub const FORMATS: &[Format] = &[
    Format {
        name: "gaussians",
        sample: |folder| scene::write(&three(), &folder.join("h.ply")).expect("written"),
        ..RENDER
    },
    Format { name: "gaussians-ascii", sample: |folder| put(folder, "h.ply", file("ascii", 1)), ..RENDER },
    Format {
        name: "gaussians-big-endian",
        sample: |folder| put(folder, "h.ply", file("binary_big_endian", 2)),
        ..RENDER
    },
    // A mesh takes seconds, hence few cases.
    Format {
        name: "gaussians-mesh",
        sample: |folder| put(folder, "h.ply", balls(column(60), 0.08_f32.ln())),
        command: "mesh in/h.ply --faces 500 --device cpu -o out.ply",
        file: Some("out.ply"),
        whole: |folder| match import::read(&folder.join("out.ply")) {
            Ok(mesh) => mesh.check().map_err(|e| e.to_string()),
            Err(e) => Err(e.to_string()),
        },
        share: 2,
        ..RENDER
    },
    Format {
        name: "spz",
        sample: |folder| scene::write(&three(), &folder.join("h.spz")).expect("written"),
        changed: &["h.spz"],
        command: "render in/h.spz --orbit 2 --size 16x24 --device cpu -o out --raw out.safetensors",
        ..RENDER
    },
    Format {
        name: "gaussians-glb",
        sample: |folder| scene::write(&three(), &folder.join("h.glb")).expect("written"),
        changed: &["h.glb"],
        command: "render in/h.glb --orbit 2 --size 16x24 --device cpu -o out --raw out.safetensors",
        ..RENDER
    },
    // With spherical harmonics, from another implementation.
    Format {
        name: "spz-harmonics",
        sample: |folder| {
            put(folder, "h.spz", fs::read(data("spz/v3_degree3.spz")).expect("a file of the tests"));
        },
        changed: &["h.spz"],
        command: "convert in/h.spz out.ply",
        file: Some("out.ply"),
        whole: |folder| {
            scene::read(&folder.join("out.ply"), &Device::flex()).map(drop).map_err(|e| e.to_string())
        },
        ..RENDER
    },
    Format {
        name: "cameras",
        sample: |folder| {
            scene::write(&three(), &folder.join("h.ply")).expect("written");
            cameras::write(&Camera::orbit(2, 24, 16), &folder.join("cameras.json")).expect("written");
        },
        changed: &["cameras.json"],
        command: "render in/h.ply --cameras in/cameras.json --device cpu -o out",
        file: None,
        ..RENDER
    },
];

/// Places on an upright ellipsoid of 2 by 0.24 metres, whose mesh takes a third of the time of a ball's.
fn column(n: u16) -> impl ExactSizeIterator<Item = [f32; 3]> {
    (0..n).map(move |i| {
        let y = 1.0 - 2.0 * (f32::from(i) + 0.5) / f32::from(n);
        let (sin, cos) = (2.4 * f32::from(i)).sin_cos();
        let radius = (1.0 - y * y).sqrt();
        [0.12 * radius * cos, y, 0.12 * radius * sin]
    })
}

fn three() -> Gaussians {
    let device = Device::flex();
    Gaussians::new(
        Tensor::from_floats([[0.0, 0.3, 0.0], [0.1, 0.9, 0.05], [-0.1, 1.5, -0.05]], &device),
        Tensor::from_floats([[1.0, 0.0, 0.0, 0.0], [0.8, 0.6, 0.0, 0.0], [0.0, 0.0, 0.6, 0.8]], &device),
        Tensor::full([3, 3], 0.1, &device),
        Tensor::full([3], 0.9, &device),
        Tensor::full([3, 3], 0.5, &device),
    )
    .expect("three of each")
}

/// Two Gaussians with spherical harmonics of this degree behind a list that is skipped.
fn file(format: &str, degree: usize) -> Vec<u8> {
    let rest = 3 * ((degree + 1).pow(2) - 1);
    let names = ply::PROPERTIES[..9].iter().map(|name| (*name).to_owned());
    let names = names.chain((0..rest).map(|i| format!("f_rest_{i}")));
    let names: Vec<String> =
        names.chain(ply::PROPERTIES[9..].iter().map(|name| (*name).to_owned())).collect();
    let properties: String = names.iter().map(|name| format!("property float {name}\n")).collect();
    let mut bytes = format!(
        "ply\nformat {format} 1.0\ncomment for tests\nelement face 1\nproperty list uchar int vertex_indices\n\
         element vertex 2\n{properties}end_header\n"
    )
    .into_bytes();
    let value = |row: usize, name: &str| match name {
        "y" => 0.5 + row as f32,
        "opacity" => 2.0,
        "rot_0" => 1.0,
        name if name.starts_with("scale_") => -2.5,
        name if name.starts_with('f') => 0.25,
        _ => 0.0,
    };
    let rows = [0, 1].map(|row| names.iter().map(|name| value(row, name)).collect::<Vec<f32>>());
    if format == "ascii" {
        bytes.extend(b"3 0 1 0\n");
        for row in rows {
            let words: Vec<String> = row.iter().map(f32::to_string).collect();
            bytes.extend(format!("{}\n", words.join(" ")).bytes());
        }
    } else {
        bytes.push(3);
        bytes.extend([0_i32, 1, 0].into_iter().flat_map(i32::to_be_bytes));
        bytes.extend(rows.into_iter().flatten().flat_map(f32::to_be_bytes));
    }
    bytes
}

/// Whether `reconstruct` wrote a PLY that can be read again, and its config.
pub fn reconstruction(folder: &Path) -> Result<(), String> {
    let loaded = scene::read(&folder.join("out.ply"), &Device::flex()).map_err(|e| e.to_string())?;
    if loaded.gaussians.is_empty() {
        return Err("the PLY is empty".into());
    }
    Config::from_file(&folder.join("out.ply.config.toml"), &[]).map(drop).map_err(|e| e.to_string())
}

/// Whether `render` wrote as many pictures as cameras.
fn pictures(folder: &Path) -> Result<(), String> {
    let views = cameras::read(&folder.join("out/cameras.json"))
        .or_else(|_| {
            // The cameras that were given are not written again.
            let inputs = fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
            let given = inputs.map(|path| path.join("cameras.json")).find(|path| path.is_file());
            cameras::read(&given.unwrap_or_default())
        })
        .map_err(|e| e.to_string())?;
    for (row, view) in views.iter().enumerate() {
        let path = folder.join(format!("out/{row:03}.png"));
        let picture = image::open(&path).map_err(|e| format!("picture {row}: {e}"))?;
        if (picture.width(), picture.height()) != (view.width, view.height) {
            return Err(format!("picture {row} has another size than its camera"));
        }
    }
    Ok(())
}
