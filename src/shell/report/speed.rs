//! Speed and forces over time.

use super::axes::{Frame, ticks};
use super::colour::{INK, SOFT_INK};
use super::svg::{Anchor, Svg};
use super::{DriveRecord, outcome_text};
use crate::sim::drive::TraceSample;

const SPEED: &str = "#1f5fa8";
const LONGITUDINAL: &str = "#0072b2";
const LATERAL: &str = "#d55e00";
const COMBINED: &str = "#dfe3ea";
const LIMIT: &str = "#b3261e";

const PAGE: [f64; 2] = [1160.0, 640.0];
const LEFT: f64 = 84.0;
const WIDTH: f64 = 1040.0;

/// The picture as an SVG document.
pub fn picture(record: &DriveRecord) -> String {
    let samples = &record.trace.samples;
    let first = samples.first().map_or(0.0, |s| s.t_s);
    let last = samples.last().map_or(0.0, |s| s.t_s);
    // From the first motion on, as the figures count it.
    let time = [0.0, if last > first { last - first } else { 1.0 }];
    let fastest = samples.iter().map(|s| s.speed_mps).fold(record.speed_limit_mps, f64::max);
    let speed_frame = Frame {
        corner: [LEFT, 84.0],
        size: [WIDTH, 220.0],
        x: time,
        y: [0.0, 1.12 * fastest.max(0.1)],
    };
    let force = |newtons: f64| newtons / record.force_limit_n;
    let combined = |s: &TraceSample| force(s.longitudinal_n.hypot(s.lateral_n));
    let reach = samples.iter().map(combined).filter(|v| v.is_finite()).fold(1.0, f64::max);
    let force_frame = Frame {
        corner: [LEFT, 346.0],
        size: [WIDTH, 220.0],
        x: time,
        y: [-1.15 * reach, 1.15 * reach],
    };

    let mut svg = Svg::new(PAGE[0], PAGE[1]);
    title(&mut svg, record);
    let time_ticks = ticks(time, 12);

    let marks = ticks(speed_frame.y, 5);
    speed_frame.draw_grid(&mut svg, &time_ticks, &marks);
    limit_line(&mut svg, &speed_frame, record.speed_limit_mps);
    curve(&mut svg, &speed_frame, samples, |s| s.speed_mps, SPEED);
    speed_frame.draw_y(&mut svg, &marks, "speed (m/s)");
    speed_frame.draw_x(&mut svg, &time_ticks, "");
    key(&mut svg, 74.0, &[("speed", SPEED), ("allowed", LIMIT)]);

    let marks = ticks(force_frame.y, 4);
    force_frame.draw_grid(&mut svg, &time_ticks, &marks);
    area(&mut svg, &force_frame, samples, combined);
    limit_line(&mut svg, &force_frame, 1.0);
    limit_line(&mut svg, &force_frame, -1.0);
    curve(&mut svg, &force_frame, samples, |s| force(s.lateral_n), LATERAL);
    curve(&mut svg, &force_frame, samples, |s| force(s.longitudinal_n), LONGITUDINAL);
    force_frame.draw_y(&mut svg, &marks, "force / friction limit");
    force_frame.draw_x(&mut svg, &time_ticks, "time (s)");
    let keys = [
        ("forward (braking below zero)", LONGITUDINAL),
        ("to the left", LATERAL),
        ("both together", "#aab1be"),
        ("friction limit", LIMIT),
    ];
    key(&mut svg, 336.0, &keys);
    svg.finish()
}

fn title(svg: &mut Svg, record: &DriveRecord) {
    let s = &record.summary;
    let head = format!("{} after {:.2} s", outcome_text(s.outcome), s.time_s);
    svg.text([LEFT, 34.0], 24.0, Anchor::Start, INK, &head);
    let limit = record.force_limit_n;
    let name =
        if record.title.is_empty() { String::new() } else { format!("{} · ", record.title) };
    let line = format!("{name}friction limit {limit:.1} N");
    svg.text([LEFT + WIDTH, 34.0], 15.0, Anchor::End, SOFT_INK, &line);
}

