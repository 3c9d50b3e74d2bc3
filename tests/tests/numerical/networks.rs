//! The networks against the authors' numbers (f64 arithmetic, stored as f32).
//!
//! Bounds: relative L2 error 1e-5 for tokens, 1e-4 for points, features and attributes.

use std::path::Path;

use burn::tensor::{Device, Tensor};
use snapsnap_base::config::Schema;
use snapsnap_net::config::{Config, Precision};
use snapsnap_net::network::{Decoded, Encoded, Input, PointPredictor, View, activate};
use snapsnap_net::regressor::Attributes;
use snapsnap_net::weights::{ImportOptions, WeightFile, import};
use snapsnap_tests::{Numbers, assert_close, device, fixture, toml_config};

const TOKENS: f64 = 1e-5;
const POINTS: f64 = 1e-4;

/// The config of a fixture from its `config.json`. Heads without weights are drawn at random and not compared.
fn config(folder: &Path) -> Config {
    let text = toml_config(&folder.join("config.json"));
    Config::from_toml(&text, "the fixture's config", &[]).expect("a config")
}

fn predictor(folder: &Path, config: &Config, device: &Device) -> PointPredictor {
    let file = tempfile::NamedTempFile::new().expect("temporary file");
    let options = ImportOptions { fill: None, seed: 0, float: Precision::F32 };
    let names = ["weights.safetensors", "stage1.pth"];
    let weights =
        names.map(|name| folder.join(name)).into_iter().find(|path| path.exists()).expect("weights");
    import(&[weights], config, options, file.path(), &|_, _| ()).expect("import");
    WeightFile::open(file.path(), None).expect("our file").point_predictor(device).expect("weights")
}

/// Compares the network of the fixture `name`, which has numbers of `heads` heads.
fn network(name: &str, heads: usize) {
    let folder = fixture(name);
    let Some(device) = device() else { return };
    let config = config(&folder);
    let net = predictor(&folder, &config, &device);
    let io = Numbers::read(&folder.join("io.safetensors"));
    let image = |i: usize| io.tensor::<4>(&format!("image{i}"), &device);
    let (front, back) = (image(1), image(2));
    let [b, _, h, w] = front.dims();
    let patch = config.network.patch;
    let encoded =
        net.encode(Input { images: Tensor::cat(vec![front, back], 0), grid: [h / patch, w / patch] });
    let Encoded::Tokens(tokens, _) = &encoded else { panic!("{name} is no transformer") };
    let halves = [tokens.clone().narrow(0, 0, b), tokens.clone().narrow(0, b, b)];
    for (i, half) in halves.iter().enumerate() {
        assert_close(
            &format!("{name} enc{}", i + 1),
            half.clone(),
            &io.f32(&format!("enc{}", i + 1)),
            TOKENS,
        );
    }
    let decoded = net.decode(encoded);
    let Decoded::Tokens(maps, _) = &decoded else { panic!("{name} is no transformer") };
    for (side, maps) in maps.iter().enumerate() {
        for (layer, tokens) in maps.iter().enumerate().skip(1) {
            let key = format!("dec{}.{layer}", side + 1);
            assert_close(&format!("{name} {key}"), tokens.clone(), &io.f32(&key), TOKENS);
        }
    }
    let mut compared = 0;
    for (&view, raw) in net.views().iter().zip(net.raw(&decoded)) {
        let k = view as usize + 1;
        if !io.has(&format!("points.{k}")) {
            continue;
        }
        let map = activate(raw, &config.network);
        let what = format!("{name} {}", view.name());
        assert_close(&format!("{what} points"), map.points, &io.f32(&format!("points.{k}")), POINTS);
        assert_close(&format!("{what} conf"), map.conf, &io.f32(&format!("conf.{k}")), POINTS);
        compared += 1;
    }
    assert_eq!(compared, heads, "{name}: heads compared");
}

#[test]
fn dpt_heads_of_a_photograph_and_of_a_side_with_sigmoid_confidence() {
    network("net-dpt", 2);
}

#[test]
fn stock_dust3r_with_exponential_confidence() {
    network("net-dpt-exp", 1);
}

#[test]
fn linear_heads() {
    network("net-linear", 2);
}

#[test]
fn point_predictor_of_the_pipeline() {
    network("pipeline", 4);
}

#[test]
fn gaussian_regressor_and_its_activations() {
    let folder = fixture("unet");
    let Some(device) = device() else { return };
    let file = tempfile::NamedTempFile::new().expect("temporary file");
    let options = ImportOptions { fill: None, seed: 0, float: Precision::F32 };
    import(&[folder.join("weights.safetensors")], &Config::default(), options, file.path(), &|_, _| ())
        .expect("import");
    let regressors =
        WeightFile::open(file.path(), None).expect("our file").regressors(&device).expect("weights");
    let io = Numbers::read(&folder.join("io.safetensors"));
    let input = io.tensor::<4>("input", &device);
    let features = regressors[0].forward(input);
    assert_close("features", features.clone(), &io.f32("features"), POINTS);
    let [b, h, w, c] = features.dims();
    let attributes = Attributes::new(features.reshape([b * h * w, c]), None);
    let map = |x: Tensor<2>| {
        let c = x.dims()[1];
        x.reshape([b, h, w, c])
    };
    assert_close("opacity", map(attributes.opacity), &io.f32("opacity"), POINTS);
    assert_close("scale", map(attributes.scale), &io.f32("scale"), POINTS);
    assert_close("rotation", map(attributes.rotation), &io.f32("rotation"), POINTS);
    assert_close("color", map(attributes.color), &io.f32("color"), POINTS);
    assert_close("offset", map(attributes.offset), &io.f32("offset"), POINTS);
}

#[test]
fn views_are_ordered_as_the_heads() {
    assert_eq!(View::ALL.map(View::name), ["front", "back", "right", "left"]);
}
