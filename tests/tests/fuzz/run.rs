//! Runs the program under a limit of memory and time. Whatever the input, it is read or refused, in words that a terminal
//! may be shown, and nothing is left half done or touched that is not the program's.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use super::case::{INPUTS, ODD_INPUTS};
use super::formats::Format;

/// Longest that any input may keep the program busy.
const LONGEST: Duration = Duration::from_secs(20);
/// Address space in kilobytes: more would take the machine's memory.
const ADDRESSES: u64 = 4_000_000;
/// How often memory is looked at: less than it takes to fill a few tens of megabytes.
const LOOK: Duration = Duration::from_millis(2);
/// Length to which the system cuts the names of programs.
const NAME: usize = 15;
/// Names of files that are being written and not yet whole.
const UNFINISHED: [&str; 2] = [".snapsnap-", ".unfinished"];
/// Longest quotation in a problem.
const QUOTED: usize = 200;

/// Everything below a folder, by path: bytes of a file, `None` for anything else.
pub type Tree = BTreeMap<PathBuf, Option<Vec<u8>>>;

/// Reads a folder. Links are not followed.
///
/// # Panics
/// If it cannot be read.
pub fn read_tree(root: &Path) -> Tree {
    let mut tree = Tree::new();
    let mut folders = vec![root.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            let kind = fs::symlink_metadata(&path).expect("an entry").file_type();
            if kind.is_dir() {
                folders.push(path.clone());
            }
            let content = kind.is_file().then(|| fs::read(&path).expect("a file"));
            tree.insert(path.strip_prefix(root).expect("below").to_owned(), content);
        }
    }
    tree
}

/// Most memory for an input that is so many bytes longer than the sound one: numbers and lists take more room in memory
/// than in text.
pub fn most_memory(sound: u64, longer: u64) -> u64 {
    sound + (300 << 20) + 50 * longer
}

/// How a run went.
pub struct Run {
    /// Exit code, if the program ended by itself in time.
    pub code: Option<i32>,
    /// Most memory that was resident at once, bytes.
    pub memory: u64,
    /// What it printed, on both streams.
    pub printed: Vec<u8>,
    /// What must not be.
    pub problems: Vec<String>,
}

/// Runs the program in the folder `work`; `notes` is a folder for its output.
///
/// # Panics
/// If there is no shell, or no room in `notes`.
pub fn run(format: &Format, arguments: &[OsString], work: &Path, notes: &Path, most_memory: u64) -> Run {
    let before = read_tree(work);
    let program = PathBuf::from(snapsnap_tests::snapsnap().get_program());
    let streams = ["stdout", "stderr"].map(|name| notes.join(name));
    let [out, err] = streams.each_ref().map(|path| fs::File::create(path).expect("a file of output"));
    let limit = format!("ulimit -c 0; ulimit -v {ADDRESSES}; exec \"$@\"");
    let mut command = Command::new("sh");
    command.arg("-c").arg(limit).arg("sh").arg(&program).args(arguments).current_dir(work);
    // Every thread has a stack: as many on every machine, so that memory compares.
    command.env_remove("RUST_BACKTRACE").env("RAYON_NUM_THREADS", "2");
    command.stdin(Stdio::null()).stdout(out).stderr(err);
    let start = Instant::now();
    let mut child = command.spawn().expect("a shell");
    let status = format!("/proc/{}/status", child.id());
    let name = program.file_name().expect("a program's name").to_string_lossy();
    let mut memory = 0;
    let ended = loop {
        memory = memory.max(high_water(&status, &name));
        if let Some(status) = child.try_wait().expect("the child can be waited for") {
            break Some(status);
        }
        if start.elapsed() > LONGEST {
            // It may have ended just now.
            let _ = child.kill();
            child.wait().expect("the child can be waited for");
            break None;
        }
        std::thread::sleep(LOOK);
    };
    let printed: Vec<u8> = streams.iter().flat_map(|path| fs::read(path).expect("output")).collect();
    let code = ended.and_then(|status| status.code());
    let is_done = code == Some(0) || format.is_partial && code == Some(1);
    let mut problems = Vec::new();
    match ended {
        None => problems.push(format!("no end within {} s", LONGEST.as_secs())),
        Some(status) if !is_done && code != Some(2) => problems.push(status.to_string()),
        Some(_) => {}
    }
    if memory > most_memory {
        problems.push(format!("takes {} MB of memory, of {} MB", memory >> 20, most_memory >> 20));
    }
    problems.extend(about_words(&printed));
    if code != Some(0) && printed.trim_ascii().is_empty() {
        problems.push("fails without a word".into());
    }
    problems.extend(about_files(format, is_done, &before, &read_tree(work)));
    if is_done {
        match catch_unwind(AssertUnwindSafe(|| (format.is_whole)(work))) {
            Ok(Ok(())) => {}
            Ok(Err(problem)) => problems.push(format!("what it wrote is not whole: {problem}")),
            Err(_) => problems.push("what it wrote makes its reader panic".into()),
        }
    }
    Run { code, memory, printed, problems }
}

