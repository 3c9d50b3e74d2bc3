//! The report of a benchmark.

use std::fmt::Write;
use std::path::Path;

use serde_json::{Value, json};
use snapsnap_base::file;
use snapsnap_base::plot::{Axes, Series, svg};

use super::{Measured, dominated};
use crate::evaluate::LeftOut;
use crate::report::{Header, escaped, left_out_markdown, number, table, table_markdown};

/// Largest size of a training's log in bytes.
const MOST: u64 = 256 << 20;

/// Figures of the validations of stage 1 and stage 2.
const POINTS: &str = "point error, mm";
const PICTURES: &str = "masked PSNR, dB";

/// The content of a report.
pub struct Bench<'a> {
    /// Command, commit, device, date.
    pub header: Header,
    /// Variants, the model under test first.
    pub measured: &'a [Measured],
    /// Variants that could not be measured, and trainings that could not be read.
    pub left_out: &'a [LeftOut],
    /// Trainings with validations.
    pub training: &'a [Training],
}

/// A training's validations over its time.
pub struct Training {
    /// Its folder's name.
    pub name: String,
    /// The validated figure.
    pub what: &'static str,
    /// Seconds and values.
    pub points: Vec<(f64, f64)>,
}

impl Training {
    /// Reads the log of a run.
    ///
    /// # Errors
    /// A message, if it cannot be read or has no validation.
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

/// Title and cells of a column.
type Column = (&'static str, fn(&Measured) -> String);

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
        report["lpips"] = json!(self.lpips());
        report["left_out"] = json!(self.left_out);
        report
    }

    /// The weights of LPIPS, or the reason for their absence.
    fn lpips(&self) -> &str {
        self.measured.first().map_or("n/a", |m| &m.lpips_weights)
    }

    /// All failures; failures inside measured variants come last.
    pub fn failures(&self) -> Vec<LeftOut> {
        let partly =
            self.measured.iter().flat_map(|m| m.left_out.iter().map(|why| LeftOut::new(&m.name, why)));
        self.left_out.iter().cloned().chain(partly).collect()
    }

    /// `report.md`.
    pub fn markdown(&self, pictures: &[&str]) -> String {
        let mut text = self.header.markdown("Error against run time");
        let runs = self.measured.first().map_or(0, |m| m.runs);
        let _ = writeln!(
            text,
            "* {runs} reconstructions each after warm-up, device synchronised. Each setting runs in its own process, whose largest memory \
             is reported (before pictures are compared)\n\
             * Errors: protocol `masked`; LPIPS: {}\n\
             * Splat error: largest difference of a colour from the f64 oracle, not supersampled (up to 1/255 and the colours behind, where \
             rounding moves a splat over a cut-off); by cut-offs: the change by skipping α < 1/255, closing pixels and \
             the largest α\n\
             * Dominated: another setting has clearly better pictures (95 % interval of the differences person by person above 0) in no more \
             time, or no worse ones in less time by more than 3 %; time: reconstruction and one view\n",
            self.lpips()
        );
        const COLUMNS: &[Column] = &[
            ("knob", |m| m.knob.clone().unwrap_or_default()),
            ("setting", |m| m.name.clone()),
            ("PSNR, dB", |m| format!("{:.2}", m.score.psnr)),
            ("SSIM ×100", |m| scaled(m.score.ssim, 100.0)),
            ("LPIPS ×100", |m| scaled(m.score.lpips, 100.0)),
            ("front, back, mm", |m| scaled(m.points_mm, 1.0)),
            ("sides, mm", |m| scaled(m.sides_mm, 1.0)),
            ("reconstruction p50, ms", |m| format!("{:.1}", 1e3 * m.p50)),
            ("p95, ms", |m| format!("{:.1}", 1e3 * m.p95)),
            ("a view, ms", |m| format!("{:.1}", 1e3 * m.render)),
            ("memory, MB", |m| m.memory.map_or("n/a".into(), |bytes| (bytes / 1_000_000).to_string())),
            ("Gaussians", |m| m.gaussians.to_string()),
            ("splat error", |m| format!("{:.1e}", m.splat_error)),
            ("by cut-offs", |m| format!("{:.1e}", m.cutoff_error)),
        ];
        let (header, rows) = self.table(COLUMNS, "dominated by");
        text += &table_markdown(&header, rows.into_iter());
        self.scenes(&mut text);
        self.modules(&mut text);
        for picture in pictures {
            let _ = writeln!(text, "\n![{picture}]({picture})");
        }
        text + &left_out_markdown(&self.failures())
    }

