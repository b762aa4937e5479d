use std::fs;

use super::*;

const YAML: &str = "image: map.pgm\nresolution: 0.05\norigin: [-1.5, 2.0, 0.25]\nnegate: 0\n\
                    occupied_thresh: 0.65\nfree_thresh: 0.196\n";

/// Two rows of three, the top one free, unknown, occupied, the lower one occupied throughout.
const PGM: &[u8] = b"P5\n# made by hand\n3 2\n255\n\xfe\xcd\x00\x00\x00\x00";

struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }
    fn with(self, name: &str, bytes: impl AsRef<[u8]>) -> Self {
        let path = self.0.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
        self
    }
    fn load(&self, name: &str) -> Result<MapFile, MapFileError> {
        load(self.0.path().join(name))
    }
}

/// What is said of a YAML text, next to a good picture.
fn said_of(yaml: impl AsRef<[u8]>) -> String {
    let folder = Folder::new().with("map.pgm", PGM).with("map.yaml", yaml);
    folder.load("map.yaml").unwrap_err().to_string()
}

/// What is said of a picture, next to a good YAML file.
fn said_of_picture(picture: impl AsRef<[u8]>) -> String {
    let folder = Folder::new().with("map.pgm", picture).with("map.yaml", YAML);
    let text = folder.load("map.yaml").unwrap_err().to_string();
    assert!(text.contains("map.pgm"), "names the picture: {text}");
    text
}

/// The cells of one row of pixels, read with more lines of YAML.
fn states(image: &image::DynamicImage, more: &str) -> Vec<MapCell> {
    let folder = Folder::new();
    image.save(folder.0.path().join("map.png")).unwrap();
    let yaml = format!("image: map.png\nresolution: 0.1\norigin: [0, 0, 0]\n{more}");
    folder.with("map.yaml", yaml).load("map.yaml").unwrap().cells
}

use MapCell::{Free, Occupied, Unknown};

#[test]
fn a_map_is_read_bottom_row_first() {
    let map = Folder::new().with("map.pgm", PGM).with("map.yaml", YAML).load("map.yaml").unwrap();
    assert_eq!((map.width, map.height, map.resolution_m), (3, 2, 0.05));
    assert_eq!(map.origin, Pose::new(-1.5, 2.0, 0.25));
    assert_eq!(map.cells, [Occupied, Occupied, Occupied, Free, Unknown, Occupied]);
    assert_eq!((map.get(1, 1), map.get(3, 0), map.get(0, 2)), (Some(Unknown), None, None));
}

#[test]
fn yaml_comes_in_many_dresses() {
    let plain = Folder::new().with("map.pgm", PGM).with("map.yaml", YAML).load("map.yaml").unwrap();
    let dresses = [
        "# a comment\norigin:\n- -1.5\n- 2\n- 0.25\nfree_thresh: 0.196\nresolution: 5.0e-2\n\
         image: map.pgm # here\noccupied_thresh: 0.65\nnegate: false\nmode: trinary\nauthor: x\n",
        "{image: map.pgm, resolution: 0.05, origin: [-1.5, 2.0, 0.25]}",
        "---\r\nimage: \"map.pgm\"\r\nresolution: '0.05'\r\norigin: [-1.5,2.0,2.5e-1]\r\n",
        "image: ./map.pgm\nresolution: 0.05\norigin: [-1.5, 2.0, 0.25]\nmode: scale\n...\n",
    ];
    for yaml in dresses {
        let folder = Folder::new().with("map.pgm", PGM).with("map.yaml", yaml);
        assert_eq!(folder.load("map.yaml").unwrap(), plain, "{yaml}");
    }
    let folder = Folder::new()
        .with("pictures/map.pgm", PGM)
        .with("maps/map.yml", YAML.replace("map.pgm", "../pictures/map.pgm"));
    assert_eq!(folder.load("maps/map.yml").unwrap(), plain);
}

