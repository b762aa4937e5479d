//! Colours of the pictures.

/// An sRGB colour.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rgb(pub u8, pub u8, pub u8);

impl Rgb {
    /// As SVG writes it: `#rrggbb`.
    pub fn hex(self) -> String {
        format!("#{:02x}{:02x}{:02x}", self.0, self.1, self.2)
    }
}

/// Text, axes and everything else that is read.
pub const INK: &str = "#20242c";
/// Ticks, frames and second-rank text.
pub const SOFT_INK: &str = "#5b6270";
/// Grid lines.
pub const HAIRLINE: &str = "#e3e6eb";

/// Space that has been seen to be free.
pub const FREE: Rgb = Rgb(255, 255, 255);
/// Space that nothing is known of.
pub const UNKNOWN: Rgb = Rgb(222, 225, 231);
/// Space in which a beam has ended.
pub const OCCUPIED: Rgb = Rgb(43, 48, 59);

/// Ten equidistant stops of the map "viridis" (van der Walt and Smith, public domain): even in
/// lightness, so that it also reads in grey and with colour-blind eyes. Its yellow end is left out:
/// it vanishes on white.
const VIRIDIS: [Rgb; 10] = [
    Rgb(68, 1, 84),
    Rgb(72, 38, 119),
    Rgb(63, 69, 138),
    Rgb(50, 100, 142),
    Rgb(39, 127, 142),
    Rgb(31, 153, 138),
    Rgb(48, 179, 122),
    Rgb(94, 201, 98),
    Rgb(140, 214, 69),
    Rgb(189, 223, 38),
];

/// The colour of a value between 0 and 1; values beyond take the end colours.
pub fn viridis(share: f64) -> Rgb {
    let place = share.clamp(0.0, 1.0) * (VIRIDIS.len() - 1) as f64;
    let below = (place as usize).min(VIRIDIS.len() - 2);
    let (a, b, t) = (VIRIDIS[below], VIRIDIS[below + 1], place - below as f64);
    let mix = |a: u8, b: u8| (f64::from(a) + t * (f64::from(b) - f64::from(a))).round() as u8;
    Rgb(mix(a.0, b.0), mix(a.1, b.1), mix(a.2, b.2))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_colour_map_grows_lighter_all_the_way() {
        let lightness =
            |c: Rgb| 0.2126 * f64::from(c.0) + 0.7152 * f64::from(c.1) + 0.0722 * f64::from(c.2);
        let shades: Vec<f64> =
            (0..=100).map(|i| lightness(viridis(f64::from(i) / 100.0))).collect();
        assert!(shades.windows(2).all(|pair| pair[1] > pair[0]));
    }

    #[test]
    fn values_beyond_the_ends_take_the_end_colours() {
        assert_eq!(viridis(-3.0), VIRIDIS[0]);
        assert_eq!(viridis(7.0), VIRIDIS[9]);
        assert_eq!(viridis(f64::NAN).hex().len(), 7);
    }
}