    /// Savings and costs of each omission, relative to the setting of its scene that omits nothing.
    fn scenes(&self, text: &mut String) {
        let mut scenes: Vec<&String> = self.measured.iter().filter_map(|m| m.scene.as_ref()).collect();
        scenes.dedup();
        for scene in scenes {
            let of_scene = || self.measured.iter().filter(|m| m.scene.as_ref() == Some(scene));
            let Some(whole) = of_scene().find(|m| m.omits.is_none()) else { continue };
            let share = |now: f64, before: f64| format!("{:.0} %", 100.0 * (1.0 - now / before));
            let megabytes = |m: &Measured| m.memory.map(|bytes| bytes as f64 / 1e6);
            let row = |m: &Measured| {
                let or_nothing = |text: String| if m.omits.is_none() { String::new() } else { text };
                let memory = megabytes(m).zip(megabytes(whole));
                let points = m.points_mm.zip(whole.points_mm);
                vec![
                    m.omits.clone().unwrap_or("nothing".into()),
                    format!("{:.1}", 1e3 * m.p50),
                    or_nothing(share(m.p50, whole.p50)),
                    memory.map_or("n/a".into(), |(now, _)| format!("{now:.0}")),
                    or_nothing(memory.map_or("n/a".into(), |(now, before)| share(now, before))),
                    format!("{:.2}", m.score.psnr),
                    or_nothing(format!("{:.2}", whole.score.psnr - m.score.psnr)),
                    points.map_or("n/a".into(), |(now, _)| format!("{now:.1}")),
                    or_nothing(points.map_or("n/a".into(), |(now, before)| format!("{:.1}", now - before))),
                    m.gaussians.to_string(),
                ]
            };
            let header =
                "left out|time, ms|saved|memory, MB|saved|PSNR, dB|lost|front, back, mm|more|Gaussians";
            let table = table_markdown(&Vec::from_iter(header.split('|')), of_scene().map(row));
            let _ = write!(text, "\n## Scene: {}\n\n{table}", escaped(scene));
            for m in of_scene() {
                let (omits, plan) = (m.omits.as_deref().unwrap_or("nothing"), m.plan.join("; "));
                let _ = writeln!(text, "\nSteps, {} left out: {}.", escaped(omits), escaped(&plan));
            }
        }
    }

    fn modules(&self, text: &mut String) {
        let mut header = vec!["setting"];
        for (name, _) in self.measured.iter().flat_map(|m| &m.modules) {
            if !header.contains(&name.as_str()) {
                header.push(name);
            }
        }
        let row = |m: &Measured| -> Vec<String> {
            let time = |name: &&str| {
                let found = m.modules.iter().find(|(module, _)| module == *name);
                found.map_or(String::new(), |(_, seconds)| format!("{:.1}", 1e3 * seconds))
            };
            [m.name.clone()].into_iter().chain(header[1..].iter().map(time)).collect()
        };
        let table = table_markdown(&header, self.measured.iter().map(row));
        let _ = write!(text, "\n## By module\n\nMilliseconds, p50.\n\n{table}");
    }