#[test]
fn text_and_wide_pictures_mean_the_same_as_bytes() {
    let plain = Folder::new().with("map.pgm", PGM).with("map.yaml", YAML).load("map.yaml").unwrap();
    let pictures: [&[u8]; 3] = [
        b"P2\n# text\n3 2\n255\n254 205 0\n0 0 0\n",
        b"P5 3 2 65535\n\xfe\xfe\xcd\xcd\x00\x00\x00\x00\x00\x00\x00\x00",
        b"P6 3 2 255\n\xfe\xfe\xfe\xcd\xcd\xcd\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00",
    ];
    for picture in pictures {
        let folder = Folder::new().with("map.pgm", picture).with("map.yaml", YAML);
        assert_eq!(folder.load("map.yaml").unwrap(), plain);
    }
}

#[test]
fn colours_count_by_their_mean_and_transparent_pixels_are_unknown() {
    let grey = image::GrayImage::from_raw(4, 1, vec![254, 205, 89, 0]).unwrap();
    // 89: occupancy 166/255 = 0.651, just above the threshold.
    assert_eq!(states(&grey.into(), ""), [Free, Unknown, Occupied, Occupied]);
    let colour = image::RgbImage::from_raw(3, 1, vec![255, 255, 252, 205, 200, 210, 255, 0, 0]);
    assert_eq!(states(&colour.unwrap().into(), ""), [Free, Unknown, Occupied]);
    let alpha = image::RgbaImage::from_raw(
        4,
        1,
        vec![254, 254, 254, 255, 205, 205, 205, 255, 0, 0, 0, 255, 255, 255, 255, 254],
    );
    assert_eq!(states(&alpha.unwrap().into(), ""), [Free, Unknown, Occupied, Unknown]);
    let grey_alpha = image::GrayAlphaImage::from_raw(2, 1, vec![255, 255, 255, 0]).unwrap();
    assert_eq!(states(&grey_alpha.into(), ""), [Free, Unknown]);
    let wide =
        image::ImageBuffer::<image::Luma<u16>, _>::from_raw(3, 1, vec![65_535, 205 * 257, 1_000]);
    assert_eq!(
        states(&image::DynamicImage::ImageLuma16(wide.unwrap()), ""),
        [Free, Unknown, Occupied]
    );
}

#[test]
fn negate_thresholds_and_modes_change_the_meaning() {
    let grey = |values: &[u8]| -> image::DynamicImage {
        image::GrayImage::from_raw(values.len() as u32, 1, values.to_vec()).unwrap().into()
    };
    assert_eq!(states(&grey(&[0, 255, 50]), "negate: 1"), [Free, Occupied, Unknown]);
    let more = "occupied_thresh: 0.45\nfree_thresh: 0.1";
    assert_eq!(states(&grey(&[254, 220, 140]), more), [Free, Unknown, Occupied]);
    // The picture's value is the occupancy in per cent.
    let raw = states(&grey(&[0, 19, 20, 65, 66, 100, 101, 255]), "mode: raw");
    assert_eq!(raw, [Free, Free, Unknown, Unknown, Occupied, Occupied, Unknown, Unknown]);
}

#[test]
fn what_is_saved_is_what_is_loaded() {
    let folder = Folder::new();
    let path = folder.0.path().join("no: 1.yaml");
    let cells: Vec<MapCell> = (0..35).map(|k| [Free, Occupied, Unknown, Free][k * 7 % 4]).collect();
    let map = MapFile {
        resolution_m: 0.05000000074505806,
        origin: Pose::new(-7.748979949951172, 1e-9, 3.1),
        width: 7,
        height: 5,
        cells,
    };
    save(&path, &map).unwrap();
    assert_eq!(load(&path).unwrap(), map);
    let error = save(folder.0.path().join("map.pgm"), &map).unwrap_err().to_string();
    assert!(error.contains(".yaml"), "{error}");
    let error = save(folder.0.path().join("none/map.yaml"), &map).unwrap_err().to_string();
    assert!(error.contains("cannot write") && error.contains("none"), "{error}");
    let wrong = MapFile { width: 8, ..map };
    assert!(save(&path, &wrong).is_err());
}

