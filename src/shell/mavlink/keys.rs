//! The key for signatures and the time stamps that go with it, in files.

use std::fs;
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::wire::mavlink::{SigningState, StreamStamp};

/// Why there is no key.
#[derive(Debug, thiserror::Error)]
pub enum KeyError {
    /// The file cannot be read.
    #[error("cannot read the key for signatures {}: {error}", .path.display())]
    Unreadable {
        /// Which.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// It holds something else.
    #[error(
        "{} holds no key: it must have 64 hexadecimal digits (openssl rand -hex 32)",
        .0.display()
    )]
    NoKey(PathBuf),
    /// Others may read it.
    #[error("others may read the key for signatures: chmod 600 {}", .0.display())]
    Readable(PathBuf),
}

/// Reads a key.
///
/// # Errors
/// If the file cannot be read, may be read by others, or holds no key.
pub fn read_key(path: &Path) -> Result<[u8; 32], KeyError> {
    use std::os::unix::fs::PermissionsExt;
    let unreadable = |error| KeyError::Unreadable { path: path.to_owned(), error };
    let mode = fs::metadata(path).map_err(unreadable)?.permissions().mode();
    if mode & 0o007 != 0 {
        return Err(KeyError::Readable(path.to_owned()));
    }
    let text = fs::read_to_string(path).map_err(unreadable)?;
    let digits = text.trim();
    let byte = |i: usize| digits.get(2 * i..2 * i + 2).and_then(|d| u8::from_str_radix(d, 16).ok());
    let bytes: Option<Vec<u8>> = (0..32).map(byte).collect();
    let key = bytes.filter(|_| digits.len() == 64).and_then(|bytes| bytes.try_into().ok());
    key.ok_or_else(|| KeyError::NoKey(path.to_owned()))
}

/// Writes a key that nobody else can read.
pub fn write_key(path: &Path, key: &[u8; 32]) -> io::Result<()> {
    let digits: String = key.iter().map(|byte| format!("{byte:02x}")).collect();
    replace(path, format!("{digits}\n").as_bytes())
}

#[derive(Default, Deserialize, Serialize)]
struct Stored {
    used_up_to: u64,
    /// System, component, link, time stamp.
    streams: Vec<(u8, u8, u8, u64)>,
}

/// Reads time stamps; without a file there are none yet.
///
/// # Errors
/// If the file is there, but cannot be read: going on without it would allow replays.
pub fn read_state(path: &Path) -> io::Result<SigningState> {
    let text = match fs::read(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(SigningState::default()),
        read => read?,
    };
    let stored: Stored = serde_json::from_slice(&text)?;
    let stream =
        |(system, component, link, timestamp)| StreamStamp { system, component, link, timestamp };
    Ok(SigningState {
        used_up_to: stored.used_up_to,
        streams: stored.streams.into_iter().map(stream).collect(),
    })
}

/// Writes time stamps.
pub fn write_state(path: &Path, state: &SigningState) -> io::Result<()> {
    let streams = state.streams.iter().map(|s| (s.system, s.component, s.link, s.timestamp));
    let stored = Stored { used_up_to: state.used_up_to, streams: streams.collect() };
    replace(path, &serde_json::to_vec(&stored)?)
}

/// Writes a file so that it is either the old or the new one, whatever happens.
pub fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut name = path.as_os_str().to_owned();
    name.push(".new");
    let new = PathBuf::from(name);
    // One that was left behind may have other permissions.
    match fs::remove_file(&new) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    let mut file = fs::OpenOptions::new().write(true).create_new(true).mode(0o600).open(&new)?;
    file.write_all(bytes)?;
    file.sync_all()?;
    fs::rename(&new, path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_is_read_as_it_was_written_and_by_nobody_else() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("key");
        assert!(matches!(read_key(&path), Err(KeyError::Unreadable { .. })));
        let key = std::array::from_fn(|i| 7 * i as u8);
        write_key(&path, &key).unwrap();
        assert_eq!(read_key(&path).unwrap(), key);
        fs::set_permissions(&path, fs::Permissions::from_mode(0o604)).unwrap();
        assert!(matches!(read_key(&path), Err(KeyError::Readable(_))));
        for text in ["", "00", &"g".repeat(64), &"0".repeat(65), &"ä".repeat(32)] {
            fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
            fs::write(&path, text).unwrap();
            assert!(matches!(read_key(&path), Err(KeyError::NoKey(_))), "{text}");
        }
    }

    #[test]
    fn time_stamps_outlive_a_restart_and_a_broken_file_is_no_empty_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("stamps");
        assert_eq!(read_state(&path).unwrap(), SigningState::default());
        let stream = StreamStamp { system: 255, component: 190, link: 3, timestamp: 1 << 47 };
        let state = SigningState { used_up_to: 123, streams: vec![stream] };
        write_state(&path, &state).unwrap();
        assert_eq!(read_state(&path).unwrap(), state);
        fs::write(&path, "{").unwrap();
        assert!(read_state(&path).is_err());
    }
}
