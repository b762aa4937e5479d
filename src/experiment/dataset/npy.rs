//! Arrays in the files of numpy (NEP 1, format version 1.0), written row by row.

use std::fs::File;
use std::io::{BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

/// Bytes of the header, which is padded so that the number of rows can be filled in at the end.
const HEADER_BYTES: usize = 128;

/// An element type.
pub trait Element: Copy {
    /// numpy's name for it.
    const DESCR: &'static str;
    /// Appends its bytes.
    fn append(self, bytes: &mut Vec<u8>);
}

macro_rules! element {
    ($type:ty, $descr:literal) => {
        impl Element for $type {
            const DESCR: &'static str = $descr;
            fn append(self, bytes: &mut Vec<u8>) {
                bytes.extend_from_slice(&self.to_le_bytes());
            }
        }
    };
}
element!(u8, "|u1");
element!(f32, "<f4");
element!(i64, "<i8");

/// A growing array file; its first axis counts the rows pushed.
pub struct Writer {
    path: PathBuf,
    file: BufWriter<File>,
    descr: &'static str,
    /// Elements along the other axes.
    shape: Vec<usize>,
    rows: usize,
    bytes: Vec<u8>,
}

impl Writer {
    /// Begins a file of rows of `shape`, of elements with numpy's name `descr`.
    pub fn create(path: &Path, descr: &'static str, shape: &[usize]) -> std::io::Result<Self> {
        let mut file = BufWriter::with_capacity(1 << 20, File::create(path)?);
        file.write_all(&header(descr, 0, shape))?;
        Ok(Self {
            path: path.to_owned(),
            file,
            descr,
            shape: shape.to_vec(),
            rows: 0,
            bytes: Vec::new(),
        })
    }

    /// Appends one row.
    ///
    /// # Panics
    /// If the row is of another type or length than the file's.
    pub fn push<T: Element>(&mut self, row: &[T]) -> std::io::Result<()> {
        assert_eq!(T::DESCR, self.descr, "element type of {}", self.path.display());
        assert_eq!(row.len(), self.shape.iter().product::<usize>(), "length of a row");
        self.rows += 1;
        self.bytes.clear();
        for element in row {
            element.append(&mut self.bytes);
        }
        self.file.write_all(&self.bytes)
    }

    /// Fills in the number of rows, and gives the SHA-256 of the whole file in hexadecimal.
    pub fn finish(mut self) -> std::io::Result<String> {
        self.file.seek(SeekFrom::Start(0))?;
        self.file.write_all(&header(self.descr, self.rows, &self.shape))?;
        self.file.into_inner().map_err(std::io::IntoInnerError::into_error)?.sync_all()?;
        sha256_of_file(&self.path)
    }
}

fn header(descr: &str, rows: usize, shape: &[usize]) -> Vec<u8> {
    let mut axes = format!("{rows},");
    for axis in shape {
        axes += &format!(" {axis},");
    }
    let axes = if shape.is_empty() { &axes[..] } else { axes.trim_end_matches(',') };
    let dictionary = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({axes}), }}");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend_from_slice(&((HEADER_BYTES - 10) as u16).to_le_bytes());
    bytes.extend_from_slice(dictionary.as_bytes());
    assert!(bytes.len() < HEADER_BYTES, "a header of {} bytes", bytes.len());
    bytes.resize(HEADER_BYTES - 1, b' ');
    bytes.push(b'\n');
    bytes
}

/// An array file being read row by row.
pub struct Reader {
    file: BufReader<File>,
    rows: usize,
    row_bytes: usize,
}

