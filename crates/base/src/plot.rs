//! Curves as SVG.

use std::ops::Range;

use plotters::coord::Shift;
use plotters::prelude::*;

/// Width and height of a chart in pixels.
const SIZE: (u32, u32) = (1000, 460);
/// Width of the legend in pixels.
const NAMES: u32 = 220;
/// Height of a line of the legend in pixels.
const ROW: i32 = 18;
/// Lines with at most this many points get a mark at each point. More marks would hide the line.
const MARKS: usize = 100;

/// A named line, or points that are not joined.
pub struct Series {
    /// Text in the legend.
    pub name: String,
    /// x and y of each point.
    pub points: Vec<(f64, f64)>,
    /// Whether the points are joined.
    pub line: bool,
}

/// Axes of a chart.
#[derive(Default)]
pub struct Axes<'a> {
    /// Text above the chart.
    pub caption: &'a str,
    /// Label of the x axis.
    pub x: &'a str,
    /// Label of the y axis.
    pub y: &'a str,
    /// Whether x is logarithmic.
    pub log_x: bool,
    /// Whether y is logarithmic.
    pub log_y: bool,
}

/// An SVG of charts below one another. Points that cannot be drawn are left out; without any point the text is empty.
pub fn svg(charts: &[(Axes, Vec<Series>)]) -> String {
    let mut text = String::new();
    if charts.iter().all(|(axes, series)| drawable(axes, series).next().is_none()) {
        return text;
    }
    {
        let size = (SIZE.0, SIZE.1 * charts.len() as u32);
        let area = SVGBackend::with_string(&mut text, size).into_drawing_area();
        // Drawing into a string cannot fail.
        let _ = area.fill(&WHITE);
        for (area, (axes, series)) in area.split_evenly((charts.len(), 1)).iter().zip(charts) {
            let _ = draw(area, axes, series);
        }
        let _ = area.present();
    }
    text
}

fn is_drawable(axes: &Axes, (x, y): (f64, f64)) -> bool {
    // Beyond 1e15, differences within a range vanish and axes have no ticks.
    let is_bounded = |v: f64, log: bool| v.abs() < 1e15 && (!log || v > 0.0);
    is_bounded(x, axes.log_x) && is_bounded(y, axes.log_y)
}

fn drawable<'a>(axes: &'a Axes, series: &'a [Series]) -> impl Iterator<Item = (f64, f64)> + 'a {
    series.iter().flat_map(|s| s.points.iter().copied()).filter(|point| is_drawable(axes, *point))
}

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Drawn = Result<(), DrawingAreaErrorKind<std::io::Error>>;

fn draw(area: &Area, axes: &Axes, series: &[Series]) -> Drawn {
    let bounds = |of: fn((f64, f64)) -> f64, log: bool| {
        let values = drawable(axes, series).map(of);
        let (low, high) = values.fold((f64::MAX, f64::MIN), |(low, high), v| (low.min(v), high.max(v)));
        let room = 0.05 * (high - low).max(1e-3 * high.abs()).max(1e-9);
        if log { 0.9 * low..1.1 * high } else { low - room..high + room }
    };
    if drawable(axes, series).next().is_none() {
        return Ok(());
    }
    let (x, y) = (bounds(|p| p.0, axes.log_x), bounds(|p| p.1, axes.log_y));
    let (plot, names) = area.split_horizontally(SIZE.0 - NAMES);
    let mut builder = ChartBuilder::on(&plot);
    builder.caption(axes.caption, ("sans-serif", 16)).margin(10).x_label_area_size(36).y_label_area_size(60);
    // A macro, since linear and logarithmic axes have different types.
    macro_rules! chart {
        ($x:expr, $y:expr) => {{
            let mut chart = builder.build_cartesian_2d($x, $y)?;
            chart
                .configure_mesh()
                .x_desc(axes.x)
                .y_desc(axes.y)
                .x_label_formatter(&|v| number(*v))
                .y_label_formatter(&|v| number(*v))
                .draw()?;
            for (i, s) in series.iter().enumerate() {
                let color = Palette99::pick(i).to_rgba();
                let points = || s.points.iter().copied().filter(|point| is_drawable(axes, *point));
                if s.line {
                    chart.draw_series(LineSeries::new(points(), &color))?;
                }
                if !s.line || points().count() <= MARKS {
                    chart.draw_series(points().map(|p| Circle::new(p, 3, color.filled())))?;
                }
                let row = 30 + ROW * i as i32;
                names.draw(&Circle::new((8, row), 3, color.filled()))?;
                names.draw(&Text::new(s.name.clone(), (18, row - 6), ("sans-serif", 13)))?;
            }
        }};
    }
    let log = |range: Range<f64>| {
        let ticks = ticks(&range);
        range.log_scale().with_key_points(ticks)
    };
    match (axes.log_x, axes.log_y) {
        (false, false) => chart!(x, y),
        (true, false) => chart!(log(x), y),
        (false, true) => chart!(x, log(y)),
        (true, true) => chart!(log(x), log(y)),
    }
    Ok(())
}

