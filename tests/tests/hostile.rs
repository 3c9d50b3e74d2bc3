//! Hostile input and interrupted runs: no file is destroyed, nothing waits for ever, memory is bounded, and no
//! temporary files are left.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use image::{Rgba, RgbaImage};
use snapsnap_tests::ply::balls;
use snapsnap_tests::{refused, root, snapsnap, succeed};

/// A temporary folder with tiny random weights `w`, a picture `i.png`, and a PLY that was made of it.
struct Workplace(tempfile::TempDir);

impl Workplace {
    fn new() -> Self {
        let place = Self(tempfile::tempdir().expect("temporary folder"));
        let config = root().join("configs/tiny.toml");
        succeed(place.run(["init-weights", "-o", "w", "--config"]).arg(config));
        let picture = RgbaImage::from_fn(200, 320, |x, y| {
            let (u, v) = (x as f32 / 200.0 - 0.5, y as f32 / 320.0 - 0.5);
            let inside = (u / 0.3).powi(2) + (v / 0.45).powi(2) < 1.0;
            Rgba([(x * 7) as u8, (y * 5) as u8, ((x + y) * 3) as u8, if inside { 255 } else { 0 }])
        });
        picture.save(place.path("i.png")).expect("PNG");
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn run<const N: usize>(&self, arguments: [&str; N]) -> Command {
        let mut command = snapsnap();
        command.current_dir(self.0.path()).args(arguments);
        command
    }

    /// `reconstruct` with two pictures and further arguments.
    fn reconstruct<const N: usize>(&self, pictures: [&str; 2], further: [&str; N]) -> Command {
        let mut command = self.run(["reconstruct", pictures[0], pictures[1], "--weights", "w"]);
        command.args(["--device", "cpu"]).args(further);
        command
    }

    /// Every file with its content.
    fn files(&self) -> Vec<(PathBuf, Vec<u8>)> {
        fn collect(folder: &Path, files: &mut Vec<(PathBuf, Vec<u8>)>) {
            for entry in fs::read_dir(folder).expect("list") {
                let path = entry.expect("entry").path();
                if path.is_dir() {
                    collect(&path, files);
                } else if path.is_file() {
                    files.push((path.clone(), fs::read(path).expect("read")));
                }
            }
        }
        let mut files = Vec::new();
        collect(self.0.path(), &mut files);
        files.sort();
        files
    }

    /// The message of a refused command, which may change no file.
    fn refusal(&self, mut command: Command) -> String {
        let before = self.files();
        let message = refused(&mut command);
        assert!(self.files() == before, "{command:?} changed something: {message}");
        message
    }
}

#[test]
fn a_folder_of_views_never_replaces_inputs_or_other_outputs() {
    let place = Workplace::new();
    for name in ["000.png", "020.png", "039.png"] {
        fs::copy(place.path("i.png"), place.path(name)).expect("copied");
    }
    let overwritten = "is an input of this command and would be overwritten";
    let pictures = place.reconstruct(["000.png", "020.png"], ["-o", "x.ply", "--turntable", "."]);
    assert!(place.refusal(pictures).contains(overwritten));
    let masks = ["--masks", "i.png", "039.png", "--turntable", "."];
    assert!(place.refusal(place.reconstruct(["i.png", "i.png"], masks)).contains(overwritten));
    for existing in [false, true] {
        if existing {
            fs::create_dir(place.path("d")).expect("folder");
        }
        for name in ["d/000.png", "d/cameras.json", "d/039.png"] {
            // The folder that a PLY lies in is there.
            if existing {
                let message =
                    place.refusal(place.reconstruct(["i.png"; 2], ["-o", name, "--turntable", "d"]));
                assert!(message.contains("is given for two outputs"), "{name}: {message}");
            }
            let message =
                place.refusal(place.reconstruct(["i.png"; 2], ["--dump", name, "--turntable", "d"]));
            assert!(message.contains("is given for two outputs") || !existing, "{name}: {message}");
        }
    }
    // Other outputs may be in the folder.
    succeed(&mut place.reconstruct(["i.png"; 2], ["-o", "d/040.ply", "--turntable", "d"]));
    assert!(fs::read(place.path("d/040.ply")).expect("the PLY").starts_with(b"ply"));
    assert!(place.path("d/039.png").exists() && place.path("d/cameras.json").exists());
}

/// One file under two spellings, links to it, and files beside a scan.
#[test]
fn outputs_are_told_apart_by_where_they_are() {
    let place = Workplace::new();
    let twice: [[&str; 4]; 3] = [
        ["-o", "q.ply", "--dump", "./q.ply"],
        ["-o", "r.ply", "--dump", "./r.ply.config.toml"],
        ["-o", "s.png", "--turntable", "./s.png"],
    ];
    for arguments in twice {
        let message = place.refusal(place.reconstruct(["i.png"; 2], arguments));
        assert!(message.contains("is given for two outputs"), "{arguments:?}: {message}");
    }
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink("t.ply", place.path("link.ply")).expect("links");
        let message = place.refusal(place.reconstruct(["i.png"; 2], ["-o", "t.ply", "--dump", "link.ply"]));
        assert!(message.contains("is given for two outputs"), "{message}");
    }

