//! Configs of evaluations and benchmarks, and their inputs: test sets, meshes, pictures.

use std::fs;
use std::path::Path;

use image::{DynamicImage, GrayImage, ImageFormat, Luma};
use snapsnap_data::dataset::Split;

use super::super::Format;
use super::{datasets, nothing, pictures, put, scans, weights};

/// Every kind of key of an evaluation, with one ablation to save time.
const EVALUATION: &str = r#"
[data]
folders = ["in/set"]
split = "test"
subjects = 1
only = ["0000"]
scans = "in/scans"

[views]
inputs = [0, 2]
turns = [0]
resolution = 32
supersampling = 1

[model]
set = ["network.conf_threshold=0.4"]

[metrics]
protocols = ["paper", "masked"]
lpips = "in/none"
geometry = true
opaque = 0.1

[baselines]
billboard = true
true_points = true
mean = ["in/set"]

[ablations.sideless]
sides = false

[groups.loose]
subjects = ["0000"]

[report]
people = 1
degrees = [0.0, 90.0]
"#;

/// Every kind of key of a benchmark.
const BENCH: &str = r#"
[data]
folders = ["in/set"]
split = "test"

[bench]
runs = 2
warm_up = 1
people = 1
views = 2
resolution = 32
oracle = 4
lpips = "in/none"

[model]
supersampling = 1

[settings."no sides"]
scene = "standing"
omits = "the sides"
sides = false
side_colors = false
stride = 2
min_opacity = 0.1
only = ["0000"]
inputs = [0, 2]

[settings.tuned]
knob = "Gaussians"
tune = "colors"
set = ["network.conf_threshold=0.4"]
preset = "gsplat"
antialiased = true
precision = "f32"
supersampling = 1
"#;

/// Common fields of all formats.
const REPORT: Format = Format {
    name: "",
    sample: |_| (),
    changed: &[],
    command: "",
    file: None,
    partial: true,
    kept: &[],
    whole: |work| report(work, "protocols"),
    share: 16,
};

pub const FORMATS: &[Format] = &[
    Format {
        name: "evaluation-config",
        sample,
        changed: &["e.toml"],
        command: "evaluate --config in/e.toml --weights in/w.safetensors --device cpu -o out",
        ..REPORT
    },
    Format {
        name: "evaluation-set",
        sample,
        // Of training people, only pictures are read.
        changed: &[
            "dataset.toml",
            "0000/1.png",
            "0000/2.png",
            "test/depth/0000/1.npz",
            "test/cameras/0000.json",
        ],
        command: "evaluate --config in/e.toml --weights in/w.safetensors --device cpu -o out",
        ..REPORT
    },
    Format {
        name: "evaluation-mesh",
        sample,
        changed: &["0000.obj"],
        command: "evaluate --config in/e.toml --mesh-dir in/scans --align similarity -o out",
        whole: |work| report(work, "geometry_cm"),
        ..REPORT
    },
    Format {
        name: "bench-config",
        sample,
        changed: &["b.toml"],
        command: "bench --config in/b.toml --quick --weights in/w.safetensors --device cpu -o out",
        whole: |work| report(work, "settings"),
        ..REPORT
    },
    Format {
        name: "compare",
        sample: compared,
        changed: &["a.png", "b.tiff", "m.png"],
        command: "compare in/a.png in/b.tiff --mask in/m.png --window mask --json",
        whole: nothing,
        ..REPORT
    },
];

/// A test person with a scan and a training person, with four views each; weights, and both configs.
fn sample(folder: &Path) {
    datasets::four_views(&folder.join("set"), &[Split::Test, Split::Train]);
    weights::write(folder);
    fs::create_dir(folder.join("scans")).expect("a folder");
    scans::obj(folder, "scans/0000");
    put(folder, "e.toml", EVALUATION);
    put(folder, "b.toml", BENCH);
}

/// Two pictures and a mask.
fn compared(folder: &Path) {
    let picture = DynamicImage::from(pictures::picture());
    put(folder, "a.png", pictures::encoded(&picture, ImageFormat::Png));
    let float = DynamicImage::ImageRgb32F(picture.to_rgb32f());
    put(folder, "b.tiff", pictures::encoded(&float, ImageFormat::Tiff));
    let mask =
        GrayImage::from_fn(picture.width(), picture.height(), |x, _| Luma([if x < 40 { 255 } else { 0 }]));
    put(folder, "m.png", pictures::encoded(&DynamicImage::from(mask), ImageFormat::Png));
}

/// Whether there is a report with this key.
fn report(work: &Path, key: &str) -> Result<(), String> {
    let text = fs::read_to_string(work.join("out/report.json")).map_err(|e| format!("report.json: {e}"))?;
    let report: serde_json::Value = serde_json::from_str(&text).map_err(|e| format!("report.json: {e}"))?;
    let is_missing = |key: &&str| report[*key].is_null();
    match ["command", "left_out", key].iter().find(|key| is_missing(key)) {
        Some(key) => Err(format!("report.json has no `{key}`")),
        None => Ok(()),
    }
}
