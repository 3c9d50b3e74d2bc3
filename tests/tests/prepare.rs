//! `snapsnap prepare` as a user types it: data sets of people and scans, broken scans, and runs that are continued.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use snapsnap_tests::{assert_says, files, limited, refused, root, shared_folder, snapsnap, succeed};

/// Settings of small and few views.
const SMALL: [&str; 4] = ["--set", "views.count=4", "--set", "views.resolution=64"];

fn prepare(kind: &str) -> Command {
    let mut command = snapsnap();
    command.args(["prepare", kind]);
    command
}

fn synth(folder: &Path, subjects: &str) -> Command {
    let mut command = prepare("synth");
    command.args(["--subjects", subjects, "--seed", "3", "-o"]).arg(folder).args(SMALL);
    command
}

#[test]
fn synthetic_people_become_a_data_set_that_has_no_fault() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let (folder, sheet) = (temporary.path().join("people"), temporary.path().join("sheet.png"));
    succeed(synth(&folder, "3").arg("--save-scans").arg("--preview").arg(&sheet));
    assert_says(&succeed(prepare("check").arg(&folder)), &["3 subjects, 12 views: no fault"]);
    let sheet = image::open(&sheet).expect("a picture").into_rgb8();
    let colors: std::collections::HashSet<[u8; 3]> = sheet.pixels().map(|p| p.0).collect();
    assert!(sheet.width() == 9 * 192 && colors.len() > 500, "{:?}", sheet.dimensions());
}

/// People that are written as scans and imported again give the same views.
#[test]
fn saved_scans_are_of_the_same_people() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let (people, again) = (temporary.path().join("people"), temporary.path().join("again"));
    // People of test sets have no random offset.
    succeed(synth(&people, "2").args(["--split", "test", "--save-scans"]));
    let scans = people.join("scans/test");
    succeed(prepare("scan").arg(&scans).arg("-o").arg(&again).args(SMALL).args(["--split", "test"]));
    let views = |folder: &Path| files(&folder.join("test"));
    assert_eq!(views(&again).len(), 2 * (4 + 4 + 1));
    assert!(views(&again) == views(&people), "the same bytes");

    // Scans of existing subjects are written as well.
    let before = files(&scans);
    fs::remove_dir_all(scans.join("0001")).expect("remove");
    succeed(synth(&people, "2").args(["--split", "test", "--save-scans"]));
    assert!(files(&scans) == before, "the same scans");
}

#[test]
fn shards_and_reruns_give_what_one_run_gives() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let (whole, shared) = (temporary.path().join("whole"), temporary.path().join("shared"));
    succeed(&mut synth(&whole, "4"));
    // The number of threads makes no difference.
    succeed(synth(&shared, "4").args(["--shard", "1/2"]).env("RAYON_NUM_THREADS", "1"));
    assert!(!shared.join("train/img/0000").exists() && shared.join("train/img/0003").exists());
    // A finished subject is left alone.
    let kept = shared.join("train/img/0001/0.png");
    fs::write(&kept, "kept").expect("write");
    succeed(synth(&shared, "4").args(["--shard", "0/2"]).env("RAYON_NUM_THREADS", "5"));
    assert_eq!(fs::read(&kept).expect("read"), b"kept");
    fs::remove_dir_all(shared.join("train/img/0001")).expect("remove");
    succeed(&mut synth(&shared, "4"));
    assert!(files(&whole) == files(&shared), "the same bytes");

    let message = refused(synth(&shared, "4").args(["--set", "views.resolution=32"]));
    assert!(message.contains("dataset.toml") && message.contains("another data set"), "{message}");
    // Settings of the cameras that `dataset.toml` does not have.
    let before = files(&shared);
    for key in ["views.pitch", "views.distance"] {
        assert_says(
            &refused(synth(&shared, "5").args(["--set", &format!("{key}=2.0")])),
            &["prepare.config.toml", &format!("`{key}`")],
        );
    }
    let mut given = prepare("synth");
    given
        .args(["--subjects", "5", "--seed", "3", "--set", "views.pitch=2", "-o"])
        .arg(&shared)
        .arg("--config");
    assert!(refused(given.arg(shared.join("prepare.config.toml"))).contains("`views.pitch`"));
    assert!(files(&shared) == before);
    // A data set without people takes new settings.
    let empty = temporary.path().join("empty");
    fs::create_dir(&empty).expect("made");
    for name in ["dataset.toml", "prepare.config.toml"] {
        fs::copy(shared.join(name), empty.join(name)).expect("copied");
    }
    succeed(synth(&empty, "1").args(["--set", "views.pitch=2"]));
    let written = fs::read_to_string(empty.join("prepare.config.toml")).expect("written");
    assert!(written.contains("pitch = 2.0"), "{written}");
}

