//! The table of stability.

use std::fmt::Write;

use serde_json::{Value, json};

use super::Row;
use crate::report::{Header, escaped};

/// `report.json`.
pub fn json(header: &Header, rows: &[Row]) -> Value {
    let mut report = header.json();
    let count = |verdict: &str| rows.iter().filter(|row| row.verdict == verdict).count();
    report["holds"] = json!(count("holds"));
    report["fails"] = json!(count("fails"));
    report["skipped"] = json!(count("skipped"));
    report["cases"] = json!(rows);
    report
}

/// `report.md`.
pub fn markdown(header: &Header, rows: &[Row]) -> String {
    let mut text = header.markdown("Stability");
    let count = |verdict: &str| rows.iter().filter(|row| row.verdict == verdict).count();
    let _ = writeln!(
        text,
        "* {} hold, {} fail, {} were skipped\n\nErrors against f64: of values as the case says, of gradients relative; in brackets what is \
         allowed.\n",
        count("holds"),
        count("fails"),
        count("skipped")
    );
    let mut area = "";
    for row in rows {
        if row.area != area {
            area = &row.area;
            let _ = writeln!(
                text,
                "\n## {area}\n\n| input | device | what must hold | values | gradients | ms | verdict | |\n|---|---|---|---|---|---|---|---|"
            );
        }
        let error = |error: Option<f64>, limit: f64| match error {
            Some(0.0) => format!("0 ({limit:.1e})"),
            Some(error) => format!("{error:.1e} ({limit:.1e})"),
            None => String::new(),
        };
        let _ = writeln!(
            text,
            "| {} | {} | {} | {} | {} | {:.0} | {} | {} |",
            escaped(&row.input),
            escaped(&row.device),
            escaped(&row.holds),
            error(row.value_error, row.value_limit),
            error(row.gradient_error, row.gradient_limit),
            1e3 * row.seconds,
            row.verdict,
            escaped(&row.note)
        );
    }
    text
}
