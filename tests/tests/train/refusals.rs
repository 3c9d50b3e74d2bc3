//! Refused settings, weights and folders.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use std::{fs, thread};

use snapsnap_net::weights::Source;
use snapsnap_tests::{
    assert_says, copy_folder, ended_with, files, fill_weights, refused, succeed, synthetic_people,
};

use super::{logged, people, place, results, train, train_on};

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
    wrong(&["--set", "training.ema_decay=nan"], &["training.ema_decay"]);
    wrong(&["--set", "training.precision=f16"], &["training.precision", "bf16"]);
    wrong(&["--set", "training.batch=0"], &["training.batch", "must be"]);
    wrong(&["--set", "optimizer.beta2=1.0"], &["optimizer.beta2"]);
    wrong(&["--set", "samples.placed_share=2"], &["samples.placed_share"]);
    wrong(&["--set", "network.resolution=128", "--set", "network.net_resolution=128"], &["64", "128"]);
    wrong(&["--set", "network.conf_mode=exp"], &["conf_mode", "sigmoid"]);
    wrong(&["--set", "stage2.alpha_weight=-0.5"], &["stage2.alpha_weight"]);
    wrong(&["--set", "schedule.warm_up=1000000"], &["schedule.warm_up", "training.steps"]);
    wrong(&["--set", "network.delta=1e30"], &["network.delta", "1000000"]);
    wrong(&["--minutes", "0"], &["--minutes", "more than 0"]);
    wrong(&["--minutes", "1e9"], &["--minutes", "at most"]);
    wrong(&["--weights", "nowhere.safetensors"], &["nowhere.safetensors"]);
    assert_says(&refused(&mut train(2, &config, &run)), &["point predictor", "--weights"]);
    assert_says(&refused(&mut train(1, &config, &people().join("run"))), &["lies in a data set"]);

    // A run is not begun twice, nor continued with other networks or another stage.
    succeed(train(1, &config, &run).args(["--set", "training.steps=2"]));
    let before = results(&run);
    assert_says(&refused(&mut train(1, &config, &run)), &["--resume"]);
    let said = refused(train(1, &config, &run).args(["--resume", "--set", "network.enc_depth=2"]));
    assert!(said.contains("other [network]"), "{said}");
    assert_says(&refused(train(2, &config, &run).args(["--resume"])), &["stage 1"]);
    // Tensors of the same shapes that mean something else.
    let other = temporary.path().join("meaning");
    for (key, named) in
        [("network.mirror=true", "`network.mirror`"), ("network.enc_heads=1", "`network.enc_heads`")]
    {
        for stage in [1, 2] {
            let mut command = train(stage, &config, &other);
            let said = refused(command.args(["--set", key, "--weights"]).arg(run.join("last.safetensors")));
            assert!(said.contains("last.safetensors") && said.contains(named), "{said}");
        }
    }
    assert!(!other.exists());
    assert!(results(&run) == before);
    let huge = ["training.batch", "network.resolution", "network.net_resolution"];
    let huge = huge.map(|key| format!("--set={key}=4096"));
    assert_says(&refused(train(1, &config, &run.join("other")).args(huge)), &["GB of memory"]);
}

/// The finished weights of a run whose state was removed, and files of the user's own.
#[test]
fn a_new_run_replaces_no_file() {
    let (temporary, config) = place();
    let run = temporary.path().join("run");
    succeed(train(1, &config, &run).arg("--set=training.steps=2"));
    fs::remove_dir_all(run.join("state")).expect("removes");
    let before = files(&run);
    for arguments in [&["--set=training.steps=2"][..], &["--resume"]] {
        let said = refused(train(1, &config, &run).args(arguments));
        assert!(said.contains("best.safetensors") && said.contains("would be replaced"), "{said}");
        assert!(files(&run) == before);
    }
    for name in ["log.jsonl", "curves.svg", "config.toml", "previews/1.png"] {
        let own = temporary.path().join(name.replace('/', "-"));
        fs::create_dir_all(own.join("previews")).expect("makes");
        fs::write(own.join(name), "the user's own").expect("writes");
        assert_says(&refused(&mut train(1, &config, &own)), &["would be replaced"]);
        assert_eq!(fs::read_to_string(own.join(name)).expect("reads"), "the user's own");
        assert!(!own.join("lock").exists(), "a refused start leaves nothing");
    }
}

