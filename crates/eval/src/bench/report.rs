//! The report of a benchmark.

use std::fmt::Write;
use std::path::Path;

use serde_json::{Value, json};
use snapsnap_base::file;

use super::{Measured, dominated};
use crate::evaluate::LeftOut;
use crate::report::{Header, escaped, table};
use snapsnap_base::plot::{Axes, Series, svg};

/// Longest log of a training that is read.
const MOST: u64 = 256 << 20;

/// What validations of the two stages tell.
const POINTS: &str = "point error, mm";
const PICTURES: &str = "masked PSNR, dB";

/// What a report is made of.
pub struct Bench<'a> {
    /// Command, commit, device, date.
    pub header: Header,
    /// Settings, the model as it is first.
    pub measured: &'a [Measured],
    /// Settings that could not be measured.
    pub left_out: &'a [LeftOut],
    /// What LPIPS was computed with, or why there is none.
    pub lpips: String,
    /// Trainings: name, and seconds and masked PSNR or point error of their validations.
    pub training: &'a [Training],
}

/// A training's validations over its time.
pub struct Training {
    /// Its folder's name.
    pub name: String,
    /// What is validated.
    pub what: &'static str,
    /// Seconds, value.
    pub points: Vec<(f64, f64)>,
}

impl Training {
    /// Reads the log of a run.
    ///
    /// # Errors
    /// Why it cannot be read, or that it has no validation.
    pub fn read(run: &Path) -> Result<Self, String> {
        let path = run.join("log.jsonl");
        let wrong = |message: String| format!("{}: {message}", path.display());
        let text = file::read_text(&path, MOST).map_err(|e| wrong(format!("cannot read: {e}")))?;
        let lines: Vec<Value> = text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
        let of = |what: &'static str, key: &str| {
            let point = |line: &Value| Some((line["seconds"].as_f64()?, line["values"][key].as_f64()?));
            let points: Vec<(f64, f64)> = lines.iter().filter_map(point).collect();
            let name = run.file_name().unwrap_or_default().to_string_lossy().into_owned();
            (!points.is_empty()).then_some(Self { name, what, points })
        };
        of(PICTURES, "validation/psnr_masked")
            .or_else(|| of(POINTS, "validation/points_mm"))
            .ok_or_else(|| wrong("has no validation".into()))
    }
}