/// A dashed line across the frame.
fn limit_line(svg: &mut Svg, frame: &Frame, value: f64) {
    let style = format!("stroke=\"{LIMIT}\" stroke-width=\"1.3\" stroke-dasharray=\"6 4\"");
    svg.line(frame.place(frame.x[0], value), frame.place(frame.x[1], value), &style);
}

/// A quantity over time.
fn curve(
    svg: &mut Svg,
    frame: &Frame,
    samples: &[TraceSample],
    value: impl Fn(&TraceSample) -> f64,
    colour: &str,
) {
    let style =
        format!("fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.8\" stroke-linejoin=\"round\"");
    svg.chain(thinned(frame, samples, value), &style);
}

/// A quantity over time, filled down to zero.
fn area(
    svg: &mut Svg,
    frame: &Frame,
    samples: &[TraceSample],
    value: impl Fn(&TraceSample) -> f64,
) {
    let points = thinned(frame, samples, value);
    let zero = frame.place(frame.x[0], 0.0)[1];
    if let (Some(first), Some(last)) = (points.first(), points.last()) {
        let (first, last) = ([first[0], zero], [last[0], zero]);
        let chain = [first].into_iter().chain(points).chain([last]);
        svg.chain(chain, &format!("fill=\"{COMBINED}\" stroke=\"none\""));
    }
}

/// The curve's points in pixels. Of all samples that share a pixel's column the first, lowest,
/// highest and last are kept, so that no peak is lost and a long drive stays a small file.
fn thinned(
    frame: &Frame,
    samples: &[TraceSample],
    value: impl Fn(&TraceSample) -> f64,
) -> Vec<[f64; 2]> {
    let first = samples.first().map_or(0.0, |s| s.t_s);
    let points: Vec<[f64; 2]> = samples
        .iter()
        .map(|s| frame.place(s.t_s - first, value(s)))
        .filter(|[x, y]| x.is_finite() && y.is_finite())
        .collect();
    let mut kept = Vec::new();
    for column in points.chunk_by(|a, b| a[0].floor() == b[0].floor()) {
        let by_height = |a: &usize, b: &usize| column[*a][1].total_cmp(&column[*b][1]);
        let mut chosen = [
            0,
            (0..column.len()).min_by(by_height).unwrap_or(0),
            (0..column.len()).max_by(by_height).unwrap_or(0),
            column.len() - 1,
        ];
        chosen.sort_unstable();
        let mut before = None;
        for i in chosen {
            if before != Some(i) {
                kept.push(column[i]);
            }
            before = Some(i);
        }
    }
    kept
}

/// What the colours mean, right-aligned above a frame.
fn key(svg: &mut Svg, y: f64, entries: &[(&str, &str)]) {
    // The bundled font's mean advance at this size, a little generous.
    let width_of = |name: &str| 6.9 * name.chars().count() as f64;
    let mut x = LEFT + WIDTH;
    for (name, colour) in entries.iter().rev() {
        x -= width_of(name);
        svg.text([x, y], 13.5, Anchor::Start, INK, name);
        let style = format!("stroke=\"{colour}\" stroke-width=\"3\"");
        svg.line([x - 24.0, y - 4.5], [x - 6.0, y - 4.5], &style);
        x -= 44.0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::Pose;

    #[test]
    fn thinning_keeps_ends_and_peaks() {
        let frame =
            Frame { corner: [0.0, 0.0], size: [10.0, 100.0], x: [0.0, 10.0], y: [0.0, 1.0] };
        let samples: Vec<TraceSample> = (0..10_000)
            .map(|i| TraceSample {
                t_s: f64::from(i) * 1e-3,
                pose: Pose::new(0.0, 0.0, 0.0),
                speed_mps: if i == 4321 { 1.0 } else { 0.25 },
                curvature_pm: 0.0,
                longitudinal_n: 0.0,
                lateral_n: 0.0,
            })
            .collect();
        let kept = thinned(&frame, &samples, |s| s.speed_mps);
        assert!(kept.len() <= 40, "{}", kept.len());
        assert_eq!(kept[0], [0.0, 75.0]);
        assert_eq!(*kept.last().unwrap(), frame.place(9.999, 0.25));
        assert!(kept.iter().any(|p| p[1] == 0.0));
        assert!(kept.windows(2).all(|pair| pair[1][0] > pair[0][0]));
    }
}