#[cfg(unix)]
#[test]
fn links_and_pipes_in_a_run_are_refused() {
    let (temporary, config) = place();
    let run = temporary.path().join("run");
    succeed(train(1, &config, &run).arg("--set=training.steps=2"));
    let other = temporary.path().join("other.txt");
    fs::write(&other, "the user's own").expect("writes");
    fs::remove_file(run.join("log.jsonl")).expect("removes");
    std::os::unix::fs::symlink(&other, run.join("log.jsonl")).expect("links");
    assert_says(&refused(train(1, &config, &run).arg("--resume")), &["log.jsonl: is a link"]);
    assert_eq!(fs::read_to_string(&other).expect("reads"), "the user's own");
    let piped = temporary.path().join("piped");
    fs::create_dir(&piped).expect("makes");
    assert!(std::process::Command::new("mkfifo").arg(piped.join("lock")).status().expect("mkfifo").success());
    assert_says(&refused(&mut train(1, &config, &piped)), &["lock: is no regular file"]);
}

#[test]
fn a_refused_start_leaves_no_folder() {
    let (temporary, config) = place();
    let run = temporary.path().join("a/b/run");
    let start = temporary.path().join("start.safetensors");
    fs::write(&start, "no weights").expect("writes");
    refused(train(1, &config, &run).arg("--weights").arg(&start));
    assert!(!temporary.path().join("a").exists());
}

/// A copy of the people, with another pixel in a picture of the training.
fn changed_people(folder: &Path) -> PathBuf {
    let copy = folder.join("copy");
    copy_folder(people(), &copy);
    let subject = fs::read_dir(copy.join("train/img")).expect("lists").next().expect("one").expect("entry");
    let picture = subject.path().join("0.png");
    let mut pixels = image::open(&picture).expect("reads").to_rgba8();
    pixels.get_pixel_mut(30, 30).0[0] ^= 1;
    pixels.save(&picture).expect("writes");
    copy
}

#[test]
fn a_run_is_continued_only_as_itself() {
    let (temporary, config) = place();
    let run = temporary.path().join("run");
    succeed(train(1, &config, &run).arg("--set=training.steps=2"));
    let before = results(&run);
    let resumed = |data: &Path, arguments: &[&str]| {
        let mut command = train_on(data, 1, &config, &run);
        command.args(["--resume", "--set=training.steps=3"]).args(arguments);
        command
    };
    for key in ["training.seed=9", "training.batch=1", "optimizer.rate=1e-5", "training.ema_decay=0"] {
        let said = refused(&mut resumed(people(), &["--set", key]));
        let name = key.split('=').next().expect("a key");
        assert!(said.contains(name) && said.contains("--force"), "{said}");
        assert!(results(&run) == before);
    }
    // A copy of the data set is the same. A copy with another picture is not.
    let said = refused(&mut resumed(&changed_people(temporary.path()), &[]));
    assert!(said.contains("the data sets have other content"), "{said}");
    // Another run's state.
    let other = temporary.path().join("other");
    succeed(train(1, &config, &other).args(["--set=training.steps=2", "--set=training.seed=8"]));
    fs::copy(other.join("state/state.safetensors"), run.join("state/state.safetensors")).expect("copies");
    assert_says(&refused(&mut resumed(people(), &[])), &["`training.seed` is 8 there"]);
    succeed(&mut resumed(people(), &["--force"]));
}

