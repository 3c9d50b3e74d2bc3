//! `snapsnap train-stage1` and `train-stage2` as a user types them: what they leave behind, that a run which is killed,
//! interrupted or out of disk goes on as if nothing had happened, and what is refused.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::time::Duration;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use snapsnap_net::weights::write_tensors;
use snapsnap_tests::{TRAINING, refused, snapsnap, succeed};

/// Three people to learn from and one to validate on, made once.
fn people() -> &'static Path {
    static PEOPLE: OnceLock<PathBuf> = OnceLock::new();
    PEOPLE.get_or_init(|| {
        let folder =
            PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(format!("people-{}", std::process::id()));
        for (split, count) in [("train", "3"), ("val", "1")] {
            let mut command = snapsnap();
            command.args(["prepare", "synth", "--seed", "5", "--subjects", count, "--split", split]);
            command.args(["--set", "views.count=4", "--set", "views.resolution=64", "-o"]).arg(&folder);
            succeed(&mut command);
        }
        folder
    })
}

/// A folder with the config above.
fn place() -> (tempfile::TempDir, PathBuf) {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let config = temporary.path().join("train.toml");
    fs::write(&config, TRAINING).expect("writes");
    (temporary, config)
}

fn train(stage: u32, config: &Path, run: &Path) -> Command {
    let mut command = snapsnap();
    command.arg(format!("train-stage{stage}")).arg("--config").arg(config);
    command.args(["--device", "cpu", "--data"]).arg(people()).arg("-o").arg(run);
    command
}

/// The files that must not depend on how a run went.
fn results(run: &Path) -> Vec<Vec<u8>> {
    let names = ["last.safetensors", "best.safetensors", "state/state.safetensors"];
    names.map(|name| fs::read(run.join(name)).unwrap_or_else(|e| panic!("{name}: {e}"))).to_vec()
}

/// The values of a field over the lines of a log.
fn logged(run: &Path, name: &str) -> Vec<(u64, f64)> {
    let text = fs::read_to_string(run.join("log.jsonl")).expect("a log");
    let lines = text.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).expect("a line"));
    let value = |line: serde_json::Value| Some((line["step"].as_u64()?, line["values"][name].as_f64()?));
    lines.filter_map(value).collect()
}

#[test]
fn both_stages_learn_and_leave_what_a_reconstruction_needs() {
    let (temporary, config) = place();
    let (one, two) = (temporary.path().join("one"), temporary.path().join("two"));
    let said = succeed(&mut train(1, &config, &one));
    assert!(said.contains("finished after 40 steps") && said.contains("train-stage2"), "{said}");
    let losses = logged(&one, "loss");
    assert_eq!(losses.len(), 40);
    let mean = |part: &[(u64, f64)]| part.iter().map(|(_, loss)| loss).sum::<f64>() / part.len() as f64;
    assert!(mean(&losses[35..]) < 0.8 * mean(&losses[..5]), "{losses:?}");
    let steps: Vec<u64> = logged(&one, "validation/points_mm").iter().map(|(step, _)| *step).collect();
    assert_eq!(steps, [10, 20, 30, 40]);
    for file in ["config.toml", "curves.svg", "previews/0000020.png", "previews/0000040.png"] {
        assert!(one.join(file).is_file(), "{file}");
    }
    assert!(fs::read(one.join("events.out.tfevents.snapsnap")).expect("events").len() > 1000);
    let svg = fs::read_to_string(one.join("curves.svg")).expect("curves");
    assert!(svg.contains("<polyline"), "{svg}");

    let weights = one.join("best.safetensors");
    let said = succeed(train(2, &config, &two).arg("--weights").arg(&weights));
    assert!(said.contains("reconstruct"), "{said}");
    assert_eq!(logged(&two, "validation/psnr_masked").len(), 4);

    // Both parts are in one file now, which makes a person of two photographs.
    let view = |view: u32| people().join(format!("val/img/0000/{view}.png"));
    let ply = temporary.path().join("human.ply");
    let mut command = snapsnap();
    command.arg("reconstruct").arg(view(0)).arg(view(2)).args(["--as-is", "--device", "cpu", "--weights"]);
    succeed(command.arg(two.join("last.safetensors")).arg("-o").arg(&ply));
    assert!(fs::metadata(&ply).expect("a file").len() > 10_000);
}

