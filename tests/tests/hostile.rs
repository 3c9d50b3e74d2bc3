//! Hostile input and interrupted runs: no file is destroyed, nothing waits for ever, memory is bounded, and no
//! temporary files are left.

use std::fs;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use snapsnap_tests::ply::balls;
use snapsnap_tests::workplace::Workplace;
use snapsnap_tests::{assert_says, files, limited, refused, root, succeed};

const INPUT: &str = "is an input of this command and would be overwritten";
const TWICE: &str = "is given for two outputs";

/// What a command with its inputs says to these outputs.
const REFUSED: [(&str, &[&str], &str); 16] = [
    (
        "reconstruct front.png back.png --weights w --device cpu",
        &["-o front.png", "-o w", "--turntable front.png", "--save-cutouts ."],
        INPUT,
    ),
    (
        "reconstruct front.png back.png --weights model --device cpu",
        &["-o model/weights.safetensors", "--dump model/weights.safetensors"],
        INPUT,
    ),
    ("reconstruct pictures/000.png pictures/020.png", &["--turntable pictures"], INPUT),
    ("reconstruct front.png back.png --masks front.png pictures/039.png", &["--turntable pictures"], INPUT),
    (
        "reconstruct front.png back.png --weights w --device cpu",
        &[
            "-o h.ply --dump h.ply",
            "-o h.ply --dump ./h.ply",
            "-o h.ply --dump ./h.ply.config.toml",
            "-o h.png --turntable ./h.png",
            "-o views/000.png --turntable views",
            "-o views/039.png --turntable views",
            "--dump views/000.png --turntable views",
            "--dump views/cameras.json --turntable views",
        ],
        TWICE,
    ),
    ("init-weights --config c.toml", &["-o c.toml"], INPUT),
    ("convert human.ply", &["human.ply", "./human.ply"], INPUT),
    ("mesh human.ply --device cpu", &["-o human.ply"], INPUT),
    // An OBJ's materials lie beside it.
    ("mesh human.mtl --device cpu --texture 64", &["-o human.obj"], INPUT),
    ("render human.ply --device cpu --orbit 2", &["--raw human.ply"], INPUT),
    ("render views/000.png --device cpu --orbit 2", &["-o views"], INPUT),
    ("render views/001.png --device cpu --orbit 2", &["-o views"], INPUT),
    ("render views/cameras.json --device cpu --orbit 2", &["-o views"], INPUT),
    (
        "render human.ply --device cpu --orbit 2",
        &[
            "-o views --raw views/000.png",
            "-o views --raw ./views/../views/001.png",
            "-o views --raw views/cameras.json",
            "-o new --raw new/000.png",
        ],
        TWICE,
    ),
    // A folder has the place of a picture.
    ("render human.ply --device cpu --orbit 3", &["-o views"], "002.png"),
    ("prepare scan scans/0000.obj -o x", &["--preview scans/0000_0.png"], "lies in a data set or its source"),
];

#[test]
fn no_input_and_no_other_output_is_overwritten() {
    let place = Workplace::with_weights();
    succeed(&mut place.reconstruct("front.png back.png"));
    for folder in ["model", "pictures", "views", "views/002.png", "scans", "d"] {
        fs::create_dir(place.path(folder)).expect("folder");
    }
    for (from, to) in [
        ("w", "model/weights.safetensors"),
        ("front.png", "pictures/000.png"),
        ("back.png", "pictures/020.png"),
        ("back.png", "pictures/039.png"),
        ("human.ply", "human.mtl"),
        ("human.ply", "views/000.png"),
        ("human.ply", "views/001.png"),
        ("human.ply", "views/cameras.json"),
        ("front.png", "scans/0000_0.png"),
    ] {
        fs::copy(place.path(from), place.path(to)).expect("copied");
    }
    fs::copy(root().join("configs/tiny.toml"), place.path("c.toml")).expect("copied");
    place.write("scans/0000.obj", "v 0 0 0\nv 1 0 0\nv 0 1.7 0\nf 1 2 3\n");
    for (command, outputs, expected) in REFUSED {
        for output in outputs {
            let message = place.refusal(&mut place.run(&format!("{command} {output}")));
            assert!(message.contains(expected), "{command} {output}: {message}");
        }
    }
    // Other outputs may be in the folder.
    succeed(&mut place.reconstruct("front.png back.png -o d/040.ply --turntable d"));
    assert!(place.read("d/040.ply").starts_with(b"ply"));
    assert!(place.path("d/039.png").exists() && place.path("d/cameras.json").exists());
}

