//! Trainings by several ranks of MPI: the losses of one process, equal bytes, and ends with one message. They need
//! `mpirun`, and a program with the feature `mpi`.

use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use snapsnap_tests::{copy_folder, files, limited, snapsnap, succeed, synthetic_people};

use super::{logged, people, place, results, train, train_on};

/// Whether ranks can be started; else the reason is printed, or an error with `SNAPSNAP_REQUIRE_MPI`.
fn is_there() -> bool {
    // The options below are Open MPI's.
    let version = Command::new("mpirun").arg("--version").output();
    let mpirun = version.is_ok_and(|output| String::from_utf8_lossy(&output.stdout).contains("Open MPI"));
    let doctor = succeed(snapsnap().args(["doctor", "--json"]));
    let report: serde_json::Value = serde_json::from_str(&doctor).expect("JSON");
    let is_built = report["mpi"].as_bool().expect("a boolean");
    let missing = match (mpirun, is_built) {
        (true, true) => return true,
        (false, _) => "there is no mpirun of Open MPI",
        (_, false) => "the program was built without the feature mpi",
    };
    assert!(std::env::var_os("SNAPSNAP_REQUIRE_MPI").is_none(), "{missing}, but MPI is required");
    println!("SKIPPED: {missing}");
    false
}

/// The command on `ranks` ranks of one thread each.
fn on_ranks(ranks: usize, command: &Command) -> Command {
    let mut all = Command::new("mpirun");
    all.args(["--allow-run-as-root", "--oversubscribe", "--bind-to", "none", "-n", &ranks.to_string()]);
    all.arg(command.get_program()).args(command.get_args()).env("RAYON_NUM_THREADS", "1");
    all
}

fn set(mut command: Command, keys: &[&str]) -> Command {
    keys.iter().for_each(|key| {
        command.args(["--set", key]);
    });
    command
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&[&output.stdout[..], &output.stderr].concat()).into_owned()
}

/// Messages of the program among the messages of `mpirun`.
fn errors(output: &Output) -> Vec<String> {
    said(output).lines().filter(|line| line.starts_with("error: ")).map(str::to_owned).collect()
}

#[test]
fn ranks_have_the_losses_of_one_process_and_the_same_bytes_again() {
    if !is_there() {
        return;
    }
    let (temporary, config) = place();
    let weights = temporary.path().join("start.safetensors");
    // Batches of 4 of one person with 50 samples: the last batch of a pass has 2, so that two of four ranks have none.
    let person = temporary.path().join("person");
    for split in ["train", "val"] {
        succeed(&mut synthetic_people(&person, split, 1, 4));
    }
    // With the rates of the other tests, rounding errors grow tenfold every two steps of stage 2.
    let keys = ["training.steps=20", "training.batch=4", "optimizer.rate=5e-4", "optimizer.muon.rate=5e-4"];
    for stage in [1, 2] {
        let run = |name: &str, ranks: usize| {
            let run = temporary.path().join(format!("{stage}-{name}"));
            let mut command = set(train_on(&person, stage, &config, &run), &keys);
            if stage == 2 {
                command.arg("--weights").arg(&weights);
            }
            if ranks > 1 {
                command = on_ranks(ranks, &command);
            }
            succeed(&mut command);
            run
        };
        let one = run("one", 1);
        for ranks in [2, 4] {
            let several = run(&ranks.to_string(), ranks);
            let (expected, found) = (logged(&one, "loss"), logged(&several, "loss"));
            assert_eq!((expected.len(), found.len()), (20, 20));
            for ((step, expected), (_, found)) in expected.iter().zip(&found) {
                assert!(
                    (found / expected - 1.0).abs() < 1e-5,
                    "stage {stage}, {ranks} ranks, step {step}: {found}, not {expected}"
                );
            }
            for name in ["validation/points_mm", "validation/psnr_masked"] {
                let (a, b) = (logged(&one, name), logged(&several, name));
                assert_eq!(a.len(), b.len());
                let scores = a.into_iter().zip(b);
                scores.for_each(|((_, a), (_, b))| assert!((a / b - 1.0).abs() < 1e-3, "{name}: {a}, {b}"));
            }
            let score = if stage == 1 { "validation/points_mm" } else { "validation/psnr_masked" };
            assert_eq!(logged(&several, score).len(), 2);
            let again = run(&format!("{ranks}-again"), ranks);
            assert!(results(&several) == results(&again), "stage {stage}: other bytes on {ranks} ranks");
        }
        fs::copy(one.join("last.safetensors"), &weights).expect("copies");
    }
}