    let small =
        ["--set", "views.count=2", "--set", "views.resolution=32", "--set", "views.samples_per_axis=1"];
    let mut make = place.run(["prepare", "synth", "--subjects", "1", "--save-scans", "-o", "people"]);
    succeed(make.args(small));
    fs::create_dir(place.path("scans")).expect("folder");
    for entry in fs::read_dir(place.path("people/scans/train/0000")).expect("list") {
        let path = entry.expect("entry").path();
        fs::copy(&path, place.path("scans").join(path.file_name().expect("a name"))).expect("copied");
    }
    let mut over =
        place.run(["prepare", "scan", "scans/0000.obj", "-o", "x", "--preview", "scans/0000_0.png"]);
    over.args(small);
    assert!(place.refusal(over).contains("lies inside the data set or its source"));

    // The config in force is not written over the one that was given.
    let config = place.path("people/prepare.config.toml");
    let text = format!("# Mine.\n{}", fs::read_to_string(&config).expect("the config"));
    fs::write(&config, &text).expect("written");
    let again = ["prepare", "synth", "--subjects", "1", "-o", "people", "--config"];
    succeed(place.run(again).arg("people/prepare.config.toml"));
    assert_eq!(fs::read_to_string(&config).expect("the config"), text);
}

#[test]
fn a_folder_that_cannot_be_made_is_noticed_before_any_work() {
    let place = Workplace::new();
    fs::write(place.path("file"), "").expect("written");
    let message = place.refusal(place.reconstruct(["i.png"; 2], ["--turntable", "file/turn"]));
    assert!(message.contains("file/turn: cannot write"), "{message}");
    let message = place.refusal(place.run(["render", "w", "--orbit", "1", "-o", "file/views"]));
    assert!(message.contains("file/views: cannot write"), "{message}");
}

/// Pictures of one render never lie beside the cameras of another.
#[test]
fn an_interrupted_render_leaves_no_cameras_of_an_older_one() {
    let place = Workplace::new();
    succeed(&mut place.reconstruct(["i.png"; 2], []));
    let render = |views: &str, size: &str| {
        let mut command = place.run(["render", "human.ply", "--device", "cpu", "-o", "views"]);
        command.args(["--orbit", views, "--size", size]);
        command
    };
    succeed(&mut render("2", "64x64"));
    let old = fs::read(place.path("views/000.png")).expect("a picture");
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
    for (path, _) in place.files() {
        let yesterday = std::time::SystemTime::now() - Duration::from_secs(86_400);
        let file = fs::File::options().append(true).open(path).expect("opens");
        file.set_modified(yesterday).expect("sets");
    }
    succeed(&mut render("2", "64x64"));
    let left = place.files().into_iter().find(|(path, _)| path.to_string_lossy().contains(".snapsnap-"));
    assert!(left.is_none(), "{left:?}");
}

