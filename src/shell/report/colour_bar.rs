//! A bar of colours, with what they stand for.

use super::axes::{Frame, tick_text, ticks};
use super::colour::{INK, Rgb, SOFT_INK, viridis};
use super::svg::{Anchor, Svg};

/// Steps that a bar's gradient is drawn in.
const STEPS: u32 = 24;

/// A bar of colours for a quantity that grows upwards.
pub struct ColourBar<'a> {
    /// Upper left corner, pixels.
    pub corner: [f64; 2],
    /// Height, pixels.
    pub height: f64,
    /// Name of the gradient, unique in the picture.
    pub name: &'a str,
    /// What the quantity is.
    pub label: &'a str,
    /// From the bar to the middle of the label, pixels.
    pub label_gap: f64,
}

impl ColourBar<'_> {
    /// Draws the bar with the colour of each share of its height, and texts at some of them.
    pub fn draw(&self, svg: &mut Svg, colour: impl Fn(f64) -> Rgb, marks: &[(f64, String)]) {
        let bar =
            Frame { corner: self.corner, size: [16.0, self.height], x: [0.0, 1.0], y: [0.0, 1.0] };
        let share = |step| f64::from(step) / f64::from(STEPS);
        let colours: Vec<String> = (0..=STEPS).map(|step| colour(share(step)).hex()).collect();
        svg.gradient_upwards(self.name, &colours);
        let style = format!("fill=\"url(#{})\" stroke=\"{SOFT_INK}\"", self.name);
        svg.rect(bar.corner, bar.size, &style);
        for (share, text) in marks {
            let [_, y] = bar.place(0.0, *share);
            svg.line([bar.right(), y], [bar.right() + 5.0, y], &format!("stroke=\"{SOFT_INK}\""));
            svg.text([bar.right() + 9.0, y + 4.5], 13.0, Anchor::Start, INK, text);
        }
        let middle = [bar.right() + self.label_gap, self.corner[1] + 0.5 * self.height];
        svg.text_upwards(middle, 14.0, INK, self.label);
    }
}

/// The bar for courses coloured by speed.
pub fn speed_bar(svg: &mut Svg, corner: [f64; 2], height: f64, speed_max_mps: f64) {
    let speeds = ticks([0.0, speed_max_mps], 5);
    let marks: Vec<(f64, String)> =
        speeds.iter().map(|speed| (speed / speed_max_mps, tick_text(*speed, &speeds))).collect();
    let bar = ColourBar { corner, height, name: "speed", label: "speed (m/s)", label_gap: 54.0 };
    bar.draw(svg, viridis, &marks);
}