/// Ticks of a logarithmic axis: powers of ten, and their multiples where the range contains few powers of ten.
fn ticks(range: &Range<f64>) -> Vec<f64> {
    let decades = (range.end / range.start).log10();
    let steps: &[f64] = match decades {
        d if d < 0.5 => &[1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 6.0, 7.0, 8.0, 9.0],
        d if d < 1.0 => &[1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0],
        d if d < 4.0 => &[1.0, 2.0, 5.0],
        _ => &[1.0],
    };
    let exponents = range.start.log10().floor() as i32..=range.end.log10().ceil() as i32;
    let all = exponents.flat_map(|e| steps.iter().map(move |step| step * 10_f64.powi(e)));
    all.filter(|tick| range.contains(tick)).collect()
}

/// A number with four significant digits at most; an integer keeps all of its digits.
fn number(value: f64) -> String {
    if value == 0.0 {
        return "0".into();
    }
    let digits = 3 - value.abs().log10().floor() as i32;
    if !(-9..=9).contains(&digits) {
        return format!("{value:.2e}");
    }
    let text = format!("{value:.*}", digits.max(0) as usize);
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').into() } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drawn(log_x: bool, points: Vec<(f64, f64)>) -> String {
        let axes = Axes { caption: "c", x: "x", y: "y", log_x, ..Axes::default() };
        svg(&[(axes, vec![Series { name: "a < b".into(), points, line: true }])])
    }

    #[test]
    fn values_beyond_all_axes_are_left_out() {
        let points = vec![(0.0, 1.0), (1.0, -1e308), (2.0, 1e308), (3.0, f64::NAN), (4.0, 2.0)];
        let drawn_points = drawn(false, points);
        // Two points, and the mark in the legend.
        assert_eq!(drawn_points.matches("<circle").count(), 3, "{drawn_points}");
        assert!(drawn_points.contains("a &lt; b"));
        assert_eq!(drawn(false, vec![(f64::INFINITY, 1.0)]), "");
    }

    #[test]
    fn a_logarithmic_axis_has_ticks_within_a_power_of_ten_too() {
        for (last, ticks) in [(4800.0, [3000, 3500, 4500]), (90_000.0, [5000, 20_000, 50_000])] {
            let drawn = drawn(true, vec![(3000.0, 1.0), (last, 2.0)]);
            // Labels stand on lines of their own.
            assert!(ticks.iter().all(|tick| drawn.contains(&format!("\n{tick}\n"))), "{drawn}");
        }
    }

    #[test]
    fn numbers_are_short() {
        let shown = [0.0, 20_000.0, 0.05, -1.5, 1234.5, 3e-12].map(number);
        assert_eq!(shown, ["0", "20000", "0.05", "-1.5", "1234", "3.00e-12"]);
    }
}
