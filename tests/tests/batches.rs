//! Many people in one command: tables and folders of pairs, folders of Gaussians; reruns and failures.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use snapsnap_tests::{ended_with, limited, names, refused, root, sample, snapsnap, succeed};

/// The sample pair, small, under these names.
fn pair(folder: &Path, front: &str, back: &str) {
    for (side, name) in [("front", front), ("back", back)] {
        let small = image::imageops::thumbnail(&sample::picture(side), 256, 256);
        small.save(folder.join(name)).expect("written");
    }
}

fn reconstruct(pairs: &Path, output: &Path) -> Command {
    let mut command = snapsnap();
    command.args(["reconstruct", "--device", "cpu", "--set", "network.resolution=256", "--pairs"]).arg(pairs);
    command.arg("-o").arg(output);
    command
}

/// Runs a command that fails for some people (exit code 1). Returns the rows of the list of failures.
fn failed(command: &mut Command, list: &Path) -> Vec<[String; 2]> {
    let said = ended_with(1, command);
    assert!(said.contains(&list.display().to_string()), "{said}");
    let mut rows = csv::Reader::from_path(list).expect("a list");
    assert_eq!(rows.headers().expect("headers"), vec!["name", "error"]);
    rows.deserialize().map(|row| row.expect("a row")).collect()
}

#[test]
fn a_table_of_pairs_becomes_the_people_of_single_calls() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let [photographs, out] = ["photographs", "out"].map(|name| temporary.path().join(name));
    fs::create_dir(&photographs).expect("made");
    pair(&photographs, "anna_front.png", "anna_back.png");
    pair(&photographs, "b.png", "c.png");
    fs::write(photographs.join("broken.png"), b"no picture").expect("written");
    let table = photographs.join("pairs.csv");
    let rows = "name,front,back\n,anna_front.png,anna_back.png\ntwice,anna_front.png,anna_front.png\n=bad,broken.png,c.png\nlost,missing.png,c.png\nother,b.png,c.png\n";
    fs::write(&table, rows).expect("written");
    let list = out.join("errors.csv");
    let errors = failed(&mut reconstruct(&table, &out), &list);
    assert_eq!(
        errors.iter().map(|[name, _]| name.as_str()).collect::<Vec<_>>(),
        ["'=bad", "lost"],
        "no formulas"
    );
    assert!(errors[0][1].contains("broken.png") && errors[1][1].contains("missing.png"), "{errors:?}");
    assert_eq!(names(&out), ["anna.ply", "errors.csv", "other.ply", "pairs.config.toml", "twice.ply"]);
    let single = temporary.path().join("single.ply");
    let mut one = snapsnap();
    one.args(["reconstruct", "--device", "cpu", "--set", "network.resolution=256", "-o"]).arg(&single);
    succeed(one.args(["anna_front.png", "anna_back.png"].map(|name| photographs.join(name))));
    let [expected, anna, other, twice] =
        [single, out.join("anna.ply"), out.join("other.ply"), out.join("twice.ply")]
            .map(|path| fs::read(path).expect("reads"));
    assert!(expected == anna && anna == other && anna != twice);
    // The next run makes only the failed people.
    pair(&photographs, "broken.png", "missing.png");
    fs::write(out.join("anna.ply"), b"kept").expect("written");
    // A power failure may leave an empty file.
    fs::write(out.join("other.ply"), b"").expect("written");
    let said = succeed(&mut reconstruct(&table, &out));
    assert!(said.contains("3 made"), "{said}");
    assert!(fs::read(out.join("other.ply")).expect("reads") == other);
    assert_eq!(fs::read(out.join("anna.ply")).expect("reads"), b"kept");
    assert_eq!(
        names(&out),
        ["=bad.ply", "anna.ply", "lost.ply", "other.ply", "pairs.config.toml", "twice.ply"]
    );
    // Other settings than before.
    for options in [["--set", "regressor.margin=24"], ["--height", "1.8"]] {
        let said = refused(reconstruct(&table, &out).args(options));
        assert!(said.contains("pairs.config.toml") && said.contains("other settings"), "{options:?}: {said}");
    }
    // Weights are compared by their content, not by their path.
    let weights = temporary.path().join("weights.safetensors");
    let mut bytes = fs::read(root().join("assets/weights/default.safetensors")).expect("reads");
    fs::write(&weights, &bytes).expect("written");
    let again = || succeed(reconstruct(&table, &out).arg("--weights").arg(&weights));
    assert!(again().contains("0 made"));
    *bytes.last_mut().expect("bytes") ^= 1;
    fs::write(&weights, &bytes).expect("written");
    let said = refused(reconstruct(&table, &out).arg("--weights").arg(&weights));
    assert!(said.contains("other settings"), "{said}");
}

