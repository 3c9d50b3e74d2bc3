//! Curves of a run: its loss and its validations' score.

use snapsnap_base::plot::{Axes, Series, svg};

use crate::log::Line;

/// An SVG of the loss over the steps and, below it, of the validations' score. Empty without values.
pub fn draw(lines: &[Line]) -> String {
    let chart = |caption: &'static str, y: &'static str, name: &str| {
        let values = lines.iter().filter_map(|line| Some((line.step as f64, *line.values.get(name)?)));
        let series = Series { name: name.into(), points: values.collect(), line: true };
        (Axes { caption, x: "step", y, log_x: false, log_y: true }, vec![series])
    };
    svg(&[chart("loss", "loss", "loss"), chart("validation (less is better)", "score", "validation/score")])
}
