//! The report of an evaluation: figures, JSON and tables.

mod markdown;

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;

use serde::Serialize;
use serde_json::{Value, json};
use snapsnap_base::plot::{Axes, Series, svg};

use super::{Header, number, table};
use crate::evaluate::config::{EvalConfig, Protocol};
use crate::evaluate::{Judged, Kind, Outcome, Row, Surface, by_person};
use crate::foreign::Traces;
use crate::parts::{PARTS, PartError};
use crate::points::{PointError, VIEWS};
use crate::score::Score;
use crate::statistics::{Interval, difference, interval, mean, quantile_of_times};

/// A figure of a score: name, value, factor and digits in tables.
type Figure = (&'static str, fn(&Score) -> Option<f64>, f64, usize);
const FIGURES: [Figure; 3] =
    [("psnr", |s| Some(s.psnr), 1.0, 2), ("ssim", |s| s.ssim, 100.0, 2), ("lpips", |s| s.lpips, 100.0, 2)];

/// Angles between the axis through front and back and the views that show the sides, in degrees.
const SIDES: RangeInclusive<f64> = 45.0..=135.0;

/// The content of a report.
pub struct Evaluation<'a> {
    /// Command, commit, device, date.
    pub header: Header,
    /// The config in force.
    pub config: &'a EvalConfig,
    /// The result.
    pub outcome: Outcome,
    /// The weights of LPIPS, or the reason for their absence.
    pub lpips: String,
    /// Time and memory.
    pub cost: Cost,
}

/// Time and memory of an evaluation.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Cost {
    /// From the first photograph to the last figure.
    pub seconds: f64,
    /// Largest memory of the process in bytes; `None` if the system does not report it.
    pub memory: Option<u64>,
}