#[test]
fn a_folder_of_pairs_is_shared_among_processes() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let [photographs, out] = ["photographs", "out"].map(|name| temporary.path().join(name));
    fs::create_dir(&photographs).expect("made");
    for name in ["a", "b", "c"] {
        pair(&photographs, &format!("{name}_front.png"), &format!("{name}_back.webp"));
    }
    fs::copy(photographs.join("a_front.png"), photographs.join("alone_front.png")).expect("copied");
    let masked = image::GrayImage::from_fn(256, 256, |x, _| {
        image::Luma([if (60..190).contains(&x) { 255 } else { 0 }])
    });
    masked.save(photographs.join("c_front_mask.png")).expect("written");
    let half = |shard: &str| {
        let mut command = reconstruct(&photographs, &out);
        command.args(["--kind", "spz", "--shard", shard]);
        command
    };
    succeed(&mut half("0/2"));
    assert_eq!(names(&out), ["a.spz", "b.spz", "pairs.config.toml"]);
    let errors = failed(&mut half("1/2"), &out.join("errors-1-of-2.csv"));
    assert!(
        errors.len() == 1 && errors[0][0] == "alone" && errors[0][1].contains("no alone_back"),
        "{errors:?}"
    );
    assert_eq!(names(&out), ["a.spz", "b.spz", "c.spz", "errors-1-of-2.csv", "pairs.config.toml"]);
    // The mask makes another person of the same photographs.
    let [a, b, c] = ["a.spz", "b.spz", "c.spz"].map(|name| fs::read(out.join(name)).expect("reads"));
    assert!(a == b && a != c);

    // Folders of Gaussians.
    let converted = temporary.path().join("converted");
    fs::write(out.join("broken.spz"), b"no splats").expect("written");
    fs::write(out.join("._a.spz"), b"hidden").expect("written");
    let mut convert = snapsnap();
    let errors = failed(convert.arg("convert").arg(&out).arg(&converted), &converted.join("errors.csv"));
    assert!(errors.len() == 1 && errors[0][0] == "broken", "{errors:?}");
    assert_eq!(names(&converted), ["a.ply", "b.ply", "c.ply", "errors.csv"]);
    let single = temporary.path().join("single.ply");
    succeed(snapsnap().arg("convert").arg(out.join("c.spz")).arg(&single));
    assert!(fs::read(&single).expect("reads") == fs::read(converted.join("c.ply")).expect("reads"));
    // Only what is missing is made.
    fs::remove_file(converted.join("a.ply")).expect("removed");
    fs::remove_file(out.join("broken.spz")).expect("removed");
    fs::write(converted.join("b.ply"), b"kept").expect("written");
    assert!(succeed(snapsnap().arg("convert").arg(&out).arg(&converted)).contains("1 made"));
    assert_eq!(fs::read(converted.join("b.ply")).expect("reads"), b"kept");
    fs::copy(converted.join("c.ply"), converted.join("b.ply")).expect("copied");
    fs::remove_file(converted.join("a.ply")).expect("removed");
    let pictures = temporary.path().join("pictures");
    let mut render = snapsnap();
    render
        .arg("render")
        .arg(&converted)
        .args(["--orbit", "2", "--size", "64x64", "--device", "cpu", "-o"])
        .arg(&pictures);
    succeed(&mut render);
    fs::remove_file(pictures.join("b/cameras.json")).expect("removed");
    assert!(succeed(&mut render).contains("1 made"));
    let mut other = snapsnap();
    other.arg("render").arg(&converted).args(["--orbit", "2", "--device", "cuda:9", "-o"]).arg(&pictures);
    assert!(refused(&mut other).contains("cuda"));
    for name in ["b", "c"] {
        assert_eq!(names(&pictures.join(name)), ["000.png", "001.png", "cameras.json"]);
    }
    let meshes = temporary.path().join("meshes");
    let mut mesh = snapsnap();
    mesh.arg("mesh")
        .arg(&converted)
        .args(["--kind", "ply", "--faces", "2000", "--shard", "0/2", "-o"])
        .arg(&meshes);
    succeed(&mut mesh);
    assert_eq!(names(&meshes), ["b.ply"]);
}

