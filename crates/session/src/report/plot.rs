//! Plots as inline SVG in the page's text colour.

use maud::{Markup, PreEscaped, html};
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::style::{PALETTE, short};
use crate::{Error, Result};

const SIZE_PX: (u32, u32) = (620, 310);
/// Placeholder for the page's text colour while drawing; no series has this colour.
const INK: RGBColor = RGBColor(1, 2, 3);
const INK_HEX: &str = "\"#010203\"";

/// A plot of one or more series.
#[derive(Debug, Clone, Default)]
pub struct Plot {
    /// The heading.
    pub title: String,
    /// Label of the x axis, with its unit.
    pub x_label: String,
    /// Label of the y axis, with its unit.
    pub y_label: String,
    /// Drawn in order; non-finite values are left out.
    pub series: Vec<Series>,
    /// Vertical marker lines.
    pub guides: Vec<Guide>,
}

/// Values to draw.
#[derive(Debug, Clone)]
pub struct Series {
    /// Shown in the legend.
    pub name: String,
    /// How to draw it.
    pub style: SeriesStyle,
    /// Pairs of x and y.
    pub points: Vec<(f64, f64)>,
}

/// How a series is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SeriesStyle {
    /// Points joined by lines.
    Line,
    /// Points alone.
    Dots,
    /// Bars from 0, as wide as the smallest distance in x: a histogram.
    Bars,
    /// The area within these points, in the colour of the series before it: its uncertainty.
    Band,
}

/// A vertical line that marks a value of x.
#[derive(Debug, Clone, PartialEq)]
pub struct Guide {
    /// Position in x.
    pub x: f64,
    /// Label at its upper end.
    pub label: String,
}

impl Plot {
    pub(super) fn to_figure(&self) -> Result<Markup> {
        let series: Vec<_> = self.series.iter().map(Series::finite).collect();
        let drawing = match Bounds::of(&series, &self.guides) {
            Some(bounds) => {
                let svg = self
                    .draw(&series, &bounds)
                    .map_err(Error::codec("draw", format!("plot `{}`", self.title)))?;
                html! { (PreEscaped(svg)) }
            }
            None => html! { p.empty { "no data" } },
        };
        Ok(html! {
            figure.plot {
                figcaption {
                    strong { (self.title) }
                    @if self.named().count() > 1 {
                        span.legend {
                            @for (series, colour) in self.named().zip(PALETTE.iter().cycle()) {
                                span { i style=(format!("background:{colour}")) {} (series.name) }
                            }
                        }
                    }
                }
                (drawing)
            }
        })
    }

    /// The series that have a colour of their own.
    fn named(&self) -> impl Iterator<Item = &Series> {
        self.series.iter().filter(|series| series.style != SeriesStyle::Band)
    }

    /// The plot as an SVG file of its own, with a legend below its upper edge.
    ///
    /// # Errors
    /// [`crate::Error::Codec`] if it cannot be drawn or has no points.
    pub fn to_svg(&self) -> Result<String> {
        let failed = |what: &str| Error::codec("draw", format!("plot `{}`", self.title))(what.to_owned());
        let series: Vec<_> = self.series.iter().map(Series::finite).collect();
        let bounds = Bounds::of(&series, &self.guides).ok_or_else(|| failed("it has no points"))?;
        let svg =
            self.draw(&series, &bounds).map_err(Error::codec("draw", format!("plot `{}`", self.title)))?;
        let legend: String = self
            .named()
            .zip(PALETTE.iter().cycle())
            .zip(0..)
            .map(|((series, colour), at)| {
                let name = html! { (series.name) }.into_string();
                let y = 26 + 18 * at;
                format!("<text x=\"{}\" y=\"{y}\" text-anchor=\"end\" font-family=\"sans-serif\" font-size=\"14\" fill=\"{colour}\">{name}</text>\n", SIZE_PX.0 - 24)
            })
            .collect();
        Ok(svg.replacen("</svg>", &format!("{legend}</svg>"), 1).replace("\"currentColor\"", "\"#333333\""))
    }

