//! From quantities to pixels, with ticks at round values.

use super::colour::{HAIRLINE, INK, SOFT_INK};
use super::svg::{Anchor, Svg};

/// A range of a quantity, its lower end first.
pub type Range = [f64; 2];

/// A rectangle of the page that shows two quantities.
#[derive(Clone, Copy)]
pub struct Frame {
    /// Upper left corner, pixels.
    pub corner: [f64; 2],
    /// Width and height, pixels.
    pub size: [f64; 2],
    /// What runs to the right.
    pub x: Range,
    /// What runs upwards.
    pub y: Range,
}

impl Frame {
    /// Pixels of a pair of values.
    pub fn place(&self, x: f64, y: f64) -> [f64; 2] {
        let share = |value: f64, range: Range| (value - range[0]) / (range[1] - range[0]);
        [
            self.corner[0] + self.size[0] * share(x, self.x),
            self.corner[1] + self.size[1] * (1.0 - share(y, self.y)),
        ]
    }

    /// Right edge, pixels.
    pub fn right(&self) -> f64 {
        self.corner[0] + self.size[0]
    }

    /// Lower edge, pixels.
    pub fn bottom(&self) -> f64 {
        self.corner[1] + self.size[1]
    }

    /// Lines across the frame at the ticks.
    pub fn draw_grid(&self, svg: &mut Svg, x_ticks: &[f64], y_ticks: &[f64]) {
        let style = format!("stroke=\"{HAIRLINE}\"");
        for &x in x_ticks {
            let [px, _] = self.place(x, self.y[0]);
            svg.line([px, self.corner[1]], [px, self.bottom()], &style);
        }
        for &y in y_ticks {
            let [_, py] = self.place(self.x[0], y);
            svg.line([self.corner[0], py], [self.right(), py], &style);
        }
    }

    /// The frame's outline, with ticks and their values to the left of it.
    pub fn draw_y(&self, svg: &mut Svg, ticks: &[f64], label: &str) {
        self.draw_outline(svg);
        for &y in ticks {
            let [px, py] = self.place(self.x[0], y);
            svg.line([px - 5.0, py], [px, py], &tick_style());
            svg.text([px - 9.0, py + 4.5], 13.0, Anchor::End, INK, &tick_text(y, ticks));
        }
        let middle = self.corner[1] + 0.5 * self.size[1];
        svg.text_upwards([self.corner[0] - 48.0, middle], 14.0, INK, label);
    }

    /// Ticks below the frame, with values and the axis' name unless it is empty.
    pub fn draw_x(&self, svg: &mut Svg, ticks: &[f64], label: &str) {
        for &x in ticks {
            let [px, py] = self.place(x, self.y[0]);
            svg.line([px, py], [px, py + 5.0], &tick_style());
            if !label.is_empty() {
                svg.text([px, py + 20.0], 13.0, Anchor::Middle, INK, &tick_text(x, ticks));
            }
        }
        let middle = self.corner[0] + 0.5 * self.size[0];
        svg.text([middle, self.bottom() + 42.0], 14.0, Anchor::Middle, INK, label);
    }

    fn draw_outline(&self, svg: &mut Svg) {
        svg.rect(self.corner, self.size, &format!("fill=\"none\" stroke=\"{SOFT_INK}\""));
    }
}

fn tick_style() -> String {
    format!("stroke=\"{SOFT_INK}\"")
}

/// Values at 1, 2 or 5 times a power of ten inside the range, about `count` of them, but no fewer
/// than two: one alone gives no scale.
pub fn ticks(range: Range, count: usize) -> Vec<f64> {
    let span = range[1] - range[0];
    if !(span > 0.0 && span.is_finite()) {
        return vec![range[0]];
    }
    let rough = span / count.max(1) as f64;
    let power = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0]
        .map(|factor| factor * power)
        .into_iter()
        .find(|step| *step >= rough * 0.999)
        .unwrap_or(10.0 * power);
    let (first, last) =
        ((range[0] / step - 1e-9).ceil() as i64, (range[1] / step + 1e-9).floor() as i64);
    if last <= first && count < 8 {
        return ticks(range, count + 1);
    }
    (first..=last).map(|i| i as f64 * step).collect()
}

/// A tick's value with as many decimals as its neighbours need.
pub fn tick_text(value: f64, ticks: &[f64]) -> String {
    let step = ticks.windows(2).map(|pair| pair[1] - pair[0]).fold(f64::INFINITY, f64::min);
    let decimals =
        if step.is_finite() { (-step.log10() - 1e-9).ceil().clamp(0.0, 6.0) as usize } else { 1 };
    // The typographer's minus is as wide as a digit.
    format!("{:.decimals$}", if value == 0.0 { 0.0 } else { value }).replace('-', "\u{2212}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(ticks([0.0, 25.0], 5), [0.0, 5.0, 10.0, 15.0, 20.0, 25.0]);
        assert_eq!(ticks([-1.05, 1.05], 4), [-1.0, 0.0, 1.0]);
        assert_eq!(ticks([3.1, 3.9], 4), [3.2, 3.4000000000000004, 3.6, 3.8000000000000003]);
        assert_eq!(ticks([22.0, 37.9], 3), [25.0, 30.0, 35.0]);
        assert_eq!(ticks([2.0, 2.0], 4), [2.0]);
        assert_eq!(ticks([0.0, f64::NAN], 4), [0.0]);
    }

    #[test]
    fn tick_texts_have_the_decimals_that_tell_them_apart() {
        assert_eq!(tick_text(3.4000000000000004, &ticks([3.1, 3.9], 4)), "3.4");
        assert_eq!(tick_text(-5.0, &[-5.0, 0.0]), "\u{2212}5");
        assert_eq!(tick_text(-0.0, &[-0.5, 0.0]), "0.0");
        assert_eq!(tick_text(0.25, &[0.0, 0.25]), "0.2");
    }

    #[test]
    fn the_lower_left_value_lies_in_the_lower_left_corner() {
        let frame =
            Frame { corner: [10.0, 20.0], size: [100.0, 50.0], x: [1.0, 3.0], y: [-1.0, 1.0] };
        assert_eq!(frame.place(1.0, -1.0), [10.0, 70.0]);
        assert_eq!(frame.place(3.0, 1.0), [110.0, 20.0]);
    }
}
