//! The programs in `examples/` run as their documentation says, and their figures are right.

use std::fs;
use std::path::Path;
use std::process::Command;

use burn::tensor::Device;
use snapsnap_net::weights::WeightFile;
use snapsnap_net::weights::schema::Part;
use snapsnap_splat::scene;
use snapsnap_tests::{root, sample, snapsnap, succeed};

/// An example, built if it is not. `--workspace` shares the other tests' build.
fn example(name: &str) -> Command {
    let test = std::env::current_exe().expect("the test's own path");
    let release = test.ancestors().nth(2).expect("target/release/deps/test");
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut build = Command::new(cargo);
    build.args(["build", "--quiet", "--release", "--workspace", "--example", name, "--target-dir"]);
    build.arg(release.parent().expect("target/release")).current_dir(root());
    assert!(build.status().expect("cargo starts").success(), "{name} builds");
    let program = release.join("examples").join(name);
    Command::new(program.with_extension(std::env::consts::EXE_EXTENSION))
}

/// The numbers in the last line of a program's output.
fn figures(output: &str) -> Vec<f64> {
    let last = output.lines().last().expect("a line");
    println!("{last}");
    last.split_whitespace().filter_map(|word| word.parse().ok()).collect()
}

#[test]
fn the_library_reconstructs_what_the_command_does() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let photographs = sample::paths();
    let [library, command] = ["library.ply", "command.ply"].map(|name| temporary.path().join(name));
    let output = succeed(example("reconstruct").args(&photographs).arg(&library));
    succeed(snapsnap().arg("reconstruct").args(&photographs).args(["--device", "cpu", "-o"]).arg(&command));
    let bytes = |path: &Path| fs::read(path).expect("a PLY");
    assert!(bytes(&library) == bytes(&command), "the files differ");
    let gaussians = scene::read(&library, &Device::flex()).expect("a PLY").gaussians;
    assert_eq!(figures(&output), [gaussians.len() as f64]);
}

#[test]
fn fitted_gaussians_show_an_unseen_view() {
    let figures = figures(&succeed(&mut example("fit_gaussians")));
    let [before, after] = figures[..] else { panic!("{figures:?}") };
    // 19.5 dB before, 34.2 dB after.
    assert!(before < 21.0 && after > 31.0, "{before} dB before, {after} dB after");
}

#[test]
fn a_trained_predictor_is_closer_to_a_held_out_person() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let weights = temporary.path().join("predictor.safetensors");
    let figures = figures(&succeed(example("train_predictor").arg("40").arg(&weights)));
    let [before, after] = figures[..] else { panic!("{figures:?}") };
    // 138 mm before, 75 mm after 40 steps.
    assert!(after < 0.7 * before, "{before} mm before, {after} mm after");
    let weights = WeightFile::open(&weights, None).expect("a weight file");
    weights.require(Part::PointPredictor).expect("a point predictor");
    weights.point_predictor(&Device::flex()).expect("finite weights");
}
