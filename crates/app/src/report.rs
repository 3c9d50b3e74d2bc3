//! The folder that a report is written into, and what stands on top of it.

use std::fs;
use std::path::{Path, PathBuf};

use image::RgbImage;
use serde_json::Value;
use snapsnap_eval::report::{Header, today};

use crate::commands::check_outputs;
use crate::failure::Failure;
use crate::output;
use crate::pictures::{make_folder, write_png};

/// Files of one report.
pub struct ReportFolder {
    path: PathBuf,
}

impl ReportFolder {
    /// Refuses a folder into which `files` cannot be written, or where they would replace one of the `inputs`; makes it.
    pub fn new(path: &Path, files: &[&str], inputs: &[&Path]) -> Result<Self, Failure> {
        if path.exists() && !path.is_dir() {
            return Err(Failure::Input(format!("{}: exists and is no folder", path.display())));
        }
        let is_new = !path.exists();
        make_folder(path)?;
        let outputs: Vec<PathBuf> = files.iter().map(|name| path.join(name)).collect();
        let outputs: Vec<&Path> = outputs.iter().map(PathBuf::as_path).collect();
        if let Err(failure) = check_outputs(&outputs, inputs) {
            if is_new {
                let _ = fs::remove_dir(path);
            }
            return Err(failure);
        }
        Ok(Self { path: path.to_owned() })
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Writes text, or removes an older report's where there is none.
    pub fn text(&self, name: &str, text: &str) -> Result<(), Failure> {
        let path = self.path.join(name);
        if text.is_empty() { self.none(name) } else { output::write(&path, text.as_bytes()) }
    }

    /// Writes JSON.
    pub fn json(&self, name: &str, value: &Value) -> Result<(), Failure> {
        let text = serde_json::to_string_pretty(value).expect("a value") + "\n";
        self.text(name, &text)
    }

    /// Writes a picture, or removes an older report's.
    pub fn picture(&self, name: &str, picture: Option<&RgbImage>) -> Result<(), Failure> {
        match picture {
            Some(picture) => write_png(&self.path.join(name), picture),
            None => self.none(name),
        }
    }

    fn none(&self, name: &str) -> Result<(), Failure> {
        let path = self.path.join(name);
        match fs::remove_file(&path) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Failure::cannot_write(&path, &e)),
            _ => Ok(()),
        }
    }
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
