//! The arrays of a data set.

use std::path::{Path, PathBuf};

use super::npy::{Element, Writer};
use super::{ArrayEntry, CROP_CELLS, DatasetError, FRONTIERS, Scene};

/// The arrays while they are written.
pub(super) struct Files {
    folder: PathBuf,
    /// In the order of [`ARRAYS`].
    writers: Vec<Writer>,
}

/// File, element type and shape of a row.
const ARRAYS: [(&str, &str, &[usize]); 8] = [
    ("observed.npy", u8::DESCR, &[CROP_CELLS, CROP_CELLS]),
    ("truth.npy", u8::DESCR, &[CROP_CELLS, CROP_CELLS]),
    ("pose.npy", f32::DESCR, &[3]),
    ("frontier.npy", f32::DESCR, &[FRONTIERS, 2]),
    ("source.npy", i64::DESCR, &[]),
    ("family.npy", u8::DESCR, &[]),
    ("kind.npy", u8::DESCR, &[]),
    ("lidar.npy", f32::DESCR, &[]),
];

impl Files {
    /// Begins all of them in a folder.
    pub fn create(folder: &Path) -> Result<Self, DatasetError> {
        let mut writers = Vec::new();
        for (name, descr, shape) in ARRAYS {
            let path = folder.join(name);
            let writer = Writer::create(&path, descr, shape);
            writers.push(writer.map_err(|error| DatasetError::File { path, error })?);
        }
        Ok(Self { folder: folder.to_owned(), writers })
    }

    /// Appends scenes of one world: its family and its number.
    pub fn push(
        &mut self,
        (family_of, number_of): (u8, i64),
        scenes: &[Scene],
    ) -> Result<(), DatasetError> {
        let [observed, truth, pose, frontier, number, family, kind, lidar] = &mut self.writers[..]
        else {
            unreachable!("there are eight arrays")
        };
        let mut put = |scene: &Scene| -> std::io::Result<()> {
            observed.push(&scene.observed)?;
            truth.push(&scene.truth)?;
            pose.push(&scene.pose)?;
            frontier.push(scene.frontiers.as_flattened())?;
            number.push(&[number_of])?;
            family.push(&[family_of])?;
            kind.push(&[scene.kind as u8])?;
            lidar.push(&[scene.lidar_range_m])
        };
        let path = &self.folder;
        scenes
            .iter()
            .try_for_each(&mut put)
            .map_err(|error| DatasetError::File { path: path.clone(), error })
    }

    /// Ends them, and hashes them.
    pub fn finish(self) -> Result<Vec<ArrayEntry>, DatasetError> {
        let folder = self.folder;
        let finish = |(writer, (name, ..)): (Writer, (&str, &str, &[usize]))| {
            let sha256 = writer.finish();
            let fail = |error| DatasetError::File { path: folder.join(name), error };
            Ok(ArrayEntry { file: name.to_owned(), sha256: sha256.map_err(fail)? })
        };
        self.writers.into_iter().zip(ARRAYS).map(finish).collect()
    }
}
