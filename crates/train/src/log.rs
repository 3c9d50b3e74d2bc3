//! Logs of a run: `log.jsonl`, TensorBoard's events and curves.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use snapsnap_base::plot::{Axes, Series, svg};
use snapsnap_base::{FileError, file};

use crate::events::Events;

/// Name of the log's file.
pub const NAME: &str = "log.jsonl";
/// Name of TensorBoard's file.
pub const EVENTS: &str = "events.out.tfevents.snapsnap";
/// Longest log that is read, in bytes.
const MOST_BYTES: u64 = 1 << 30;

/// Folder of previews, named by their steps.
pub const PREVIEWS: &str = "previews";

/// One line of `log.jsonl`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Line {
    /// Steps so far.
    pub step: u64,
    /// Seconds of training so far, all sessions together.
    pub seconds: f64,
    /// Measurements by name: parts of the loss, learning rate and gradient norm, or, as `validation/…`, those of a
    /// validation.
    pub values: BTreeMap<String, f64>,
}

/// The logs of a run.
pub struct Log {
    path: PathBuf,
    file: File,
    events: Events,
    /// All lines so far.
    lines: Vec<Line>,
}

impl Log {
    /// Begins the logs of the run in `folder`, or continues them after step `step`. Later lines of a killed session are
    /// dropped.
    ///
    /// # Errors
    /// [`FileError`] if a file cannot be read or written.
    pub fn open(folder: &Path, step: u64) -> Result<Self, FileError> {
        let path = folder.join(NAME);
        let (mut lines, mut kept) = (Vec::new(), String::new());
        if step > 0 && path.exists() {
            let text = file::read_text(&path, MOST_BYTES).map_err(FileError::read(&path))?;
            // The last line of a killed session may be incomplete.
            for line in text.lines() {
                if let Some(read) = serde_json::from_str(line).ok().filter(|read: &Line| read.step <= step) {
                    lines.push(read);
                    kept.extend([line, "\n"]);
                }
            }
        }
        file::write_whole(&path, |out| out.write_all(kept.as_bytes())).map_err(FileError::write(&path))?;
        let appended = OpenOptions::new().append(true).open(&path).map_err(FileError::write(&path))?;
        let events_path = folder.join(EVENTS);
        let mut events = Events::create(&events_path).map_err(FileError::write(&events_path))?;
        for line in &lines {
            events.add(line.step, &line.values).map_err(FileError::write(&events_path))?;
        }
        for (at, path) in previews(&folder.join(PREVIEWS), step) {
            // A missing or damaged preview does not stop the run.
            if let (Ok(size), Ok(png)) = (image::image_dimensions(&path), std::fs::read(&path)) {
                events.add_preview(at, size, &png).map_err(FileError::write(&events_path))?;
            }
        }
        Ok(Self { path, file: appended, events, lines })
    }

    /// Seconds of training before this session.
    pub fn seconds(&self) -> f64 {
        self.lines.last().map_or(0.0, |line| line.seconds)
    }

    /// An SVG of the loss over the steps and, below it, of the score by which validations choose the best weights. It
    /// is empty without values.
    pub fn curves(&self) -> String {
        let chart = |caption: &'static str, y: &'static str, name: &str, log_y: bool| {
            let values =
                self.lines.iter().filter_map(|line| Some((line.step as f64, *line.values.get(name)?)));
            let points: Vec<_> = values.collect();
            let axes = Axes { caption, x: "step", y, log_x: false, log_y };
            (!points.is_empty()).then(|| (axes, vec![Series { name: name.into(), points, line: true }]))
        };
        let charts = [
            chart("training: loss (less is better)", "loss, without unit", "loss", true),
            chart("held-out people: error of points (less is better)", "mm", "validation/points_mm", true),
            chart(
                "held-out people: PSNR of the person (more is better)",
                "dB",
                "validation/psnr_masked",
                false,
            ),
        ];
        svg(&charts.into_iter().flatten().collect::<Vec<_>>())
    }

    /// Adds a preview to TensorBoard's events.
    ///
    /// # Errors
    /// [`FileError`] if the file cannot be written.
    pub fn add_preview(&mut self, step: u64, size: (u32, u32), png: &[u8]) -> Result<(), FileError> {
        let path = self.path.with_file_name(EVENTS);
        self.events.add_preview(step, size, png).map_err(FileError::write(&path))
    }

    /// Adds a line.
    ///
    /// # Errors
    /// [`FileError`] if a file cannot be written.
    pub fn add(&mut self, line: Line) -> Result<(), FileError> {
        let text = serde_json::to_string(&line).expect("plain numbers") + "\n";
        let written =
            self.events.add(line.step, &line.values).and_then(|()| self.file.write_all(text.as_bytes()));
        written.map_err(FileError::write(&self.path))?;
        self.lines.push(line);
        Ok(())
    }
}

/// Previews of a run up to a step, in order.
fn previews(folder: &Path, last: u64) -> Vec<(u64, PathBuf)> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    let step = |path: &PathBuf| path.file_stem()?.to_str()?.parse::<u64>().ok().filter(|step| *step <= last);
    let pictures = entries.filter(|path| path.extension().is_some_and(|end| end == "png") && path.is_file());
    let mut found: Vec<_> = pictures.filter_map(|path| Some((step(&path)?, path))).collect();
    found.sort();
    found
}