/// Most memory that the process had resident so far; 0 before it runs this program (it shares this one's memory, then
/// it is the shell) and after its end.
fn high_water(status: &str, program: &str) -> u64 {
    let text = fs::read_to_string(status).unwrap_or_default();
    let value = |key: &str| text.lines().find_map(|line| line.strip_prefix(key)).map_or("", str::trim);
    if value("Name:") != program.get(..NAME).unwrap_or(program) {
        return 0;
    }
    let kilobytes = value("VmHWM:").strip_suffix(" kB").and_then(|number| number.parse::<u64>().ok());
    1024 * kilobytes.unwrap_or(0)
}

fn about_words(printed: &[u8]) -> Vec<String> {
    let short = |line: &str| line.escape_debug().take(QUOTED).collect::<String>();
    let Ok(text) = std::str::from_utf8(printed) else {
        return vec![format!("prints what is no UTF-8: {}", short(&String::from_utf8_lossy(printed)))];
    };
    let mut problems = Vec::new();
    let odd_name = String::from_utf8_lossy(ODD_INPUTS);
    if text.contains(&*odd_name) {
        problems.push("prints control characters: those of a folder's name".into());
    }
    let text = text.replace(&*odd_name, INPUTS);
    if let Some(at) = text.find("panicked at") {
        problems.push(format!("panicked: {}", short(&text[at..])));
    }
    let is_odd = |c: char| c.is_control() && c != '\n' && c != '\t';
    if let Some(line) = text.lines().find(|line| line.contains(is_odd)) {
        problems.push(format!("prints control characters: {}", short(line)));
    }
    problems
}

fn about_files(format: &Format, is_done: bool, before: &Tree, after: &Tree) -> Vec<String> {
    // The folder of inputs may have another name that begins the same.
    let is_input = |path: &Path| {
        path.to_string_lossy().starts_with(&format!("{INPUTS}/"))
            || path.to_string_lossy().starts_with(&format!("{INPUTS} "))
    };
    let name = |path: &Path| path.display().to_string().escape_debug().to_string();
    let mut problems = Vec::new();
    for (path, content) in before {
        // A success replaces its output.
        if (is_input(path) || !is_done) && after.get(path) != Some(content) {
            problems.push(format!("{} was there before, and is gone or changed", name(path)));
        }
    }
    for (path, content) in after.iter().filter(|(path, _)| !before.contains_key(*path)) {
        let is_left = format.kept.iter().any(|kept| path.starts_with(kept));
        if UNFINISHED.iter().any(|part| path.to_string_lossy().contains(part)) {
            problems.push(format!("left {} unfinished", name(path)));
        } else if is_input(path) {
            problems.push(format!("wrote {} among its inputs", name(path)));
        } else if !is_done && content.is_some() && !is_left {
            problems.push(format!("wrote {} though it failed", name(path)));
        }
    }
    problems
}
