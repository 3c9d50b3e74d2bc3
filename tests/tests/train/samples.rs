//! Samples that cannot be read or do not show a person cost steps or validations, not the run.

use std::fs;
use std::path::PathBuf;

use snapsnap_tests::{assert_says, copy_folder, ended_with, refused, succeed};

use super::{logged, people, place, results, train, train_on};

#[test]
fn a_broken_sample_is_skipped_and_named_and_twenty_in_a_row_end_the_run() {
    let (temporary, config) = place();
    let copy = temporary.path().join("people");
    copy_folder(people(), &copy);
    let broken = copy.join("train/img/0001/2.png");
    fs::write(&broken, b"not a picture").expect("writes");
    let one = ["--set", "training.batch=1", "--set", "training.validation_samples=0"];
    let train = |code: i32, run: &str| {
        ended_with(code, train_on(&copy, 1, &config, &temporary.path().join(run)).args(one))
    };
    let said = train(0, "some");
    assert!(said.contains("skipped") && said.contains("img/0001/2.png"), "{said}");
    for (subject, view) in (0..3).flat_map(|subject| (0..4).map(move |view| (subject, view))) {
        fs::write(copy.join(format!("train/img/000{subject}/{view}.png")), b"").expect("writes");
    }
    let said = train(1, "none");
    assert!(said.contains("20 steps in a row") && said.contains(".png: "), "{said}");
}

/// Samples without a person are skipped. The others are trained on.
#[test]
fn samples_without_a_person_are_skipped_and_named() {
    let (temporary, config) = place();
    let (copy, one) = (temporary.path().join("people"), temporary.path().join("one"));
    copy_folder(people(), &copy);
    for view in 0..4 {
        let nobody = image::RgbaImage::new(64, 64);
        nobody.save(copy.join(format!("train/img/0001/{view}.png"))).expect("writes");
    }
    let set = ["--set=training.steps=9", "--set=training.batch=1"];
    succeed(train(1, &config, &one).args(set));
    let run = temporary.path().join("run");
    let mut command = train_on(&copy, 2, &config, &run);
    let said = ended_with(0, command.args(set).arg("--weights").arg(one.join("best.safetensors")));
    assert!(said.contains("png: the mask is empty: no pixel"), "{said}");
    assert!(said.contains("img/0001/") && !said.contains("img/0000/"), "{said}");
    assert_eq!(logged(&run, "loss").len(), 9 - said.matches("skipped: ").count());
}

/// An unreadable picture costs validations, but no steps. The final validation is made by the next session.
#[test]
fn failed_validations_cost_no_step() {
    let (temporary, config) = place();
    let (copy, run) = (temporary.path().join("people"), temporary.path().join("run"));
    copy_folder(people(), &copy);
    let train = || {
        let mut command = train_on(&copy, 1, &config, &run);
        command.arg("--resume");
        command
    };
    let pictures: Vec<PathBuf> = (0..4).map(|view| copy.join(format!("val/img/0000/{view}.png"))).collect();
    let sound: Vec<Vec<u8>> = pictures.iter().map(|path| fs::read(path).expect("reads")).collect();
    pictures.iter().for_each(|path| fs::write(path, b"not a picture").expect("writes"));
    assert_says(&refused(&mut train()), &["no validation after step 10", "val/img/0000/"]);
    assert_eq!(logged(&run, "loss").len(), 40);
    assert!(logged(&run, "validation/points_mm").is_empty() && !run.join("best.safetensors").exists());
    pictures.iter().zip(&sound).for_each(|(path, bytes)| fs::write(path, bytes).expect("writes"));
    assert_says(&refused(&mut train()), &["the data sets have other content"]);
    succeed(train().arg("--force"));
    assert_eq!(logged(&run, "validation/points_mm").len(), 1);
    assert!(run.join("best.safetensors").exists() && run.join("previews/0000040.png").exists());
    let before = results(&run);
    succeed(&mut train());
    assert!(results(&run) == before);
}