/// Kills a training at random moments until it is done. Returns how often it was killed.
fn killed_at_random(command: impl Fn() -> Command, random: &mut ChaCha8Rng, most: u32) -> u32 {
    for kills in 0..most {
        let mut child = start(command().arg("--resume"));
        let patience = Duration::from_millis(random.random_range(50..1500));
        std::thread::sleep(patience);
        if let Some(status) = child.try_wait().expect("waits") {
            assert!(status.success(), "{status}");
            return kills;
        }
        child.kill().expect("kills");
        child.wait().expect("ends");
    }
    succeed(command().arg("--resume"));
    most
}

fn start(command: &mut Command) -> Child {
    command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("starts")
}

#[test]
fn runs_that_were_killed_end_with_the_bytes_of_an_undisturbed_one() {
    let (temporary, config) = place();
    let undisturbed = temporary.path().join("undisturbed");
    // Long enough to be killed often, with a checkpoint every few moments.
    let long = ["--set", "training.steps=240"];
    succeed(train(1, &config, &undisturbed).args(long));
    let seed = std::env::var("SNAPSNAP_TEST_SEED").ok().and_then(|s| s.parse().ok()).unwrap_or(7);
    println!("seed {seed}");
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let killed = temporary.path().join("killed");
    let command = || {
        let mut command = train(1, &config, &killed);
        command.args(long);
        command
    };
    let kills = killed_at_random(command, &mut random, 20);
    println!("killed {kills} times");
    assert!(kills > 0, "the run was too short to be killed");
    assert!(results(&undisturbed) == results(&killed), "other bytes after {kills} kills");
    let steps = |run: &Path| logged(run, "loss").into_iter().map(|(step, _)| step).collect::<Vec<_>>();
    assert_eq!(steps(&killed), steps(&undisturbed), "the log has every step once");
}