impl Evaluation<'_> {
    /// Intervals over people, by figure.
    fn overall(people: &BTreeMap<usize, Score>) -> [Option<Interval>; 3] {
        FIGURES.map(|(_, of, ..)| {
            let values: Option<Vec<f64>> = people.values().map(of).collect();
            interval(&values?)
        })
    }

    /// The interval of the PSNR of views from the sides, dB, over people.
    fn sides(judged: &Judged, protocol: usize) -> Option<Interval> {
        let people = by_person(of_sides(judged), protocol);
        interval(&people.values().map(|score| score.psnr).collect::<Vec<_>>())
    }

    /// Intervals over people: overlap of masks; shares of foreign colour and beside the person, in views from the sides.
    fn photographs(judged: &Judged) -> [Option<Interval>; 3] {
        let over = |of: fn(&Traces) -> f64| {
            let mut people: BTreeMap<usize, Vec<f64>> = BTreeMap::new();
            for row in of_sides(judged) {
                people.entry(row.person).or_default().extend(row.traces.as_ref().map(of));
            }
            interval(&people.values().filter_map(|values| mean(values)).collect::<Vec<_>>())
        };
        [interval(&judged.masks), over(|traces| traces.foreign), over(|traces| traces.beside)]
    }

    /// Figures of `one` minus figures of `other`, person by person, over the views that both have.
    fn difference(one: &Judged, other: &Judged, protocol: usize) -> [Option<Interval>; 3] {
        let place = |row: &Row| (row.person, row.view);
        let both: BTreeSet<_> = one.rows.iter().map(place).collect();
        let both: BTreeSet<_> = other.rows.iter().map(place).filter(|row| both.contains(row)).collect();
        let [one, other] = [one, other]
            .map(|judged| by_person(judged.rows.iter().filter(|row| both.contains(&place(row))), protocol));
        FIGURES.map(|(_, of, ..)| {
            let pairs = one.values().zip(other.values());
            let values: Option<Vec<f64>> = pairs.map(|(a, b)| Some(difference(of(a)?, of(b)?))).collect();
            interval(&values?)
        })
    }

    fn protocols(&self) -> impl Iterator<Item = (usize, Protocol)> {
        self.config.metrics.protocols.iter().copied().enumerate()
    }

    fn by_protocol(&self, value: impl Fn(usize) -> Value) -> Value {
        self.protocols().map(|(i, protocol)| (protocol.name(), value(i))).collect()
    }

    fn of_kind(&self, kind: Kind) -> impl Iterator<Item = &Judged> {
        self.outcome.judged.iter().filter(move |judged| judged.kind == kind)
    }

    fn model(&self) -> Option<&Judged> {
        self.of_kind(Kind::Model).next()
    }

    /// `report.json`.
    pub fn json(&self) -> Value {
        let mut report = self.header.json();
        let protocols = |model: &Judged| self.by_protocol(|protocol| self.protocol_json(model, protocol));
        report["protocols"] = self.model().map_or(json!({}), protocols);
        let plain = |judged: &Judged| {
            self.by_protocol(|protocol| {
                let mut value = figures(Self::overall(&by_person(judged.rows.iter(), protocol)));
                value["sides_psnr"] = json!(Self::sides(judged, protocol));
                value
            })
        };
        let named = |kind: Kind, value: &dyn Fn(&Judged) -> Value| -> Value {
            self.of_kind(kind).map(|judged| (judged.name.clone(), value(judged))).collect()
        };
        report["baselines"] = named(Kind::Baseline, &plain);
        report["baselines_geometry_cm"] = named(Kind::Baseline, &|judged| geometry_json(&judged.surface));
        report["compared"] = named(Kind::Other, &|judged| {
            let difference = |protocol: usize| match self.model() {
                Some(model) => figures(Self::difference(judged, model, protocol)),
                None => Value::Null,
            };
            json!({
                "protocols": plain(judged),
                "difference": self.by_protocol(difference),
                "photographs": photographs_json(judged),
                "points_mm": points_json(judged),
                "parts": parts_json(judged),
                "geometry_cm": geometry_json(&judged.surface),
                "mesh_cm": geometry_json(&judged.mesh),
                "seconds": seconds_json(judged),
                "mean_degrees_cm_scale": alignment_means(judged),
            })
        });
        report["photographs"] = self.model().map_or(Value::Null, photographs_json);
        report["points_mm"] = self.model().map_or(json!({}), points_json);
        report["parts"] = self.model().map_or(json!({}), parts_json);
        report["alignment"] = json!({
            "method": self.config.metrics.align,
            "mean_degrees_cm_scale": self.model().and_then(alignment_means),
        });
        report["geometry_cm"] = self.model().map_or(Value::Null, |model| geometry_json(&model.surface));
        report["mesh_cm"] = self.model().map_or(Value::Null, |model| geometry_json(&model.mesh));
        report["seconds"] = self.model().map_or(Value::Null, seconds_json);
        report["lpips"] = json!(self.lpips);
        report["cost"] = json!(self.cost);
        report["left_out"] = json!(self.outcome.left_out);
        report
    }

    fn protocol_json(&self, model: &Judged, protocol: usize) -> Value {
        let people = by_person(model.rows.iter(), protocol);
        let subject = |(person, score): (&usize, &Score)| {
            let mut value = json!(score);
            value["name"] = json!(self.outcome.people[*person]);
            value
        };
        json!({
            "overall": figures(Self::overall(&people)),
            "sides_psnr": Self::sides(model, protocol),
            "people": people.len(),
            "views": model.rows.len(),
            "subjects": people.iter().map(subject).collect::<Vec<_>>(),
        })
    }

    /// `views.csv`: a row per contestant, person, view and protocol.
    pub fn views_csv(&self) -> String {
        const HEADER: [&str; 8] =
            ["contestant", "protocol", "subject", "view", "degrees", "psnr", "ssim", "lpips"];
        let mut rows = Vec::new();
        for (judged, row) in self.outcome.judged.iter().flat_map(|j| j.rows.iter().map(move |row| (j, row))) {
            for ((_, protocol), score) in self.protocols().zip(&row.scores) {
                let person = self.outcome.people[row.person].clone();
                let mut cells = vec![judged.name.clone(), protocol.name().into(), person];
                cells.extend([row.view.to_string(), format!("{:.2}", row.degrees)]);
                cells.extend(FIGURES.map(|(_, of, ..)| number(of(score))));
                rows.push(cells);
            }
        }
        table(&HEADER, rows.into_iter())
    }

    /// `by_view.svg`: PSNR of the last protocol over the angle from the first photograph.
    pub fn by_view(&self) -> String {
        let Some((protocol, name)) = self.protocols().last() else { return String::new() };
        let series = |judged: &Judged| {
            let mut views: BTreeMap<i64, Vec<f64>> = BTreeMap::new();
            for row in &judged.rows {
                views.entry(row.degrees.round() as i64).or_default().push(row.scores[protocol].psnr);
            }
            let points = views.iter().filter_map(|(degrees, psnr)| Some((*degrees as f64, mean(psnr)?)));
            Series { name: judged.name.clone(), points: points.collect(), line: true }
        };
        let caption = format!("PSNR by view, protocol `{}`, mean over people", name.name());
        let (x, y) = ("degrees from the first photograph", "PSNR, dB");
        let axes = Axes { caption: &caption, x, y, ..Axes::default() };
        svg(&[(axes, self.outcome.judged.iter().map(series).collect())])
    }

    /// The best, middle and worst people by PSNR of the last protocol, `count` of each, without repetition, as indices
    /// in [`Outcome::people`].
    pub fn ranked(&self, count: usize) -> Vec<usize> {
        let Some((model, (protocol, _))) = self.model().zip(self.protocols().last()) else {
            return Vec::new();
        };
        let mut people: Vec<(usize, Score)> = by_person(model.rows.iter(), protocol).into_iter().collect();
        people.sort_by(|a, b| b.1.psnr.total_cmp(&a.1.psnr));
        let n = people.len();
        let starts = [0, (n / 2).saturating_sub(count / 2), n.saturating_sub(count)];
        let places: BTreeSet<usize> =
            starts.into_iter().flat_map(|from| from..(from + count).min(n)).collect();
        places.into_iter().map(|place| people[place].0).collect()
    }
}