impl Reader {
    /// Opens a file that must hold rows of `shape` of elements with numpy's name `descr`.
    ///
    /// # Errors
    /// In words, what is wrong.
    pub fn open(path: &Path, descr: &str, shape: &[usize]) -> Result<Self, String> {
        let said = |error: std::io::Error| error.to_string();
        let mut file = BufReader::with_capacity(1 << 20, File::open(path).map_err(said)?);
        let mut start = [0; 10];
        file.read_exact(&mut start).map_err(|_| "too short for an array of numpy".to_owned())?;
        if &start[..8] != b"\x93NUMPY\x01\x00" {
            return Err("not an array of numpy (format 1.0)".into());
        }
        let mut text = vec![0; usize::from(u16::from_le_bytes([start[8], start[9]]))];
        file.read_exact(&mut text).map_err(|_| "its header is cut off".to_owned())?;
        let text = String::from_utf8_lossy(&text).into_owned();
        let (rows, rest) = text
            .split_once("'shape': (")
            .and_then(|(_, rest)| rest.split_once(','))
            .and_then(|(rows, rest)| Some((rows.trim().parse::<usize>().ok()?, rest)))
            .ok_or_else(|| format!("its header has no shape: {text}"))?;
        let axes = rest.split_once(')').map_or("", |(axes, _)| axes);
        let axes = axes.split(',').map(str::trim).filter(|a| !a.is_empty()).map(str::parse);
        let axes: Result<Vec<usize>, _> = axes.collect();
        let fits = text.contains(&format!("'descr': '{descr}'"))
            && text.contains("'fortran_order': False")
            && axes.as_deref() == Ok(shape);
        if !fits {
            return Err(format!("it should hold rows of {shape:?} of type {descr}: {text}"));
        }
        let element: usize = descr[2..].parse().expect("a type's name ends in its size");
        let row_bytes = shape.iter().product::<usize>() * element;
        let header_bytes = 10 + text.len() as u64;
        let bytes = file.get_ref().metadata().map_err(said)?.len();
        if bytes != header_bytes + (rows * row_bytes) as u64 {
            return Err(format!("{bytes} bytes are too few or too many for {rows} rows"));
        }
        Ok(Self { file, rows, row_bytes })
    }

    /// Number of rows.
    pub const fn rows(&self) -> usize {
        self.rows
    }

    /// The bytes of the next row.
    pub fn next_row(&mut self) -> std::io::Result<Vec<u8>> {
        let mut row = vec![0; self.row_bytes];
        self.file.read_exact(&mut row)?;
        Ok(row)
    }

    /// Passes over some rows.
    pub fn skip_rows(&mut self, rows: usize) -> std::io::Result<()> {
        self.file.seek_relative((rows * self.row_bytes) as i64)
    }
}

/// SHA-256 of a file in hexadecimal.
pub fn sha256_of_file(path: &Path) -> std::io::Result<String> {
    let mut file = File::open(path)?;
    let mut hash = Sha256::new();
    let mut buffer = vec![0; 1 << 20];
    loop {
        let n = file.read(&mut buffer)?;
        if n == 0 {
            return Ok(hex(&hash.finalize()));
        }
        hash.update(&buffer[..n]);
    }
}

/// SHA-256 of some bytes in hexadecimal.
pub fn sha256(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_what_numpy_writes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.npy");
        let mut writer = Writer::create(&path, f32::DESCR, &[2]).unwrap();
        writer.push(&[1.0_f32, -0.5]).unwrap();
        writer.push(&[f32::NAN, 3.0]).unwrap();
        let sum = writer.finish().unwrap();
        let bytes = std::fs::read(&path).unwrap();
        assert_eq!(bytes.len(), 128 + 16);
        assert_eq!(&bytes[..10], b"\x93NUMPY\x01\x00\x76\x00");
        let text = std::str::from_utf8(&bytes[10..128]).unwrap();
        let wanted = "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 2), }";
        assert_eq!(text.trim_end(), wanted);
        assert!(text.ends_with('\n'));
        assert_eq!(&bytes[128..136], [0, 0, 128, 63, 0, 0, 0, 191]);
        assert_eq!(sum, sha256(&bytes));
    }

    #[test]
    fn a_row_of_one_number_gives_an_array_of_one_axis() {
        let text = String::from_utf8_lossy(&header("|u1", 7, &[])).into_owned();
        assert!(text.contains("'shape': (7,), "), "{text}");
    }

    #[test]
    fn hashes_are_the_published_ones() {
        // FIPS 180-2, appendix B.1.
        assert_eq!(
            sha256(b"abc"),
            "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
        );
    }
}
