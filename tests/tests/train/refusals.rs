//! Refused settings, weights and folders.

use std::fs;

use snapsnap_tests::{refused, succeed};

use super::{people, place, results, train};

#[test]
fn wrong_settings_weights_and_folders_are_refused_by_name() {
    let (temporary, config) = place();
    let run = temporary.path().join("run");
    let wrong = |arguments: &[&str], expected: &[&str]| {
        let said = refused(train(1, &config, &run).args(arguments));
        for part in expected {
            assert!(said.contains(part), "{arguments:?}: {said}");
        }
        assert!(!run.join("state").exists());
    };
    wrong(&["--set", "training.batches=3"], &["unknown field", "batches"]);
    wrong(&["--set", "training.steps=0"], &["training.steps", "must be"]);
    wrong(&["--set", "training.clip=nan"], &["training.clip"]);
    wrong(&["--set", "optimizer.beta2=1.0"], &["optimizer.beta2"]);
    wrong(&["--set", "schedule.end=2"], &["schedule.end"]);
    wrong(&["--set", "network.resolution=128", "--set", "network.net_resolution=128"], &["64", "128"]);
    wrong(&["--set", "network.conf_mode=exp"], &["conf_mode", "sigmoid"]);
    wrong(&["--set", "optimizer.epsilon=0"], &["optimizer.epsilon"]);
    wrong(&["--minutes", "0"], &["--minutes"]);
    wrong(&["--weights", "nowhere.safetensors"], &["nowhere.safetensors"]);
    let said = refused(&mut train(2, &config, &run));
    assert!(said.contains("point predictor") && said.contains("--weights"), "{said}");
    let said = refused(&mut train(1, &config, &people().join("run")));
    assert!(said.contains("lies in a data set"), "{said}");

    // A run is not begun twice, nor continued with other networks or another stage.
    succeed(train(1, &config, &run).args(["--set", "training.steps=2"]));
    let before = results(&run);
    let said = refused(&mut train(1, &config, &run));
    assert!(said.contains("--resume"), "{said}");
    let said = refused(train(1, &config, &run).args(["--resume", "--set", "network.enc_depth=2"]));
    assert!(said.contains("other [network]"), "{said}");
    let said = refused(train(2, &config, &run).args(["--resume"]));
    assert!(said.contains("stage 1"), "{said}");
    assert!(results(&run) == before);
    // A folder without a state may be used again, but a run does not replace its own initial weights.
    fs::rename(run.join("state"), run.join("elsewhere")).expect("moves");
    let said = refused(train(2, &config, &run).arg("--weights").arg(run.join("best.safetensors")));
    assert!(said.contains("would be replaced"), "{said}");
    fs::rename(run.join("elsewhere"), run.join("state")).expect("moves back");
    assert!(results(&run) == before);
    let said = refused(train(1, &config, &run.join("other")).args(["--set", "training.batch=4096"]).args([
        "--set",
        "network.resolution=4096",
        "--set",
        "network.net_resolution=4096",
    ]));
    assert!(said.contains("GB of memory"), "{said}");
}
