//! Runs every command of README and docs, except docs/notes, in the order of the pages, with less work: two people, a
//! few steps, small pictures. A shell evaluates the pages' blocks and records the programs that it would start. The
//! test then runs them. Commands within the text are checked only: programs, benches, tests and options must exist.
#![cfg(unix)]

use std::collections::BTreeSet;
use std::fs;
use std::path::PathBuf;
use std::process::Command;
use std::time::Instant;

use snapsnap_tests::{data, root, sample, shared, snapsnap, succeed, toml_config};

/// In reading order: a page's commands use the outputs of earlier pages.
const PAGES: [&str; 15] = [
    "README.md",
    "CONTRIBUTING.md",
    "docs/training.md",
    "docs/look.md",
    "docs/python.md",
    "docs/weights.md",
    "docs/evaluation.md",
    "docs/formats.md",
    "docs/architecture.md",
    "docs/commands.md",
    "docs/inference.md",
    "docs/splat.md",
    "docs/data.md",
    "docs/fuzz.md",
    "datasets/README.md",
];
/// Tasks of `cargo xtask` that are no commands of the program.
const TASKS: [&str; 6] = ["test", "lint", "dist", "fuzz", "bundle", "help"];
/// Records the commands that the shell would start. Byte 0x1F ends an argument, 0x1E a command.
const RECORDER: &str = r#"set -eu
record() { { printf '%s\037' "$@"; printf '\036'; } >> "$COMMANDS"; }
for program in cargo snapsnap python pip bash; do eval "$program() { record $program \"\$@\"; }"; done
touch() { :; }
"#;

type Words = Vec<String>;

/// The shell blocks of a page.
fn blocks(page: &str) -> Vec<String> {
    let text = fs::read_to_string(root().join(page)).unwrap_or_else(|e| panic!("{page}: {e}"));
    let mut found = Vec::new();
    let mut lines = text.lines();
    while lines.by_ref().any(|line| line == "```sh") {
        let block: Vec<&str> = lines.by_ref().take_while(|line| *line != "```").collect();
        found.push(block.join("\n"));
    }
    found
}

/// The commands of a script with these arguments, after the shell's expansion of variables and loops.
fn recorded(page: &str, script: &str, arguments: &[String]) -> Vec<Words> {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let commands = temporary.path().join("commands");
    fs::write(&commands, "").expect("written");
    let mut shell = Command::new("/bin/bash");
    shell.args(["-c", &format!("{RECORDER}{script}"), page]).args(arguments).env("COMMANDS", &commands);
    // Only some rows of the sweeps and one generation of people, since all are alike.
    shell.env("ROWS", "base transformer regressor free-start all").env("GENERATIONS", "1");
    // Nothing but what is recorded may be started.
    let output = shell.env("PATH", "/nowhere").current_dir(temporary.path()).output().expect("bash starts");
    assert!(output.status.success(), "{page}: {script}\n{}", String::from_utf8_lossy(&output.stderr));
    let text = fs::read_to_string(&commands).expect("read");
    let words = |command: &str| command.split_terminator('\u{1f}').map(str::to_owned).collect();
    text.split_terminator('\u{1e}').map(words).collect()
}

/// Commands of a page: of its blocks, and of scripts that they run.
fn commands(page: &str) -> Vec<Words> {
    let mut all = Vec::new();
    for block in blocks(page) {
        for words in recorded(page, &block, &[]) {
            if words[0] == "bash" {
                let script =
                    fs::read_to_string(root().join(&words[1])).unwrap_or_else(|e| panic!("{words:?}: {e}"));
                all.extend(recorded(&words[1], &script, &words[2..]));
            } else {
                all.push(words);
            }
        }
    }
    all
}

/// The program's own words, if it is the program that is run.
fn of_program(words: &[String]) -> Option<&[String]> {
    match words.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["snapsnap", ..] => Some(&words[1..]),
        ["cargo", "xtask", task, ..] if !TASKS.contains(&task) => Some(&words[2..]),
        _ => None,
    }
}

/// Asserts that another program's command names existing files and tasks.
fn look(words: &[String]) {
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let is_there = match words[..] {
        ["cargo", "xtask", task, ..] => TASKS.contains(&task),
        ["cargo", "test", ref rest @ ..] => match rest.iter().position(|word| *word == "--test") {
            Some(at) => ["tests/tests/X.rs", "tests/tests/X/main.rs"]
                .iter()
                .any(|path| root().join(path.replace('X', rest[at + 1])).is_file()),
            None => rest.contains(&"--lib"),
        },
        ["cargo", "bench", ref rest @ ..] => {
            let at = rest.iter().position(|word| *word == "--bench").expect("the name of a bench");
            let file = format!("benches/{}.rs", rest[at + 1]);
            let crates = fs::read_dir(root().join("crates")).expect("the crates");
            crates.flatten().any(|folder| folder.path().join(&file).is_file())
        }
        ["python", "-m", "snapsnap"] => true,
        ["python", file, ..] => root().join(file).is_file(),
        ["cargo", "doc", ..] | ["cargo", "build", ..] => true,
        ["pip", "install", folder] => root().join(folder).join("pyproject.toml").is_file(),
        ["cargo", "install", "--locked", "--path", folder] => {
            root().join(folder).join("Cargo.toml").is_file()
        }
        ["cargo", "run", .., "--example", name] | ["cargo", "run", .., "--example", name, "--", _] => {
            root().join("examples").join(name).with_extension("rs").is_file()
        }
        _ => false,
    };
    assert!(is_there, "nobody knows how to try `{}`", words.join(" "));
}

