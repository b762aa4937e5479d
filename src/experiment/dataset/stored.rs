//! A data set that has been written before.

use std::path::{Path, PathBuf};

use super::npy::{Element, Reader, sha256};
use super::{CROP_CELLS, DatasetError, FORMAT_VERSION, Manifest};

/// What is needed of a scene to score predictions of it.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneRow {
    /// 0 unknown, 1 free, 2 occupied; row by row.
    pub observed: Vec<u8>,
    /// 0 free, 1 occupied, 255 no target; row by row.
    pub truth: Vec<u8>,
    /// As in `family.npy`.
    pub family: u8,
    /// As in `source.npy`.
    pub source: i64,
}

/// A data set in a folder, opened.
pub struct Stored {
    /// Its manifest.
    pub manifest: Manifest,
    /// SHA-256 of the manifest's file.
    pub manifest_sha256: String,
    folder: PathBuf,
}

impl Stored {
    /// Opens a folder.
    ///
    /// # Errors
    /// If it is not a data set of this version.
    pub fn open(folder: &Path) -> Result<Self, DatasetError> {
        let path = folder.join("manifest.json");
        let bytes = match std::fs::read(&path) {
            Ok(bytes) => bytes,
            Err(error) => return Err(DatasetError::File { path, error }),
        };
        let damaged = |why| DatasetError::Damaged { path: path.clone(), why };
        let value: serde_json::Value =
            serde_json::from_slice(&bytes).map_err(|error| damaged(error.to_string()))?;
        let version = value.get("format_version").and_then(serde_json::Value::as_u64);
        if version != Some(u64::from(FORMAT_VERSION)) {
            let found = version.map_or_else(|| "none".to_owned(), |v| v.to_string());
            return Err(damaged(format!("format version {FORMAT_VERSION} is wanted, not {found}")));
        }
        let manifest: Manifest =
            serde_json::from_value(value).map_err(|error| damaged(error.to_string()))?;
        if manifest.crop_cells != CROP_CELLS {
            let found = manifest.crop_cells;
            return Err(damaged(format!("crops of {CROP_CELLS} cells are wanted, not {found}")));
        }
        Ok(Self { manifest, manifest_sha256: sha256(&bytes), folder: folder.to_owned() })
    }

    /// Hands out at most `most` scenes, evenly spread over the data set.
    ///
    /// # Errors
    /// If an array is missing or damaged.
    pub fn scenes(&self, most: usize, take: &mut dyn FnMut(SceneRow)) -> Result<(), DatasetError> {
        let all = self.manifest.scenes;
        let open = |name: &str, descr: &str, shape: &[usize]| {
            let path = self.folder.join(name);
            let damaged = |why| DatasetError::Damaged { path: path.clone(), why };
            let reader = Reader::open(&path, descr, shape).map_err(damaged)?;
            if reader.rows() != all {
                let rows = reader.rows();
                return Err(damaged(format!("{rows} rows, but the manifest says {all} scenes")));
            }
            Ok(reader)
        };
        let crop = [CROP_CELLS, CROP_CELLS];
        let mut observed = open("observed.npy", u8::DESCR, &crop)?;
        let mut truth = open("truth.npy", u8::DESCR, &crop)?;
        let mut source = open("source.npy", i64::DESCR, &[])?;
        let mut family = open("family.npy", u8::DESCR, &[])?;
        let mut read = |skip: usize| -> std::io::Result<SceneRow> {
            for reader in [&mut observed, &mut truth, &mut source, &mut family] {
                reader.skip_rows(skip)?;
            }
            let number = source.next_row()?.try_into().expect("a row of eight bytes");
            Ok(SceneRow {
                observed: observed.next_row()?,
                truth: truth.next_row()?,
                family: family.next_row()?[0],
                source: i64::from_le_bytes(number),
            })
        };
        let wanted = most.min(all);
        let mut next = 0;
        for k in 0..wanted {
            let at = k * all / wanted;
            let row = read(at - next)
                .map_err(|error| DatasetError::File { path: self.folder.clone(), error })?;
            take(row);
            next = at + 1;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Settings, generate, scenes};
    use super::*;

    fn settings() -> Settings {
        Settings {
            families: vec!["solid".into()],
            seeds: [1_000_000, 1_000_002],
            scenes_per_world: 4,
            resolution_m: 0.25,
            world_resolution_m: 0.25,
            lidar_ranges_m: vec![5.0],
            beams: 720,
            along_drive: 0.0,
            drive_max_m: 10.0,
            clearance_m: 0.5,
            held_out: true,
            seed: 3,
        }
    }

    #[test]
    fn what_was_written_is_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let manifest = generate(&settings(), &[], folder.path(), false, &|_, _| {}).unwrap();
        let mut made = Vec::new();
        scenes(&settings(), &[], &|_, _| {}, &mut |row| made.push(row)).unwrap();
        let stored = Stored::open(folder.path()).unwrap();
        assert_eq!(stored.manifest, manifest);
        let read = |most| {
            let mut rows = Vec::new();
            stored.scenes(most, &mut |row| rows.push(row)).unwrap();
            rows
        };
        assert_eq!(read(usize::MAX), made);
        assert_eq!(read(2), [made[0].clone(), made[4].clone()]);
        assert_eq!((made[4].family, made[4].source), (1, 1_000_001));
    }

    #[test]
    fn folders_that_are_no_data_set_or_damaged_are_refused_with_the_reason() {
        let root = tempfile::tempdir().unwrap();
        let open = || {
            let stored = Stored::open(root.path())?;
            stored.scenes(usize::MAX, &mut |_| {})
        };
        assert!(matches!(open(), Err(DatasetError::File { .. })));
        generate(&settings(), &[], root.path(), true, &|_, _| {}).unwrap();
        open().unwrap();
        let refused = |file: &str, change: &dyn Fn(&mut Vec<u8>), wanted: &str| {
            let path = root.path().join(file);
            let before = std::fs::read(&path).unwrap();
            let mut bytes = before.clone();
            change(&mut bytes);
            std::fs::write(&path, bytes).unwrap();
            let error = open().unwrap_err().to_string();
            assert!(error.contains(wanted) && error.contains(file), "{error}");
            std::fs::write(&path, before).unwrap();
        };
        refused("manifest.json", &|b| b.truncate(30), "EOF");
        refused("manifest.json", &|b| b[21] = b'7', "format version 1 is wanted, not 7");
        refused("observed.npy", &|b| b.truncate(200), "too few or too many");
        refused("observed.npy", &|b| b.truncate(3), "too short");
        refused("truth.npy", &|b| b[2] = b'x', "not an array of numpy");
        refused("source.npy", &|b| b[23] = b'f', "should hold rows");
        open().unwrap();
    }
}