#[test]
fn time_budgets_and_interrupts_end_a_session_that_goes_on_to_the_same_bytes() {
    let (temporary, config) = place();
    let weights = temporary.path().join("start.safetensors");
    let one = temporary.path().join("one");
    succeed(&mut train(1, &config, &one));
    fs::copy(one.join("last.safetensors"), &weights).expect("copies");
    let (whole, pieces) = (temporary.path().join("whole"), temporary.path().join("pieces"));
    succeed(train(2, &config, &whole).arg("--weights").arg(&weights));
    let said = succeed(train(2, &config, &pieces).arg("--weights").arg(&weights).args([
        "--minutes",
        "0.001",
        "--resume",
    ]));
    assert!(said.contains("interrupted") && said.contains("--resume"), "{said}");
    // The run knows its own predictor, data and config.
    fs::remove_file(&weights).expect("removes");
    let own = || {
        let mut command = snapsnap();
        command.args(["train-stage2", "--resume", "--device", "cpu", "-o"]).arg(&pieces);
        command
    };
    #[cfg(unix)]
    {
        let child = own().stdout(Stdio::null()).stderr(Stdio::piped()).spawn().expect("starts");
        std::thread::sleep(Duration::from_millis(700));
        Command::new("kill").args(["-INT", &child.id().to_string()]).status().expect("kill");
        let output = child.wait_with_output().expect("ends");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
    succeed(&mut own());
    assert!(results(&whole) == results(&pieces), "other bytes");
    // A finished run that is asked to go on changes nothing.
    let before = results(&whole);
    succeed(train(2, &config, &whole).arg("--resume"));
    assert!(results(&whole) == before);
}

/// Maps that were kept, all or some of them damaged, are what the predictor makes again.
#[test]
fn point_maps_that_are_kept_change_nothing() {
    let (temporary, config) = place();
    let (one, maps) = (temporary.path().join("one"), temporary.path().join("maps"));
    const PLAIN: [&str; 6] = [
        "exposure=0",
        "white_balance=0",
        "mask_erosion=0",
        "mask_dilation=0",
        "jpeg_quality=0",
        "background=false",
    ];
    let plain = PLAIN.map(|key| format!("--set=samples.augment.{key}"));
    succeed(train(1, &config, &one).arg("--set=training.steps=12"));
    let learn = |run: &str, kept: bool| {
        let run = temporary.path().join(run);
        let mut command = train(2, &config, &run);
        command
            .arg("--set=training.steps=12")
            .args(&plain)
            .arg("--weights")
            .arg(one.join("best.safetensors"));
        if kept {
            command.arg("--set").arg(format!("stage2.maps='{}'", maps.display()));
        }
        succeed(&mut command);
        results(&run)
    };
    let live = learn("live", false);
    assert!(learn("first", true) == live, "other bytes while maps are made");
    let folder = fs::read_dir(&maps).expect("lists").next().expect("one predictor").expect("entry").path();
    let files: Vec<PathBuf> =
        fs::read_dir(&folder).expect("lists").map(|entry| entry.expect("entry").path()).collect();
    // Four views of three people to learn from, each of which may be the front, and one to validate on, at most.
    assert!((4..=14).contains(&files.len()), "{files:?}");
    let before: Vec<Vec<u8>> = files.iter().map(|file| fs::read(file).expect("reads")).collect();
    fs::write(&files[0], &before[0][..before[0].len() / 2]).expect("writes");
    fs::write(&files[1], b"").expect("writes");
    fs::remove_file(&files[2]).expect("removes");
    assert!(learn("second", true) == live, "other bytes of maps that were kept");
    for (file, before) in files.iter().zip(&before) {
        assert!(fs::read(file).expect("reads") == *before, "{}", file.display());
    }

    let refused = |arguments: &[&str]| {
        let mut command = train(2, &config, &temporary.path().join("wrong"));
        command.args(&plain).arg("--weights").arg(one.join("best.safetensors"));
        refused(command.args(arguments))
    };
    let said = refused(&["--set", "stage2.maps=maps", "--set", "samples.augment.exposure=0.1"]);
    assert!(said.contains("stage2.maps") && said.contains("exposure"), "{said}");
    let said = refused(&["--set", "stage2.maps=maps", "--set", "stage2.points=1", "--set", "stage2.noise=0"]);
    assert!(said.contains("stage2.maps"), "{said}");
    let said = refused(&["--set=stage2.maps="]);
    assert!(said.contains("stage2.maps") && said.contains("folder"), "{said}");
    let said = refused(&["--set=stage2.lpips={ weight = 1.0, files = [] }"]);
    assert!(said.contains("stage2.lpips.files"), "{said}");
    let inside = format!("stage2.maps='{}'", people().join("maps").display());
    let said = refused(&["--set", &inside]);
    assert!(said.contains("lies in a data set"), "{said}");
}

/// Random weights of AlexNet and of the learned layers.
fn perceptual(path: &Path) {
    let mut tensors: Vec<(String, Vec<usize>)> = Vec::new();
    for (number, (place, outputs, inputs, side)) in
        [(0, 64, 3, 11), (3, 192, 64, 5), (6, 384, 192, 3), (8, 256, 384, 3), (10, 256, 256, 3)]
            .into_iter()
            .enumerate()
    {
        tensors.push((format!("features.{place}.weight"), vec![outputs, inputs, side, side]));
        tensors.push((format!("features.{place}.bias"), vec![outputs]));
        tensors.push((format!("lin{number}.model.1.weight"), vec![1, outputs, 1, 1]));
    }
    let mut random = ChaCha8Rng::seed_from_u64(4);
    let sizes: Vec<usize> = tensors.iter().map(|(_, shape)| shape.iter().product()).collect();
    let values = |i: usize| Ok((0..sizes[i]).map(|_| random.random_range(0.0..0.05)).collect());
    write_tensors(path, "AlexNet", HashMap::new(), tensors, values, &|_, _| ()).expect("writes");
}

#[test]
fn perceptual_distance_counts_towards_the_end() {
    let (temporary, config) = place();
    let (one, two) = (temporary.path().join("one"), temporary.path().join("two"));
    succeed(train(1, &config, &one).arg("--set=training.steps=4"));
    let weights = temporary.path().join("alexnet.safetensors");
    let learn = || {
        let mut command = train(2, &config, &two);
        command.arg("--weights").arg(one.join("best.safetensors")).arg("--set=training.steps=8");
        let lpips = format!("{{ weight = 0.1, after = 0.5, files = ['{}'] }}", weights.display());
        command.arg(format!("--set=stage2.lpips={lpips}"));
        command
    };
    let said = refused(&mut learn());
    assert!(said.contains("alexnet.safetensors"), "{said}");
    perceptual(&weights);
    succeed(&mut learn());
    let logged = logged(&two, "lpips");
    assert_eq!(logged.iter().map(|(step, _)| *step).collect::<Vec<_>>(), [5, 6, 7, 8]);
    assert!(logged.iter().all(|(_, distance)| (0.0..1.0).contains(distance)), "{logged:?}");
    let said = refused(learn().arg("--set=stage2.lpips.weight=-1"));
    assert!(said.contains("stage2.lpips"), "{said}");
}

/// Too large a loss scale is found out within a few steps, which are skipped.
#[test]
fn sixteen_bits_learn_what_thirty_two_do() {
    let (temporary, config) = place();
    let losses = |precision: &str| {
        let run = temporary.path().join(precision);
        let set = format!("training.precision={precision}");
        let said = succeed(train(1, &config, &run).args(["--set", &set]));
        assert!(said.contains("finished after 40 steps"), "{said}");
        logged(&run, "validation/points_mm")
    };
    let (_, expected) = *losses("f32").last().expect("validations");
    for precision in ["bf16", "f16"] {
        let (_, error) = *losses(precision).last().expect("validations");
        println!("{precision}: {error} mm instead of {expected}");
        assert!((error - expected).abs() < 0.1 * expected, "{precision}: {error} instead of {expected}");
    }
    let state = fs::read(temporary.path().join("f16/state/state.safetensors")).expect("a state");
    assert!(String::from_utf8_lossy(&state[..20_000]).contains("\\\"loss_scale\\\":{"));
    // The regressor as well, on a predictor that is frozen; validations are in f32.
    let start = temporary.path().join("f32/best.safetensors");
    let scores = ["f32", "f16"].map(|precision| {
        let run = temporary.path().join(format!("two-{precision}"));
        let set = format!("--set=training.precision={precision}");
        succeed(train(2, &config, &run).args([&set, "--set=training.steps=10"]).arg("--weights").arg(&start));
        logged(&run, "validation/psnr_masked").last().expect("validations").1
    });
    println!("stage 2: {scores:?} dB");
    assert!((scores[0] - scores[1]).abs() < 0.1, "{scores:?}");
    let mut rehearsal = train(1, &config, &temporary.path().join("rehearsal"));
    succeed(rehearsal.args(["--dry-run", "--set=training.precision=f16"]));
    let mut command = snapsnap();
    command.args(["train-stage1", "--device", "ndarray", "--set", "training.precision=f16", "--config"]);
    command.arg(&config).arg("--data").arg(people()).arg("-o").arg(temporary.path().join("ndarray"));
    let said = refused(&mut command);
    assert!(said.contains("training.precision") && said.contains("ndarray"), "{said}");
}

/// A limit on the size of files stands for a full disk: the checkpoint does not fit, the log does.
#[cfg(unix)]
#[test]
fn a_full_disk_leaves_the_last_checkpoint_and_exit_code_2() {
    let (temporary, config) = place();
    let run = temporary.path().join("run");
    succeed(train(1, &config, &run).args(["--set", "training.steps=8"]));
    let before = results(&run);
    let command = train(1, &config, &run);
    let mut shell = Command::new("sh");
    shell.args(["-c", "trap '' XFSZ; ulimit -f 20; exec \"$@\"", "sh"]).arg(command.get_program());
    let said = refused(shell.args(command.get_args()).arg("--resume"));
    assert!(said.contains("cannot write"), "{said}");
    assert!(results(&run) == before, "a file was changed");
    succeed(train(1, &config, &run).arg("--resume"));
    assert_eq!(logged(&run, "loss").len(), 40);
}

#[test]
fn a_broken_sample_is_skipped_and_named_and_twenty_in_a_row_end_the_run() {
    let (temporary, config) = place();
    let copy = temporary.path().join("people");
    copy_folder(people(), &copy);
    let broken = copy.join("train/img/0001/2.png");
    fs::write(&broken, b"not a picture").expect("writes");
    let one = ["--set", "training.batch=1", "--set", "training.validation_samples=0"];
    let train = |run: &str| {
        let mut command = snapsnap();
        command.args(["train-stage1", "--device", "cpu", "--config"]).arg(&config).args(one);
        command.arg("--data").arg(&copy).arg("-o").arg(temporary.path().join(run));
        command
    };
    let output = train("some").output().expect("runs");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said.contains("skipped") && said.contains("img/0001/2.png"), "{said}");
    for (subject, view) in (0..3).flat_map(|subject| (0..4).map(move |view| (subject, view))) {
        fs::write(copy.join(format!("train/img/000{subject}/{view}.png")), b"").expect("writes");
    }
    let output = train("none").output().expect("runs");
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("20 steps in a row") && said.contains(".png: "), "{said}");
}

