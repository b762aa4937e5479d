//! Writing SVG: the few elements that the pictures need.

use std::fmt::Write;

use base64::Engine as _;

/// A picture under construction; coordinates are pixels from the upper left corner.
pub struct Svg {
    width: f64,
    height: f64,
    body: String,
}

/// Where a text lies with respect to its point.
#[derive(Clone, Copy)]
pub enum Anchor {
    /// It begins there.
    Start,
    /// It is centred there.
    Middle,
    /// It ends there.
    End,
}

impl Svg {
    /// An empty white page.
    pub fn new(width: f64, height: f64) -> Self {
        let mut svg = Self { width, height, body: String::new() };
        svg.rect([0.0, 0.0], [width, height], "fill=\"#fff\"");
        svg
    }

    /// A filled or outlined rectangle by its upper left corner and its size.
    pub fn rect(&mut self, corner: [f64; 2], size: [f64; 2], style: &str) {
        let ([x, y], [w, h]) = (corner, size);
        self.push(format_args!(
            "<rect x=\"{x:.2}\" y=\"{y:.2}\" width=\"{w:.2}\" height=\"{h:.2}\" {style}/>"
        ));
    }

    /// A straight line.
    pub fn line(&mut self, a: [f64; 2], b: [f64; 2], style: &str) {
        let ([x1, y1], [x2, y2]) = (a, b);
        self.push(format_args!(
            "<line x1=\"{x1:.2}\" y1=\"{y1:.2}\" x2=\"{x2:.2}\" y2=\"{y2:.2}\" {style}/>"
        ));
    }

    /// A circle.
    pub fn circle(&mut self, centre: [f64; 2], radius: f64, style: &str) {
        let [x, y] = centre;
        self.push(format_args!("<circle cx=\"{x:.2}\" cy=\"{y:.2}\" r=\"{radius:.2}\" {style}/>"));
    }

    /// A chain of straight lines; open unless the style fills it. Nothing for no points.
    pub fn chain(&mut self, points: impl IntoIterator<Item = [f64; 2]>, style: &str) {
        let mut path = String::new();
        for [x, y] in points {
            let letter = if path.is_empty() { 'M' } else { 'L' };
            let _ = write!(path, "{letter}{x:.1} {y:.1}");
        }
        if !path.is_empty() {
            self.push(format_args!("<path d=\"{path}\" {style}/>"));
        }
    }

    /// Separate straight lines in one style.
    pub fn segments(&mut self, lines: impl IntoIterator<Item = [[f64; 2]; 2]>, style: &str) {
        let mut path = String::new();
        for [[x1, y1], [x2, y2]] in lines {
            let _ = write!(path, "M{x1:.1} {y1:.1}L{x2:.1} {y2:.1}");
        }
        if !path.is_empty() {
            self.push(format_args!("<path d=\"{path}\" {style}/>"));
        }
    }

    /// A line of text; the point lies on its base line.
    pub fn text(&mut self, at: [f64; 2], size: f64, anchor: Anchor, colour: &str, text: &str) {
        let [x, y] = at;
        let (anchor, text) = (anchor.name(), escaped(text));
        self.push(format_args!(
            "<text x=\"{x:.1}\" y=\"{y:.1}\" font-size=\"{size}\" text-anchor=\"{anchor}\" \
             fill=\"{colour}\">{text}</text>"
        ));
    }

    /// A line of text that reads upwards, centred on its point.
    pub fn text_upwards(&mut self, at: [f64; 2], size: f64, colour: &str, text: &str) {
        let ([x, y], text) = (at, escaped(text));
        self.push(format_args!(
            "<text transform=\"translate({x:.1} {y:.1}) rotate(-90)\" font-size=\"{size}\" \
             text-anchor=\"middle\" fill=\"{colour}\">{text}</text>"
        ));
    }

    /// A PNG picture stretched over a rectangle, its pixels left square.
    pub fn png(&mut self, corner: [f64; 2], size: [f64; 2], png: &[u8]) {
        let ([x, y], [w, h]) = (corner, size);
        let data = base64::engine::general_purpose::STANDARD.encode(png);
        self.push(format_args!(
            "<image x=\"{x:.2}\" y=\"{y:.2}\" width=\"{w:.2}\" height=\"{h:.2}\" \
             preserveAspectRatio=\"none\" style=\"image-rendering:pixelated\" \
             href=\"data:image/png;base64,{data}\"/>"
        ));
    }

    /// Colours from left to right or from bottom to top, to be used as `fill="url(#id)"`.
    pub fn gradient_upwards(&mut self, id: &str, colours: &[String]) {
        let mut stops = String::new();
        for (i, colour) in colours.iter().enumerate() {
            let offset = i as f64 / (colours.len() - 1).max(1) as f64;
            let _ = write!(stops, "<stop offset=\"{offset:.4}\" stop-color=\"{colour}\"/>");
        }
        self.push(format_args!(
            "<defs><linearGradient id=\"{id}\" x1=\"0\" y1=\"1\" x2=\"0\" y2=\"0\">{stops}\
             </linearGradient></defs>"
        ));
    }

    /// Everything drawn by `draw` is cut off at a rectangle.
    pub fn clipped(
        &mut self,
        id: &str,
        corner: [f64; 2],
        size: [f64; 2],
        draw: impl FnOnce(&mut Self),
    ) {
        self.push(format_args!("<clipPath id=\"{id}\">"));
        self.rect(corner, size, "");
        self.push(format_args!("</clipPath><g clip-path=\"url(#{id})\">"));
        draw(self);
        self.push(format_args!("</g>"));
    }

    /// The finished document.
    pub fn finish(self) -> String {
        let Self { width, height, body } = self;
        // The bundled font first; the others are for viewers that do not have it.
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width:.0}\" height=\"{height:.0}\" \
             viewBox=\"0 0 {width:.0} {height:.0}\" \
             font-family=\"Ubuntu, 'Noto Sans', 'Segoe UI', Helvetica, Arial, sans-serif\">\n\
             {body}</svg>\n"
        )
    }

    fn push(&mut self, element: std::fmt::Arguments<'_>) {
        let _ = writeln!(self.body, "{element}");
    }
}

impl Anchor {
    const fn name(self) -> &'static str {
        match self {
            Self::Start => "start",
            Self::Middle => "middle",
            Self::End => "end",
        }
    }
}

/// A text without characters that mean something in XML, or that XML forbids.
fn escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            c if c.is_control() => out.push(' '),
            c => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_text_gives_a_document_that_parses() {
        let mut svg = Svg::new(100.0, 50.0);
        svg.text([5.0, 20.0], 12.0, Anchor::Start, "#000", "a<b & \"c\" \u{1} \u{1b}[0m ]]>");
        let document = svg.finish();
        assert!(document.contains("a&lt;b &amp; &quot;c&quot;"));
        super::super::raster::png("test", &document).unwrap();
    }
}