/// A run without averaged weights begins them with --force.
#[test]
fn averages_begin_with_the_weights() {
    let (temporary, config) = place();
    let run = temporary.path().join("run");
    succeed(train(1, &config, &run).args(["--set=training.steps=2", "--set=training.ema_decay=0"]));
    let resumed = || {
        let mut command = train(1, &config, &run);
        command.args(["--resume", "--set=training.steps=4"]);
        command
    };
    let before = results(&run);
    assert_says(&refused(&mut resumed()), &["`training.ema_decay`", "--force"]);
    assert!(results(&run) == before);
    let values = || {
        let weights = Source::open(&run.join("last.safetensors")).expect("weights");
        weights
            .tensors()
            .keys()
            .map(|name| weights.read_f32(name).expect("values"))
            .collect::<Vec<_>>()
            .concat()
    };
    let weights = values();
    // A step without effect: the averages are the weights.
    let without_effect = ["--set=optimizer.rate=1e-12", "--set=optimizer.muon.rate=1e-12"];
    succeed(resumed().arg("--force").args(without_effect));
    let off = values().iter().zip(&weights).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(off < 1e-6, "{off}");
    succeed(resumed().arg("--set=training.steps=5").args(without_effect));
}

/// After a change of the validation's people, the best score of the earlier people no longer counts.
#[test]
fn the_best_validation_is_of_the_present_people() {
    let (temporary, config) = place();
    let [run, far] = ["run", "far"].map(|name| temporary.path().join(name));
    for split in ["train", "val"] {
        succeed(synthetic_people(&far, split, 1, 4).arg("--set=views.distance=2"));
    }
    let said = succeed(&mut train(1, &config, &run));
    let best = |said: &str| {
        said.lines()
            .find(|line| line.starts_with("best validation:"))
            .map(|line| line.split(',').next().map(str::to_owned))
    };
    let before = results(&run);
    // Changes that do not affect validations keep the best weights.
    let ruined = temporary.path().join("ruined");
    copy_folder(&run, &ruined);
    let ruinous =
        ["--set=optimizer.rate=1", "--set=optimizer.muon.rate=1", "--set=samples.augment.exposure=0.1"];
    let mut command = train_on(&changed_people(temporary.path()), 1, &config, &ruined);
    let after = succeed(command.args(["--resume", "--force", "--set=training.steps=47"]).args(ruinous));
    assert!(best(&said).is_some() && best(&after) == best(&said), "{said} {after}");
    assert!(results(&ruined)[1] == before[1]);
    let mut command = train_on(&far, 1, &config, &run);
    let output = command.args(["--resume", "--force", "--set=training.steps=44"]).output().expect("runs");
    let [out, err] = [output.stdout, output.stderr].map(|said| String::from_utf8_lossy(&said).into_owned());
    assert!(output.status.success() && err.contains("counts no longer"), "{err}");
    assert!(out.contains("after step 44"), "{out}");
    assert!(results(&run)[1] != before[1], "the former best weights");
}

/// A run goes on with one generation of people after the other. The validation's people have a data set of their own.
#[test]
fn the_best_validation_counts_for_later_people() {
    let (temporary, config) = place();
    let [run, other, held] = ["run", "other", "held"].map(|name| temporary.path().join(name));
    succeed(&mut synthetic_people(&held, "val", 1, 4));
    // Other people, and another description of them.
    succeed(synthetic_people(&other, "train", 1, 4).arg("--set=views.samples_per_axis=2"));
    let generation = |people: &Path, steps: &str| {
        let mut command = train_on(people, 1, &config, &run);
        command.arg("--data").arg(&held).args(["--resume", "--force", steps]);
        command
    };
    let training_alone = temporary.path().join("first");
    copy_folder(people(), &training_alone);
    fs::remove_dir_all(training_alone.join("val")).expect("removes");
    succeed(&mut generation(&training_alone, "--set=training.steps=4"));
    let said = ended_with(0, &mut generation(&other, "--set=training.steps=6"));
    assert!(!said.contains("counts no longer"), "{said}");
    assert_eq!(logged(&run, "validation/points_mm").last().expect("a validation").0, 6);
    let said = refused(&mut train_on(&held, 1, &config, &temporary.path().join("none")));
    assert!(said.contains("no data set has people of the split train"), "{said}");
}