/// A person who is not in their photographs cannot be trained on; the others can.
#[test]
fn samples_that_show_nobody_are_skipped_and_named() {
    let (temporary, config) = place();
    let (copy, one) = (temporary.path().join("people"), temporary.path().join("one"));
    copy_folder(people(), &copy);
    for view in 0..4 {
        let nobody = image::RgbaImage::new(64, 64);
        nobody.save(copy.join(format!("train/img/0001/{view}.png"))).expect("writes");
    }
    let set = ["--set=training.steps=9", "--set=training.batch=1", "--set=network.conf_threshold=0.999"];
    succeed(train(1, &config, &one).args(set));
    let run = temporary.path().join("run");
    let mut command = snapsnap();
    command
        .args(["train-stage2", "--device", "cpu", "--config"])
        .arg(&config)
        .args(set)
        .arg("--data")
        .arg(&copy);
    command.arg("--weights").arg(one.join("best.safetensors")).arg("-o").arg(&run);
    let output = command.output().expect("runs");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said.contains("skipped: no pixel is part of a person"), "{said}");
    assert!(said.contains("0001, view ") && !said.contains("0000, view "), "{said}");
    assert_eq!(logged(&run, "loss").len(), 9 - said.matches("skipped: ").count());
}

/// A picture that cannot be read costs the validations it is in, but no step, and the last one is made up for.
#[test]
fn validations_that_cannot_be_made_cost_no_step() {
    let (temporary, config) = place();
    let (copy, run) = (temporary.path().join("people"), temporary.path().join("run"));
    copy_folder(people(), &copy);
    let train = || {
        let mut command = snapsnap();
        command.args(["train-stage1", "--device", "cpu", "--resume", "--config"]).arg(&config);
        command.arg("--data").arg(&copy).arg("-o").arg(&run);
        command
    };
    let pictures: Vec<PathBuf> = (0..4).map(|view| copy.join(format!("val/img/0000/{view}.png"))).collect();
    let sound: Vec<Vec<u8>> = pictures.iter().map(|path| fs::read(path).expect("reads")).collect();
    pictures.iter().for_each(|path| fs::write(path, b"not a picture").expect("writes"));
    let said = refused(&mut train());
    assert!(said.contains("no validation after step 10") && said.contains("val/img/0000/"), "{said}");
    assert_eq!(logged(&run, "loss").len(), 40);
    assert!(logged(&run, "validation/points_mm").is_empty() && !run.join("best.safetensors").exists());
    pictures.iter().zip(&sound).for_each(|(path, bytes)| fs::write(path, bytes).expect("writes"));
    succeed(&mut train());
    assert_eq!(logged(&run, "validation/points_mm").len(), 1);
    assert!(run.join("best.safetensors").exists() && run.join("previews/0000040.png").exists());
    let before = results(&run);
    succeed(&mut train());
    assert!(results(&run) == before);
}