#[test]
fn a_wrong_value_is_named_with_what_is_allowed() {
    let cases = [
        ("resolution: 0.05", "resolution: 0", "resolution is 0, but must be a number of metres"),
        ("resolution: 0.05", "resolution: -0.05", "resolution is -0.05"),
        ("resolution: 0.05", "resolution: .nan", "resolution is .nan"),
        ("resolution: 0.05", "resolution: .inf", "resolution is .inf"),
        ("resolution: 0.05", "resolution: [1, 2]", "resolution is [1,2]"),
        ("resolution: 0.05", "resolution: fine", "resolution is \"fine\""),
        ("resolution: 0.05\n", "", "resolution is missing"),
        ("resolution: 0.05", "resolution:", "resolution is missing"),
        ("image: map.pgm", "image: ''", "image is \"\", but must be the name"),
        ("image: map.pgm", "image: 7", "image is 7"),
        ("image: map.pgm\n", "", "image is missing"),
        ("[-1.5, 2.0, 0.25]", "[-1.5, 2.0]", "origin is [-1.5,2.0], but must be a list of three"),
        ("[-1.5, 2.0, 0.25]", "[-1.5, 2.0, north]", "origin is"),
        ("[-1.5, 2.0, 0.25]", "[.nan, 2.0, 0]", "origin is"),
        ("[-1.5, 2.0, 0.25]", "5", "origin is 5"),
        ("negate: 0", "negate: 2", "negate is 2, but must be 0 or 1"),
        ("0.196", "0.7", "free_thresh is 0.7 and occupied_thresh is 0.65"),
        ("0.65", "65", "occupied_thresh is 65, but must be a number from 0 to 1"),
        ("0.65", ".nan", "occupied_thresh is .nan"),
        ("negate: 0", "mode: ternary", "mode is \"ternary\", but must be trinary, scale or raw"),
    ];
    for (good, bad, expected) in cases {
        assert!(YAML.contains(good), "{good}");
        let text = said_of(YAML.replace(good, bad));
        assert!(text.contains(expected) && text.contains("map.yaml"), "{bad}: {text}");
    }
}

#[test]
fn what_is_not_a_map_is_called_so() {
    let png = [0x89, b'P', b'N', b'G', 13, 10, 26, 10];
    for (bytes, expected) in [
        (&png[..], "not text"),
        (b"", "empty"),
        (b"\n\n", "empty"),
        (b"just some words", "no keys"),
        (b"- a\n- b\n", "no keys"),
        (b"name: car\nspeed: 3\n", "none of the keys"),
        (b"image: [map.pgm\nresolution: 0.05\n", "map.yaml is not a map file"),
        (b"a: &a [x, x]\nb: &b [*a, *a]\nimage: *nothing\n", "map.yaml is not a map file"),
    ] {
        let text = said_of(bytes);
        assert!(text.contains(expected) && text.contains("map_server"), "{text}");
    }
    assert!(said_of(vec![b'#'; 300_000]).contains("more than 16384 bytes"));
    let nested = "[".repeat(10_000);
    assert!(said_of(format!("image: {nested}")).contains("not a map file"));
}

#[test]
fn a_missing_file_is_named() {
    let folder = Folder::new().with("map.yaml", YAML);
    let text = folder.load("other.yaml").unwrap_err().to_string();
    assert!(text.contains("cannot read") && text.contains("other.yaml"), "{text}");
    let text = folder.load("map.yaml").unwrap_err().to_string();
    assert!(text.contains("cannot read") && text.contains("map.pgm"), "{text}");
    assert!(folder.load("").is_err(), "a folder");
}