/// A killed run leaves complete subjects only, and the next run makes the others.
#[test]
#[cfg(unix)]
fn a_killed_run_is_finished_by_the_next() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let folder = temporary.path().join("people");
    for signal in ["-INT", "-KILL"] {
        let mut child = synth(&folder, "6").stderr(Stdio::null()).spawn().expect("starts");
        let start = Instant::now();
        // During a subject that is not the first of this run.
        let before = count(&folder);
        while count(&folder) == before && start.elapsed() < Duration::from_secs(60) {
            std::thread::sleep(Duration::from_millis(5));
        }
        let pid = child.id().to_string();
        assert!(Command::new("kill").args([signal, &pid]).status().expect("kill").success());
        child.wait().expect("ends");
        assert!(count(&folder) > before && count(&folder) < 6, "{} subjects", count(&folder));
        if signal == "-INT" {
            let left = fs::read_dir(folder.join(".unfinished")).into_iter().flatten().flatten();
            let left: Vec<PathBuf> = left.map(|e| e.path()).filter(|path| path.is_dir()).collect();
            assert!(left.is_empty(), "Ctrl-C removes unfinished subjects: {left:?}");
        }
    }
    succeed(&mut synth(&folder, "6"));
    assert!(succeed(prepare("check").arg(&folder)).contains("6 subjects, 24 views: no fault"));
}

fn count(folder: &Path) -> usize {
    fs::read_dir(folder.join("train/img")).map_or(0, Iterator::count)
}

#[test]
fn makehuman_people_become_a_data_set() {
    let Some(data) = shared_folder("makehuman") else { return };
    let temporary = tempfile::tempdir().expect("temporary folder");
    let make = |name: &str, split: &str| {
        let folder = temporary.path().join(name);
        let mut command = prepare("makehuman");
        command.arg(&data).args(["--subjects", "2", "--seed", "5", "--split", split, "-o"]).arg(&folder);
        succeed(command.args(SMALL));
        folder
    };
    let (first, again, val) = (make("a", "train"), make("b", "train"), make("c", "val"));
    assert!(succeed(prepare("check").arg(&first)).contains("2 subjects, 8 views: no fault"));
    assert!(files(&first) == files(&again), "the same bytes");
    let picture =
        |folder: &Path, split: &str| fs::read(folder.join(split).join("img/0000/0.png")).expect("read");
    assert_ne!(picture(&first, "train"), picture(&val, "val"), "no one is in two splits");
}

