//! Runs the program as a child under a limit of memory and time, and measures what it took.

use std::ffi::OsString;
use std::fs;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

/// Longest that any input may keep the program busy.
pub const LONGEST: Duration = Duration::from_secs(20);
/// Address space in kilobytes: what this stops would have taken the machine's memory.
const ADDRESSES: u64 = 4_000_000;
/// How often memory is looked at: less than it takes to fill a few tens of megabytes.
const LOOK: Duration = Duration::from_millis(2);

/// How a run ended and what it took.
#[derive(Debug)]
pub struct Ran {
    /// How it ended.
    pub ended: Ended,
    /// How long it took.
    pub time: Duration,
    /// Most memory that was resident at once, bytes.
    pub memory: u64,
    /// What it printed, on both streams.
    pub printed: Vec<u8>,
}

/// How a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Ended {
    /// With this exit code.
    Code(i32),
    /// By this signal.
    Signal(i32),
    /// Not by itself within [`LONGEST`].
    Never,
}

impl Ended {
    fn of(status: ExitStatus) -> Self {
        match (status.code(), status.signal()) {
            (Some(code), _) => Self::Code(code),
            (None, signal) => Self::Signal(signal.unwrap_or(0)),
        }
    }
}

/// Runs `program` in the folder `work`; `notes` is a folder for what it prints.
///
/// # Panics
/// If there is no shell, or no room in `notes`.
pub fn run(program: &Path, arguments: &[OsString], work: &Path, notes: &Path) -> Ran {
    let streams = ["stdout", "stderr"].map(|name| notes.join(name));
    let [out, err] =
        streams.each_ref().map(|path| fs::File::create(path).expect("a file for what it prints"));
    let limit = format!("ulimit -c 0; ulimit -v {ADDRESSES}; exec \"$@\"");
    let mut command = Command::new("sh");
    command.arg("-c").arg(limit).arg("sh").arg(program).args(arguments).current_dir(work);
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
            break Ended::of(status);
        }
        if start.elapsed() > LONGEST {
            // It may have ended just now.
            let _ = child.kill();
            child.wait().expect("the child can be waited for");
            break Ended::Never;
        }
        std::thread::sleep(LOOK);
    };
    let time = start.elapsed();
    let printed = streams.iter().flat_map(|path| fs::read(path).expect("what it printed")).collect();
    Ran { ended, time, memory, printed }
}

/// Length to which the system cuts the names of programs.
const NAME: usize = 15;

/// Most memory that the process had resident so far, if it runs this program: before, it shares this one's memory, then
/// it is the shell. 0 once it has ended.
fn high_water(status: &str, program: &str) -> u64 {
    let text = fs::read_to_string(status).unwrap_or_default();
    let value = |key: &str| text.lines().find_map(|line| line.strip_prefix(key)).map_or("", str::trim);
    if value("Name:") != program.get(..NAME).unwrap_or(program) {
        return 0;
    }
    let kilobytes = value("VmHWM:").strip_suffix(" kB").and_then(|number| number.parse::<u64>().ok());
    1024 * kilobytes.unwrap_or(0)
}
