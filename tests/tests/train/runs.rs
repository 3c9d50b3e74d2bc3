//! Undisturbed runs.

use std::fs;

use snapsnap_tests::{Numbers, TRAINING, assert_says, refused, snapsnap, succeed};

use super::{logged, people, place, train};

#[test]
fn both_stages_learn_and_write_weights_for_reconstructions() {
    let (temporary, config) = place();
    let (one, two) = (temporary.path().join("one"), temporary.path().join("two"));
    let said = succeed(&mut train(1, &config, &one));
    let weights = one.join("best.safetensors");
    let next = format!("a training of stage 2, which begins with --weights {}", weights.display());
    assert!(said.contains("finished after 40 steps") && said.contains(&next), "{said}");
    let losses = logged(&one, "loss");
    assert_eq!(losses.len(), 40);
    let mean = |part: &[(u64, f64)]| part.iter().map(|(_, loss)| loss).sum::<f64>() / part.len() as f64;
    assert!(mean(&losses[35..]) < 0.8 * mean(&losses[..5]), "{losses:?}");
    let steps: Vec<u64> = logged(&one, "validation/points_mm").iter().map(|(step, _)| *step).collect();
    assert_eq!(steps, [10, 20, 30, 40]);
    for file in ["config.toml", "curves.svg", "previews/0000020.png", "previews/0000040.png"] {
        assert!(one.join(file).is_file(), "{file}");
    }
    // TensorBoard gets the previews.
    let events = fs::read(one.join("events.out.tfevents.snapsnap")).expect("events");
    let has = |part: &[u8]| events.windows(part.len()).any(|window| window == part);
    for preview in ["previews/0000020.png", "previews/0000040.png"] {
        assert!(has(&fs::read(one.join(preview)).expect("a preview")), "{preview}");
    }
    // Captions stand above the pictures and a note below: 14 rows each.
    let (width, height) = image::image_dimensions(one.join("previews/0000040.png")).expect("a picture");
    assert_eq!((height - 28) % 4, 0);
    assert_eq!(width % (4 * (height - 28) / 4), 0);
    let svg = fs::read_to_string(one.join("curves.svg")).expect("curves");
    assert_says(&svg, &["<polyline", "held-out people: error of points", "\nmm\n", "\nstep\n"]);

    // The printed command runs as it is, but for the photographs. The file of stage 2 contains both networks.
    let said = succeed(train(2, &config, &two).arg("--weights").arg(&weights));
    let command = said.lines().find_map(|line| line.strip_prefix("next:")).expect("a command").trim();
    let photographs = [0, 2].map(|view| people().join(format!("val/img/0000/{view}.png")));
    let photographs = photographs.map(|path| path.display().to_string()).join(" ");
    let program = snapsnap().get_program().to_string_lossy().into_owned();
    let command = command.replacen("snapsnap", &program, 1).replacen("FRONT BACK", &photographs, 1);
    succeed(std::process::Command::new("sh").current_dir(temporary.path()).arg("-c").arg(command));
    assert!(temporary.path().join("turn.png").is_file());
    assert!(fs::metadata(temporary.path().join("human.ply")).expect("a file").len() > 10_000);
    assert_eq!(logged(&two, "validation/psnr_masked").len(), 4);

    // Stage 1 ignores the regressor of a weight file. Stage 2 checks the regressor's config.
    let other = [
        "--set=training.steps=1",
        "--set=schedule.warm_up=0",
        "--set=regressor.start=published",
        "--weights",
    ];
    let both = two.join("last.safetensors");
    succeed(train(1, &config, &temporary.path().join("three")).args(other).arg(&both));
    let said = refused(train(2, &config, &temporary.path().join("four")).args(other).arg(&both));
    assert!(said.contains("`regressor.start`") && said.contains("`import-weights --set`"), "{said}");
}

