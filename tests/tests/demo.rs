//! The demo, and reconstructions with the default weights, without any training or download.

use std::fs;

use image::{GenericImageView, ImageFormat};
use snapsnap_base::config::Schema;
use snapsnap_net::config::{RegressorConfig, RotationFrame};
use snapsnap_net::weights::{Source, WeightFile, save};
use snapsnap_splat::scene;
use snapsnap_tests::{refused, root, snapsnap, succeed};

/// Least PSNR on the person in unseen views. The photographs as flat cut-outs have at most 15 dB
/// (docs/notes/evaluation.md).
const LEAST_DB: f64 = 16.0;

#[test]
fn a_demo_is_made_of_the_sample_pair_and_looks_like_the_person() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let mut command = snapsnap();
    command.current_dir(temporary.path()).args(["demo", "--device", "cpu"]);
    let said = succeed(&mut command);
    let folder = temporary.path().join("demo");
    let mut names: Vec<String> = fs::read_dir(&folder)
        .expect("a folder")
        .map(|entry| entry.expect("an entry").file_name().into_string().expect("UTF-8"))
        .collect();
    names.sort();
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
    assert_eq!(names, expected);
    assert!(expected.iter().all(|name| said.contains(&format!("demo/{name}"))), "{said}");
    let report = fs::read_to_string(folder.join("report.json")).expect("a report");
    let report: serde_json::Value = serde_json::from_str(&report).expect("JSON");
    for degrees in ["45", "135", "270"] {
        let psnr = report["psnr_masked"][degrees].as_f64().expect("a figure");
        assert!(psnr > LEAST_DB, "{degrees}°: {psnr} dB");
    }
    let gaussians = scene::read(&folder.join("human.ply"), &burn::tensor::Device::flex()).expect("a PLY");
    assert_eq!(Some(gaussians.gaussians.len() as u64), report["gaussians"].as_u64());
    let sheet = image::open(folder.join("comparison.png")).expect("a picture");
    assert_eq!(sheet.dimensions(), (1792, 512));
    let gif = fs::read(folder.join("turntable.gif")).expect("an animation");
    assert_eq!(image::guess_format(&gif).expect("a picture"), ImageFormat::Gif);
    // A second demo replaces the first one, even an incomplete one.
    fs::write(folder.join("human.ply"), "cut").expect("written");
    fs::write(folder.join("report.json"), r#"{"command":"snapsnap demo","commit":"0"}"#).expect("written");
    succeed(&mut command);
    scene::read(&folder.join("human.ply"), &burn::tensor::Device::flex()).expect("a PLY");
    let other = temporary.path().join("mine");
    fs::create_dir(&other).expect("a folder");
    fs::write(other.join("human.ply"), "mine").expect("written");
    let message = refused(snapsnap().current_dir(temporary.path()).args(["demo", "-o", "mine"]));
    assert!(message.contains("human.ply") && message.contains("another folder"), "{message}");
    assert_eq!(fs::read_to_string(other.join("human.ply")).expect("read"), "mine");
}

