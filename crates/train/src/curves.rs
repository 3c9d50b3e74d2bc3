//! Curves of a run: its loss, and what validations found.

use plotters::coord::Shift;
use plotters::prelude::*;

use crate::log::Line;

/// Width and height of one picture in pixels.
const SIZE: (u32, u32) = (800, 300);

/// An SVG of the loss over the steps and, below it, of the validations' score. Empty without lines.
pub fn draw(lines: &[Line]) -> String {
    let series = |name: &str| -> Vec<(f64, f64)> {
        let values = lines.iter().filter_map(|line| Some((line.step as f64, *line.values.get(name)?)));
        values.filter(|(_, value)| value.is_finite() && *value > 0.0).collect()
    };
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, (SIZE.0, 2 * SIZE.1)).into_drawing_area();
        let (upper, lower) = area.split_vertically(SIZE.1);
        // Drawing into a string cannot fail.
        let _ = area.fill(&WHITE);
        let _ = chart(&upper, "loss", &series("loss"));
        let _ = chart(&lower, "validation (less is better)", &series("validation/score"));
        let _ = area.present();
    }
    svg
}

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

fn chart(
    area: &Area,
    caption: &str,
    points: &[(f64, f64)],
) -> Result<(), DrawingAreaErrorKind<std::io::Error>> {
    let Some(&(last, _)) = points.last() else { return Ok(()) };
    let range = points.iter().fold((f64::MAX, f64::MIN_POSITIVE), |(least, most), (_, value)| {
        (least.min(*value), most.max(*value))
    });
    let mut chart = ChartBuilder::on(area)
        .caption(caption, ("sans-serif", 16))
        .margin(8)
        .x_label_area_size(24)
        .y_label_area_size(64)
        .build_cartesian_2d(0.0..last.max(1.0), (0.9 * range.0..1.1 * range.1).log_scale())?;
    chart.configure_mesh().y_label_formatter(&|value| format!("{value:.3e}")).draw()?;
    chart.draw_series(LineSeries::new(points.iter().copied(), &BLUE))?;
    Ok(())
}