/// The same command with less work.
fn less(words: &[String]) -> Words {
    let mut words = words.to_vec();
    for word in &mut words {
        // Networks of the published size have a test's size here.
        if matches!(word.as_str(), "configs/full.toml" | "configs/full-compat.toml") {
            *word = "published.toml".into();
        }
        if word == "views.resolution=1024" {
            *word = "views.resolution=256".into();
        }
    }
    let mut more: Vec<&str> = Vec::new();
    match words[0].as_str() {
        "prepare" if matches!(words[1].as_str(), "synth" | "makehuman" | "avatars") => {
            let folder = shared(&words[1]);
            if words[1] != "synth" && !folder.is_dir() {
                println!("SKIPPED: no {}; simple people instead: {}", folder.display(), words.join(" "));
                words.splice(1..3, ["synth".to_owned()]);
            }
            let count = words.iter().position(|word| word == "--subjects").expect("how many people");
            words[count + 1] = "2".into();
            more.extend(["--set", "views.count=8", "--set", "views.samples_per_axis=1"]);
            let is_fine =
                !words.iter().any(|word| word.contains("small.toml") || word.contains("default.toml"));
            more.extend(is_fine.then_some(["--set", "views.resolution=256"]).into_iter().flatten());
        }
        "prepare" if words[1] == "scan" => {
            more.extend(["--set", "views.count=4", "--set", "views.samples_per_axis=1"]);
        }
        "train-stage1" | "train-stage2" => {
            for key in [
                "training.steps=1",
                "schedule.warm_up=0",
                "training.validate_every=1",
                "training.validation_samples=1",
                "training.checkpoint_every=1",
                "training.preview_every=0",
            ] {
                more.extend(["--set", key]);
            }
            // Their schedules end with a fall.
            let of_default =
                |name: &str| words.iter().any(|word| *word == format!("configs/default/{name}.toml"));
            if ["photographs", "stage1", "details"].iter().any(|name| of_default(name)) {
                more.extend(["--set", "schedule.fall=0"]);
            }
            if of_default("regressor") || of_default("details") {
                more.extend(["--set", "network.resolution=256"]);
            }
            if of_default("details") {
                more.extend(["--set", "network.details.resolution=256"]);
            }
        }
        "evaluate" => {
            for key in ["data.subjects=1", "report.people=1", "views.compared=[1]", "views.resolution=0"] {
                more.extend(["--set", key]);
            }
            if !words.iter().any(|word| word == "--weights") {
                more.extend(["--set", "model.set=[\"network.resolution=256\"]"]);
            }
        }
        // Servers do not end; tests/tests/view.rs and studio.rs test them.
        "view" | "studio" => more.push("--help"),
        // A mesh takes twelve seconds: one is made. tests/tests/surface.rs and batches.rs make textures and folders.
        "mesh" if words.len() > 4 => more.push("--help"),
        "bench" => {
            more.push("--quick");
            if words.iter().any(|word| word == "configs/bench.toml") {
                for name in ["canvas 512", "canvas 1024"] {
                    words.extend([
                        "--set".into(),
                        format!("settings.{name}.set=[\"network.resolution=256\"]"),
                    ]);
                }
                // A software GPU takes minutes to compile its kernels.
                more.extend(["--set", "settings.wgpu.device=\"cpu\""]);
            }
        }
        // tests/tests/demo.rs tests the full resolution.
        "reconstruct" if !words.iter().any(|word| word == "--weights") => {
            more.extend(["--set", "network.resolution=256"]);
        }
        "stability" => more.extend(["--quick", "--device", "cpu", "--only", "opacity 1e-7"]),
        "fetch-weights" => more.push("--list"),
        "import-weights" if words.iter().any(|word| word.ends_with(".pth")) => {
            more.extend(["--config", "published.toml"]);
        }
        _ => {}
    }
    if ["reconstruct", "demo", "train-stage1", "train-stage2", "render", "bench", "mesh"]
        .contains(&words[0].as_str())
    {
        more.extend(["--device", "cpu"]);
    }
    // One device is enough, and one `--device` all that is allowed.
    if let Some(at) = words.iter().position(|word| word == "--device") {
        words.drain(at..at + 2);
    }
    words.extend(more.into_iter().map(str::to_owned));
    words
}