/// All other layers keep the values that the run begins with.
#[test]
fn details_are_trained_alone() {
    let (temporary, config) = place();
    let [start, run] = ["start.safetensors", "run"].map(|name| temporary.path().join(name));
    let details = [
        "network.anchor=ray",
        "network.net_resolution=32",
        "network.details.resolution=64",
        "network.details.dims=[4,4,8,8]",
    ];
    let set = || details.iter().flat_map(|key| ["--set", key]);
    let networks = temporary.path().join("networks.toml");
    fs::write(&networks, TRAINING.split("[samples]").next().expect("sections of networks")).expect("writes");
    let mut init = snapsnap();
    succeed(init.arg("init-weights").arg("--config").arg(networks).args(set()).arg("-o").arg(&start));
    let only = ["--set=stage1.only_details=true", "--set=training.steps=3", "--set=schedule.warm_up=0"];
    succeed(train(1, &config, &run).args(set()).args(only).arg("--weights").arg(&start));
    let [start, end] = [start, run.join("last.safetensors")].map(|path| Numbers::read(&path));
    let (mut moved, mut kept) = (0, 0);
    for name in end.names() {
        match name.starts_with("details.") {
            true => moved += u32::from(start.f32(&name) != end.f32(&name)),
            false => {
                assert_eq!(start.f32(&name), end.f32(&name), "{name}");
                kept += 1;
            }
        }
    }
    assert!(moved > 40 && kept > 40, "{moved} {kept}");
    let said = refused(train(1, &config, &temporary.path().join("random")).args(set()).args(only));
    assert!(said.contains("--weights"), "{said}");
    let without = ["--set=stage1.only_details=true"];
    let said = refused(train(1, &config, &temporary.path().join("without")).args(without));
    assert!(said.contains("`stage1.only_details`") && said.contains("`network.details`"), "{said}");
}

#[test]
fn a_rehearsal_writes_nothing_and_prints_the_time_of_the_run() {
    let (temporary, config) = place();
    let run = temporary.path().join("run");
    assert_says(&succeed(train(1, &config, &run).arg("--dry-run")), &["40 steps will take about", "memory"]);
    assert!(!run.exists());
}

/// A file's data reach the disk before its rename, the rename before the next step, and weights before their state.
#[test]
#[cfg(target_os = "linux")]
fn checkpoints_reach_the_disk_in_their_order() {
    use std::path::Path;
    use std::process::Command;

    let probe = Command::new("strace").arg("true").output();
    if !probe.is_ok_and(|probe| probe.status.success()) {
        println!("skipped: strace cannot watch processes here (Debian: apt-get install strace)");
        return;
    }
    let (temporary, config) = place();
    let (run, log) = (temporary.path().join("run"), temporary.path().join("calls"));
    let command = train(1, &config, &run);
    let mut watched = Command::new("strace");
    watched.args(["-f", "-y", "-s", "4096", "-e", "trace=fsync,rename,renameat,renameat2", "-o"]).arg(&log);
    watched.arg(command.get_program()).args(command.get_args());
    succeed(watched.arg("--set=training.steps=2"));
    let calls = fs::read_to_string(&log).expect("calls");
    let calls: Vec<&str> = calls.lines().filter(|line| !line.contains("resumed>")).collect();
    let synced = |part: &[&str], path: &Path| {
        part.iter().any(|call| call.contains("fsync(") && call.contains(&format!("<{}>", path.display())))
    };
    let mut renamed = Vec::new();
    for (i, call) in calls.iter().enumerate().filter(|(_, call)| call.contains("rename")) {
        let mut paths = call.split('"').skip(1).step_by(2).map(Path::new);
        let (from, to) = (paths.next().expect("a path"), paths.next().expect("a path"));
        let folder = to.parent().expect("lies in a folder").canonicalize().expect("a folder");
        let from = folder.join(from.file_name().expect("a name"));
        assert!(synced(&calls[..i], &from), "{call}: before its data");
        // Calls of the same thread.
        let of_thread = |other: &&&str| other.split(' ').next() == call.split(' ').next();
        let after = calls[i + 1..].iter().filter(of_thread).take_while(|call| !call.contains("rename"));
        assert!(synced(&after.copied().collect::<Vec<_>>(), &folder), "{call}: the folder is not synced");
        renamed.push(to.file_name().expect("a name").to_string_lossy().into_owned());
    }
    // The first state is written before the first step.
    let place = |name: &str| renamed.iter().rposition(|renamed| renamed == name);
    let [weights, state] = ["last.safetensors", "state.safetensors"].map(place);
    assert!(weights.is_some() && weights < state, "{renamed:?}");
}