#[test]
fn real_scans_with_several_materials_are_imported() {
    let Some(scans) = shared_folder("samples/scans") else { return };
    let temporary = tempfile::tempdir().expect("temporary folder");
    let folder = temporary.path().join("scans_128_4");
    let layout = ["--set", "views.layout=authors", "--set", "views.count=4", "--set", "views.resolution=128"];
    succeed(
        prepare("scan").arg(&scans).arg("-o").arg(&folder).args(["--collection", "thuman2.0"]).args(layout),
    );
    // Subjects 0 and 1 are on the published list.
    assert!(folder.join("val/parm/0001/3_extrinsic.npy").is_file());
    let mut only = prepare("scan");
    only.arg(&scans).args(["--collection", "thuman2.0", "--only", "train", "-o"]);
    assert!(refused(only.arg(temporary.path().join("none"))).contains("none of its scans is in the split"));
    assert!(succeed(prepare("check").arg(&folder)).contains("2 subjects, 8 views: no fault"));
    let picture = image::open(folder.join("val/img/0000/0.jpg")).expect("a picture").into_rgb8();
    // Scan 0000 wears a shirt of dark red and teal over a skirt of green and violet.
    let is_seen = |near: [i32; 3]| {
        picture.pixels().filter(|p| (0..3).all(|c| (i32::from(p.0[c]) - near[c]).abs() < 40)).count() > 100
    };
    assert!(is_seen([55, 45, 140]) && is_seen([45, 75, 25]), "the skirt's colours");
}

/// Each broken scan is named with the reason, the others are made, and memory is bounded.
#[test]
#[cfg(unix)]
fn broken_scans_are_named_and_skipped() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let scans = temporary.path().join("scäns with spaces 人");
    let write = |name: &str, content: &[u8]| {
        let path = scans.join(name).join(name);
        fs::create_dir_all(path.parent().expect("a folder")).expect("make");
        fs::write(path, content).expect("write");
    };
    let pyramid = "v -0.3 0 -0.3\nv 0.3 0 -0.3\nv 0 0 0.4\nv 0 1.7 0\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n";
    let billion = "ply\nformat binary_little_endian 1.0\nelement vertex 1000000000\nproperty float x\nproperty float y\n\
                   property float z\nelement face 1000000000\nproperty list uchar int vertex_indices\nend_header\n1234";
    write("sound one.obj", pyramid.as_bytes());
    write("trüncated.obj", &pyramid.as_bytes()[..pyramid.len() - 3]);
    write("half.obj", pyramid.replace("f 1 3", &format!("{}f 1 3", "v 0 0 0\n".repeat(3))).as_bytes());
    write("no number.obj", pyramid.replace("f 1 2 4", "f 1 2 x").as_bytes());
    write("billion text.ply", billion.replace("binary_little_endian", "ascii").as_bytes());
    write("billion.ply", billion.as_bytes());
    write("nan.obj", pyramid.replacen("1.7", "nan", 1).as_bytes());
    write("no triangle.obj", b"v 0 0 0\nv 0 1 0\n");
    write("bad colour.obj", format!("mtllib a.mtl\n{pyramid}").as_bytes());
    fs::write(scans.join("bad colour.obj/a.mtl"), "newmtl a\nKd 1 1\n").expect("write");
    write("far away.obj", b"v 900 0 0\nv 901 0 0\nv 900 1.7 0\nf 1 2 3\n");
    write("flat.obj", b"v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 2 3\n");
    write("absent texture.obj", format!("mtllib a.mtl\n{pyramid}").as_bytes());
    fs::write(scans.join("absent texture.obj/a.mtl"), "newmtl a\nmap_Kd skin.png\n").expect("write");
    // A bitmap of 100,000 × 100,000 pixels.
    let mut absurd =
        b"BM\x36\0\0\0\0\0\0\0\x36\0\0\0\x28\0\0\0\xa0\x86\x01\0\xa0\x86\x01\0\x01\0\x18\0".to_vec();
    absurd.resize(200, 0);
    write("absurd texture.obj", format!("mtllib a.mtl\n{pyramid}").as_bytes());
    fs::write(scans.join("absurd texture.obj/a.mtl"), "newmtl a\nmap_Kd skin.bmp\n").expect("write");
    fs::write(scans.join("absurd texture.obj/skin.bmp"), absurd).expect("write");

    let out = temporary.path().join("out");
    let mut command = prepare("scan");
    command.arg(&scans).arg("-o").arg(&out).args(SMALL);
    // A tenth of the size in the headers.
    let message = refused(&mut limited(&command, "-v 3000000"));
    let expected = [
        ("trüncated.obj", "line 8, `f 3 1`: a face needs three corners"),
        ("half.obj", "its last 3 of 7 vertices belong to no face"),
        ("no number.obj", "no face"),
        ("billion text.ply", "of 1000000000"),
        ("billion.ply", "of 1000000000: `y` is missing"),
        ("nan.obj", "position 3 is not finite"),
        ("no triangle.obj", "there is no triangle"),
        ("flat.obj", "the mesh has no height"),
        ("absent texture.obj", "texture `skin.png` is missing"),
        ("skin.bmp", "Image too large"),
        ("bad colour.obj/a.mtl", "line 2, `Kd 1 1`: no colour"),
        ("far away", "sees nothing of far away"),
        ("", "12 of 13 subjects could not be made; the others are there"),
    ];
    for (name, reason) in expected {
        let found = message.lines().any(|line| line.contains(name) && line.contains(reason));
        assert!(found, "{name}: {reason}\n{message}");
    }
    assert_eq!(count(&out), 1, "the sound one is there");
    assert!(succeed(prepare("check").arg(&out)).contains("1 subjects, 4 views: no fault"));
}

