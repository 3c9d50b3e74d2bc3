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
        Ok(Self { path, file: appended, events, lines })
    }

    /// Seconds of training before this session.
    pub fn seconds(&self) -> f64 {
        self.lines.last().map_or(0.0, |line| line.seconds)
    }

    /// An SVG of the loss over the steps and, below it, of the validations' score. Empty without values.
    pub fn curves(&self) -> String {
        let chart = |caption: &'static str, y: &'static str, name: &str| {
            let values =
                self.lines.iter().filter_map(|line| Some((line.step as f64, *line.values.get(name)?)));
            let series = Series { name: name.into(), points: values.collect(), line: true };
            (Axes { caption, x: "step", y, log_x: false, log_y: true }, vec![series])
        };
        let scores = chart("validation (less is better)", "score", "validation/score");
        svg(&[chart("loss", "loss", "loss"), scores])
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