#[test]
fn wrong_batches_are_refused() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let (folder, out) = (temporary.path(), temporary.path().join("out"));
    let table = folder.join("pairs.csv");
    let said = |content: &str| {
        fs::write(&table, content).expect("written");
        refused(&mut reconstruct(&table, &out))
    };
    for (content, message) in [
        ("", "has no column `front`"),
        ("front,back\n", "no pair"),
        ("front,rear\na,b\n", "has no column `back`"),
        ("front,back,front\na,b,c\n", "duplicate field `front`"),
        ("front,back\na\n", "found record with 1 fields"),
        ("front,back\na,\n", "line 2: needs a front and a back"),
        ("front,back\nfront.png,back.png\n", "line 2: needs a name"),
        ("name,front,back\r\na,b,c\r\n\r\nd,e,\r\n", "line 4: needs a front and a back"),
        ("name,front,back\n../a,b,c\n", "`../a` cannot be the name"),
        ("name,front,back\nCON,b,c\n", "`CON` cannot be the name"),
        ("name,front,back\na,b,\"c\nd,e,f\n", "is a quotation mark missing?"),
        ("name,front,back\nx,b,c\nX,b,c\n", "two pairs are called `X`"),
    ] {
        let said = said(content);
        assert!(said.contains(message) && said.contains("pairs.csv"), "{content:?}: {said}");
    }
    fs::write(&table, b"front,back\n\xff\xfe,b\n").expect("written");
    assert!(refused(&mut reconstruct(&table, &out)).contains("pairs.csv"));
    assert!(refused(&mut reconstruct(Path::new("/dev/zero"), &out)).contains("/dev/zero"));
    assert!(!out.exists(), "nothing was made");
    // The table has the path of the list of failures.
    fs::create_dir(&out).expect("made");
    let list = out.join("errors.csv");
    fs::write(&list, "front,back\nx_front.png,x_back.png\n").expect("written");
    let said = refused(&mut reconstruct(&list, &out));
    assert!(said.contains("move it away") && list.is_file(), "{said}");
    let mut single = snapsnap();
    let said = refused(single.args(["reconstruct", "a.png", "b.png", "--shard", "0/2"]));
    assert!(said.contains("--shard") && said.contains("--pairs"), "{said}");
    // A failed start claims no folder.
    fs::write(&table, "front,back\nx_front.png,x_back.png\n").expect("written");
    let said = refused(reconstruct(&table, &out).args(["--faces", "100"]));
    assert!(said.contains("--faces") && names(&out) == ["errors.csv"], "{said}");
    let said = refused(snapsnap().args(["reconstruct", "--pairs"]).arg(&table));
    assert!(said.contains("give a folder"), "{said}");
    let said = refused(snapsnap().args(["reconstruct", "a.png", "b.png", "--pairs"]).arg(&table));
    assert!(said.contains("cannot be used with"), "{said}");
    let said = refused(snapsnap().arg("convert").arg(folder).arg(folder));
    assert!(said.contains("folder of the inputs"), "{said}");
}

/// A full disk ends the command, since the next people could not be written either. An interrupted command continues.
#[cfg(unix)]
#[test]
fn batches_end_on_a_full_disk_and_go_on_after_a_kill() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let [photographs, out] = ["photographs", "out"].map(|name| temporary.path().join(name));
    fs::create_dir(&photographs).expect("made");
    for i in 0..6 {
        pair(&photographs, &format!("{i}_front.png"), &format!("{i}_back.png"));
    }
    let said = refused(&mut limited(&reconstruct(&photographs, &out), "-f 50"));
    assert!(said.contains("cannot write"), "{said}");
    assert_eq!(names(&out), ["pairs.config.toml"]);
    let file = |i: usize| out.join(format!("{i}.ply"));
    let mut child = reconstruct(&photographs, &out).stderr(Stdio::null()).spawn().expect("starts");
    while !file(1).exists() {
        std::thread::sleep(Duration::from_millis(20));
        assert!(child.try_wait().expect("waits").is_none_or(|status| status.success()));
    }
    let _ = child.kill();
    child.wait().expect("ends");
    let first = fs::metadata(file(0)).expect("a file").modified().expect("a time");
    succeed(&mut reconstruct(&photographs, &out));
    assert_eq!(fs::metadata(file(0)).expect("a file").modified().expect("a time"), first);
    let all: Vec<Vec<u8>> = (0..6).map(|i| fs::read(file(i)).expect("reads")).collect();
    assert!(all.iter().all(|one| *one == all[0] && one.len() > 10_000));
}

#[test]
fn tables_name_photographs_beside_them() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let photographs: PathBuf = temporary.path().join("a");
    fs::create_dir(&photographs).expect("made");
    pair(&photographs, "x_front.png", "x_back.png");
    // As a spreadsheet may write it.
    let table = temporary.path().join("list.csv");
    fs::write(&table, "\u{feff}Back; Front\r\na/x_back.png; a/x_front.png\r\n;\r\n").expect("written");
    let out = temporary.path().join("out");
    succeed(&mut reconstruct(&table, &out));
    assert_eq!(names(&out), ["pairs.config.toml", "x.ply"]);
}