#[test]
fn wrong_arguments_are_refused_before_any_work() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let out = temporary.path().join("out");
    let refusal = |arguments: &[&str]| {
        let message = refused(prepare("synth").arg("-o").arg(&out).args(arguments));
        assert!(!out.exists(), "{arguments:?} wrote something");
        message
    };
    let table: [(&[&str], &str); 8] = [
        (&["--subjects", "0"], "--subjects is 0, must be 1 to"),
        (&["--shard", "2/2"], "`2/2` is no shard"),
        (&["--set", "views.count=0"], "`views.count`: is 0, must be 1 to 4096"),
        (&["--set", "views.resolution=9000"], "`views.resolution`"),
        (&["--set", "jitter.view.pitch=-1"], "`jitter.view.pitch`: is -1"),
        (&["--set", "views.colour=1"], "unknown field `colour`"),
        (&["--config", "/no/such.toml"], "/no/such.toml: cannot read"),
        (&["--set", "views.layout=authors"], "must end in `_1024_24`"),
    ];
    for (arguments, expected) in table {
        let message = refusal(arguments);
        assert!(message.contains(expected), "{arguments:?}: {message}");
    }
    for (sheet, reason) in [("sheet.jpg", "must end in .png"), ("set/img.png", "lies in a data set")] {
        let set = temporary.path().join("set");
        fs::create_dir_all(&set).expect("make");
        let mut command = prepare("synth");
        command.arg("-o").arg(&set).arg("--preview").arg(temporary.path().join(sheet));
        assert_says(&refused(&mut command), &[reason]);
        assert_eq!(files(&set).len(), 0);
    }
    assert_says(&refused(prepare("check").arg(temporary.path())), &["is no data set"]);
    let message = refused(prepare("makehuman").arg(temporary.path()).arg("-o").arg(&out));
    assert!(message.contains("is no MakeHuman data"), "{message}");
}

/// Every config in configs/data is valid.
#[test]
fn shipped_configs_are_understood() {
    let configs = root().join("configs/data");
    let temporary = tempfile::tempdir().expect("temporary folder");
    // The authors' layout needs the size and the number of views in the folder's name.
    for name in ["published", "training", "evaluation", "small", "default"] {
        let folder = temporary.path().join(format!("{name}_64_4"));
        let mut command = prepare("synth");
        command.args(["--subjects", "1", "--config"]).arg(configs.join(name).with_extension("toml"));
        succeed(command.arg("-o").arg(&folder).args(SMALL));
        assert!(succeed(prepare("check").arg(&folder)).contains("no fault"), "{name}");
        // The config in force lies beside the data, and is a config itself.
        let resolved = folder.join("prepare.config.toml");
        let mut again = prepare("synth");
        again.args(["--subjects", "1", "--config"]).arg(&resolved).arg("-o").arg(&folder);
        succeed(&mut again);
    }
}
