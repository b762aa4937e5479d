//! SVG to PNG, with the fonts that are part of the program.

use std::sync::{Arc, LazyLock};

use resvg::{tiny_skia, usvg};

use super::ReportError;

/// Pixels of the PNG for one of the SVG, so that it is sharp on a dense screen.
const SCALE: f32 = 1.5;

static FONTS: LazyLock<Arc<usvg::fontdb::Database>> = LazyLock::new(|| {
    let mut fonts = usvg::fontdb::Database::new();
    fonts.load_font_data(epaint_default_fonts::UBUNTU_LIGHT.to_vec());
    let family = |face: &usvg::fontdb::FaceInfo| Some(face.families.first()?.0.clone());
    let name = fonts.faces().next().and_then(family);
    fonts.set_sans_serif_family(name.expect("the bundled font has a family name"));
    Arc::new(fonts)
});

/// The document as `usvg` understands it.
pub fn parse(what: &'static str, svg: &str) -> Result<usvg::Tree, ReportError> {
    let options = usvg::Options { fontdb: Arc::clone(&FONTS), ..usvg::Options::default() };
    usvg::Tree::from_str(svg, &options)
        .map_err(|error| ReportError::Draw { what, why: error.to_string() })
}

/// The document as a PNG file. `what` names the picture in messages.
pub fn png(what: &'static str, svg: &str) -> Result<Vec<u8>, ReportError> {
    let fail = |why: String| ReportError::Draw { what, why };
    let tree = parse(what, svg)?;
    let size = tree.size().to_int_size().scale_by(SCALE);
    let size = size.ok_or_else(|| fail("the page is too large".into()))?;
    let mut pixels = tiny_skia::Pixmap::new(size.width(), size.height())
        .ok_or_else(|| fail(format!("no room for {} x {} pixels", size.width(), size.height())))?;
    let transform = tiny_skia::Transform::from_scale(SCALE, SCALE);
    resvg::render(&tree, transform, &mut pixels.as_mut());
    pixels.encode_png().map_err(|error| fail(error.to_string()))
}
