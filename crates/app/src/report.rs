//! The folder that a report is written into, and what stands on top of it.

use std::cell::RefCell;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use image::RgbImage;
use serde_json::Value;
use snapsnap_base::file;
use snapsnap_eval::report::{Header, today};

use crate::commands::check_outputs;
use crate::failure::Failure;
use crate::output;
use crate::pictures::{make_folder, write_png};

/// Files that reports on figures have, of whatever command.
const FILES: &[&str] = &[
    "report.md",
    "config.toml",
    "people.png",
    "by_view.svg",
    "views.csv",
    "subjects.csv",
    "settings.csv",
    "pareto.svg",
    "training_points.svg",
    "training_pictures.svg",
    REPORT,
];
/// By which a report is known; written last.
pub const REPORT: &str = "report.json";
/// Longest one that is looked into.
const MOST: u64 = 256 << 20;

/// Files of one report.
pub struct ReportFolder {
    path: PathBuf,
    /// All that there can be.
    files: &'static [&'static str],
    is_new: bool,
    written: RefCell<Vec<String>>,
}

impl ReportFolder {
    /// Makes the folder. Refuses one where a report's files cannot be written, or would replace one of the `inputs` or anything
    /// but an older report's.
    pub fn new(path: &Path, inputs: &[&Path]) -> Result<Self, Failure> {
        Self::of(path, FILES, inputs)
    }

    /// The same for a report with files of its own; the last is [`REPORT`].
    pub fn of(path: &Path, files: &'static [&'static str], inputs: &[&Path]) -> Result<Self, Failure> {
        if path.exists() && !path.is_dir() {
            return Err(Failure::Input(format!("{}: exists and is no folder", path.display())));
        }
        let is_new = !path.exists();
        make_folder(path)?;
        let folder = Self { path: path.to_owned(), files, is_new, written: RefCell::default() };
        let outputs: Vec<PathBuf> = files.iter().map(|name| path.join(name)).collect();
        let there = outputs.iter().find(|file| file.symlink_metadata().is_ok());
        if let Some(file) = there.filter(|_| !is_report(path)) {
            let message = "exists and belongs to no report of this program: give another folder";
            return Err(Failure::Input(format!("{}: {message}", file.display())));
        }
        let outputs: Vec<&Path> = outputs.iter().map(PathBuf::as_path).collect();
        check_outputs(&outputs, inputs)?;
        Ok(folder)
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Writes text, if there is any.
    pub fn text(&self, name: &str, text: &str) -> Result<(), Failure> {
        if text.is_empty() {
            return Ok(());
        }
        output::write(&self.file(name), text.as_bytes())
    }

    /// Writes a picture, if there is one.
    pub fn picture(&self, name: &str, picture: Option<&RgbImage>) -> Result<(), Failure> {
        picture.map_or(Ok(()), |picture| write_png(&self.file(name), picture))
    }

    /// Writes the report's JSON, and removes what an older report had and this one has not.
    pub fn finish(&self, value: &Value) -> Result<(), Failure> {
        let text = serde_json::to_string_pretty(value).expect("a value") + "\n";
        self.text(REPORT, &text)?;
        let written = self.written.borrow();
        for name in self.files.iter().filter(|name| !written.iter().any(|there| there == *name)) {
            let path = self.path.join(name);
            match fs::remove_file(&path) {
                Err(e) if e.kind() != io::ErrorKind::NotFound => {
                    return Err(Failure::cannot_write(&path, &e));
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// A file that the caller writes.
    pub fn file(&self, name: &str) -> PathBuf {
        assert!(self.files.contains(&name), "{name}");
        self.written.borrow_mut().push(name.to_owned());
        self.path.join(name)
    }
}

impl Drop for ReportFolder {
    /// An empty folder is nothing to leave behind.
    fn drop(&mut self) {
        if self.is_new {
            let _ = fs::remove_dir(&self.path);
        }
    }
}

/// Whether a folder holds a report of ours.
fn is_report(folder: &Path) -> bool {
    let text = file::read_text(&folder.join(REPORT), MOST).unwrap_or_default();
    let report: Value = serde_json::from_str(&text).unwrap_or_default();
    report["command"].as_str().is_some_and(|command| command.starts_with("snapsnap "))
        && !report["commit"].is_null()
}

/// The command line as it was typed, program and all.
pub fn header(device: &str) -> Header {
    let words = std::env::args_os().skip(1).map(|word| {
        let word = word.to_string_lossy().into_owned();
        let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=:,+@%".contains(c);
        if !word.is_empty() && word.chars().all(plain) { word } else { format!("{word:?}") }
    });
    Header {
        command: format!("snapsnap {}", words.collect::<Vec<_>>().join(" ")),
        commit: env!("SNAPSNAP_COMMIT").into(),
        device: device.into(),
        date: today(),
    }
}
