//! The demo and the default weights, without any training or download.

use std::fs;

use image::{GenericImageView, ImageFormat};
use snapsnap_base::config::Schema;
use snapsnap_net::config::{RegressorConfig, RotationFrame};
use snapsnap_net::weights::{Source, WeightFile, save};
use snapsnap_splat::scene;
use snapsnap_tests::workplace::Workplace;
use snapsnap_tests::{assert_says, names, root, set_tensor, succeed};

/// Least PSNR on the person in unseen views. The photographs as flat cut-outs have at most 15 dB
/// (docs/notes/evaluation.md).
const LEAST_DB: f64 = 16.0;

#[test]
fn a_demo_is_made_of_the_sample_pair_and_looks_like_the_person() {
    let place = Workplace::empty();
    let mut command = place.run("demo --device cpu");
    let said = succeed(&mut command);
    let folder = place.path("demo");
    let expected = [
        "back.png",
        "comparison.png",
        "front.png",
        "human.ply",
        "report.json",
        "report.md",
        "turntable.gif",
        "turntable.png",
    ];
    assert_eq!(names(&folder), expected);
    assert!(expected.iter().all(|name| said.contains(&format!("demo/{name}"))), "{said}");
    let report: serde_json::Value = serde_json::from_slice(&place.read("demo/report.json")).expect("JSON");
    for degrees in ["45", "135", "270"] {
        let psnr = report["psnr_masked"][degrees].as_f64().expect("a figure");
        assert!(psnr > LEAST_DB, "{degrees}°: {psnr} dB");
    }
    let gaussians = scene::read(&folder.join("human.ply"), &burn::tensor::Device::flex()).expect("a PLY");
    assert_eq!(Some(gaussians.gaussians.len() as u64), report["gaussians"].as_u64());
    let sheet = image::open(folder.join("comparison.png")).expect("a picture");
    assert_eq!(sheet.dimensions(), (1792, 512));
    assert_eq!(image::guess_format(&place.read("demo/turntable.gif")).expect("a picture"), ImageFormat::Gif);
    // A second demo replaces the first one, even an incomplete one.
    place.write("demo/human.ply", "cut");
    place.write("demo/report.json", r#"{"command":"snapsnap demo","commit":"0"}"#);
    succeed(&mut command);
    scene::read(&folder.join("human.ply"), &burn::tensor::Device::flex()).expect("a PLY");
    fs::create_dir(place.path("mine")).expect("a folder");
    place.write("mine/human.ply", "mine");
    assert_says(&place.refusal(&mut place.run("demo -o mine")), &["human.ply", "another folder"]);
}

#[test]
fn the_default_weights_are_whole_small_and_of_a_config_that_is_kept() {
    let path = root().join("assets/weights/default.safetensors");
    let bytes = fs::metadata(&path).expect("the default weights").len();
    assert!(bytes <= 16 << 20, "{bytes} bytes");
    let weights = WeightFile::open(&path, None).expect("weights");
    assert_eq!(weights.config.network.resolution, 1024);
    for (name, entry) in Source::open(&path).expect("weights").tensors() {
        assert_eq!(entry.dtype, "f16", "{name}");
    }
}

/// A trained point predictor gets the regressor of another file together with that regressor's config.
#[test]
fn a_filled_regressor_keeps_its_config() {
    let place = Workplace::empty();
    let import = |line: &str, to: &str| {
        succeed(&mut place.run(&format!("import-weights {line} -o {to}")));
        WeightFile::open(&place.path(to), None).expect("weights").config
    };
    let default = root().join("assets/weights/default.safetensors");
    fs::copy(&default, place.path("both.safetensors")).expect("copies");
    // Stage 1 writes the predictor alone, beside a regressor's config that no training has used.
    let source = Source::open(&default).expect("weights");
    let both = WeightFile::open(&default, None).expect("weights");
    let mut config = both.config.clone();
    (config.network.closed_top, config.network.hull_margin) = (false, Some(5));
    config.mode.rotation_frame = Some(RotationFrame::World);
    config.regressor = RegressorConfig::default();
    let predictors =
        source.tensors().keys().filter(|name| !name.contains("pred_unet.") && !name.contains("gs_conv."));
    let values = predictors.map(|name| (name.clone(), source.read_f32(name).expect("values"))).collect();
    save(&config, &values, &place.path("points.safetensors")).expect("written");
    let filled = import("points.safetensors --fill both.safetensors", "filled.safetensors");
    assert_eq!(filled.regressor, both.config.regressor);
    // The frame of the rotations belongs to the regressor.
    assert_eq!(filled.rotation_frame(), both.config.rotation_frame());
    assert_eq!(filled.network, config.network);
    // The config of the command line is taken whole.
    place.write("own.toml", both.config.to_toml());
    let line = "points.safetensors --fill both.safetensors --config own.toml --set regressor.margin=24";
    assert_eq!(import(line, "own.safetensors").regressor.margin, Some(24));
}

#[test]
fn weights_in_16_bits_are_the_nearest_ones_and_what_is_beyond_is_refused() {
    let place = Workplace::empty();
    let body = "--set network.body=convolution --set network.mask_channel=true";
    let line = format!("init-weights --seed 1 {body} -o whole.safetensors --config");
    succeed(place.run(&line).arg(root().join("configs/tiny.toml")));
    // The stored config is kept, but for the keys of `--set`.
    let half = "--half --set network.resolution=256 -o half.safetensors";
    succeed(&mut place.run(&format!("import-weights whole.safetensors {half}")));
    let paths = ["whole.safetensors", "half.safetensors"].map(|name| place.path(name));
    let [whole, half] = paths.each_ref().map(|path| Source::open(path).expect("weights"));
    assert_eq!(whole.tensors().len(), half.tensors().len());
    for name in whole.tensors().keys() {
        let (exact, near) = (whole.read_f32(name).expect("f32"), half.read_f32(name).expect("f16"));
        for (exact, near) in exact.iter().zip(near) {
            // Eleven bits, or the smallest step of f16.
            assert!(
                (exact - near).abs() <= (exact.abs() * 2.0_f32.powi(-11)).max(3e-8),
                "{name}: {exact} {near}"
            );
        }
    }
    let [before, stored] = paths.map(|path| WeightFile::open(&path, None).expect("weights").config);
    assert_eq!((stored.network.resolution, before.network.resolution), (256, 128));
    assert_eq!(stored.network.body, before.network.body);
    fs::rename(place.path("whole.safetensors"), place.path("huge.safetensors")).expect("renames");
    set_tensor(&place.path("huge.safetensors"), "gs_conv.bias", &[1e5]);
    let message = place.refusal(&mut place.run("import-weights huge.safetensors --half -o no.safetensors"));
    assert_says(&message, &["huge.safetensors", "beyond the range of 16 bits, not finite: gs_conv.bias"]);
}