#[cfg(unix)]
#[test]
fn links_to_inputs_and_outputs_are_followed() {
    use std::os::unix::fs::symlink;
    let place = Workplace::with_weights();
    succeed(&mut place.reconstruct("front.png back.png"));
    symlink("t.ply", place.path("link.ply")).expect("links");
    let message = place.refusal(&mut place.reconstruct("front.png back.png -o t.ply --dump link.ply"));
    assert!(message.contains(TWICE), "{message}");
    fs::create_dir(place.path("d")).expect("folder");
    symlink(place.path("human.ply"), place.path("d/001.png")).expect("links");
    assert_says(&place.refusal(&mut place.run("render human.ply --device cpu --orbit 2 -o d")), &[INPUT]);
}

/// Files that a command writes where it reads them: cameras stay, pictures are replaced, and a run is repeated.
#[test]
fn what_a_command_wrote_it_reads_in_place() {
    let place = Workplace::with_weights();
    succeed(&mut place.reconstruct("front.png back.png"));
    let first = place.read("human.ply");
    succeed(&mut place.reconstruct("front.png back.png --config human.ply.config.toml"));
    assert!(first == place.read("human.ply"));

    succeed(&mut place.run("render human.ply --device cpu --orbit 2 --size 8x8 -o d"));
    let cameras = place.read("d/cameras.json");
    let again = "render human.ply --device cpu --cameras d/cameras.json -o d";
    succeed(&mut place.run(again));
    assert!(place.read("d/cameras.json") == cameras);
    // The cameras would not describe pictures of another size.
    let message = place.refusal(&mut place.run(&format!("{again} --size 32x32")));
    assert!(message.contains("d/cameras.json") && message.contains("another folder"), "{message}");

    // The config in force is not written over the one that was given.
    let small = "--set views.count=2 --set views.resolution=32 --set views.samples_per_axis=1";
    succeed(&mut place.run(&format!("prepare synth --subjects 1 -o people {small}")));
    let text = [b"# Mine.\n", &place.read("people/prepare.config.toml")[..]].concat();
    place.write("people/prepare.config.toml", &text);
    succeed(&mut place.run("prepare synth --subjects 1 -o people --config people/prepare.config.toml"));
    assert!(place.read("people/prepare.config.toml") == text);
}

/// Pictures of one render never lie beside the cameras of another.
#[test]
fn an_interrupted_render_leaves_no_cameras_of_an_older_one() {
    let place = Workplace::with_weights();
    succeed(&mut place.reconstruct("front.png back.png"));
    let render = |views: &str, size: &str| {
        place.run(&format!("render human.ply --device cpu -o views --orbit {views} --size {size}"))
    };
    succeed(&mut render("2", "64x64"));
    let old = place.read("views/000.png");
    let mut second = render("100000", "128x128").stderr(Stdio::null()).spawn().expect("starts");
    let start = Instant::now();
    while fs::read(place.path("views/000.png")).is_ok_and(|picture| picture == old) {
        assert!(start.elapsed() < Duration::from_secs(60), "no picture came");
        std::thread::sleep(Duration::from_millis(5));
    }
    second.kill().expect("kills");
    second.wait().expect("ends");
    assert!(!place.path("views/cameras.json").exists());
    // A later render removes the temporary files of the killed one.
    for path in files(place.folder()).into_keys() {
        let yesterday = std::time::SystemTime::now() - Duration::from_secs(86_400);
        let file = fs::File::options().append(true).open(place.folder().join(path)).expect("opens");
        file.set_modified(yesterday).expect("sets");
    }
    succeed(&mut render("2", "64x64"));
    let left = files(place.folder()).into_keys().find(|path| path.to_string_lossy().contains(".snapsnap-"));
    assert!(left.is_none(), "{left:?}");
}

/// Reading a pipe or a device might never end.
#[test]
#[cfg(unix)]
fn pipes_and_devices_are_no_input() {
    let place = Workplace::with_weights();
    let made = Command::new("mkfifo").arg(place.path("pipe")).status().expect("mkfifo");
    assert!(made.success());
    for path in ["pipe", "/dev/zero"] {
        for line in [
            format!("init-weights -o x --config {path}"),
            format!("reconstruct front.png back.png --weights w --device cpu --config {path}"),
            format!("reconstruct front.png back.png --weights {path}"),
            format!("reconstruct {path} back.png --weights w --device cpu"),
            format!("render {path} --orbit 1 --device cpu"),
            format!("render w --device cpu --cameras {path}"),
            format!("import-weights {path} -o x"),
            format!("prepare scan {path} -o x"),
            format!("prepare synth -o x --config {path}"),
        ] {
            let message = place.refusal(&mut place.run(&line));
            assert!(message.contains("regular file") || message.contains("cannot read"), "{line}: {message}");
        }
    }
}