/// A killed rank ends all, and the resumed run has the same bytes. `SNAPSNAP_TEST_KILLS`: number of kills.
#[test]
fn a_killed_rank_ends_all_and_the_run_goes_on() {
    if !is_there() {
        return;
    }
    let (temporary, config) = place();
    let kills = std::env::var("SNAPSNAP_TEST_KILLS").ok().and_then(|kills| kills.parse().ok()).unwrap_or(3);
    // A kill comes after some 20 steps.
    let steps = format!("training.steps={}", 40 * kills);
    let command = |run: &Path| on_ranks(2, &set(train(1, &config, run), &[&steps]));
    let undisturbed = temporary.path().join("undisturbed");
    succeed(&mut command(&undisturbed));
    let (killed, mut random) = (temporary.path().join("killed"), ChaCha8Rng::seed_from_u64(11));
    let (mut made, mut longest) = (0, Duration::ZERO);
    while made < kills {
        let child = command(&killed).arg("--resume").stdout(Stdio::null()).stderr(Stdio::piped()).spawn();
        let mut child = child.expect("starts");
        std::thread::sleep(Duration::from_millis(random.random_range(400..2500)));
        if child.try_wait().expect("waits").is_some() {
            break;
        }
        // The program's processes are children of mpirun.
        let ranks =
            Command::new("pgrep").args(["-P", &child.id().to_string(), "snapsnap"]).output().expect("pgrep");
        let ranks = String::from_utf8_lossy(&ranks.stdout).into_owned();
        let ranks: Vec<&str> = ranks.split_whitespace().collect();
        let Some(victim) = ranks.get(random.random_range(0..ranks.len().max(1))) else {
            // The ranks have not started yet.
            child.kill().expect("kills");
            child.wait().expect("ends");
            continue;
        };
        Command::new("kill").args(["-KILL", victim]).status().expect("kill");
        let start = Instant::now();
        let output = child.wait_with_output().expect("ends");
        longest = longest.max(start.elapsed());
        // The run may have ended just before.
        made += usize::from(!output.status.success());
    }
    println!("{made} ranks killed, the others ended within {longest:?}");
    assert!(made > 0 && longest < Duration::from_secs(30), "{made} kills, {longest:?}");
    succeed(command(&killed).arg("--resume"));
    assert!(results(&undisturbed) == results(&killed), "other bytes after {made} kills");
}

#[test]
fn signals_end_a_session_with_a_code_for_scripts_and_other_ranks_go_on() {
    if !is_there() {
        return;
    }
    let (temporary, config) = place();
    let keys = ["training.steps=400", "training.batch=4", "training.validate_every=0"];
    let command = |run: &Path| set(train(1, &config, run), &keys);
    let whole = temporary.path().join("whole");
    succeed(&mut command(&whole));
    let run = temporary.path().join("run");
    let mut made = Vec::new();
    for (signal, ranks) in [("-TERM", 1), ("-USR1", 1), ("-USR1", 2)] {
        let mut pieces = command(&run);
        pieces.arg("--resume");
        let mut pieces = if ranks > 1 { on_ranks(ranks, &pieces) } else { pieces };
        let child = pieces.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("starts");
        // The session has begun once it logs a step.
        let before = made.last().copied().unwrap_or(0);
        let start = Instant::now();
        let lines = || fs::read_to_string(run.join("log.jsonl")).unwrap_or_default().matches('\n').count();
        while lines() < before + 3 {
            assert!(start.elapsed() < Duration::from_secs(60), "no step was logged");
            std::thread::sleep(Duration::from_millis(20));
        }
        Command::new("kill").args([signal, &child.id().to_string()]).status().expect("kill");
        let output = child.wait_with_output().expect("ends");
        assert_eq!(output.status.code(), Some(75), "{signal}, {ranks} ranks: {}", said(&output));
        let steps = said(&output)
            .split("interrupted after ")
            .nth(1)
            .and_then(|rest| rest.split(' ').next()?.parse().ok());
        made.push(steps.unwrap_or_else(|| panic!("{}", said(&output))));
    }
    succeed(command(&run).arg("--resume"));
    let (expected, found) = (logged(&whole, "loss"), logged(&run, "loss"));
    assert_eq!(expected.len(), found.len());
    let [first, alone, together]: [usize; 3] = made.try_into().expect("three");
    assert!(0 < first && first < alone && alone < together && together < 400, "{first} {alone} {together}");
    assert!(expected[..alone] == found[..alone], "a process alone goes on with other losses");
    // The samples are the same, and rounding alone differs. It grows with the steps.
    for ((step, expected), (_, found)) in expected.iter().zip(&found).skip(alone).take(10) {
        assert!((found / expected - 1.0).abs() < 1e-3, "step {step}: {found}, not {expected}");
    }
}

