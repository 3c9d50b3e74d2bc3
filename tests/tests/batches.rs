//! Many people in one command: tables and folders of pairs, folders of Gaussians; reruns and failures.

use std::fs;
use std::process::{Command, Stdio};
use std::time::Duration;

use snapsnap_tests::workplace::Workplace;
use snapsnap_tests::{assert_says, ended_with, limited, names, refused, root, sample, succeed};

/// A place with a folder `photographs`.
fn place() -> Workplace {
    let place = Workplace::empty();
    fs::create_dir(place.path("photographs")).expect("made");
    place
}

/// The sample pair, small, under these names in `photographs`.
fn pair(place: &Workplace, front: &str, back: &str) {
    for (side, name) in [("front", front), ("back", back)] {
        let small = image::imageops::thumbnail(&sample::picture(side), 256, 256);
        small.save(place.path("photographs").join(name)).expect("written");
    }
}

/// `reconstruct` on small canvases.
fn reconstruct(place: &Workplace, line: &str) -> Command {
    place.run(&format!("reconstruct --device cpu --set network.resolution=256 {line}"))
}

/// Runs a command that fails for some people (exit code 1). Returns the rows of the list of failures.
fn failed(place: &Workplace, command: &mut Command, list: &str) -> Vec<[String; 2]> {
    assert_says(&ended_with(1, command), &[list]);
    let mut rows = csv::Reader::from_path(place.path(list)).expect("a list");
    assert_eq!(rows.headers().expect("headers"), vec!["name", "error"]);
    rows.deserialize().map(|row| row.expect("a row")).collect()
}

#[test]
fn a_table_of_pairs_becomes_the_people_of_single_calls() {
    let place = place();
    pair(&place, "anna_front.png", "anna_back.png");
    pair(&place, "b.png", "c.png");
    place.write("photographs/broken.png", "no picture");
    let rows = "name,front,back\n,anna_front.png,anna_back.png\ntwice,anna_front.png,anna_front.png\n=bad,broken.png,c.png\nlost,missing.png,c.png\nother,b.png,c.png\n";
    place.write("photographs/pairs.csv", rows);
    let all = || reconstruct(&place, "--pairs photographs/pairs.csv -o out");
    let errors = failed(&place, &mut all(), "out/errors.csv");
    assert_eq!(
        errors.iter().map(|[name, _]| name.as_str()).collect::<Vec<_>>(),
        ["'=bad", "lost"],
        "no formulas"
    );
    assert!(errors[0][1].contains("broken.png") && errors[1][1].contains("missing.png"), "{errors:?}");
    let made = || names(&place.path("out"));
    assert_eq!(made(), ["anna.ply", "errors.csv", "other.ply", "pairs.config.toml", "twice.ply"]);
    let line = "photographs/anna_front.png photographs/anna_back.png -o single.ply";
    succeed(&mut reconstruct(&place, line));
    let [expected, anna, other, twice] =
        ["single.ply", "out/anna.ply", "out/other.ply", "out/twice.ply"].map(|name| place.read(name));
    assert!(expected == anna && anna == other && anna != twice);
    // The next run makes only the failed people.
    pair(&place, "broken.png", "missing.png");
    place.write("out/anna.ply", "kept");
    // A power failure may leave an empty file.
    place.write("out/other.ply", "");
    assert_says(&succeed(&mut all()), &["3 made"]);
    assert!(place.read("out/other.ply") == other);
    assert_eq!(place.read("out/anna.ply"), b"kept");
    assert_eq!(made(), ["=bad.ply", "anna.ply", "lost.ply", "other.ply", "pairs.config.toml", "twice.ply"]);
    // Other settings than before.
    for options in [["--set", "regressor.margin=24"], ["--height", "1.8"]] {
        let said = refused(all().args(options));
        assert!(said.contains("pairs.config.toml") && said.contains("other settings"), "{options:?}: {said}");
    }
    // Weights are compared by their content, not by their path.
    let mut bytes = fs::read(root().join("assets/weights/default.safetensors")).expect("reads");
    place.write("w.safetensors", &bytes);
    assert!(succeed(all().args(["--weights", "w.safetensors"])).contains("0 made"));
    *bytes.last_mut().expect("bytes") ^= 1;
    place.write("w.safetensors", &bytes);
    assert_says(&refused(all().args(["--weights", "w.safetensors"])), &["other settings"]);
}

