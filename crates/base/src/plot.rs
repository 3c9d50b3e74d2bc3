//! Curves as SVG.

use plotters::coord::Shift;
use plotters::prelude::*;

/// Width and height of a chart in pixels.
const SIZE: (u32, u32) = (1000, 460);
/// Columns of the names of the series.
const NAMES: u32 = 220;
/// Rows of a name.
const ROW: i32 = 18;
/// Largest number of points of a line that are marked. More marks would hide the line.
const MARKS: usize = 100;

/// A named line, or points that are not joined.
pub struct Series {
    /// In the legend.
    pub name: String,
    /// x and y.
    pub points: Vec<(f64, f64)>,
    /// Whether the points are joined.
    pub line: bool,
}

/// Axes of a chart.
#[derive(Default)]
pub struct Axes<'a> {
    /// Above it.
    pub caption: &'a str,
    /// Below it.
    pub x: &'a str,
    /// Beside it.
    pub y: &'a str,
    /// Whether x is logarithmic.
    pub log_x: bool,
    /// Whether y is logarithmic.
    pub log_y: bool,
}

/// An SVG of some charts below one another. Values that cannot be drawn are left out; the text is empty if none is left.
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
    // Beyond that, ranges have no differences and axes no ticks.
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
        // Ticks are powers of ten: within one of them there is none.
        if log && high >= 10.0 * low {
            (0.8 * low..1.2 * high, true)
        } else {
            (low - room..high + room, false)
        }
    };
    if drawable(axes, series).next().is_none() {
        return Ok(());
    }
    let ((x, log_x), (y, log_y)) = (bounds(|p| p.0, axes.log_x), bounds(|p| p.1, axes.log_y));
    let (plot, names) = area.split_horizontally(SIZE.0 - NAMES);
    let mut builder = ChartBuilder::on(&plot);
    builder.caption(axes.caption, ("sans-serif", 16)).margin(10).x_label_area_size(36).y_label_area_size(60);
    // One call for each kind of axis, whose types differ.
    macro_rules! chart {
        ($x:expr, $y:expr) => {{
            let mut chart = builder.build_cartesian_2d($x, $y)?;
            chart.configure_mesh().x_desc(axes.x).y_desc(axes.y).draw()?;
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
    match (log_x, log_y) {
        (false, false) => chart!(x, y),
        (true, false) => chart!(x.log_scale(), y),
        (false, true) => chart!(x, y.log_scale()),
        (true, true) => chart!(x.log_scale(), y.log_scale()),
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_beyond_all_axes_are_left_out() {
        let axes = || Axes { caption: "c", x: "x", y: "y", ..Axes::default() };
        let series = |points: Vec<(f64, f64)>| vec![Series { name: "a < b".into(), points, line: true }];
        let drawn = svg(&[(
            axes(),
            series(vec![(0.0, 1.0), (1.0, -1e308), (2.0, 1e308), (3.0, f64::NAN), (4.0, 2.0)]),
        )]);
        // The mark beside the name is one more.
        assert_eq!(drawn.matches("<circle").count(), 3, "{drawn}");
        assert!(drawn.contains("a &lt; b"));
        assert_eq!(svg(&[(axes(), series(vec![(f64::INFINITY, 1.0)]))]), "");
    }

    #[test]
    fn a_logarithmic_axis_has_ticks_within_a_power_of_ten_too() {
        let axes = || Axes { caption: "c", x: "x", y: "y", log_x: true, ..Axes::default() };
        let drawn = |last: f64| {
            svg(&[(
                axes(),
                vec![Series { name: "n".into(), points: vec![(3000.0, 1.0), (last, 2.0)], line: true }],
            )])
        };
        assert!(drawn(4800.0).contains("3600.0"), "{}", drawn(4800.0));
        assert!(!drawn(90_000.0).contains("3600.0") && drawn(90_000.0).contains("10000.0"));
    }
}