/// Reading a pipe or a device might never end.
#[test]
#[cfg(unix)]
fn pipes_and_devices_are_no_input() {
    let place = Workplace::new();
    let made = Command::new("mkfifo").arg(place.path("pipe")).status().expect("mkfifo");
    assert!(made.success());
    for path in ["pipe", "/dev/zero"] {
        let commands = [
            place.run(["init-weights", "-o", "x", "--config", path]),
            place.reconstruct(["i.png"; 2], ["--config", path]),
            place.run(["reconstruct", "i.png", "i.png", "--weights", path]),
            place.reconstruct([path, "i.png"], []),
            place.run(["render", path, "--orbit", "1", "--device", "cpu"]),
            place.run(["render", "w", "--device", "cpu", "--cameras", path]),
            place.run(["import-weights", path, "-o", "x"]),
            place.run(["prepare", "scan", path, "-o", "x"]),
            place.run(["prepare", "synth", "-o", "x", "--config", path]),
        ];
        for command in commands {
            let what = format!("{command:?}");
            let message = place.refusal(command);
            assert!(message.contains("regular file") || message.contains("cannot read"), "{what}: {message}");
        }
    }
}

/// Gigabytes of zeros behind the Gaussians are not read: within 3 GB of address space.
#[test]
#[cfg(target_os = "linux")]
fn what_lies_behind_the_gaussians_is_not_read() {
    let place = Workplace::new();
    succeed(&mut place.reconstruct(["i.png"; 2], []));
    let file = fs::File::options().write(true).open(place.path("human.ply")).expect("opens");
    file.set_len(20 << 30).expect("grows");
    let program = snapsnap().get_program().to_owned();
    let limited = Command::new("sh")
        .current_dir(place.0.path())
        .args(["-c", "ulimit -v 3000000; exec \"$@\"", "sh"])
        .arg(program)
        .args(["render", "human.ply", "--orbit", "1", "--size", "64x64", "--device", "cpu"])
        .output()
        .expect("starts");
    assert!(limited.status.success(), "{}", String::from_utf8_lossy(&limited.stderr));
}

#[test]
#[cfg(target_os = "linux")]
fn a_reconstruction_that_memory_cannot_hold_is_refused_with_both_figures() {
    let place = Workplace::new();
    // The process's memory limit counts if it is below the machine's memory.
    let program = snapsnap().get_program().to_owned();
    let limited = Command::new("sh")
        .current_dir(place.0.path())
        .args(["-c", "ulimit -v 6000000; exec \"$@\"", "sh"])
        .arg(program)
        .args(["reconstruct", "i.png", "i.png", "--weights", "w", "--device", "cpu"])
        .args(["--set", "network.resolution=4096"])
        .output()
        .expect("starts");
    let message = String::from_utf8_lossy(&limited.stderr);
    assert_eq!(limited.status.code(), Some(2), "{message}");
    assert!(message.contains("needs 8.6 GB") && message.contains("this process can have"), "{message}");
}

#[test]
#[cfg(unix)]
fn outputs_keep_their_permissions() {
    use std::os::unix::fs::PermissionsExt;
    let place = Workplace::new();
    let mode = |name: &str| fs::metadata(place.path(name)).expect("there").permissions().mode() & 0o777;
    let chmod = |name: &str, mode| {
        fs::set_permissions(place.path(name), fs::Permissions::from_mode(mode)).expect("chmod");
    };
    for name in ["private.ply", "locked.ply"] {
        fs::write(place.path(name), "old").expect("written");
    }
    chmod("private.ply", 0o600);
    chmod("locked.ply", 0o444);
    succeed(&mut place.reconstruct(["i.png"; 2], ["-o", "private.ply"]));
    assert_eq!(mode("private.ply"), 0o600);
    let message = place.refusal(place.reconstruct(["i.png"; 2], ["-o", "locked.ply"]));
    assert!(message.contains("locked.ply: cannot write: is write-protected"), "{message}");
}

