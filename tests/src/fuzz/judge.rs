//! What must hold whatever the input: it is read or refused, in bounded time and memory, in words that a terminal may be
//! shown, and nothing is left half done or touched that is not the program's.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Component, Path};

use super::child::{Ended, LONGEST, Ran};
use super::tree::{Entry, Tree};
use super::{Format, INPUTS, ODD_INPUTS};

/// Memory that a changed sample may take beyond the sound one.
pub const MORE_MEMORY: u64 = 300 << 20;
/// And for each byte that it is longer: numbers and lists take more room in memory than in text.
pub const MEMORY_PER_BYTE: u64 = 50;
/// Names of what is being written and not yet whole.
const UNFINISHED: [&str; 2] = [".snapsnap-", ".unfinished"];
/// Longest quotation in a problem.
const QUOTED: usize = 200;

/// What is wrong with a run; nothing, if all is well.
pub fn problems(
    format: &Format,
    ran: &Ran,
    before: &Tree,
    after: &Tree,
    work: &Path,
    most_memory: u64,
) -> Vec<String> {
    let mut problems = Vec::new();
    let done = is_done(format, ran);
    match ran.ended {
        Ended::Code(2) => {}
        _ if done => {}
        Ended::Code(code) => problems.push(format!("exit code {code}")),
        Ended::Signal(signal) => problems.push(format!("ended by signal {signal}")),
        Ended::Never => problems.push(format!("no end within {} s", LONGEST.as_secs())),
    }
    if ran.memory > most_memory {
        problems.push(format!("takes {} MB of memory, of {} MB", ran.memory >> 20, most_memory >> 20));
    }
    problems.extend(about_words(ran));
    problems.extend(about_files(format, ran, before, after));
    if done {
        let whole = catch_unwind(AssertUnwindSafe(|| (format.whole)(work)));
        match whole {
            Ok(Ok(())) => {}
            Ok(Err(problem)) => problems.push(format!("what it wrote is not whole: {problem}")),
            Err(_) => problems.push("what it wrote makes its reader panic".into()),
        }
    }
    problems
}

/// Whether the command did what it was for, or what it could of it.
fn is_done(format: &Format, ran: &Ran) -> bool {
    ran.ended == Ended::Code(0) || format.partial && ran.ended == Ended::Code(1)
}

fn about_words(ran: &Ran) -> Vec<String> {
    let mut problems = Vec::new();
    let text = match std::str::from_utf8(&ran.printed) {
        Ok(text) => text,
        Err(e) => {
            let start = e.valid_up_to().saturating_sub(QUOTED / 2);
            let around = &ran.printed[start..ran.printed.len().min(start + QUOTED)];
            return vec![format!("prints what is no UTF-8: `{}`", around.escape_ascii())];
        }
    };
    let short = |line: &str| line.escape_debug().take(QUOTED).collect::<String>();
    let odd_name = String::from_utf8_lossy(ODD_INPUTS);
    if text.contains(&*odd_name) {
        problems.push("prints control characters: those of a folder's name".into());
    }
    let text = text.replace(&*odd_name, INPUTS);
    if let Some(at) = text.find("panicked at") {
        let lines: Vec<&str> = text[at..].lines().take(2).collect();
        problems.push(format!("panicked: {}", short(&lines.join(" "))));
    }
    let odd = |c: char| c.is_control() && c != '\n' && c != '\t';
    if let Some(line) = text.lines().find(|line| line.contains(odd)) {
        // From a little before the first.
        let at = line.find(odd).unwrap_or(0);
        let start = (0..=at.saturating_sub(QUOTED / 2)).rev().find(|at| line.is_char_boundary(*at));
        problems.push(format!("prints control characters: `{}`", short(&line[start.unwrap_or(0)..])));
    }
    if ran.ended != Ended::Code(0) && text.trim().is_empty() {
        problems.push("fails without a word".into());
    }
    problems
}

fn about_files(format: &Format, ran: &Ran, before: &Tree, after: &Tree) -> Vec<String> {
    let mut problems = Vec::new();
    let done = is_done(format, ran);
    let is_input = |path: &Path| {
        let first = path.components().next();
        // The folder of inputs may have another name that begins the same.
        matches!(first, Some(Component::Normal(name)) if name.to_string_lossy().starts_with(INPUTS))
    };
    let is_left = |path: &Path| format.kept.iter().any(|kept| path == Path::new(kept));
    for (path, entry) in before {
        let name = path.display().to_string().escape_debug().to_string();
        let what = if is_input(path) { "input" } else { "output of before" };
        match after.get(path) {
            // A success replaces its output.
            _ if done && !is_input(path) => {}
            None => problems.push(format!("{what} {name} is gone")),
            Some(now) if now != entry => problems.push(format!("{what} {name} was changed")),
            Some(_) => {}
        }
    }
    for (path, entry) in after.iter().filter(|(path, _)| !before.contains_key(*path)) {
        let text = path.display().to_string();
        let name = text.escape_debug();
        if UNFINISHED.iter().any(|part| text.contains(part)) {
            problems.push(format!("left {name} unfinished"));
        } else if is_input(path) {
            problems.push(format!("wrote {name} among its inputs"));
        } else if !done && *entry != Entry::Folder && !is_left(path) {
            problems.push(format!("wrote {name} though it failed"));
        }
    }
    problems
}
