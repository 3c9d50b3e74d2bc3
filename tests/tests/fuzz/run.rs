//! Runs the program under a limit of memory and time. Whatever the input, it is read or refused, in words that a terminal
//! may be shown, and nothing is left half done or touched that is not the program's.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use snapsnap_tests::{files, limited, snapsnap};

use super::checks;
use super::formats::Format;

/// Longest that any input may keep the program busy.
const LONGEST: Duration = Duration::from_secs(20);
/// No core dumps, and an address space in kilobytes: more would take the machine's memory.
const LIMITS: &str = "-c 0; ulimit -v 4000000";
/// How often memory is looked at: less than it takes to fill a few tens of megabytes.
const LOOK: Duration = Duration::from_millis(2);
/// Names of files that are being written and not yet whole.
const UNFINISHED: [&str; 2] = [".snapsnap-", ".unfinished"];
/// Longest quotation in a problem.
const QUOTED: usize = 200;

/// Files below a folder.
type Files = BTreeMap<PathBuf, Vec<u8>>;

/// How a run went.
pub struct Run {
    /// Exit code, if the program ended by itself in time.
    pub code: Option<i32>,
    /// Most memory that was resident at once, bytes.
    pub memory: u64,
    /// What it printed, on both streams.
    pub printed: String,
    /// What must not be.
    pub problems: Vec<String>,
}

/// Runs the format's command in the folder `work` of `place`. `inputs` is the name of the folder of inputs.
///
/// # Panics
/// If there is no shell, or no room in `place`.
pub fn run(format: &Format, inputs: &OsStr, place: &Path, most_memory: u64) -> Run {
    let work = place.join("work");
    let before = files(&work);
    let mut command = snapsnap();
    command.current_dir(&work).args(format.command.split_whitespace().map(|word| {
        let input = word.strip_prefix("in/").map(|name| Path::new(inputs).join(name));
        input.unwrap_or_else(|| word.into())
    }));
    let printed = place.join("printed");
    let out = fs::File::create(&printed).expect("a file of output");
    let err = out.try_clone().expect("a second stream");
    let mut command = limited(&command, LIMITS);
    // Every thread has a stack: as many on every machine, so that memory compares.
    command.env_remove("RUST_BACKTRACE").env("RAYON_NUM_THREADS", "2");
    command.stdin(Stdio::null()).stdout(out).stderr(err);
    let start = Instant::now();
    let mut child = command.spawn().expect("a shell");
    let mut memory = 0;
    let ended = loop {
        memory = memory.max(high_water(child.id()));
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
    let printed = fs::read(printed).expect("output");
    let code = ended.and_then(|status| status.code());
    let is_done = code == Some(0) || format.is_partial() && code == Some(1);
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
    if work.join("out/.unfinished").exists() {
        problems.push("left the folder of unfinished people".into());
    }
    problems.extend(about_files(format, inputs, is_done, &before, &files(&work)));
    if is_done {
        match catch_unwind(AssertUnwindSafe(|| checks::check(&format.command, &work))) {
            Ok(Ok(())) => {}
            Ok(Err(problem)) => problems.push(format!("what it wrote is not whole: {problem}")),
            Err(_) => problems.push("what it wrote makes its reader panic".into()),
        }
    }
    Run { code, memory, printed: String::from_utf8_lossy(&printed).into_owned(), problems }
}

/// Most memory that the process had resident so far; 0 before it runs the program (it shares this one's memory, then it
/// is the shell) and after its end.
fn high_water(process: u32) -> u64 {
    let status = fs::read_to_string(format!("/proc/{process}/status")).unwrap_or_default();
    let mut lines = status.lines().filter(|_| status.starts_with("Name:\tsnapsnap"));
    let kilobytes = lines.find_map(|line| line.strip_prefix("VmHWM:")?.trim().strip_suffix(" kB"));
    kilobytes.map_or(0, |number| 1024 * number.parse::<u64>().expect("a number"))
}

fn about_words(printed: &[u8]) -> Vec<String> {
    let short = |line: &str| line.escape_debug().take(QUOTED).collect::<String>();
    let Ok(text) = std::str::from_utf8(printed) else {
        return vec![format!("prints what is no UTF-8: {}", short(&String::from_utf8_lossy(printed)))];
    };
    let panicked = text.find("panicked at").map(|at| format!("panicked: {}", short(&text[at..])));
    let is_odd = |c: char| c.is_control() && c != '\n' && c != '\t';
    let odd = text.lines().find(|line| line.contains(is_odd));
    let odd = odd.map(|line| format!("prints control characters: {}", short(line)));
    panicked.into_iter().chain(odd).collect()
}

fn about_files(format: &Format, inputs: &OsStr, is_done: bool, before: &Files, after: &Files) -> Vec<String> {
    let mut problems = Vec::new();
    for (path, content) in before {
        // A success replaces its output.
        if (path.starts_with(inputs) || !is_done) && after.get(path) != Some(content) {
            problems.push(format!("{path:?} was there before, and is gone or changed"));
        }
    }
    for path in after.keys().filter(|path| !before.contains_key(*path)) {
        let is_kept = format.kept.iter().any(|kept| path.starts_with(kept));
        if UNFINISHED.iter().any(|part| path.to_string_lossy().contains(part)) {
            problems.push(format!("left {path:?} unfinished"));
        } else if path.starts_with(inputs) {
            problems.push(format!("wrote {path:?} among its inputs"));
        } else if !is_done && !is_kept {
            problems.push(format!("wrote {path:?} though it failed"));
        }
    }
    problems
}
