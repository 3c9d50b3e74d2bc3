//! Configs of trainings.

use std::path::Path;

use snapsnap_data::dataset::Split;

use super::super::Format;
use super::{datasets, nothing, put, weights};

/// Every kind of key except those of the networks.
const TRAINING: &str = r#"
[data]
folders = ["in/set"]

[samples]
repeat = 2
random_targets = 1
front_within_degrees = 180.0

[samples.augment]
exposure = 0.1
jpeg_quality = 90
background = true

[training]
steps = 40
batch = 1
accumulate = 2
clip = 1.0
ema_decay = 0.9
seed = 7
shuffle = true
prefetch = 1
validation_samples = 1
validate_on = "train"
precision = "f32"

[optimizer]
rate = 1e-3
decay_all = false

[optimizer.muon]
rate = 1e-3
momentum = 0.95

[schedule]
kind = "cosine"
warm_up = 4
end = 0.01

[stage1]
confidence_weight = 0.5

[stage2]
l1_share = 0.8
alpha_weight = 0.5
anisotropy_weight = 0.01
anisotropy_limit = 4.0
"#;

/// A rehearsal, which writes nothing. Settings that could make it slow are fixed.
const REHEARSAL: Format = Format {
    name: "train-config",
    sample,
    changed: &["t.toml"],
    command: "train-stage1 --config in/t.toml --device cpu --dry-run --set network.enc_depth=1 \
              --set network.dec_depth=1 --set network.enc_dim=8 --set network.dec_dim=8 --set network.mlp_ratio=1 \
              --set network.layer_dims=[2,2,2,2] --set network.feature_dim=4 --set network.last_dim=2 \
              --set training.batch=1 --set training.accumulate=1 \
              --set training.workers=1 --set training.validation_samples=1",
    file: None,
    partial: false,
    kept: &[],
    whole: nothing,
    share: 20,
};

pub const FORMATS: &[Format] = &[
    REHEARSAL,
    Format {
        name: "train-config-stage2",
        command: "train-stage2 --config in/t.toml --weights in/w.safetensors --device cpu --dry-run \
                  --set training.batch=1 --set training.accumulate=1 --set training.workers=1 \
                  --set training.validation_samples=1 --set samples.random_targets=1",
        ..REHEARSAL
    },
];

/// One subject of four views, weights, and a config.
fn sample(folder: &Path) {
    datasets::four_views(&folder.join("set"), &[Split::Train]);
    weights::write(folder);
    put(folder, "t.toml", format!("{}{TRAINING}", weights::CONFIG));
}
