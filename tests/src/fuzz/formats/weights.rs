//! Weight files and the configs of networks.

use std::path::Path;

use safetensors::SafeTensors;
use snapsnap_base::config::Schema;
use snapsnap_net::config::Config;
use snapsnap_net::weights::{Source, WeightFile, init};

use super::super::Format;
use super::{gaussians, pickle, pictures, put};

/// The smallest networks that make sense.
pub const CONFIG: &str = r#"# As small as it gets.
[network]
enc_dim = 8
enc_depth = 1
enc_heads = 1
dec_dim = 8
dec_depth = 1
dec_heads = 1
mlp_ratio = 1
layer_dims = [2, 2, 2, 2]
feature_dim = 4
last_dim = 2
hooks = [0, 1, 1, 1]
head = "dpt"
resolution = 64
net_resolution = 32
conf_threshold = 0.5
delta = 1.7

[regressor]
channels = 2
groups = 1

[mode]
compat = false
person_height = 739
"#;

/// What those have in common that write one weight file.
const WEIGHTS: Format = Format {
    name: "",
    sample: |_| (),
    changed: &[],
    command: "",
    file: Some("out.safetensors"),
    partial: false,
    kept: &[],
    whole: weights,
    share: 28,
};

pub const FORMATS: &[Format] = &[
    Format {
        name: "weights",
        sample: |folder| pictures::with_alpha(folder, "png", image::ImageFormat::Png),
        changed: &["w.safetensors"],
        command: "reconstruct in/front.png in/back.png --as-is --weights in/w.safetensors --device cpu -o out.ply",
        file: Some("out.ply"),
        whole: gaussians::reconstruction,
        ..WEIGHTS
    },
    Format {
        name: "weights-export",
        sample: write,
        changed: &["w.safetensors"],
        command: "export-weights in/w.safetensors -o out.safetensors",
        whole: tensors,
        ..WEIGHTS
    },
    Format {
        name: "weights-import",
        sample: |folder| {
            write(folder);
            put(folder, "c.toml", CONFIG);
        },
        changed: &["w.safetensors"],
        command: "import-weights in/w.safetensors --config in/c.toml -o out.safetensors",
        ..WEIGHTS
    },
    Format {
        name: "checkpoint",
        sample: |folder| {
            write(folder);
            put(folder, "c.toml", CONFIG);
            let path = folder.join("w.safetensors");
            put(folder, "w.pth", pickle::checkpoint(&Source::open(&path).expect("just written")));
            std::fs::remove_file(path).expect("removed");
        },
        changed: &["w.pth"],
        command: "import-weights in/w.pth --config in/c.toml -o out.safetensors",
        ..WEIGHTS
    },
    Format {
        name: "checkpoint-authors",
        sample: |folder| {
            for name in ["stage1.pth", "stage2.pth"] {
                put(folder, name, std::fs::read(crate::data("pipeline").join(name)).expect("test data"));
            }
            put(folder, "c.toml", include_str!("../../../../configs/tiny.toml"));
        },
        changed: &["stage2.pth"],
        command: "import-weights in/stage1.pth in/stage2.pth --config in/c.toml -o out.safetensors",
        share: 8,
        ..WEIGHTS
    },
    Format {
        name: "config",
        sample: |folder| put(folder, "c.toml", CONFIG),
        changed: &["c.toml"],
        // A deeper network is no mistake, and takes its time.
        command: "init-weights --config in/c.toml --set network.enc_depth=1 --set network.dec_depth=1 -o out.safetensors",
        ..WEIGHTS
    },
    Format {
        name: "config-reconstruct",
        sample: |folder| {
            pictures::with_alpha(folder, "png", image::ImageFormat::Png);
            put(folder, "c.toml", CONFIG);
        },
        changed: &["c.toml"],
        command: "reconstruct in/front.png in/back.png --as-is --weights in/w.safetensors --config in/c.toml \
                  --device cpu -o out.ply",
        file: Some("out.ply"),
        whole: gaussians::reconstruction,
        ..WEIGHTS
    },
];

/// Random weights of the smallest networks.
pub fn write(folder: &Path) {
    let config = Config::from_toml(CONFIG, "the smallest config", &[]).expect("a sound config");
    init(&config, 1, &folder.join("w.safetensors"), &|_, _| ()).expect("written");
}

/// Whether the weight file fits its own config and holds numbers.
fn weights(folder: &Path) -> Result<(), String> {
    let path = folder.join("out.safetensors");
    WeightFile::open(&path, None).map_err(|e| e.to_string())?;
    let source = Source::open(&path).map_err(|e| e.to_string())?;
    for name in source.tensors().keys() {
        let values = source.read_f32(name).map_err(|e| e.to_string())?;
        if values.iter().any(|value| !value.is_finite()) {
            return Err(format!("`{name}` is not finite"));
        }
    }
    Ok(())
}

fn tensors(folder: &Path) -> Result<(), String> {
    let bytes = std::fs::read(folder.join("out.safetensors")).map_err(|e| e.to_string())?;
    SafeTensors::deserialize(&bytes).map(drop).map_err(|e| e.to_string())
}