/// Gigabytes of zeros behind the Gaussians are not read: within 3 GB of address space.
#[test]
#[cfg(target_os = "linux")]
fn what_lies_behind_the_gaussians_is_not_read() {
    let place = Workplace::with_weights();
    succeed(&mut place.reconstruct("front.png back.png"));
    let file = fs::File::options().write(true).open(place.path("human.ply")).expect("opens");
    file.set_len(20 << 30).expect("grows");
    let command = place.run("render human.ply --orbit 1 --size 64x64 --device cpu");
    succeed(&mut limited(&command, "-v 3000000"));
}

#[test]
#[cfg(target_os = "linux")]
fn a_reconstruction_that_memory_cannot_hold_is_refused_with_both_figures() {
    let place = Workplace::with_weights();
    // The process's memory limit counts if it is below the machine's memory.
    let command = place.reconstruct("front.png back.png --set network.resolution=4096");
    assert_says(&refused(&mut limited(&command, "-v 6000000")), &["needs 8.6 GB", "this process can have"]);
}

#[test]
#[cfg(unix)]
fn outputs_keep_their_permissions() {
    use std::os::unix::fs::PermissionsExt;
    let place = Workplace::with_weights();
    let mode = |name: &str| fs::metadata(place.path(name)).expect("there").permissions().mode() & 0o777;
    let chmod = |name: &str, mode| {
        fs::set_permissions(place.path(name), fs::Permissions::from_mode(mode)).expect("chmod");
    };
    for name in ["private.ply", "locked.ply"] {
        place.write(name, "old");
    }
    chmod("private.ply", 0o600);
    chmod("locked.ply", 0o444);
    succeed(&mut place.reconstruct("front.png back.png -o private.ply"));
    assert_eq!(mode("private.ply"), 0o600);
    let message = place.refusal(&mut place.reconstruct("front.png back.png -o locked.ply"));
    assert!(message.contains("locked.ply: cannot write: is write-protected"), "{message}");
}

/// Contents and names of files are printed without control characters.
#[test]
fn escapes_in_files_and_names_stay_text() {
    let place = Workplace::with_weights();
    place.write("c.toml", "[network]\n\"\x1b[31mrot\" = 1\n");
    place.write("p.pth", b"\x80\x02c\x1b[31mevil\nthing\n.");
    for line in [
        "init-weights -o x --config c.toml",
        "import-weights p.pth -o x",
        "reconstruct \x1b[31mno.png back.png --weights w --device cpu",
        "\x1b[31mno-command",
    ] {
        let message = place.refusal(&mut place.run(line));
        let is_text = message.contains("[31m") || message.contains("no-command");
        assert!(!message.contains('\x1b') && is_text, "{line:?}: {message:?}");
    }
}

/// Half a million Gaussians of a metre in one place, as a PLY and as an SPZ of ten kilobytes.
#[test]
fn small_files_that_take_minutes_are_refused_at_once() {
    let place = Workplace::empty();
    place.write("many.ply", balls((0..500_000).map(|_| [0.0; 3]), 0.0));
    succeed(&mut place.run("convert many.ply many.spz"));
    let large = "the Gaussians are too large";
    for (name, expected) in [("many.ply", [large, "--force"]), ("many.spz", ["no real scene"; 2])] {
        let mesh = format!("mesh {name} --device cpu -o mesh.glb");
        let render = format!("render {name} --device cpu --orbit 8 -o views");
        for (line, expected) in [mesh, render].iter().zip(expected) {
            let start = Instant::now();
            let said = refused(&mut place.run(line));
            assert!(said.contains(name) && said.contains(expected), "{said}");
            // A second on a quiet machine.
            assert!(start.elapsed() < Duration::from_secs(10), "{:?}: {said}", start.elapsed());
        }
        assert!(!place.path("mesh.glb").exists() && !place.path("views/cameras.json").exists());
    }
}

/// Gaussians all over a cube have far more surface than a person. The refusal is bounded in memory.
#[test]
#[cfg(target_os = "linux")]
fn scattered_gaussians_are_refused_within_two_gigabytes() {
    let place = Workplace::empty();
    let mut random = snapsnap_tests::scenes::Random(5);
    let places: Vec<[f32; 3]> = (0..13_000).map(|_| [0; 3].map(|_| random.between(-1.0, 1.0))).collect();
    place.write("cube.ply", balls(places.into_iter(), 0.02_f32.ln()));
    let said = refused(&mut limited(&place.run("mesh cube.ply --device cpu -o mesh.glb"), "-v 2500000"));
    let expected = "million triangles, far more than a person's";
    assert!(said.contains(expected) && said.contains("--force"), "{said}");
}
