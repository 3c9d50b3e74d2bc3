//! Options of a run: 16 bits, completed sides.

use std::fs;
use std::path::Path;

use snapsnap_tests::{assert_says, refused, snapsnap, succeed, synthetic_people};

use super::{logged, people, place, train, train_on};

/// A run keeps its precision, and `reconstruct` reads the precision from the weights.
#[test]
fn the_precision_of_a_run_is_that_of_its_weights() {
    let (temporary, config) = place();
    let [one, two] = ["one", "two"].map(|run| temporary.path().join(run));
    let with = |precision: &str, steps: u32| {
        let mut command = train(1, &config, &one);
        command.arg("--resume").arg(format!("--set=training.precision={precision}"));
        command.arg(format!("--set=training.steps={steps}"));
        command
    };
    succeed(&mut with("f32", 2));
    assert_says(&refused(&mut with("bf16", 3)), &["`training.precision`", "--force"]);
    succeed(with("bf16", 3).arg("--force"));
    let written = fs::read_to_string(one.join("config.toml")).expect("a config");
    assert!(written.contains("\nprecision = \"bf16\""), "{written}");
    let mut second = train(2, &config, &two);
    second.args(["--set=training.precision=bf16", "--set=training.steps=2"]).arg("--weights");
    succeed(second.arg(one.join("last.safetensors")));
    let report = succeed(snapsnap().current_dir(temporary.path()).args(["doctor", "--json"]));
    let report: serde_json::Value = serde_json::from_str(&report).expect("JSON");
    let auto = if report["bf16"] == true { "bf16" } else { "f32" };
    let view = |view: u32| people().join(format!("val/img/0000/{view}.png"));
    let said = |precision: &str| {
        let mut command = snapsnap();
        command.current_dir(temporary.path()).arg("reconstruct").arg(view(0)).arg(view(2));
        command.args(["--as-is", "--device=cpu", "-v", "--precision", precision, "--weights"]);
        succeed(command.arg(two.join("last.safetensors")))
    };
    assert!(said("auto").contains(&format!("precision: {auto}")));
    assert!(said("f32").contains("precision: f32\n") && said("bf16").contains("precision: bf16, by "));
}

/// Completed sides with their second surfaces, from the data to the Gaussians.
#[test]
fn second_surfaces_of_completed_sides_are_trained_and_become_gaussians() {
    let (temporary, config) = place();
    let [data, one, two] = ["people", "one", "two"].map(|name| temporary.path().join(name));
    for (split, count) in [("train", 2), ("val", 1)] {
        succeed(synthetic_people(&data, split, count, 4).arg("--set=views.second_depth=true"));
    }
    const KEYS: [&str; 8] = [
        "network.body=convolution",
        "network.patch=8",
        "network.mask_channel=true",
        "network.mirror=true",
        "network.sides=completed",
        "network.second_layer=true",
        "network.side_dims=[4,4,8,8]",
        "network.conf_threshold=0.01",
    ];
    let keys = KEYS.map(|key| format!("--set={key}"));
    let with = |stage: u32, people: &Path, run: &Path| {
        let mut command = train_on(people, stage, &config, run);
        command.args(&keys).arg("--set=training.steps=10");
        command
    };
    assert_says(&refused(&mut with(1, people(), &one)), &["second surfaces"]);
    succeed(with(1, &data, &one).arg("--set=training.steps=80"));
    for name in ["validation/right_second_mm", "validation/left_second_mm"] {
        let (_, error) = *logged(&one, name).last().expect("a validation");
        assert!(error > 1.0 && error < 2000.0, "{name}: {error}");
    }
    succeed(with(2, &data, &two).arg("--weights").arg(one.join("last.safetensors")));
    let view = |view: u32| data.join(format!("val/img/0000/{view}.png"));
    let mut command = snapsnap();
    command.current_dir(temporary.path()).arg("reconstruct").arg(view(0)).arg(view(2));
    command.args(["--as-is", "--device=cpu", "-v", "--dump=all.safetensors", "--weights"]);
    let said = succeed(command.arg(two.join("last.safetensors")));
    assert!(said.contains("completed sides") && said.contains("regressor (second surfaces)"), "{said}");
    for name in ["right-second", "left-second"] {
        let line = said.lines().find(|line| line.contains(&format!("{name}: "))).unwrap_or_default();
        assert!(line.contains("pixels become Gaussians") && !line.contains(": 0 of"), "{name}: {said}");
    }
    let dump = fs::read(temporary.path().join("all.safetensors")).expect("reads");
    assert!(String::from_utf8_lossy(&dump[..1000]).contains("[6,64,64,3]"));
}

#[test]
fn validations_of_sixteen_bits_are_close_to_thirty_two() {
    let (temporary, config) = place();
    let [error, expected] = ["bf16", "f32"].map(|precision| {
        let run = temporary.path().join(precision);
        let set = format!("--set=training.precision={precision}");
        succeed(train(1, &config, &run).args([&set, "--set=training.seed=1", "--set=training.steps=20"]));
        logged(&run, "validation/points_mm").last().expect("validations").1
    });
    assert!((error - expected).abs() < 0.02 * expected, "{error} instead of {expected}");
    // The regressor on a frozen predictor. Validations are in f32. At the config's own rate the score changes by a dB
    // every few steps in any precision, so that rounding decides. This rate is stable.
    let start = temporary.path().join("f32/best.safetensors");
    let scores = ["f32", "bf16"].map(|precision| {
        let run = temporary.path().join(format!("two-{precision}"));
        let set = format!("--set=training.precision={precision}");
        let mut command = train(2, &config, &run);
        command.args([&set, "--set=training.seed=1", "--set=training.steps=30", "--set=optimizer.rate=1e-3"]);
        succeed(command.arg("--set=optimizer.muon.rate=1e-3").arg("--weights").arg(&start));
        let scores = logged(&run, "validation/psnr_masked");
        (scores[0].1, scores[1].1)
    });
    println!("stage 2: {scores:?} dB");
    for (first, last) in scores {
        assert!(last > first + 0.1 && (last - scores[0].1).abs() < 0.02, "{scores:?}");
    }
    let mut command = snapsnap();
    command.args(["train-stage1", "--device", "ndarray", "--set", "training.precision=bf16", "--config"]);
    command.arg(&config).arg("--data").arg(people()).arg("-o").arg(temporary.path().join("ndarray"));
    assert_says(&refused(&mut command), &["training.precision", "ndarray"]);
}
