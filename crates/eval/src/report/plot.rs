//! Curves as SVG.

use plotters::prelude::*;

/// Width and height in pixels.
const SIZE: (u32, u32) = (1000, 460);
/// Of which the names of the series take so many columns,
const NAMES: u32 = 220;
/// and each so many rows.
const ROW: i32 = 18;

/// A named line, or points that are not joined.
pub struct Series {
    /// In the legend.
    pub name: String,
    /// x and y.
    pub points: Vec<(f64, f64)>,
    /// Whether the points are joined.
    pub line: bool,
}

/// Axes of a picture.
pub struct Axes<'a> {
    /// Above it.
    pub caption: &'a str,
    /// Below it.
    pub x: &'a str,
    /// Beside it.
    pub y: &'a str,
    /// Whether x is logarithmic.
    pub log: bool,
}

/// An SVG of some series; empty if no point is finite.
pub fn svg(axes: &Axes, series: &[Series]) -> String {
    // Beyond that, ranges have no differences and axes no ticks.
    let drawn = |v: f64| v.abs() < 1e15;
    let finite = |(x, y): &(f64, f64)| drawn(*x) && drawn(*y) && (!axes.log || *x > 0.0);
    let all: Vec<(f64, f64)> = series.iter().flat_map(|s| s.points.iter().copied()).filter(finite).collect();
    let range = |of: fn(&(f64, f64)) -> f64| {
        let values = all.iter().map(of);
        let (low, high) = values.fold((f64::MAX, f64::MIN), |(low, high), v| (low.min(v), high.max(v)));
        let room = 0.05 * (high - low).max(1e-3 * high.abs()).max(1e-9);
        (low - room, high + room)
    };
    let mut text = String::new();
    if all.is_empty() {
        return text;
    }
    let ((left, right), (bottom, top)) = (range(|p| p.0), range(|p| p.1));
    {
        let area = SVGBackend::with_string(&mut text, SIZE).into_drawing_area();
        // Drawing into a string cannot fail.
        let _ = area.fill(&WHITE);
        let (plot, names) = area.split_horizontally(SIZE.0 - NAMES);
        let mut builder = ChartBuilder::on(&plot);
        let builder = builder
            .caption(axes.caption, ("sans-serif", 16))
            .margin(10)
            .x_label_area_size(36)
            .y_label_area_size(60);
        // One call for each kind of axis, whose types differ.
        macro_rules! draw {
            ($x:expr) => {
                if let Ok(mut chart) = builder.build_cartesian_2d($x, bottom..top) {
                    let _ = chart.configure_mesh().x_desc(axes.x).y_desc(axes.y).draw();
                    for (i, s) in series.iter().enumerate() {
                        let color = Palette99::pick(i).to_rgba();
                        let points: Vec<_> = s.points.iter().copied().filter(finite).collect();
                        if s.line {
                            let _ = chart.draw_series(LineSeries::new(points.iter().copied(), &color));
                        }
                        let dots = points.iter().map(|p| Circle::new(*p, 3, color.filled()));
                        let _ = chart.draw_series(dots);
                        let row = 30 + ROW * i as i32;
                        let _ = names.draw(&Circle::new((8, row), 3, color.filled()));
                        let _ = names.draw(&Text::new(s.name.clone(), (18, row - 6), ("sans-serif", 13)));
                    }
                }
            };
        }
        let least = all.iter().map(|p| p.0).fold(f64::MAX, f64::min);
        // Ticks are powers of ten: within one of them there is none.
        if axes.log && right >= 10.0 * least {
            draw!((0.8 * least..1.2 * right).log_scale());
        } else {
            draw!(left..right);
        }
        let _ = area.present();
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_drawn_is_left_out() {
        let axes = Axes { caption: "c", x: "x", y: "y", log: false };
        let series = |points: Vec<(f64, f64)>| [Series { name: "a < b".into(), points, line: true }];
        let drawn =
            svg(&axes, &series(vec![(0.0, 1.0), (1.0, -1e308), (2.0, 1e308), (3.0, f64::NAN), (4.0, 2.0)]));
        // The mark beside the name is one more.
        assert_eq!(drawn.matches("<circle").count(), 3, "{drawn}");
        assert!(drawn.contains("a &lt; b"));
        assert_eq!(svg(&axes, &series(vec![(f64::INFINITY, 1.0)])), "");
    }

    #[test]
    fn a_logarithmic_axis_has_ticks_within_a_power_of_ten_too() {
        let axes = Axes { caption: "c", x: "x", y: "y", log: true };
        let drawn = |last: f64| {
            svg(&axes, &[Series { name: "n".into(), points: vec![(3000.0, 1.0), (last, 2.0)], line: true }])
        };
        assert!(drawn(4800.0).contains("3600.0"), "{}", drawn(4800.0));
        assert!(!drawn(90_000.0).contains("3600.0") && drawn(90_000.0).contains("10000.0"));
    }
}
