//! Reports: JSON with stable keys, Markdown for people, tables and pictures.

pub mod evaluation;
pub mod meshes;

use serde_json::{Value, json};
use time::OffsetDateTime;

use crate::evaluate::LeftOut;
use crate::statistics::Interval;

/// The first lines of every report.
#[derive(Debug, Clone)]
pub struct Header {
    /// The command line.
    pub command: String,
    /// Commit of the program.
    pub commit: String,
    /// Name of the device.
    pub device: String,
    /// UTC, `YYYY-MM-DD`.
    pub date: String,
}

impl Header {
    /// The first four keys of a report.
    pub fn json(&self) -> Value {
        json!({ "command": self.command, "commit": self.commit, "device": self.device, "date": self.date })
    }

    /// The first lines of a Markdown report.
    pub fn markdown(&self, title: &str) -> String {
        format!(
            "# {title}\n\n* Command: `{}`\n* Commit: {}\n* Device: {}\n* Date: {}\n",
            self.command, self.commit, self.device, self.date
        )
    }
}

/// Today, UTC, `YYYY-MM-DD`.
pub fn today() -> String {
    OffsetDateTime::now_utc().date().to_string()
}

/// A cell of a Markdown table: a figure with its interval, multiplied by `times`.
pub fn cell(interval: Option<Interval>, times: f64, digits: usize) -> String {
    match interval {
        None => "n/a".into(),
        Some(Interval { mean, .. }) if mean.is_nan() => "n/a".into(),
        Some(Interval { mean, .. }) if mean.is_infinite() => if mean > 0.0 { "∞" } else { "−∞" }.into(),
        // One person has no spread.
        Some(Interval { mean, low, high }) if low == high => format!("{:.digits$}", mean * times),
        Some(Interval { mean, low, high }) => {
            let [mean, low, high] = [mean, low, high].map(|v| format!("{:.digits$}", v * times));
            format!("{mean} [{low}, {high}]")
        }
    }
}

/// A table as CSV.
///
/// # Panics
/// If a row is not as long as the header.
pub fn table(header: &[&str], rows: impl Iterator<Item = Vec<String>>) -> String {
    let mut table = csv::Writer::from_writer(Vec::new());
    table.write_record(header).expect("memory takes any record");
    rows.for_each(|row| table.write_record(row).expect("as long as the header"));
    let bytes = table.into_inner().expect("memory can be written");
    String::from_utf8(bytes).expect("made of text")
}

/// A cell of a CSV table; an absent figure is empty.
pub fn number(figure: Option<f64>) -> String {
    figure.map_or(String::new(), |v| v.to_string())
}

/// The section of failures, if there are any.
pub fn left_out_markdown(left_out: &[LeftOut]) -> String {
    if left_out.is_empty() {
        return String::new();
    }
    let line = |LeftOut { name, why }: &LeftOut| format!("* {}: {}\n", escaped(name), escaped(why));
    let lines: String = left_out.iter().map(line).collect();
    format!("\n## Left out: {}\n\n{lines}", left_out.len())
}

/// A Markdown table.
pub fn table_markdown(header: &[&str], rows: impl Iterator<Item = Vec<String>>) -> String {
    let line = |row: Vec<String>| {
        let cells: Vec<String> = row.iter().map(|cell| escaped(cell)).collect();
        format!("| {} |\n", cells.join(" | "))
    };
    let (titles, rule) = (header.join(" | "), "---|".repeat(header.len()));
    format!("| {titles} |\n|{rule}\n{}", rows.map(line).collect::<String>())
}

/// Text within a Markdown table.
pub fn escaped(text: &str) -> String {
    text.replace('|', "\\|").replace(['\n', '\r'], " ")
}
