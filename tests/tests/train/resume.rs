//! Runs that are continued after a kill, an interrupt or a full disk end with the same bytes. Damaged states are
//! refused.

use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use snapsnap_tests::{assert_says, ended, ended_with, limited, refused, snapsnap, succeed};

use super::{logged, place, results, train};

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
fn killed_runs_end_with_the_bytes_of_an_undisturbed_run() {
    let (temporary, config) = place();
    let undisturbed = temporary.path().join("undisturbed");
    // Long enough for several kills, with frequent checkpoints.
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
fn sessions_after_a_time_limit_or_an_interrupt_end_with_the_same_bytes() {
    let (temporary, config) = place();
    let weights = temporary.path().join("start.safetensors");
    let one = temporary.path().join("one");
    succeed(&mut train(1, &config, &one));
    fs::copy(one.join("last.safetensors"), &weights).expect("copies");
    let (whole, pieces) = (temporary.path().join("whole"), temporary.path().join("pieces"));
    succeed(train(2, &config, &whole).arg("--weights").arg(&weights));
    let mut command = train(2, &config, &pieces);
    let said = succeed(command.args(["--minutes", "0.001", "--resume", "--weights"]).arg(&weights));
    assert!(said.contains("interrupted") && said.contains("--resume"), "{said}");
    // The run's folder contains its predictor, data paths and config.
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
    // --resume of a finished run changes nothing.
    let before = results(&whole);
    succeed(train(2, &config, &whole).arg("--resume"));
    assert!(results(&whole) == before);
}

/// A limit on the size of files imitates a full disk. The log fits, the checkpoint does not.
#[cfg(unix)]
#[test]
fn a_full_disk_leaves_the_last_checkpoint_and_exit_code_2() {
    let (temporary, config) = place();
    let run = temporary.path().join("run");
    succeed(train(1, &config, &run).args(["--set", "training.steps=8"]));
    let before = results(&run);
    assert_says(&refused(&mut limited(train(1, &config, &run).arg("--resume"), "-f 20")), &["cannot write"]);
    assert!(results(&run) == before, "a file was changed");
    succeed(train(1, &config, &run).arg("--resume"));
    assert_eq!(logged(&run, "loss").len(), 40);
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
    let lengths = [0, 7, 100, header, whole.len() / 2, whole.len() - 1];
    let mut damaged: Vec<Vec<u8>> = lengths.iter().map(|length| whole[..*length].to_vec()).collect();
    for _ in 0..12 {
        // Only in the header: any values of the tensors are valid.
        let mut bytes = whole.clone();
        let at = random.random_range(0..header);
        bytes[at] = bytes[at].wrapping_add(random.random_range(1..255));
        damaged.push(bytes);
    }
    for bytes in damaged {
        fs::write(&state, &bytes).expect("writes");
        let _ = fs::remove_file(run.join("state/former.safetensors"));
        let (code, said) = ended(train(1, &config, &run).args(["--resume", "--set", "training.steps=2"]));
        // A changed header may be a valid state, for example of another step. A truncated file never is.
        if bytes.len() < whole.len() || code != Some(0) {
            assert!(code == Some(2) && said.contains("state.safetensors"), "{code:?}: {said}");
            assert!(fs::read(&state).expect("reads") == bytes && results(&run)[..2] == before[..2]);
        }
        for (name, bytes) in ["last.safetensors", "best.safetensors"].iter().zip(&before) {
            fs::write(run.join(name), bytes).expect("writes");
        }
    }
}

/// After a power failure, a run goes on from the state before the damaged one and has the same end.
#[test]
fn a_run_with_a_damaged_state_goes_on_from_the_state_before() {
    let (temporary, config) = place();
    let run = temporary.path().join("run");
    succeed(train(1, &config, &run).args(["--set", "training.steps=4"]));
    let (before, state) = (results(&run), run.join("state/state.safetensors"));
    fs::write(&state, &before[2][..before[2].len() / 2]).expect("writes");
    let said = ended_with(0, train(1, &config, &run).args(["--resume", "--set", "training.steps=4"]));
    assert!(said.contains("goes on from the state before it"), "{said}");
    assert!(results(&run) == before, "another end");
    // A number of steps beyond every training is no sign of a finished one.
    let length = 8 + u64::from_le_bytes(before[2][..8].try_into().expect("eight bytes")) as usize;
    let header = String::from_utf8(before[2][8..length].to_vec()).expect("text");
    let grown = header.replace("\\\"step\\\":4,", "\\\"step\\\":4000000000000000000,");
    assert_ne!(header, grown);
    let mut bytes = (grown.len() as u64).to_le_bytes().to_vec();
    bytes.extend(grown.bytes().chain(before[2][length..].iter().copied()));
    fs::write(&state, bytes).expect("writes");
    fs::remove_file(run.join("state/former.safetensors")).expect("is there");
    let said = refused(train(1, &config, &run).args(["--resume", "--set", "training.steps=4"]));
    assert!(said.contains("tells of 4000000000000000000 steps"), "{said}");
}
