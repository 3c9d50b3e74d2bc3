//! What many cases came to: counted by format, failures told apart by what went wrong.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs;
use std::process::Command;
use std::time::{Duration, Instant};

use super::case::{Case, Outcome};
use super::child::Ended;

/// What the numbers of a report mean.
const MEANING: &str = "\
Each case is a sound sample with random changes, and the program reads it as it reads a user's file. These conditions must hold:

* The exit code is 0 with whole output, or 2 without output. Evaluations may end with 1 if a part cannot be read; the rest is whole.
* The case ends within 20 s.
* It takes at most 300 MB more than the sound sample, and 50 bytes for each byte by which it is longer.
* There is no panic, and no control character reaches the terminal.
* The input files do not change.
";
/// What the columns of its table are called.
const HEADER: &str =
    "| format | cases | mean | exit 0 | exit 2 | otherwise | failed | longest, seed | most memory, seed |";

/// Counts of one format.
#[derive(Debug, Default)]
struct Row {
    cases: u64,
    ends: BTreeMap<Ended, u64>,
    failures: u64,
    total: Duration,
    /// With the seed of the case that took it.
    slowest: (Duration, u64),
    /// With the seed of the case that took it.
    memory: (u64, u64),
}

/// One way in which a format fails.
struct Failure {
    /// The first case that did.
    case: Case,
    problem: String,
    changes: Vec<String>,
    times: u64,
}

/// What cases came to.
pub struct Tally {
    start: Instant,
    time: Duration,
    rows: BTreeMap<&'static str, Row>,
    failures: BTreeMap<(&'static str, String), Failure>,
}

impl Tally {
    /// Nothing yet.
    pub fn new(formats: impl Iterator<Item = &'static str>) -> Self {
        let rows = formats.map(|name| (name, Row::default())).collect();
        Self { start: Instant::now(), time: Duration::ZERO, rows, failures: BTreeMap::new() }
    }

    /// Whether the case fails as none did before.
    pub fn is_new(&self, case: Case, outcome: &Outcome) -> bool {
        let key = |problem: &String| (case.format.name, kind(problem, outcome));
        outcome.problems.iter().any(|problem| !self.failures.contains_key(&key(problem)))
    }

    /// Counts a case, which `least` repeats with fewer changes; returns what has not been seen before.
    pub fn add(&mut self, case: Case, least: Case, outcome: &Outcome) -> Vec<String> {
        let row = self.rows.entry(case.format.name).or_default();
        let ran = &outcome.ran;
        row.cases += 1;
        *row.ends.entry(ran.ended).or_default() += 1;
        row.failures += u64::from(!outcome.problems.is_empty());
        row.total += ran.time;
        row.slowest = row.slowest.max((ran.time, case.seed));
        row.memory = row.memory.max((ran.memory, case.seed));
        let mut new = Vec::new();
        for problem in &outcome.problems {
            let key = (case.format.name, kind(problem, outcome));
            let failure = self.failures.entry(key).or_insert_with(|| {
                let changes = outcome.changes.clone();
                Failure { case: least, problem: problem.clone(), changes, times: 0 }
            });
            failure.times += 1;
            if failure.times == 1 {
                new.push(failure.line());
            }
        }
        new
    }

    /// The time is over.
    pub fn stop(&mut self) {
        self.time = self.start.elapsed();
    }

    fn cases(&self) -> u64 {
        self.rows.values().map(|row| row.cases).sum()
    }

    /// One line on how far a run is.
    pub fn progress(&self) -> String {
        let seconds = self.start.elapsed().as_secs_f64();
        let cases = self.cases();
        let rate = cases as f64 / seconds;
        let failures = self.failures.len();
        format!("{seconds:.0} s: {cases} cases, {rate:.0} a second, {failures} different failures")
    }

    /// Every kind of failure, with the command that repeats it.
    pub fn failures(&self) -> Vec<String> {
        self.failures.values().map(Failure::line).collect()
    }

    /// The whole in Markdown; `command` is what was typed.
    pub fn markdown(&self, command: &str) -> String {
        let mut text = String::from("# Fuzzing\n\n");
        let mut line = |line: String| writeln!(text, "{line}").expect("written to memory");
        let cores = std::thread::available_parallelism().map_or(0, usize::from);
        line(format!("`{command}`, {}, {cores} cores of {}.\n", commit(), processor()));
        let seconds = self.time.as_secs_f64();
        let all = self.cases();
        line(format!("{all} cases in {seconds:.0} s, {:.0} a second.", all as f64 / seconds));
        line(MEANING.into());
        line(HEADER.into());
        line("|---|---:|---:|---:|---:|---:|---:|---:|---:|".into());
        for (name, row) in &self.rows {
            let ended = |code: i32| row.ends.get(&Ended::Code(code)).copied().unwrap_or(0);
            let other = row.cases - ended(0) - ended(2);
            let mean = row.total.as_secs_f64() * 1e3 / row.cases.max(1) as f64;
            line(format!(
                "| {name} | {} | {mean:.0} ms | {} | {} | {other} | {} | {:.1} s, {} | {} MB, {} |",
                row.cases,
                ended(0),
                ended(2),
                row.failures,
                row.slowest.0.as_secs_f64(),
                row.slowest.1,
                row.memory.0 >> 20,
                row.memory.1
            ));
        }
        line("\n## Failures\n".into());
        if self.failures.is_empty() {
            line("None.".into());
        }
        for failure in self.failures.values() {
            let Failure { case, problem, changes, times } = failure;
            line(format!("* `cargo xtask fuzz --case {case}`, {times} times: {problem}"));
            changes.iter().for_each(|change| line(format!("  * {}", change.escape_debug())));
        }
        text
    }
}

impl Failure {
    fn line(&self) -> String {
        format!("{} {} — cargo xtask fuzz --case {}", self.case, self.problem, self.case)
    }
}

/// The problem without what differs from case to case.
fn kind(problem: &str, outcome: &Outcome) -> String {
    if let Some((before, after)) = problem.split_once(".rs:") {
        // A panic: where it is, not with which numbers.
        return format!("{before}:{}", after.split(' ').next().unwrap_or_default());
    }
    let start = problem.split('`').next().unwrap_or_default();
    let start: String = start.chars().map(|c| if c.is_ascii_digit() { '#' } else { c }).collect();
    start + outcome.instead.unwrap_or_default()
}

fn commit() -> String {
    let folder = env!("CARGO_MANIFEST_DIR");
    let output = Command::new("git").args(["-C", folder, "rev-parse", "--short", "HEAD"]).output();
    let hash = output.ok().filter(|output| output.status.success());
    hash.map_or("no commit".into(), |output| {
        format!("commit {}", String::from_utf8_lossy(&output.stdout).trim())
    })
}

fn processor() -> String {
    let text = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = text.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": "));
    name.map_or("an unnamed processor".into(), |(_, name)| name.to_owned())
}