impl Bench<'_> {
    /// `report.json`.
    pub fn json(&self) -> Value {
        let mut report = self.header.json();
        let by = dominated(self.measured);
        let setting = |(measured, by): (&Measured, &Option<usize>)| {
            let mut value = json!(measured);
            value["modules"] = measured.modules.iter().map(|(name, s)| (name.clone(), json!(s))).collect();
            value["dominated_by"] = json!(by.map(|place| &self.measured[place].name));
            value
        };
        report["settings"] = self.measured.iter().zip(&by).map(setting).collect();
        let curve = |t: &Training| json!({ "run": t.name, "what": t.what, "points": t.points });
        report["training"] = self.training.iter().map(curve).collect();
        report["lpips"] = json!(self.lpips);
        report["left_out"] = json!(self.left_out);
        report
    }

    /// `report.md`.
    pub fn markdown(&self, pictures: &[&str]) -> String {
        let mut text = self.header.markdown("Error against run time");
        let runs = self.measured.first().map_or(0, |m| m.runs);
        let _ = writeln!(
            text,
            "* {runs} reconstructions each after warm-up, device synchronised, each setting in a process of its own, whose largest memory \
             is told (without comparing pictures)\n\
             * Errors: protocol `masked`; LPIPS: {}\n\
             * Splat error: largest difference of a colour from the f64 oracle, not supersampled (where rounding takes a splat over a \
             cut-off, up to 1/255 and what it hides); by cut-offs: what skipping α < 1/255, closing pixels and \
             the largest α change of it\n\
             * Dominated: another has clearly better pictures (95 % interval of the differences person by person above 0) in no more time, or \
             no worse ones in less time by more than 3 %; time: reconstruction and one view\n",
            self.lpips
        );
        let _ = writeln!(
            text,
            "| knob | setting | PSNR, dB | SSIM ×100 | LPIPS ×100 | front, back, mm | sides, mm | reconstruction p50, ms | p95, ms | a view, ms | memory, MB | Gaussians | splat error | by cut-offs | dominated by |\n\
             |---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|"
        );
        let by = dominated(self.measured);
        let optional =
            |value: Option<f64>, times: f64| value.map_or("n/a".into(), |v| format!("{:.2}", v * times));
        for (m, by) in self.measured.iter().zip(&by) {
            let _ = writeln!(
                text,
                "| {} | {} | {:.2} | {} | {} | {} | {} | {:.1} | {:.1} | {:.1} | {} | {} | {:.1e} | {:.1e} | {} |",
                escaped(m.knob.as_deref().unwrap_or_default()),
                escaped(&m.name),
                m.psnr,
                optional(m.ssim, 100.0),
                optional(m.lpips, 100.0),
                optional(m.points_mm, 1.0),
                optional(m.sides_mm, 1.0),
                1e3 * m.p50,
                1e3 * m.p95,
                1e3 * m.render,
                m.memory.map_or("n/a".into(), |bytes| (bytes / 1_000_000).to_string()),
                m.gaussians,
                m.splat_error,
                m.cutoff_error,
                by.map_or(String::new(), |place| escaped(&self.measured[place].name)),
            );
        }
        self.scenes(&mut text);
        self.modules(&mut text);
        for picture in pictures {
            let _ = writeln!(text, "\n![{picture}]({picture})");
        }
        let partly = self.measured.iter().flat_map(|m| m.left_out.iter().map(move |why| (&m.name, why)));
        let whole = self.left_out.iter().map(|l| (&l.name, &l.why));
        let all: Vec<_> = whole.chain(partly).collect();
        if !all.is_empty() {
            let _ = writeln!(text, "\n## Left out: {}\n", all.len());
            for (name, why) in all {
                let _ = writeln!(text, "* {}: {}", escaped(name), escaped(why));
            }
        }
        text
    }

    /// What each omission saves and costs, beside the setting of its scene that leaves nothing out.
    fn scenes(&self, text: &mut String) {
        let mut scenes: Vec<&String> = self.measured.iter().filter_map(|m| m.scene.as_ref()).collect();
        scenes.dedup();
        for scene in scenes {
            let of_scene = || self.measured.iter().filter(|m| m.scene.as_ref() == Some(scene));
            let Some(whole) = of_scene().find(|m| m.omits.is_none()) else { continue };
            let _ = writeln!(
                text,
                "\n## Scene: {}\n\n| left out | {}, ms | saved | memory, MB | saved | PSNR, dB | lost | front, back, mm | more | Gaussians |\n\
                 |---|---|---|---|---|---|---|---|---|---|",
                escaped(scene),
                if whole.tuning.is_some() { "a step of fitting" } else { "time" }
            );
            // Where something is fitted, a step of that is what takes time.
            let time = |m: &Measured| 1e3 * m.tuning.unwrap_or(m.p50);
            let share = |now: f64, before: f64| format!("{:.0} %", 100.0 * (1.0 - now / before));
            let megabytes = |m: &Measured| m.memory.map(|bytes| bytes as f64 / 1e6);
            for m in of_scene() {
                let is_whole = m.omits.is_none();
                let or_nothing = |text: String| if is_whole { String::new() } else { text };
                let memory = megabytes(m).zip(megabytes(whole));
                let points = m.points_mm.zip(whole.points_mm);
                let _ = writeln!(
                    text,
                    "| {} | {:.1} | {} | {} | {} | {:.2} | {} | {} | {} | {} |",
                    escaped(m.omits.as_deref().unwrap_or("nothing")),
                    time(m),
                    or_nothing(share(time(m), time(whole))),
                    memory.map_or("n/a".into(), |(now, _)| format!("{now:.0}")),
                    or_nothing(memory.map_or("n/a".into(), |(now, before)| share(now, before))),
                    m.psnr,
                    or_nothing(format!("{:.2}", whole.psnr - m.psnr)),
                    points.map_or("n/a".into(), |(now, _)| format!("{now:.1}")),
                    or_nothing(points.map_or("n/a".into(), |(now, before)| format!("{:.1}", now - before))),
                    m.gaussians
                );
            }
            for m in of_scene() {
                let omits = m.omits.as_deref().unwrap_or("nothing");
                let _ = writeln!(
                    text,
                    "\nWhat ran with {} left out: {}.",
                    escaped(omits),
                    escaped(&m.plan.join("; "))
                );
            }
        }
    }

    fn modules(&self, text: &mut String) {
        let mut names: Vec<&String> = Vec::new();
        for (name, _) in self.measured.iter().flat_map(|m| &m.modules) {
            if !names.contains(&name) {
                names.push(name);
            }
        }
        let _ = writeln!(text, "\n## By module\n\nMilliseconds, p50.\n");
        let heads: Vec<String> = names.iter().map(|name| escaped(name)).collect();
        let _ = writeln!(text, "| setting | {} |\n|---|{}", heads.join(" | "), "---|".repeat(names.len()));
        for m in self.measured {
            let time = |name: &&String| {
                let found = m.modules.iter().find(|(there, _)| there == *name);
                found.map_or(String::new(), |(_, seconds)| format!("{:.1}", 1e3 * seconds))
            };
            let times: Vec<String> = names.iter().map(time).collect();
            let _ = writeln!(text, "| {} | {} |", escaped(&m.name), times.join(" | "));
        }
    }

    /// `settings.csv`.
    pub fn csv(&self) -> String {
        let header = [
            "setting",
            "knob",
            "scene",
            "omits",
            "people",
            "device",
            "psnr",
            "ssim",
            "lpips",
            "points_mm",
            "sides_mm",
            "p50_s",
            "p95_s",
            "render_s",
            "tuning_step_s",
            "memory_bytes",
            "gaussians",
            "splat_error",
            "cutoff_error",
            "dominated_by",
        ];
        let number = |value: Option<f64>| value.map_or(String::new(), |v| v.to_string());
        let row = |(m, by): (&Measured, Option<usize>)| {
            vec![
                m.name.clone(),
                m.knob.clone().unwrap_or_default(),
                m.scene.clone().unwrap_or_default(),
                m.omits.clone().unwrap_or_default(),
                m.people.iter().map(|person| person.name.as_str()).collect::<Vec<_>>().join(" "),
                m.device.clone(),
                m.psnr.to_string(),
                number(m.ssim),
                number(m.lpips),
                number(m.points_mm),
                number(m.sides_mm),
                m.p50.to_string(),
                m.p95.to_string(),
                m.render.to_string(),
                number(m.tuning),
                m.memory.map_or(String::new(), |bytes| bytes.to_string()),
                m.gaussians.to_string(),
                m.splat_error.to_string(),
                m.cutoff_error.to_string(),
                by.map_or(String::new(), |place| self.measured[place].name.clone()),
            ]
        };
        table(&header, self.measured.iter().zip(dominated(self.measured)).map(row))
    }

    /// PSNR over run time, the front joined; empty where there is nothing to choose from.
    fn pareto(&self) -> String {
        let at = |m: &Measured| (1e3 * m.time(), m.psnr);
        let by = dominated(self.measured);
        let plain = || {
            let alike = |m: &Measured| m.scene.is_none() && m.tuning.is_none();
            self.measured.iter().zip(&by).filter(move |(m, _)| alike(m))
        };
        if plain().count() < 2 {
            return String::new();
        }
        let mut front: Vec<(f64, f64)> = plain().filter(|(_, by)| by.is_none()).map(|(m, _)| at(m)).collect();
        front.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut series = vec![Series { name: "Pareto front".into(), points: front, line: true }];
        for (m, _) in plain() {
            series.push(Series { name: m.name.clone(), points: vec![at(m)], line: false });
        }
        let axes = Axes {
            caption: "Error against run time",
            x: "a reconstruction and a view, p50, ms",
            y: "PSNR, masked, dB",
            log_x: true,
            log_y: false,
        };
        svg(&[(axes, series)])
    }

    /// Validations of one kind over wall-clock time.
    fn curves(&self, what: &str) -> String {
        let alike = self.training.iter().filter(|t| t.what == what);
        let series: Vec<Series> = alike
            .map(|t| Series {
                name: t.name.clone(),
                points: t.points.iter().map(|(s, v)| (s / 60.0, *v)).collect(),
                line: true,
            })
            .collect();
        let caption = "Validation against wall-clock time";
        let axes = Axes { caption, x: "minutes", y: what, ..Axes::default() };
        svg(&[(axes, series)])
    }

    /// The plots by their names, empty where there is nothing to draw.
    pub fn plots(&self) -> [(&'static str, String); 3] {
        [
            ("pareto.svg", self.pareto()),
            ("training_points.svg", self.curves(POINTS)),
            ("training_pictures.svg", self.curves(PICTURES)),
        ]
    }
}
