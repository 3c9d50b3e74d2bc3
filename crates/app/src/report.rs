//! Folders and headers of reports, and the errors of incomplete reports.

use std::cell::RefCell;
use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;
use snapsnap_base::file;
use snapsnap_eval::evaluate::LeftOut;
use snapsnap_eval::report::{Header, today};

use crate::failure::Failure;
use crate::output::{self, check_folder, check_outputs, make_folder};
use crate::say;

/// Files of the reports of all commands but `demo`.
const FILES: &[&str] = &[
    "report.md",
    "config.toml",
    "people.png",
    "by_view.svg",
    "views.csv",
    "settings.csv",
    "pareto.svg",
    "training_points.svg",
    "training_pictures.svg",
    REPORT,
];
/// The file that marks a folder as a report. It is written last.
pub const REPORT: &str = "report.json";
/// Largest size of [`REPORT`] in bytes.
const MOST: u64 = 256 << 20;

/// Files of one report.
pub struct ReportFolder {
    pub path: PathBuf,
    /// All possible files.
    files: &'static [&'static str],
    is_new: bool,
    written: RefCell<Vec<String>>,
}

impl ReportFolder {
    /// Makes the folder. Refuses folders in which the report's files cannot be written, or would replace one of the
    /// `inputs` or a file that is not part of an older report.
    pub fn new(path: &Path, inputs: &[&Path]) -> Result<Self, Failure> {
        Self::of(path, FILES, inputs)
    }

    /// [`ReportFolder::new`] for a report with other files, the last of which is [`REPORT`].
    pub fn of(path: &Path, files: &'static [&'static str], inputs: &[&Path]) -> Result<Self, Failure> {
        check_folder(path)?;
        let is_new = !path.exists();
        make_folder(path)?;
        let folder = Self { path: path.to_owned(), files, is_new, written: RefCell::default() };
        let outputs: Vec<PathBuf> = files.iter().map(|name| path.join(name)).collect();
        let there = outputs.iter().find(|file| file.symlink_metadata().is_ok());
        if let Some(file) = there.filter(|_| !is_report(path)) {
            let message = "exists and belongs to no report of this program: give another folder";
            return Err(Failure::file(file, message));
        }
        let outputs: Vec<&Path> = outputs.iter().map(PathBuf::as_path).collect();
        check_outputs(&outputs, inputs)?;
        Ok(folder)
    }

    /// Writes a text unless it is empty.
    pub fn text(&self, name: &str, text: &str) -> Result<(), Failure> {
        if text.is_empty() {
            return Ok(());
        }
        output::write(&self.file(name), text.as_bytes())
    }

    /// Writes the report's JSON, and removes files that only an older report contained.
    pub fn finish(&self, value: &Value) -> Result<(), Failure> {
        let text = serde_json::to_string_pretty(value).expect("a value") + "\n";
        self.text(REPORT, &text)?;
        let written = self.written.borrow();
        let mut older = self.files.iter().filter(|name| !written.iter().any(|file| file == *name));
        older.try_for_each(|name| output::remove(&self.path.join(name)))
    }

    /// Path of a file that the caller writes.
    pub fn file(&self, name: &str) -> PathBuf {
        assert!(self.files.contains(&name), "{name}");
        self.written.borrow_mut().push(name.to_owned());
        self.path.join(name)
    }
}

impl Drop for ReportFolder {
    /// Removes a new folder that is still empty.
    fn drop(&mut self) {
        if self.is_new {
            let _ = fs::remove_dir(&self.path);
        }
    }
}

/// Whether a folder contains a report of this program.
fn is_report(folder: &Path) -> bool {
    let text = file::read_text(&folder.join(REPORT), MOST).unwrap_or_default();
    let report: Value = serde_json::from_str(&text).unwrap_or_default();
    report["command"].as_str().is_some_and(|command| command.starts_with("snapsnap "))
        && !report["commit"].is_null()
}

/// The error of a command with failed parts, which are printed. `rest` describes the other parts.
pub fn complete(left_out: &[LeftOut], rest: &str) -> Result<(), Failure> {
    if left_out.is_empty() {
        return Ok(());
    }
    print_left_out(left_out);
    Err(Failure::Internal(format!("{} left out, {rest}", left_out.len())))
}

/// Prints the failed parts of a command.
pub fn print_left_out(left_out: &[LeftOut]) {
    for LeftOut { name, why, .. } in left_out {
        say::err(&format!("left out: {name}: {why}"));
    }
}

/// The error of a command without any successful part.
pub fn nothing_left(message: &str, left_out: &[LeftOut]) -> Failure {
    let whys: Vec<String> = left_out.iter().map(|l| format!("{}: {}", l.name, l.why)).collect();
    Failure::Input(format!("{message}: {}", whys.join("; ")))
}

/// A word or a path as a shell takes it.
pub fn quoted(word: &Path) -> String {
    let text = word.display().to_string();
    let is_plain = |c: char| c.is_alphanumeric() || "/._-+:=@%,".contains(c);
    if !text.is_empty() && text.chars().all(is_plain) {
        text
    } else {
        format!("'{}'", text.replace('\'', r"'\''"))
    }
}

/// The header of a report, with the command line of this process.
pub fn header(device: &str) -> Header {
    let words = std::env::args_os().skip(1).map(|word| quoted(word.as_ref()));
    Header {
        command: format!("snapsnap {}", words.collect::<Vec<_>>().join(" ")),
        commit: env!("SNAPSNAP_COMMIT").into(),
        device: device.into(),
        date: today(),
    }
}
