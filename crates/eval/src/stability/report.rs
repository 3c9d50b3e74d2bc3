//! The table of stability.

use std::fmt::Write;

use serde_json::{Value, json};

use super::Row;
use crate::report::{Header, table_markdown};

fn count(rows: &[Row], verdict: &str) -> usize {
    rows.iter().filter(|row| row.verdict == verdict).count()
}

/// `report.json`.
pub fn json(header: &Header, rows: &[Row]) -> Value {
    let mut report = header.json();
    for verdict in ["holds", "fails", "skipped"] {
        report[verdict] = json!(count(rows, verdict));
    }
    report["cases"] = json!(rows);
    report
}

/// `report.md`.
pub fn markdown(header: &Header, rows: &[Row]) -> String {
    let mut text = header.markdown("Stability");
    let _ = writeln!(
        text,
        "* {} hold, {} fail, {} were skipped\n\nErrors against f64: of values as defined by the case, of gradients relative; limits in \
         brackets.\n",
        count(rows, "holds"),
        count(rows, "fails"),
        count(rows, "skipped")
    );
    let error = |error: Option<f64>, limit: f64| match error {
        Some(0.0) => format!("0 ({limit:.1e})"),
        Some(error) => format!("{error:.1e} ({limit:.1e})"),
        None => String::new(),
    };
    let cells = |row: &Row| {
        vec![
            row.case.input.clone(),
            row.device.clone(),
            row.case.holds.clone(),
            error(row.value_error, row.case.value_limit),
            error(row.gradient_error, row.case.gradient_limit),
            format!("{:.0}", 1e3 * row.seconds),
            row.verdict.to_owned(),
            row.note.clone(),
        ]
    };
    let header = ["input", "device", "requirement", "values", "gradients", "ms", "verdict", ""];
    for rows in rows.chunk_by(|a, b| a.case.area == b.case.area) {
        let table = table_markdown(&header, rows.iter().map(cells));
        let _ = write!(text, "\n## {}\n\n{table}", rows[0].case.area);
    }
    text
}