#[test]
fn a_broken_picture_is_refused_before_anything_is_allocated_for_it() {
    assert!(said_of_picture(b"").contains("empty"));
    assert!(said_of_picture(b"GIF89a......").contains("neither a PNG nor a PGM"));
    assert!(said_of_picture(b"P5\n3").contains("not a readable picture"));
    assert!(said_of_picture(b"P5 0 0 255\n").contains("0 x 0"));
    assert!(said_of_picture(b"P5 3 2 255\n\x00\x00\x00").contains("cut off"));
    assert!(said_of_picture(b"P2 3 2 255\n1 2 3 4").contains("cut off"));
    assert!(said_of_picture(b"P2 3 2 255\n1 2 3 4 x 6").contains("cut off or damaged"));
    assert!(said_of_picture(b"P5 8000 8000 255\n\x00").contains("promises 8000 x 8000 pixels"));
    let text = said_of_picture(b"P5 100000 100000 255\n\x00");
    assert!(text.contains("100000 x 100000 pixels; at most 67108864"), "{text}");
    assert!(!said_of_picture(b"P5 4294967295 4294967295 65535\n").is_empty());

    let mut png = Vec::new();
    let image = image::GrayImage::from_fn(64, 64, |x, y| image::Luma([(x * y % 251) as u8]));
    image.write_to(&mut std::io::Cursor::new(&mut png), image::ImageFormat::Png).unwrap();
    assert!(said_of_picture(&png[..png.len() / 2]).contains("cut off or damaged"));
    assert!(!said_of_picture(&png[..20]).is_empty());
    // A header that lies: sides of 8000, then of 4 thousand million pixels (checksum made good).
    for (side, expected) in [(8000u32, "cut off: its header promises"), (4_000_000_000, "")] {
        let mut lying = png.clone();
        lying[16..20].copy_from_slice(&side.to_be_bytes());
        lying[20..24].copy_from_slice(&side.to_be_bytes());
        let checksum = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&lying[12..29]);
        lying[29..33].copy_from_slice(&checksum.to_be_bytes());
        let text = said_of_picture(&lying);
        assert!(text.contains(expected), "{text}");
    }
}

#[test]
fn damaged_bytes_never_panic() {
    use rand_chacha::rand_core::{Rng, SeedableRng};
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(5);
    let mut png = Vec::new();
    let image = image::RgbaImage::from_pixel(9, 7, image::Rgba([200, 10, 3, 255]));
    image.write_to(&mut std::io::Cursor::new(&mut png), image::ImageFormat::Png).unwrap();
    let path = Path::new("damaged");
    for _ in 0..2_000 {
        let mut yaml = YAML.as_bytes().to_vec();
        let mut pictures = [PGM.to_vec(), png.clone()];
        for bytes in pictures.iter_mut().chain([&mut yaml]) {
            let at = rng.next_u32() as usize % bytes.len();
            bytes[at] = rng.next_u32() as u8;
            if rng.next_u32() % 3 == 0 {
                bytes.truncate(rng.next_u32() as usize % bytes.len());
            }
        }
        let _ = std::str::from_utf8(&yaml).map(|text| metadata::parse(path, text));
        for picture in &pictures {
            if let Ok(raster) = raster::decode(path, picture) {
                let good = metadata::parse(path, YAML).unwrap();
                assert_eq!(raster.classify(&good).len(), raster.width * raster.height);
            }
        }
    }
}

/// Every map_server map in the folder named by `APEXD_DATA`, at any depth.
#[test]
fn all_maps_of_the_data_folder_load() {
    let Some(folder) = std::env::var_os("APEXD_DATA") else {
        println!("skipped: APEXD_DATA is not set");
        return;
    };
    let mut folders = vec![PathBuf::from(folder)];
    let mut read = 0;
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|e| e == "yaml" || e == "yml") {
                let map = load(&path).unwrap();
                let count = |state| map.cells.iter().filter(|cell| **cell == state).count();
                let (free, occupied) = (count(Free), count(Occupied));
                assert!(free > 0 && occupied > 0, "{}: a map of one state", path.display());
                println!(
                    "{}: {} x {} at {} m, origin {:?}, free {free}, occupied {occupied}, unknown {}",
                    path.display(),
                    map.width,
                    map.height,
                    map.resolution_m,
                    map.origin,
                    count(Unknown)
                );
                read += 1;
            }
        }
    }
    assert!(read > 0, "no map in the folder");
}
