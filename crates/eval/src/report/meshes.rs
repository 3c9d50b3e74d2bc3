//! The report of meshes.

use std::fmt::Write;

use serde_json::{Value, json};

use super::{Header, cell, left_out_markdown, table_markdown};
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

/// A figure over the people who have it.
fn overall(figures: &[MeshFigures], of: fn(&MeshFigures) -> Option<f64>) -> Option<Interval> {
    interval(&figures.iter().filter_map(of).collect::<Vec<f64>>())
}

/// `report.json`.
pub fn json(header: &Header, figures: &[MeshFigures], left_out: &[LeftOut]) -> Value {
    let mut report = header.json();
    let entries = FIGURES.iter().map(|(key, _, of)| (*key, json!(overall(figures, *of))));
    report["geometry_cm"] = entries.collect();
    report["people"] = json!(figures.len());
    report["subjects"] = json!(figures);
    report["left_out"] = json!(left_out);
    report
}

/// `report.md`.
pub fn markdown(header: &Header, figures: &[MeshFigures], left_out: &[LeftOut], alignment: &str) -> String {
    let mut text = header.markdown("Meshes");
    let people = figures.len();
    let row = |(key, title, of): Figure| {
        let digits = if key == "normal_consistency" { 4 } else { 3 };
        vec![title.to_owned(), cell(overall(figures, of), 1.0, digits)]
    };
    let _ = writeln!(
        text,
        "* {people} people; intervals: 95 %, bootstrap over people\n* Alignment: {alignment}\n\n{}",
        table_markdown(&["", ""], FIGURES.into_iter().map(row))
    );
    text.trim_end().to_owned() + "\n" + &left_out_markdown(left_out)
}