#[test]
fn a_folder_of_pairs_is_shared_among_processes() {
    let place = place();
    for name in ["a", "b", "c"] {
        pair(&place, &format!("{name}_front.png"), &format!("{name}_back.webp"));
    }
    place.write("photographs/alone_front.png", place.read("photographs/a_front.png"));
    let masked = image::GrayImage::from_fn(256, 256, |x, _| {
        image::Luma([if (60..190).contains(&x) { 255 } else { 0 }])
    });
    masked.save(place.path("photographs/c_front_mask.png")).expect("written");
    let half =
        |shard: &str| reconstruct(&place, &format!("--pairs photographs -o out --kind spz --shard {shard}"));
    let names = |folder: &str| names(&place.path(folder));
    succeed(&mut half("0/2"));
    assert_eq!(names("out"), ["a.spz", "b.spz", "pairs.config.toml"]);
    let errors = failed(&place, &mut half("1/2"), "out/errors-1-of-2.csv");
    assert!(
        errors.len() == 1 && errors[0][0] == "alone" && errors[0][1].contains("no alone_back"),
        "{errors:?}"
    );
    assert_eq!(names("out"), ["a.spz", "b.spz", "c.spz", "errors-1-of-2.csv", "pairs.config.toml"]);
    // The mask makes another person of the same photographs.
    let [a, b, c] = ["out/a.spz", "out/b.spz", "out/c.spz"].map(|name| place.read(name));
    assert!(a == b && a != c);

    // Folders of Gaussians.
    place.write("out/broken.spz", "no splats");
    place.write("out/._a.spz", "hidden");
    let errors = failed(&place, &mut place.run("convert out converted"), "converted/errors.csv");
    assert!(errors.len() == 1 && errors[0][0] == "broken", "{errors:?}");
    assert_eq!(names("converted"), ["a.ply", "b.ply", "c.ply", "errors.csv"]);
    succeed(&mut place.run("convert out/c.spz single.ply"));
    assert!(place.read("single.ply") == place.read("converted/c.ply"));
    // Only what is missing is made.
    fs::remove_file(place.path("converted/a.ply")).expect("removed");
    fs::remove_file(place.path("out/broken.spz")).expect("removed");
    place.write("converted/b.ply", "kept");
    assert!(succeed(&mut place.run("convert out converted")).contains("1 made"));
    assert_eq!(place.read("converted/b.ply"), b"kept");
    place.write("converted/b.ply", place.read("converted/c.ply"));
    fs::remove_file(place.path("converted/a.ply")).expect("removed");
    let mut render = place.run("render converted --orbit 2 --size 64x64 --device cpu -o pictures");
    succeed(&mut render);
    fs::remove_file(place.path("pictures/b/cameras.json")).expect("removed");
    assert!(succeed(&mut render).contains("1 made"));
    let mut other = place.run("render converted --orbit 2 --device cuda:9 -o pictures");
    assert!(refused(&mut other).contains("cuda"));
    for name in ["pictures/b", "pictures/c"] {
        assert_eq!(names(name), ["000.png", "001.png", "cameras.json"]);
    }
    succeed(&mut place.run("mesh converted --kind ply --faces 2000 --shard 0/2 -o meshes"));
    assert_eq!(names("meshes"), ["b.ply"]);
}

#[test]
fn wrong_batches_are_refused() {
    let place = Workplace::empty();
    let refusal = |line: &str| place.refusal(&mut reconstruct(&place, line));
    let of_table = "--pairs pairs.csv -o out";
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
        place.write("pairs.csv", content);
        let said = refusal(of_table);
        assert!(said.contains(message) && said.contains("pairs.csv"), "{content:?}: {said}");
    }
    place.write("pairs.csv", b"front,back\n\xff\xfe,b\n");
    assert!(refusal(of_table).contains("pairs.csv"));
    assert!(refusal("--pairs /dev/zero -o out").contains("/dev/zero"));
    // The table has the path of the list of failures.
    fs::create_dir(place.path("out")).expect("made");
    for table in ["pairs.csv", "out/errors.csv"] {
        place.write(table, "front,back\nx_front.png,x_back.png\n");
    }
    for (line, expected) in [
        ("--pairs out/errors.csv -o out", "move it away"),
        ("a.png b.png --shard 0/2", "--shard: is for many people, with --pairs"),
        // A failed start claims no folder.
        ("--pairs pairs.csv -o out --faces 100", "--faces"),
        ("--pairs pairs.csv", "give a folder"),
        ("a.png b.png --pairs pairs.csv", "cannot be used with"),
    ] {
        let said = refusal(line);
        assert!(said.contains(expected), "{line}: {said}");
    }
    assert_says(&refused(&mut place.run("convert out out")), &["folder of the inputs"]);
}

/// A full disk ends the command, since the next people could not be written either. An interrupted command continues.
#[cfg(unix)]
#[test]
fn batches_end_on_a_full_disk_and_go_on_after_a_kill() {
    let place = place();
    for i in 0..6 {
        pair(&place, &format!("{i}_front.png"), &format!("{i}_back.png"));
    }
    let all = || reconstruct(&place, "--pairs photographs -o out");
    assert_says(&refused(&mut limited(&all(), "-f 50")), &["cannot write"]);
    assert_eq!(names(&place.path("out")), ["pairs.config.toml"]);
    let file = |i: usize| place.path(&format!("out/{i}.ply"));
    let mut child = all().stderr(Stdio::null()).spawn().expect("starts");
    while !file(1).exists() {
        std::thread::sleep(Duration::from_millis(20));
        assert!(child.try_wait().expect("waits").is_none_or(|status| status.success()));
    }
    let _ = child.kill();
    child.wait().expect("ends");
    let first = fs::metadata(file(0)).expect("a file").modified().expect("a time");
    succeed(&mut all());
    assert_eq!(fs::metadata(file(0)).expect("a file").modified().expect("a time"), first);
    let people: Vec<Vec<u8>> = (0..6).map(|i| fs::read(file(i)).expect("reads")).collect();
    assert!(people.iter().all(|one| *one == people[0] && one.len() > 10_000));
}

#[test]
fn tables_name_photographs_beside_them() {
    let place = place();
    pair(&place, "x_front.png", "x_back.png");
    // As a spreadsheet may write it.
    let table = "\u{feff}Back; Front\r\nphotographs/x_back.png; photographs/x_front.png\r\n;\r\n";
    place.write("list.csv", table);
    succeed(&mut reconstruct(&place, "--pairs list.csv -o out"));
    assert_eq!(names(&place.path("out")), ["pairs.config.toml", "x.ply"]);
}
