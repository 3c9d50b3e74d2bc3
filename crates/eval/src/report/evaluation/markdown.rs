//! The Markdown report of an evaluation.

use std::fmt::Write;

use super::{
    Cost, Evaluation, FIGURES, alignment_means, part_means, point_means, seconds, surface_intervals,
};
use crate::evaluate::{Judged, Kind, Surface, by_person};
use crate::geometry::{Align, OPAQUE};
use crate::parts::PARTS;
use crate::points::VIEWS;
use crate::report::{cell, escaped, left_out_markdown, table_markdown};
use crate::statistics::Interval;

/// Titles of the figures of a score.
const TITLES: [&str; 3] = ["PSNR, dB", "SSIM", "LPIPS"];

impl Evaluation<'_> {
    /// `report.md`; `pictures` are names of files in the same folder.
    pub fn markdown(&self, pictures: &[&str]) -> String {
        let mut text = self.header.markdown("Evaluation");
        let _ = writeln!(text, "* LPIPS: {}", self.lpips);
        let people = self.outcome.people.len();
        let _ = writeln!(
            text,
            "* {people} people; {}; intervals: 95 %, bootstrap over people; SSIM and LPIPS × 100; sides: the views from 45° to 135°\n",
            self.outcome.pictures
        );
        self.alignment_markdown(&mut text);
        for (i, protocol) in self.protocols() {
            let row = |judged: &Judged| {
                let people = by_person(judged.rows.iter(), i);
                let counts = [people.len().to_string(), judged.rows.len().to_string()];
                let sides = cell(Self::sides(judged, i), 1.0, 2);
                [scores(&judged.name, counts, &Self::overall(&people)), vec![sides]].concat()
            };
            let header = [&["", "people", "views"][..], &TITLES, &["PSNR of the sides, dB"]].concat();
            let table = table_markdown(&header, self.outcome.judged.iter().map(row));
            let _ = writeln!(text, "## Protocol `{}`\n\n{table}", protocol.name());
            let others = self.outcome.judged.iter().filter(|judged| judged.kind != Kind::Model);
            if let Some(model) = self.model().filter(|_| others.clone().next().is_some()) {
                let row = |judged: &Judged| scores(&judged.name, [], &Self::difference(judged, model, i));
                let table = table_markdown(&[&[""][..], &TITLES].concat(), others.map(row));
                let name = escaped(&model.name);
                let _ = writeln!(text, "Differences, person by person, from {name}:\n\n{table}");
            }
        }
        self.photographs_markdown(&mut text);
        self.geometry_markdown(&mut text);
        for picture in pictures {
            let _ = writeln!(text, "![{picture}]({picture})\n");
        }
        let ranked = self.ranked(self.config.report.people);
        let shown: Vec<String> = ranked.iter().map(|row| escaped(&self.outcome.people[*row])).collect();
        if !shown.is_empty() && !pictures.is_empty() {
            let degrees: Vec<String> = self.config.report.degrees.iter().map(|d| format!("{d}°")).collect();
            let _ = writeln!(
                text,
                "Pictures: {}, from the best to the worst. Both photographs, then at {} the model's picture, the ground truth, and their \
                 mean absolute difference from 0 (black) to ½ (white), in the paper's window.\n",
                shown.join(", "),
                degrees.join(", ")
            );
        }
        text.trim_end().to_owned() + "\n" + &left_out_markdown(&self.outcome.left_out)
    }

    /// How models were moved before anything was measured.
    fn alignment_markdown(&self, text: &mut String) {
        let align = self.config.metrics.align;
        if align == Align::None {
            return;
        }
        let moved = self.outcome.judged.iter().filter(|judged| !judged.aligned.is_empty());
        let row = |judged: &Judged| {
            let means = alignment_means(judged).map(|[degrees, cm, scale]| {
                [format!("{degrees:.1}"), format!("{cm:.1}"), format!("{scale:.3}")]
            });
            [vec![judged.name.clone()], means.unwrap_or_default().into()].concat()
        };
        let _ = writeln!(
            text,
            "## Alignment\n\nEvery model was aligned with the ground truth before anything was measured ({}); baselines were not. Means of \
             rotation in degrees, motion of the middle in cm, and scale:\n\n{}",
            align.description(),
            table_markdown(&["", "degrees", "cm", "scale"], moved.map(row))
        );
    }

    /// What the photographs' backgrounds left in the people.
    fn photographs_markdown(&self, text: &mut String) {
        let found = self.outcome.judged.iter().map(|judged| (judged, Self::photographs(judged)));
        let found = found.filter(|(_, shares)| shares.iter().any(Option::is_some));
        let row = |(judged, [masks, foreign, beside]): (&Judged, [Option<Interval>; 3])| {
            let shares = [foreign, beside].map(|share| cell(share, 100.0, 2));
            [vec![judged.name.clone(), cell(masks, 1.0, 4)], shares.into()].concat()
        };
        section(
            text,
            "## Photographs\n\nIoU of the cut-outs and the true masks. In the views from 45° to 135°, pixels in a colour of the background \
             instead of the person's, and pixels that show something outside of the grown true mask, as shares of the \
             person's pixels.",
            &["", "IoU of the masks", "foreign colour, %", "beside the person, %"],
            found.map(row),
        );
    }

    fn geometry_markdown(&self, text: &mut String) {
        let made: Vec<&Judged> = self.outcome.judged.iter().filter(|j| !j.gaussians.is_empty()).collect();
        let with_points = made.iter().filter(|judged| !judged.points.is_empty());
        let row = |judged: &&Judged| {
            let views = (0..VIEWS.len()).map(|view| match point_means(judged, view) {
                Some([mean, centred, missed]) => format!("{mean:.1} ({centred:.1}), {:.1} %", 100.0 * missed),
                None => "n/a".into(),
            });
            [judged.name.clone()].into_iter().chain(views).collect()
        };
        section(
            text,
            "## Points\n\nMean distance from the ground-truth points, mm; in brackets after the mean shift of each person's front and \
             back is removed; then the share of ground-truth points without a prediction.",
            &[&[""][..], &VIEWS].concat(),
            with_points.map(row),
        );
        let with_parts = made.iter().filter(|judged| !judged.parts.is_empty());
        let row = |judged: &&Judged| {
            let shown = |figure: Option<f64>| figure.map_or("n/a".into(), |figure| format!("{figure:.1}"));
            let parts = (0..PARTS.len()).map(|part| {
                let [relief, normals, far] = part_means(judged, part).map(shown);
                format!("{relief}, {normals}°, {far} %")
            });
            [judged.name.clone()].into_iter().chain(parts).collect()
        };
        section(
            text,
            "## Parts of the body\n\nIn the photographs: mean distance in mm from the ground-truth points after the part's median shift \
             is removed; mean angle between the normals; share of points that are 4 cm or more away, which the mean leaves out.",
            &[&[""][..], &PARTS].concat(),
            with_parts.map(row),
        );
        let centres = made.iter().map(|judged| (judged.name.clone(), &judged.surface));
        let meshes = made.iter().map(|judged| (format!("{}, mesh", judged.name), &judged.mesh));
        let surfaces = centres.chain(meshes).filter(|(_, found)| !found.is_empty());
        let row = |(name, found): (String, &Vec<Surface>)| {
            let [forward, backward, mean, normals, open] = surface_intervals(found);
            let distances = [forward, backward, mean].map(|distance| cell(distance, 1.0, 2));
            [vec![name], distances.into(), vec![cell(normals, 1.0, 3), cell(open, 100.0, 2)]].concat()
        };
        let about = format!(
            "## Surface\n\nDistances in cm between the ground-truth points of all views and the centres of the \
             Gaussians with an opacity of at least {OPAQUE}, or points drawn from the meshes of the Gaussians; normals: mean cosine from \
             the views nearest to 0, 90, 180 and 270°, in maps of 256² at most; open: share of the person's pixels that are covered by \
             less than 90 % or show a surface more than 6 cm behind the true one, from the views nearest to every 45°, without the rim \
             and without steps of the true depth."
        );
        let header = ["", "to the truth", "from the truth", "Chamfer", "normals", "open, %"];
        section(text, &about, &header, surfaces.map(row));
        let row = |judged: &Judged| {
            let times =
                seconds(judged).map_or(["n/a".into(), "n/a".into()], |p| p.map(|s| format!("{s:.3}")));
            let mean = judged.gaussians.iter().sum::<usize>() / judged.gaussians.len();
            [vec![judged.name.clone()], times.into(), vec![mean.to_string()]].concat()
        };
        let views = self.outcome.judged.iter().map(|judged| judged.rows.len()).max().unwrap_or(0);
        let Cost { seconds, memory } = self.cost;
        let memory =
            memory.map_or(String::new(), |bytes| format!(", {} MB of memory at most", bytes / 1_000_000));
        let _ = writeln!(
            text,
            "## Run time\n\nIn all: {seconds:.1} s, {:.3} s a person and view{memory}.\n\nBy model: from the photographs on their canvas \
             to the Gaussians, without rendering. `bench` measures more exactly.\n\n{}",
            seconds / views.max(1) as f64,
            table_markdown(&["", "seconds a person, p50", "p95", "Gaussians"], made.into_iter().map(row))
        );
    }
}

/// A heading, what a table shows, and the table, unless it is empty.
fn section(text: &mut String, about: &str, header: &[&str], rows: impl Iterator<Item = Vec<String>>) {
    let mut rows = rows.peekable();
    if rows.peek().is_some() {
        let _ = writeln!(text, "{about}\n\n{}", table_markdown(header, rows));
    }
}

/// A row of a table of scores.
fn scores<const N: usize>(name: &str, counts: [String; N], intervals: &[Option<Interval>; 3]) -> Vec<String> {
    let figures = FIGURES.iter().zip(intervals).map(|((.., times, digits), i)| cell(*i, *times, *digits));
    [name.to_owned()].into_iter().chain(counts).chain(figures).collect()
}