    /// `settings.csv`.
    pub fn csv(&self) -> String {
        const COLUMNS: &[Column] = &[
            ("setting", |m| m.name.clone()),
            ("knob", |m| m.knob.clone().unwrap_or_default()),
            ("scene", |m| m.scene.clone().unwrap_or_default()),
            ("omits", |m| m.omits.clone().unwrap_or_default()),
            ("people", |m| m.people.iter().map(|p| p.name.as_str()).collect::<Vec<_>>().join(" ")),
            ("device", |m| m.device.clone()),
            ("psnr", |m| m.score.psnr.to_string()),
            ("ssim", |m| number(m.score.ssim)),
            ("lpips", |m| number(m.score.lpips)),
            ("points_mm", |m| number(m.points_mm)),
            ("sides_mm", |m| number(m.sides_mm)),
            ("p50_s", |m| m.p50.to_string()),
            ("p95_s", |m| m.p95.to_string()),
            ("render_s", |m| m.render.to_string()),
            ("memory_bytes", |m| m.memory.map_or(String::new(), |bytes| bytes.to_string())),
            ("gaussians", |m| m.gaussians.to_string()),
            ("splat_error", |m| m.splat_error.to_string()),
            ("cutoff_error", |m| m.cutoff_error.to_string()),
        ];
        let (header, rows) = self.table(COLUMNS, "dominated_by");
        table(&header, rows.into_iter())
    }

    /// Header and rows of a table of all variants, whose last column is the dominating variant.
    fn table(&self, columns: &[Column], last: &'static str) -> (Vec<&'static str>, Vec<Vec<String>>) {
        let row = |(m, by): (&Measured, Option<usize>)| -> Vec<String> {
            let by = by.map_or(String::new(), |index| self.measured[index].name.clone());
            columns.iter().map(|(_, cell)| cell(m)).chain([by]).collect()
        };
        let header = columns.iter().map(|(title, _)| *title).chain([last]).collect();
        (header, self.measured.iter().zip(dominated(self.measured)).map(row).collect())
    }

    /// PSNR over run time with the Pareto front as a line; empty for less than two settings.
    fn pareto(&self) -> String {
        let at = |m: &Measured| (1e3 * m.time(), m.score.psnr);
        let by = dominated(self.measured);
        let plain = || self.measured.iter().zip(&by).filter(|(m, _)| m.scene.is_none());
        if plain().count() < 2 {
            return String::new();
        }
        let mut front: Vec<(f64, f64)> = plain().filter(|(_, by)| by.is_none()).map(|(m, _)| at(m)).collect();
        front.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut series = vec![Series { name: "Pareto front".into(), points: front, line: true }];
        for (m, _) in plain() {
            series.push(Series { name: m.name.clone(), points: vec![at(m)], line: false });
        }
        let (x, y) = ("a reconstruction and a view, p50, ms", "PSNR, masked, dB");
        let axes = Axes { caption: "Error against run time", x, y, log_x: true, log_y: false };
        svg(&[(axes, series)])
    }

    /// Validations of one kind over wall-clock time.
    fn curves(&self, what: &str) -> String {
        let alike = self.training.iter().filter(|t| t.what == what);
        let curve = |t: &Training| {
            let points = t.points.iter().map(|(s, v)| (s / 60.0, *v)).collect();
            Series { name: t.name.clone(), points, line: true }
        };
        let caption = "Validation against wall-clock time";
        let axes = Axes { caption, x: "minutes", y: what, ..Axes::default() };
        svg(&[(axes, alike.map(curve).collect())])
    }

    /// File names and texts of the plots. A plot without points is empty.
    pub fn plots(&self) -> [(&'static str, String); 3] {
        [
            ("pareto.svg", self.pareto()),
            ("training_points.svg", self.curves(POINTS)),
            ("training_pictures.svg", self.curves(PICTURES)),
        ]
    }
}

/// A figure in a table of Markdown, multiplied by `times`.
fn scaled(figure: Option<f64>, times: f64) -> String {
    figure.map_or("n/a".into(), |v| format!("{:.2}", v * times))
}