/// A folder with the files that the pages expect: photographs, checkpoints, scans, MakeHuman's data.
fn place() -> tempfile::TempDir {
    use std::os::unix::fs::symlink;
    let temporary = tempfile::tempdir().expect("temporary folder");
    let to = |name: &str| {
        let path = temporary.path().join(name);
        fs::create_dir_all(path.parent().expect("a folder")).expect("made");
        path
    };
    for name in ["configs", "assets", "docs"] {
        symlink(root().join(name), to(name)).expect("linked");
    }
    for side in ["front", "back"] {
        let picture = sample::picture(side);
        picture.save(to(&format!("{side}.png"))).expect("saved");
        let mask = image::GrayImage::from_fn(picture.width(), picture.height(), |x, y| {
            image::Luma([picture.get_pixel(x, y)[3]])
        });
        mask.save(to(&format!("{side}_mask.png"))).expect("saved");
        picture.save(to(&format!("photographs/anna_{side}.png"))).expect("saved");
        image::DynamicImage::from(picture).into_rgb8().save(to(&format!("{side}.jpg"))).expect("saved");
    }
    for (name, from) in [("a.png", "45.png"), ("b.png", "135.png")] {
        fs::copy(root().join("assets/sample").join(from), to(name)).expect("copied");
    }
    for name in ["stage1.pth", "stage2.pth"] {
        fs::copy(data("pipeline").join(name), to(name)).expect("copied");
    }
    fs::write(to("pairs.csv"), "front,back\nphotographs/anna_front.png,photographs/anna_back.png\n")
        .expect("written");
    fs::write(to("published.toml"), toml_config(&data("pipeline").join("config.json"))).expect("written");
    symlink(shared("makehuman"), to("path/to/makehuman/data")).expect("linked");
    symlink(shared("avatars"), to("path/to/avatars")).expect("linked");
    let cone: String = (0..12)
        .map(|i| f64::from(i) * std::f64::consts::TAU / 12.0)
        .map(|angle| format!("v {} 0 {}\n", 0.3 * angle.cos(), 0.2 * angle.sin()))
        .chain(["v 0 1.8 0\n".into()])
        .chain((0..12).map(|i| format!("f {} 13 {}\n", i + 1, (i + 1) % 12 + 1)))
        .collect();
    for folder in ["path/to/scans", "meshes"] {
        for name in ["0000", "0001"] {
            fs::write(to(&format!("{folder}/{name}.obj")), &cone).expect("written");
        }
    }
    temporary
}

#[test]
fn every_command_of_readme_and_docs_works() {
    let place = place();
    let mut made: BTreeSet<PathBuf> = BTreeSet::new();
    let mut tried: BTreeSet<Words> = BTreeSet::new();
    for page in PAGES {
        for words in commands(page) {
            let Some(own) = of_program(&words) else {
                look(&words);
                continue;
            };
            let less = less(own);
            // A command that several pages have runs once.
            if !tried.insert(less.clone()) {
                continue;
            }
            let begun = Instant::now();
            // A training is not begun in the folder of another; here pages come after one another.
            if let (true, Some(at)) =
                (less[0].starts_with("train-"), less.iter().position(|word| word == "-o"))
            {
                let run = place.path().join(&less[at + 1]);
                if !less.iter().any(|word| word == "--dry-run" || word == "--resume")
                    && !made.insert(run.clone())
                {
                    fs::remove_dir_all(run).expect("removed");
                }
            }
            succeed(snapsnap().current_dir(place.path()).args(&less));
            println!("{page}: {} ({:.1} s)", words.join(" "), begun.elapsed().as_secs_f32());
        }
    }
    println!("{} commands", tried.len());
    assert!(tried.len() > 20, "the pages' blocks were not found");
}

/// Options of commands within the text are in the program's help; other programs and files exist.
#[test]
fn commands_within_the_text_are_there() {
    let mut checked = 0;
    for page in PAGES {
        let text = fs::read_to_string(root().join(page)).expect("read").replace('\n', " ");
        let text: String = text.split("```").step_by(2).collect();
        for span in text.split('`').skip(1).step_by(2) {
            let words: Words =
                span.split_whitespace().map(|word| word.trim_matches(['\'', '"']).to_owned()).collect();
            let names = ["cargo", "snapsnap", "python"];
            let is_command = words.len() > 2 && names.contains(&words[0].as_str());
            if !is_command || words.contains(&"COMMAND".to_owned()) {
                continue;
            }
            checked += 1;
            let Some(own) = of_program(&words) else {
                look(&words);
                continue;
            };
            let help = help(own);
            for option in own.iter().filter(|word| word.starts_with("--")) {
                let option = option.trim_end_matches(',');
                assert!(help.contains(option), "{page}: `{span}`: there is no {option}");
            }
        }
    }
    assert!(checked > 10, "{checked} commands were found in the text");
}

/// The help of a command that may have one below it.
fn help(own: &[String]) -> String {
    let below =
        own.iter().skip(1).take_while(|word| own[0] == "prepare" && word.chars().all(char::is_alphabetic));
    succeed(snapsnap().arg(&own[0]).args(below.take(1)).arg("--help"))
}
