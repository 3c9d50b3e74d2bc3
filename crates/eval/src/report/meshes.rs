//! The report of meshes.

use std::fmt::Write;

use serde_json::{Value, json};

use super::{Header, cell, escaped};
use crate::evaluate::LeftOut;
use crate::evaluate::meshes::MeshFigures;
use crate::statistics::{Interval, interval};

type Figure = (&'static str, &'static str, fn(&MeshFigures) -> Option<f64>);
const FIGURES: [Figure; 6] = [
    ("to_truth", "mesh → truth, cm", |f| Some(f.to_truth)),
    ("from_truth", "truth → mesh, cm", |f| Some(f.from_truth)),
    ("chamfer", "Chamfer (mean of both), cm", |f| Some(f.chamfer)),
    ("truth_to_surface", "truth → triangles of the mesh, cm", |f| Some(f.truth_to_surface)),
    ("surface_to_scan", "mesh → triangles of the scan, cm", |f| f.surface_to_scan),
    ("normal_consistency", "normals, mean cosine", |f| f.normal_consistency),
];

/// Over the people who have it.
fn overall(figures: &[MeshFigures], of: fn(&MeshFigures) -> Option<f64>) -> Option<Interval> {
    interval(&figures.iter().filter_map(of).collect::<Vec<f64>>())
}

/// `report.json`.
pub fn json(header: &Header, figures: &[MeshFigures], left_out: &[LeftOut]) -> Value {
    let mut report = header.json();
    let entries = FIGURES.iter().map(|(key, _, of)| ((*key).to_owned(), json!(overall(figures, *of))));
    report["geometry_cm"] = Value::Object(entries.collect());
    report["people"] = json!(figures.len());
    report["subjects"] = json!(figures);
    report["left_out"] = json!(left_out);
    report
}

/// `report.md`.
pub fn markdown(header: &Header, figures: &[MeshFigures], left_out: &[LeftOut], alignment: &str) -> String {
    let mut text = header.markdown("Meshes");
    let people = figures.len();
    let _ = writeln!(
        text,
        "* {people} people; intervals: 95 %, bootstrap over people\n* Alignment: {alignment}\n"
    );
    let _ = writeln!(text, "| | |\n|---|---|");
    for (key, title, of) in FIGURES {
        let digits = if key == "normal_consistency" { 4 } else { 3 };
        let _ = writeln!(text, "| {title} | {} |", cell(overall(figures, of), 1.0, digits));
    }
    if !left_out.is_empty() {
        let _ = writeln!(text, "\n## Left out: {}\n", left_out.len());
        for LeftOut { name, why } in left_out {
            let _ = writeln!(text, "* {}: {}", escaped(name), escaped(why));
        }
    }
    text
}