/// The views from the sides; half a degree for views at the ends of the range.
fn of_sides(judged: &Judged) -> impl Iterator<Item = &Row> {
    judged.rows.iter().filter(|row| SIDES.contains(&(row.degrees % 180.0).round()))
}

/// Figures by their names.
fn by_name<const N: usize>(names: [&str; N], figures: [impl Serialize; N]) -> Value {
    names.into_iter().zip(figures).map(|(name, figure)| (name, json!(figure))).collect()
}

fn photographs_json(judged: &Judged) -> Value {
    by_name(["mask_iou", "foreign_share", "beside_share"], Evaluation::photographs(judged))
}

fn figures(intervals: [Option<Interval>; 3]) -> Value {
    by_name(FIGURES.map(|(name, ..)| name), intervals)
}

/// Means over people: distance in mm, distance after centring in mm, share of missed points.
fn point_means(judged: &Judged, view: usize) -> Option<[f64; 3]> {
    let errors = || judged.points.iter().filter(|error| error.view == view);
    let over = |of: fn(&PointError) -> f64| mean(&errors().map(of).collect::<Vec<_>>());
    Some([over(|e| 1e3 * e.mean)?, over(|e| 1e3 * e.centred)?, over(|e| e.missed)?])
}

/// Means over people and photographs: distance in mm, degrees between normals, share of far points in per cent.
fn part_means(judged: &Judged, part: usize) -> [Option<f64>; 3] {
    let errors = || judged.parts.iter().filter(|error| error.part == part);
    let over = |of: fn(&PartError) -> Option<f64>| mean(&errors().filter_map(of).collect::<Vec<_>>());
    [over(|e| e.relief.map(|relief| 1e3 * relief)), over(|e| e.normals), over(|e| Some(100.0 * e.far))]
}

fn parts_json(judged: &Judged) -> Value {
    const NAMES: [&str; 3] = ["relief_mm", "normals_degrees", "far_percent"];
    by_name(PARTS, std::array::from_fn(|part| by_name(NAMES, part_means(judged, part))))
}

/// Means over people: degrees, centimetres, scale.
fn alignment_means(judged: &Judged) -> Option<[f64; 3]> {
    let over = |i: usize| mean(&judged.aligned.iter().map(|figures| figures[i]).collect::<Vec<_>>());
    Some([over(0)?, over(1)?, over(2)?])
}

fn points_json(judged: &Judged) -> Value {
    let of_view = |view| point_means(judged, view).map(|means| by_name(["mean", "centred", "missed"], means));
    by_name(VIEWS, std::array::from_fn(of_view))
}

/// Means over people: distances in cm to the truth, from the truth and both; cosine of normals; open share.
fn surface_intervals(surfaces: &[Surface]) -> [Option<Interval>; 5] {
    let over =
        |of: fn(&Surface) -> Option<f64>| interval(&surfaces.iter().filter_map(of).collect::<Vec<_>>());
    [
        over(|s| Some(1e2 * s.chamfer.forward)),
        over(|s| Some(1e2 * s.chamfer.backward)),
        over(|s| Some(1e2 * s.chamfer.mean())),
        over(|s| s.normals),
        over(|s| s.open),
    ]
}

fn geometry_json(surfaces: &[Surface]) -> Value {
    const NAMES: [&str; 5] = ["to_truth", "from_truth", "chamfer", "normal_consistency", "open_share"];
    by_name(NAMES, surface_intervals(surfaces))
}

/// Seconds, p50 and p95.
fn seconds(judged: &Judged) -> Option<[f64; 2]> {
    let times = &judged.times;
    (!times.is_empty()).then(|| [0.5, 0.95].map(|share| quantile_of_times(times, share)))
}

fn seconds_json(judged: &Judged) -> Value {
    json!(seconds(judged).map(|times| by_name(["p50", "p95"], times)))
}