    fn draw(
        &self,
        series: &[Series],
        bounds: &Bounds,
    ) -> std::result::Result<String, Box<dyn std::error::Error>> {
        let mut svg = String::new();
        {
            let faded = INK.mix(0.75);
            let root = SVGBackend::with_string(&mut svg, SIZE_PX).into_drawing_area();
            let mut chart = ChartBuilder::on(&root)
                .margin(8)
                // Half of the longest label, at a tick that lies on the edge.
                .margin_right(26)
                .margin_top(if self.guides.is_empty() { 8 } else { 30 })
                .x_label_area_size(46)
                .y_label_area_size(62)
                .build_cartesian_2d(bounds.x.0..bounds.x.1, bounds.y.0..bounds.y.1)?;
            chart
                .configure_mesh()
                .light_line_style(TRANSPARENT)
                .bold_line_style(INK.mix(0.11))
                .axis_style(INK.mix(0.45))
                .label_style(("sans-serif", 14).into_font().color(&faded))
                .axis_desc_style(("sans-serif", 14).into_font().color(&faded))
                .x_desc(&self.x_label)
                .y_desc(&self.y_label)
                .x_labels(7)
                .y_labels(6)
                .x_label_formatter(&|x| tick(*x, bounds.x))
                .y_label_formatter(&|y| tick(*y, bounds.y))
                .draw()?;
            for guide in &self.guides {
                let line = vec![(guide.x, bounds.y.0), (guide.x, bounds.y.1)];
                chart.draw_series(DashedLineSeries::new(line, 4, 4, INK.mix(0.5).stroke_width(1)))?;
                let style = TextStyle::from(("sans-serif", 13).into_font())
                    .color(&faded)
                    .pos(Pos::new(HPos::Center, VPos::Bottom));
                let (x, y) = chart.plotting_area().map_coordinate(&(guide.x, bounds.y.1));
                root.draw_text(&guide.label, &style, (x, y - 4))?;
            }
            for (series, colour) in series.iter().zip(colours(series)) {
                let colour = parse_hex(colour);
                match series.style {
                    SeriesStyle::Band => {
                        chart
                            .draw_series([Polygon::new(series.points.clone(), colour.mix(0.25).filled())])?;
                    }
                    SeriesStyle::Line => {
                        chart.draw_series(LineSeries::new(series.points.clone(), colour.stroke_width(2)))?;
                        // If there are few samples, show which values were measured.
                        if series.points.len() <= 40 {
                            chart.draw_series(dots(series, colour))?;
                        }
                    }
                    SeriesStyle::Dots => {
                        chart.draw_series(dots(series, colour))?;
                    }
                    SeriesStyle::Bars => {
                        let half = 0.46 * series.spacing();
                        let bars = series
                            .points
                            .iter()
                            .map(|&(x, y)| Rectangle::new([(x - half, 0.0), (x + half, y)], colour.filled()));
                        chart.draw_series(bars)?;
                    }
                }
            }
            root.present()?;
        }
        let (width, height) = SIZE_PX;
        Ok(svg
            .replacen(&format!("width=\"{width}\" height=\"{height}\" "), "role=\"img\" ", 1)
            .replace(INK_HEX, "\"currentColor\""))
    }
}

/// The colour of each series: that of the series before it for a band.
fn colours(series: &[Series]) -> impl Iterator<Item = &'static str> {
    let mut next = 0;
    series.iter().map(move |series| {
        next += usize::from(series.style != SeriesStyle::Band);
        PALETTE[next.saturating_sub(1) % PALETTE.len()]
    })
}

impl Series {
    /// A series drawn as an area between low and high values: (x, low, high).
    pub fn band(points: &[(f64, f64, f64)]) -> Series {
        let low = points.iter().map(|&(x, low, _)| (x, low));
        let high = points.iter().rev().map(|&(x, _, high)| (x, high));
        Series { name: String::new(), style: SeriesStyle::Band, points: low.chain(high).collect() }
    }

    /// A series drawn as a line.
    pub fn line(name: impl Into<String>, points: Vec<(f64, f64)>) -> Series {
        Series { name: name.into(), style: SeriesStyle::Line, points }
    }

    fn finite(&self) -> Series {
        let points = self.points.iter().copied().filter(|(x, y)| x.is_finite() && y.is_finite()).collect();
        Series { points, ..self.clone() }
    }

    fn spacing(&self) -> f64 {
        let mut xs: Vec<f64> = self.points.iter().map(|&(x, _)| x).collect();
        xs.sort_by(f64::total_cmp);
        let gaps = xs.windows(2).map(|pair| pair[1] - pair[0]).filter(|gap| *gap > 0.0);
        gaps.min_by(f64::total_cmp).unwrap_or(1.0)
    }
}

struct Bounds {
    x: (f64, f64),
    y: (f64, f64),
}

impl Bounds {
    /// Bounds of all points, with a margin; y starts at 0 if no value is negative. `None` if there are no
    /// points.
    fn of(series: &[Series], guides: &[Guide]) -> Option<Bounds> {
        let points = || series.iter().flat_map(|series| &series.points);
        points().next()?;
        let bars = series.iter().filter(|series| series.style == SeriesStyle::Bars);
        let half_bar = bars.map(|series| 0.5 * series.spacing()).fold(0.0, f64::max);
        let guides = guides.iter().map(|guide| guide.x).filter(|x| x.is_finite());
        let x = span(points().map(|&(x, _)| x).chain(guides));
        let y = span(points().map(|&(_, y)| y).chain([0.0]));
        let margin_x = half_bar.max(0.015 * (x.1 - x.0));
        let margin_y = 0.06 * (y.1 - y.0);
        Some(Bounds {
            x: (x.0 - margin_x, x.1 + margin_x),
            y: (if y.0 < 0.0 { y.0 - margin_y } else { 0.0 }, y.1 + margin_y),
        })
    }
}

/// Smallest and largest value, widened if the interval would be empty.
fn span(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (low, high) = values
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
    if low < high { (low, high) } else { (low - 0.5, high + 0.5) }
}

/// The label of a tick on an axis with these ends. Steps that are added up miss zero by rounding.
fn tick(value: f64, (low, high): (f64, f64)) -> String {
    short(if value.abs() < 1e-9 * (high - low) { 0.0 } else { value })
}

fn dots(series: &Series, colour: RGBColor) -> impl Iterator<Item = Circle<(f64, f64), i32>> {
    series.points.iter().map(move |&point| Circle::new(point, 3, colour.filled()))
}

fn parse_hex(colour: &str) -> RGBColor {
    let channel =
        |at: usize| colour.get(at..at + 2).and_then(|hex| u8::from_str_radix(hex, 16).ok()).unwrap_or(0);
    RGBColor(channel(1), channel(3), channel(5))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tick_at_zero_is_zero_however_its_steps_add_up() {
        assert_eq!(tick(-5.55e-17, (-0.4, 0.4)), "0");
        assert_eq!(tick(-5.55e-17, (-1e-16, 1e-16)), short(-5.55e-17));
        assert_eq!(tick(0.25, (-0.4, 0.4)), "0.25");
    }
}