/// Contents and names of files are printed without control characters.
#[test]
fn escapes_in_files_and_names_stay_text() {
    let place = Workplace::new();
    fs::write(place.path("c.toml"), "[network]\n\"\x1b[31mrot\" = 1\n").expect("written");
    fs::write(place.path("p.pth"), b"\x80\x02c\x1b[31mevil\nthing\n.").expect("written");
    let commands = [
        place.run(["init-weights", "-o", "x", "--config", "c.toml"]),
        place.run(["import-weights", "p.pth", "-o", "x"]),
        place.reconstruct(["\x1b[31mno.png", "i.png"], []),
        place.run(["\x1b[31mno-command"]),
    ];
    for command in commands {
        let what = format!("{command:?}");
        let message = place.refusal(command);
        let is_text = message.contains("[31m") || message.contains("no-command");
        assert!(!message.contains('\x1b') && is_text, "{what}: {message:?}");
    }
}

/// Half a million Gaussians of a metre in one place, as a PLY and as an SPZ of ten kilobytes.
#[test]
fn small_files_that_take_minutes_are_refused_at_once() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let path = |name: &str| temporary.path().join(name);
    fs::write(path("many.ply"), balls((0..500_000).map(|_| [0.0; 3]), 0.0)).expect("written");
    succeed(snapsnap().arg("convert").arg(path("many.ply")).arg(path("many.spz")));
    let large = "the Gaussians are too large";
    for (name, expected) in [("many.ply", [large, "--force"]), ("many.spz", ["no real scene"; 2])] {
        let mut mesh = snapsnap();
        mesh.arg("mesh").arg(path(name)).args(["--device", "cpu", "-o"]).arg(path("mesh.glb"));
        let mut render = snapsnap();
        render
            .arg("render")
            .arg(path(name))
            .args(["--device", "cpu", "--orbit", "8", "-o"])
            .arg(path("views"));
        for (command, expected) in [&mut mesh, &mut render].into_iter().zip(expected) {
            let start = Instant::now();
            let said = refused(command);
            assert!(said.contains(name) && said.contains(expected), "{said}");
            // A second on a quiet machine.
            assert!(start.elapsed() < Duration::from_secs(10), "{:?}: {said}", start.elapsed());
        }
        assert!(!path("mesh.glb").exists() && !path("views/cameras.json").exists());
    }
}

/// Gaussians all over a cube have far more surface than a person. The refusal is bounded in memory.
#[test]
#[cfg(target_os = "linux")]
fn scattered_gaussians_are_refused_within_two_gigabytes() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let path = |name: &str| temporary.path().join(name);
    let mut random = snapsnap_tests::scenes::Random(5);
    let mut place = || [0; 3].map(|_| random.between(-1.0, 1.0));
    let places: Vec<[f32; 3]> = (0..13_000).map(|_| place()).collect();
    fs::write(path("cube.ply"), balls(places.into_iter(), 0.02_f32.ln())).expect("written");
    let program = snapsnap().get_program().to_owned();
    let limited = Command::new("sh")
        .args(["-c", "ulimit -v 2500000; exec \"$@\"", "sh"])
        .arg(program)
        .args(["mesh", "--device", "cpu", "-o"])
        .args([path("mesh.glb"), path("cube.ply")])
        .output()
        .expect("starts");
    let said = String::from_utf8_lossy(&limited.stderr);
    assert_eq!(limited.status.code(), Some(2), "{said}");
    assert!(
        said.contains("million triangles, far more than a person's") && said.contains("--force"),
        "{said}"
    );
}