/// Two pictures, without weights, config and masks.
#[test]
fn two_pictures_become_a_person_with_the_default_weights() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let [front, back] = ["front.png", "back.png"].map(|name| root().join("assets/sample").join(name));
    let mut command = snapsnap();
    command
        .current_dir(temporary.path())
        .arg("reconstruct")
        .args([&front, &back])
        .args(["--device", "cpu", "-v"]);
    let said = succeed(&mut command);
    assert!(said.contains("weights: the default weights"), "{said}");
    let count = scene::read(&temporary.path().join("human.ply"), &burn::tensor::Device::flex())
        .expect("a PLY")
        .gaussians
        .len();
    assert!(count > 100_000, "{count} Gaussians");
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
    let temporary = tempfile::tempdir().expect("temporary folder");
    let path = |name: &str| temporary.path().join(name);
    let import = |from: &str, more: &[&str], to: &str| {
        let mut command = snapsnap();
        command
            .current_dir(temporary.path())
            .arg("import-weights")
            .arg(path(from))
            .args(more)
            .arg("-o")
            .arg(to);
        succeed(&mut command);
        WeightFile::open(&path(to), None).expect("weights").config
    };
    fs::copy(root().join("assets/weights/default.safetensors"), path("both")).expect("copies");
    // Stage 1 writes the predictor alone, beside a regressor's config that no training has used.
    let (source, both) = (
        Source::open(&path("both")).expect("weights"),
        WeightFile::open(&path("both"), None).expect("weights"),
    );
    let mut config = both.config.clone();
    (config.network.closed_top, config.network.hull_margin) = (false, Some(5));
    config.mode.rotation_frame = Some(RotationFrame::World);
    config.regressor = RegressorConfig::default();
    let predictors =
        source.tensors().keys().filter(|name| !name.contains("pred_unet.") && !name.contains("gs_conv."));
    let values = predictors.map(|name| (name.clone(), source.read_f32(name).expect("values"))).collect();
    save(&config, &values, &path("points.safetensors")).expect("written");
    fs::rename(path("both"), path("both.safetensors")).expect("renames");
    let filled = import("points.safetensors", &["--fill", "both.safetensors"], "filled.safetensors");
    assert_eq!(filled.regressor, both.config.regressor);
    // The frame of the rotations belongs to the regressor.
    assert_eq!(filled.rotation_frame(), both.config.rotation_frame());
    assert_eq!(filled.network, config.network);
    // The config of the command line is taken whole.
    fs::write(path("own.toml"), both.config.to_toml()).expect("written");
    let more = ["--fill", "both.safetensors", "--config", "own.toml", "--set", "regressor.margin=24"];
    assert_eq!(import("points.safetensors", &more, "own.safetensors").regressor.margin, Some(24));
}

#[test]
fn weights_in_16_bits_are_the_nearest_ones_and_what_is_beyond_is_refused() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let command = |arguments: &[&str]| {
        let mut command = snapsnap();
        command.current_dir(temporary.path()).args(arguments);
        command
    };
    let tiny = root().join("configs/tiny.toml");
    let tiny = tiny.to_str().expect("UTF-8");
    let body = ["--set", "network.body=convolution", "--set", "network.mask_channel=true"];
    succeed(
        command(&["init-weights", "--config", tiny, "--seed", "1", "-o", "whole.safetensors"]).args(body),
    );
    // The stored config is kept, but for the keys of `--set`.
    let half = ["import-weights", "whole.safetensors", "--half", "--set", "network.resolution=256", "-o"];
    succeed(command(&half).arg("half.safetensors"));
    let [whole, half_path] =
        ["whole.safetensors", "half.safetensors"].map(|name| temporary.path().join(name));
    let [whole, half_source] = [&whole, &half_path].map(|path| Source::open(path).expect("weights"));
    assert_eq!(whole.tensors().len(), half_source.tensors().len());
    for name in whole.tensors().keys() {
        let (exact, near) = (whole.read_f32(name).expect("f32"), half_source.read_f32(name).expect("f16"));
        for (exact, near) in exact.iter().zip(near) {
            // Eleven bits, or the smallest step of f16.
            assert!(
                (exact - near).abs() <= (exact.abs() * 2.0_f32.powi(-11)).max(3e-8),
                "{name}: {exact} {near}"
            );
        }
    }
    let stored = WeightFile::open(&half_path, None).expect("weights").config;
    let before = WeightFile::open(&temporary.path().join("whole.safetensors"), None).expect("weights").config;
    assert_eq!((stored.network.resolution, before.network.resolution), (256, 128));
    assert_eq!(stored.network.body, before.network.body);
    let mut bytes = fs::read(temporary.path().join("whole.safetensors")).expect("read");
    let at = bytes.len() - 4;
    bytes[at..].copy_from_slice(&1e5_f32.to_le_bytes());
    fs::write(temporary.path().join("huge.safetensors"), bytes).expect("written");
    let message =
        refused(&mut command(&["import-weights", "huge.safetensors", "--half", "-o", "no.safetensors"]));
    assert!(message.contains("not finite") && message.contains("huge.safetensors"), "{message}");
    assert!(!temporary.path().join("no.safetensors").exists());
}
