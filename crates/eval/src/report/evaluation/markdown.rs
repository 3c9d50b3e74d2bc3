//! The report of an evaluation, for people.

use std::fmt::Write;

use super::{Cost, Evaluation, FIGURES, Grouped, point_means, seconds, surface_intervals};
use crate::evaluate::{Judged, Kind};
use crate::points::VIEWS;
use crate::report::{cell, escaped};
use crate::statistics::Interval;

impl Evaluation<'_> {
    /// `report.md`; `pictures` are files beside it.
    pub fn markdown(&self, pictures: &[&str]) -> String {
        let mut text = self.header.markdown("Evaluation");
        let _ = writeln!(text, "* LPIPS: {}", self.lpips);
        let people = self.outcome.people.len();
        let _ = writeln!(
            text,
            "* {people} people; {}; intervals: 95 %, bootstrap over people; SSIM and LPIPS × 100\n",
            self.outcome.pictures
        );
        for (i, protocol) in self.protocols() {
            let _ = writeln!(text, "## Protocol `{}`\n", protocol.name());
            let _ =
                writeln!(text, "| | people | views | PSNR, dB | SSIM | LPIPS |\n|---|---|---|---|---|---|");
            for judged in &self.outcome.judged {
                let people = self.people(judged, i);
                let row = table_row(&Self::overall(&people));
                let (name, n) = (escaped(&judged.name), people.len());
                let _ = writeln!(text, "| {name} | {n} | {} | {row} |", judged.rows.len());
            }
            let others: Vec<&Judged> =
                self.outcome.judged.iter().filter(|judged| judged.kind != Kind::Model).collect();
            if let Some(model) = self.model().filter(|_| !others.is_empty()) {
                let _ = writeln!(
                    text,
                    "\nDifferences, person by person, from {}:\n\n| | PSNR, dB | SSIM | LPIPS |\n|---|---|---|---|",
                    escaped(&model.name)
                );
                for judged in others {
                    let row = table_row(&Self::difference(judged, model, i));
                    let _ = writeln!(text, "| {} | {row} |", escaped(&judged.name));
                }
            }
            text.push('\n');
        }
        for (name, rows) in self.groups() {
            let _ = writeln!(
                text,
                "## Group `{}`\n\n| | protocol | people | PSNR, dB | SSIM | LPIPS |\n|---|---|---|---|---|---|",
                escaped(&name)
            );
            for Grouped { contestant, protocol, people, figures } in rows {
                let row = table_row(&figures);
                let _ =
                    writeln!(text, "| {} | {} | {people} | {row} |", escaped(&contestant), protocol.name());
            }
            text.push('\n');
        }
        self.geometry_markdown(&mut text);
        for picture in pictures {
            let _ = writeln!(text, "![{picture}]({picture})\n");
        }
        let shown: Vec<String> = self
            .ranked(self.config.report.people)
            .iter()
            .map(|row| escaped(&self.outcome.people[*row]))
            .collect();
        if !shown.is_empty() && !pictures.is_empty() {
            let degrees: Vec<String> = self.config.report.degrees.iter().map(|d| format!("{d}°")).collect();
            let _ = writeln!(
                text,
                "Pictures: {}, from the best to the worst. Both photographs, then at {} what the model shows, what is true, and their \
                 mean absolute difference from 0 (black) to ½ (white), in the paper's window.\n",
                shown.join(", "),
                degrees.join(", ")
            );
        }
        if !self.outcome.left_out.is_empty() {
            let _ = writeln!(text, "## Left out: {}\n", self.outcome.left_out.len());
            for left_out in &self.outcome.left_out {
                let _ = writeln!(text, "* {}: {}", escaped(&left_out.name), escaped(&left_out.why));
            }
        }
        text
    }

    fn cost_markdown(&self) -> String {
        let views = self.outcome.judged.iter().map(|judged| judged.rows.len()).max().unwrap_or(0);
        let Cost { seconds, memory } = self.cost;
        let memory =
            memory.map_or(String::new(), |bytes| format!(", {} MB of memory at most", bytes / 1_000_000));
        format!(
            "All of it: {seconds:.1} s, {:.3} s a person and view{memory}.",
            seconds / views.max(1) as f64
        )
    }

    fn geometry_markdown(&self, text: &mut String) {
        let made: Vec<&Judged> = self.outcome.judged.iter().filter(|j| !j.gaussians.is_empty()).collect();
        let with_points: Vec<&&Judged> = made.iter().filter(|judged| !judged.points.is_empty()).collect();
        if !with_points.is_empty() {
            let _ = writeln!(
                text,
                "## Points\n\nMean distance from the true points, mm; in brackets after the mean shift of each person's front and back is \
                 removed; then the share of points where nothing was predicted.\n\n\
                 | | front | back | right | left |\n|---|---|---|---|---|"
            );
            for judged in with_points {
                let cells = (0..VIEWS.len()).map(|view| match point_means(judged, view) {
                    Some([mean, centred, missed]) => {
                        format!("{mean:.1} ({centred:.1}), {:.1} %", 100.0 * missed)
                    }
                    None => "n/a".into(),
                });
                let _ = writeln!(
                    text,
                    "| {} | {} |",
                    escaped(&judged.name),
                    cells.collect::<Vec<_>>().join(" | ")
                );
            }
            text.push('\n');
        }
        let centres = made.iter().map(|judged| (judged.name.clone(), &judged.surface));
        let meshes = made.iter().map(|judged| (format!("{}, mesh", judged.name), &judged.mesh));
        let surfaces: Vec<_> = centres.chain(meshes).filter(|(_, found)| !found.is_empty()).collect();
        if !surfaces.is_empty() {
            let _ = writeln!(
                text,
                "## Surface\n\nCentres of the Gaussians at least {} opaque against the true points of all views, in the world as it is \
                 (nothing is aligned), and points drawn from the meshes made of them, cm; normals: mean cosine from the views nearest to \
                 0, 90, 180 and 270°, in maps of 256² at most.\n\n\
                 | | to the truth | from the truth | Chamfer | normals |\n|---|---|---|---|---|",
                self.config.metrics.opaque
            );
            for (name, found) in surfaces {
                let [forward, backward, mean, normals] = surface_intervals(found);
                let cells = [
                    cell(forward, 1.0, 2),
                    cell(backward, 1.0, 2),
                    cell(mean, 1.0, 2),
                    cell(normals, 1.0, 3),
                ];
                let _ = writeln!(text, "| {} | {} |", escaped(&name), cells.join(" | "));
            }
            text.push('\n');
        }
        let _ = writeln!(
            text,
            "## Run time\n\n{}\n\nBy model: from the photographs on their canvas to the Gaussians, without rendering, in turn with all that is compared; `bench` measures.\n\n| | seconds a person, p50 | p95 | Gaussians |\n|---|---|---|---|",
            self.cost_markdown()
        );
        for judged in made {
            let (p50, p95) = seconds(judged)
                .map_or(("n/a".into(), "n/a".into()), |[a, b]| (format!("{a:.3}"), format!("{b:.3}")));
            let n = judged.gaussians.iter().sum::<usize>() / judged.gaussians.len();
            let _ = writeln!(text, "| {} | {p50} | {p95} | {n} |", escaped(&judged.name));
        }
        text.push('\n');
    }
}

fn table_row(intervals: &[Option<Interval>; 3]) -> String {
    let cells = FIGURES.iter().zip(intervals).map(|((.., times, digits), i)| cell(*i, *times, *digits));
    cells.collect::<Vec<_>>().join(" | ")
}