#[test]
fn stage_2_continues_with_its_own_predictor_only() {
    let (temporary, config) = place();
    let starts = ["one", "two"].map(|name| temporary.path().join(name));
    for (i, start) in starts.iter().enumerate() {
        let seed = format!("--set=training.seed={i}");
        succeed(train(1, &config, start).args(["--set=training.steps=2", &seed]));
    }
    let run = temporary.path().join("run");
    let weights = |i: usize| starts[i].join("last.safetensors");
    succeed(train(2, &config, &run).arg("--set=training.steps=2").arg("--weights").arg(weights(0)));
    let resumed = |steps: u32, i: usize| {
        let mut command = train(2, &config, &run);
        command.arg("--resume").arg(format!("--set=training.steps={steps}")).arg("--weights").arg(weights(i));
        command
    };
    succeed(&mut resumed(3, 0));
    assert_says(&refused(&mut resumed(4, 1)), &["the frozen point predictor has other weights", "--force"]);
    // From the first moment on, the run's predictor is the second one.
    let mut killed = resumed(1_000_000, 1);
    let mut killed = killed.args(["--force", "--set=training.checkpoint_every=0"]).spawn().expect("starts");
    let written = || fs::read_to_string(run.join("config.toml")).expect("a config");
    let begun = Instant::now();
    while !written().contains(&format!("{:?}", weights(1).display().to_string())) {
        assert!(begun.elapsed() < Duration::from_secs(60) && killed.try_wait().expect("asks").is_none());
        thread::sleep(Duration::from_millis(5));
    }
    killed.kill().expect("kills");
    killed.wait().expect("ends");
    refused(&mut resumed(5, 0));
    succeed(train(2, &config, &run).args(["--resume", "--set=training.steps=5"]));
    succeed(&mut resumed(6, 1));
    // A predictor that is trained as well is in the state.
    let joint = temporary.path().join("joint");
    let trained = |steps: &str, weights: &Path| {
        let mut command = train(2, &config, &joint);
        command.args(["--resume", "--set=stage2.points_weight=0.2", steps, "--weights"]).arg(weights);
        command
    };
    succeed(&mut trained("--set=training.steps=2", &weights(0)));
    let said = ended_with(0, &mut trained("--set=training.steps=3", &weights(1)));
    assert!(said.contains("--weights is not read"), "{said}");
    let written = fs::read_to_string(joint.join("config.toml")).expect("a config");
    assert!(written.contains(&format!("{:?}", weights(0).display().to_string())), "{written}");
    fs::copy(weights(0), run.join("last.safetensors")).expect("copies");
    let said = refused(train(2, &config, &run).args(["--resume", "--set=training.steps=7"]));
    assert!(said.contains("the frozen point predictor has other weights"), "{said}");
    // Neither the initial weights nor `last.safetensors` are needed.
    fs::remove_file(weights(0)).expect("removed");
    fs::remove_file(joint.join("last.safetensors")).expect("removed");
    succeed(&mut trained("--set=training.steps=4", &weights(1)));
}

/// Weights of 1e30 make every loss infinite: no step is made, and nothing is recommended.
#[test]
fn a_training_without_a_single_step_fails() {
    let (temporary, config) = place();
    let (one, start) = (temporary.path().join("one"), temporary.path().join("start.safetensors"));
    succeed(train(1, &config, &one).arg("--set=training.steps=2"));
    fs::copy(one.join("last.safetensors"), &start).expect("copies");
    fill_weights(&start, 1e30);
    let mut command = train(2, &config, &temporary.path().join("run"));
    let output = command.arg("--set=training.steps=3").arg("--weights").arg(&start).output().expect("runs");
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("could not be made") && !String::from_utf8_lossy(&output.stdout).contains("next:"));
}