fn copy_folder(from: &Path, to: &Path) {
    fs::create_dir_all(to).expect("makes");
    for entry in fs::read_dir(from).expect("lists").map(|entry| entry.expect("entry").path()) {
        let target = to.join(entry.file_name().expect("named"));
        if entry.is_dir() {
            copy_folder(&entry, &target);
        } else {
            fs::copy(&entry, &target).expect("copies");
        }
    }
}

/// Two implementations on the same processor stand for two cards.
#[test]
fn two_devices_share_batches_and_learn_what_one_does() {
    let (temporary, config) = place();
    let weights = temporary.path().join("start.safetensors");
    for stage in [1, 2] {
        let losses = |devices: &str| {
            let run = temporary.path().join(format!("{stage}-{devices}"));
            let mut command = snapsnap();
            command
                .arg(format!("train-stage{stage}"))
                .arg("--config")
                .arg(&config)
                .arg("--data")
                .arg(people());
            command.args(["--device", devices, "--set", "training.steps=3", "--set", "training.batch=3"]);
            // What is random within a step follows from the device's number.
            command.args(["--set", "stage2.noise=0", "-o"]).arg(&run);
            if stage == 2 {
                command.arg("--weights").arg(&weights);
            }
            succeed(&mut command);
            (logged(&run, "loss"), run.join("last.safetensors"))
        };
        let ((one, last), (two, _)) = (losses("cpu"), losses("cpu,ndarray"));
        println!("stage {stage}: {one:?} {two:?}");
        for ((step, one), (_, two)) in one.iter().zip(&two) {
            // Pixels of all samples are pooled on one device and averaged over two.
            assert!((one - two).abs() < 0.05 * one, "stage {stage}, step {step}: {one} and {two}");
        }
        fs::copy(last, &weights).expect("copies");
    }
    let said = refused(train(1, &config, &temporary.path().join("x")).args(["--set", "training.batch=0"]));
    assert!(said.contains("training.batch"), "{said}");
    let mut command = snapsnap();
    command.args(["train-stage1", "--device", "cpu,cpu,ndarray", "--config"]).arg(&config);
    let said = refused(command.arg("--data").arg(people()).arg("-o").arg(temporary.path().join("y")));
    assert!(said.contains("3 devices share a batch of 2"), "{said}");
}

