//! The picture half of a map.

use std::io::Cursor;
use std::path::Path;

use image::{ImageDecoder, ImageFormat, ImageReader};

use super::metadata::{Metadata, Mode};
use super::{MapCell, MapFile, MapFileError, PIXELS_MAX};

/// Most bytes that a decoded picture may take: [`PIXELS_MAX`] in colour with transparency.
const DECODED_BYTES_MAX: u64 = 4 * PIXELS_MAX;

/// Deflate makes at most this many bytes out of one (RFC 1951: 258 bytes from two bits).
const DEFLATE_RATIO_MAX: u64 = 1032;

/// A decoded picture, row 0 at the top.
pub(super) struct Raster {
    pub width: usize,
    pub height: usize,
    samples: image::DynamicImage,
}

/// Decodes a PNG or a portable anymap (PGM, PBM, PPM, PAM; plain or binary).
pub(super) fn decode(path: &Path, bytes: &[u8]) -> Result<Raster, MapFileError> {
    let broken = |reason: String| MapFileError::Image { path: path.to_owned(), reason };
    let format = match bytes {
        [0x89, b'P', b'N', b'G', ..] => ImageFormat::Png,
        [b'P', b'1'..=b'7', ..] => ImageFormat::Pnm,
        [] => return Err(broken("the file is empty; wanted is a PNG or PGM picture".into())),
        _ => return Err(broken("neither a PNG nor a PGM picture".into())),
    };
    let decoder = ImageReader::with_format(Cursor::new(bytes), format)
        .into_decoder()
        .map_err(|e| broken(format!("not a readable picture: {e}")))?;

    // Everything about the size is settled on the header, before a pixel is allocated.
    let (width, height) = decoder.dimensions();
    let pixels = u64::from(width) * u64::from(height);
    if pixels == 0 {
        return Err(broken(format!("it has {width} x {height} pixels, but a map has some")));
    }
    if pixels > PIXELS_MAX || decoder.total_bytes() > DECODED_BYTES_MAX {
        let path = path.to_owned();
        return Err(MapFileError::TooManyPixels { path, width, height, limit: PIXELS_MAX });
    }
    let least_bytes = match bytes {
        // A bitmap packs eight pixels in a byte; every other anymap spends a byte or more on one.
        [b'P', b'4', ..] => pixels / 8,
        [b'P', ..] => pixels,
        _ => pixels / 8 / DEFLATE_RATIO_MAX,
    };
    if (bytes.len() as u64) < least_bytes {
        return Err(broken(format!(
            "cut off: its header promises {width} x {height} pixels, but the file ends after {} \
             bytes",
            bytes.len()
        )));
    }
    let samples = image::DynamicImage::from_decoder(decoder)
        .map_err(|e| broken(format!("cut off or damaged: {e}")))?;
    Ok(Raster { width: width as usize, height: height as usize, samples })
}

impl Raster {
    /// The three states, row 0 at the bottom.
    pub fn classify(&self, metadata: &Metadata) -> Vec<MapCell> {
        let colour = self.samples.color();
        let channels = usize::from(colour.channel_count());
        let colours = channels - usize::from(colour.has_alpha());
        let wide = usize::from(colour.bytes_per_pixel()) == 2 * channels;
        let bytes = self.samples.as_bytes();
        let row_bytes = self.width * usize::from(colour.bytes_per_pixel());
        let mut cells = Vec::with_capacity(self.width * self.height);

        if channels == 1 && !wide {
            let table: Vec<MapCell> =
                (0..=255u8).map(|value| classify_value(f64::from(value), metadata)).collect();
            for row in bytes.chunks_exact(row_bytes).rev() {
                cells.extend(row.iter().map(|value| table[usize::from(*value)]));
            }
            return cells;
        }
        let sample = |pixel: &[u8], k: usize| {
            if wide {
                u32::from(u16::from_ne_bytes([pixel[2 * k], pixel[2 * k + 1]]))
            } else {
                u32::from(pixel[k])
            }
        };
        let sample_max = if wide { 65_535 } else { 255 };
        for row in bytes.chunks_exact(row_bytes).rev() {
            cells.extend(row.chunks_exact(usize::from(colour.bytes_per_pixel())).map(|pixel| {
                if colours < channels && sample(pixel, colours) < sample_max {
                    return MapCell::Unknown;
                }
                let sum: u32 = (0..colours).map(|k| sample(pixel, k)).sum();
                let mean = f64::from(sum) / colours as f64;
                classify_value(mean * (255.0 / f64::from(sample_max)), metadata)
            }));
        }
        cells
    }
}

/// The state of a pixel of brightness `value`, 0 to 255.
fn classify_value(value: f64, metadata: &Metadata) -> MapCell {
    let value = if metadata.negate { 255.0 - value } else { value };
    let occupied = match metadata.mode {
        Mode::Trinary | Mode::Scale => (255.0 - value) / 255.0,
        Mode::Raw if value > 100.0 => return MapCell::Unknown,
        Mode::Raw => value / 100.0,
    };
    if occupied > metadata.occupied_thresh {
        MapCell::Occupied
    } else if occupied < metadata.free_thresh {
        MapCell::Free
    } else {
        MapCell::Unknown
    }
}

/// A binary PGM with `map_saver`'s values.
pub(super) fn encode(map: &MapFile) -> Vec<u8> {
    let mut bytes = format!("P5\n{} {}\n255\n", map.width, map.height).into_bytes();
    bytes.reserve(map.cells.len());
    for row in map.cells.chunks_exact(map.width).rev() {
        bytes.extend(row.iter().map(|cell| match cell {
            MapCell::Free => 254,
            MapCell::Unknown => 205,
            MapCell::Occupied => 0,
        }));
    }
    bytes
}