#[test]
fn failures_of_a_rank_end_all_with_one_message() {
    if !is_there() {
        return;
    }
    let (temporary, config) = place();
    let run = |name: &str| temporary.path().join(name);
    let start = Instant::now();
    // More ranks than samples in a batch. All ranks notice it.
    let output = on_ranks(3, &train(1, &config, &run("many"))).output().expect("runs");
    let message = "`training.batch` is 2, must be at least 3, the number of ranks";
    assert_eq!(output.status.code(), Some(2), "{}", said(&output));
    assert!(
        matches!(&errors(&output)[..], [one] if one.contains("rank 0 on ") && one.ends_with(message)),
        "{}",
        said(&output)
    );
    // All pictures are broken: no step can be made.
    let broken = run("broken");
    copy_folder(people(), &broken);
    let pictures = broken.join("train");
    for path in files(&pictures).into_keys().filter(|path| path.extension().is_some_and(|end| end == "png")) {
        fs::write(pictures.join(path), b"no picture").expect("writes");
    }
    let output = on_ranks(2, &train_on(&broken, 1, &config, &run("stuck"))).output().expect("runs");
    assert_eq!(output.status.code(), Some(1), "{}", said(&output));
    assert!(matches!(&errors(&output)[..], [one] if one.contains("steps in a row")), "{}", said(&output));
    // Ranks with another seed.
    let mut other = Command::new("mpirun");
    other.args(["--allow-run-as-root", "--oversubscribe", "-n", "2", "sh", "-c"]);
    other.arg("data=$1; shift; [ \"$OMPI_COMM_WORLD_RANK\" = 0 ] || set -- \"$@\" --set training.seed=9; exec \"$@\" --data \"$data\"");
    let single = train(1, &config, &run("other"));
    let output = other
        .arg("sh")
        .arg(people())
        .arg(single.get_program())
        .args(single.get_args())
        .output()
        .expect("runs");
    assert_eq!(output.status.code(), Some(2), "{}", said(&output));
    let errors_there = errors(&output);
    assert!(
        errors_there.iter().any(|error| error.contains("rank 1 on") && error.contains("training.seed")),
        "{}",
        said(&output)
    );
    // A full disk on the first rank, after a checkpoint.
    let full = run("full");
    succeed(&mut on_ranks(2, &set(train(1, &config, &full), &["training.steps=8"])));
    let before = results(&full);
    let resumed = limited(train(1, &config, &full).arg("--resume"), "-f 20");
    let output = on_ranks(2, &resumed).output().expect("runs");
    assert_eq!(output.status.code(), Some(1), "{}", said(&output));
    assert!(
        matches!(&errors(&output)[..], [one] if one.contains("rank 0 on ") && one.contains("cannot write")),
        "{}",
        said(&output)
    );
    assert!(results(&full) == before);
    assert!(start.elapsed() < Duration::from_secs(120), "{:?}", start.elapsed());
}