#[test]
fn a_rehearsal_writes_nothing_and_says_how_long_the_run_will_take() {
    let (temporary, config) = place();
    let run = temporary.path().join("run");
    let said = succeed(train(1, &config, &run).arg("--dry-run"));
    assert!(said.contains("40 steps will take about") && said.contains("memory"), "{said}");
    assert!(!run.exists());
}

#[test]
fn what_cannot_be_trained_is_refused_by_name() {
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

    // A run is not begun twice, nor gone on with by other networks or another stage.
    succeed(train(1, &config, &run).args(["--set", "training.steps=2"]));
    let before = results(&run);
    let said = refused(&mut train(1, &config, &run));
    assert!(said.contains("--resume"), "{said}");
    let said = refused(train(1, &config, &run).args(["--resume", "--set", "network.enc_depth=2"]));
    assert!(said.contains("other [network]"), "{said}");
    let said = refused(train(2, &config, &run).args(["--resume"]));
    assert!(said.contains("stage 1"), "{said}");
    assert!(results(&run) == before);
    // Without its state a folder is none of a run's, but weights that a run begins with are not replaced by it.
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

#[test]
fn a_damaged_state_is_refused_and_changes_nothing() {
    let (temporary, config) = place();
    let run = temporary.path().join("run");
    succeed(train(1, &config, &run).args(["--set", "training.steps=2"]));
    let (before, state) = (results(&run), run.join("state/state.safetensors"));
    let whole = before[2].clone();
    let header = 8 + u64::from_le_bytes(whole[..8].try_into().expect("eight bytes")) as usize;
    let mut random = ChaCha8Rng::seed_from_u64(11);
    let mut damaged: Vec<Vec<u8>> = [0, 7, 100, header, whole.len() / 2, whole.len() - 1]
        .map(|length| whole[..length].to_vec())
        .into_iter()
        .collect();
    for _ in 0..12 {
        // In the header, where the bytes mean something.
        let mut bytes = whole.clone();
        let at = random.random_range(0..header);
        bytes[at] = bytes[at].wrapping_add(random.random_range(1..255));
        damaged.push(bytes);
    }
    for bytes in damaged {
        fs::write(&state, &bytes).expect("writes");
        let output = train(1, &config, &run).args(["--resume", "--set", "training.steps=2"]).output();
        let output = output.expect("runs");
        let said = String::from_utf8_lossy(&output.stderr);
        // What is damaged may still be a state, of another step, say.
        if output.status.code() != Some(0) {
            assert_eq!(output.status.code(), Some(2), "{said}");
            assert!(said.contains("state.safetensors") && !said.contains("panicked"), "{said}");
            assert!(fs::read(&state).expect("reads") == bytes && results(&run)[..2] == before[..2]);
        }
        for (name, bytes) in ["last.safetensors", "best.safetensors"].iter().zip(&before) {
            fs::write(run.join(name), bytes).expect("writes");
        }
    }
}
