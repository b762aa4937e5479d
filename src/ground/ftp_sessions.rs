//! Open files of ground stations: few, and closed when nobody asks for more.

use super::ftp::Volume;
use super::outbox::Peer;
use crate::time::{Duration, Instant};

/// Open files of one ground station.
const PER_PEER: usize = 4;
/// Open files altogether.
const ALL: usize = 32;
/// A file that nobody asks for any more is closed.
const SILENCE: Duration = Duration::from_secs(60);

/// An open file.
pub struct Session {
    /// Its number.
    pub number: u8,
    /// Whose it is.
    pub peer: Peer,
    /// The file.
    pub volume: Box<dyn Volume>,
    /// When it was asked for last.
    pub used: Instant,
}

/// All open files.
#[derive(Default)]
pub struct Sessions {
    open: Vec<Session>,
}

impl Sessions {
    /// Opens one more; `None` if there are too many.
    pub fn open(&mut self, now: Instant, peer: Peer, volume: Box<dyn Volume>) -> Option<u8> {
        self.expire(now);
        let own = self.open.iter().filter(|session| session.peer == peer).count();
        if own >= PER_PEER || self.open.len() >= ALL {
            return None;
        }
        let taken = |number: &u8| self.open.iter().any(|session| session.number == *number);
        let number = (0..=u8::MAX).find(|number| !taken(number))?;
        self.open.push(Session { number, peer, volume, used: now });
        Some(number)
    }

    /// An open file of a ground station.
    pub fn get(&mut self, now: Instant, peer: Peer, number: u8) -> Option<&mut Session> {
        let ours = |session: &&mut Session| session.peer == peer && session.number == number;
        let session = self.open.iter_mut().find(ours)?;
        session.used = now;
        Some(session)
    }

    /// Closes a file; says whether it was open.
    pub fn close(&mut self, peer: Peer, number: u8) -> bool {
        let before = self.open.len();
        self.open.retain(|session| session.peer != peer || session.number != number);
        self.open.len() < before
    }

    /// Closes all files of a ground station.
    pub fn reset(&mut self, peer: Peer) {
        self.open.retain(|session| session.peer != peer);
    }

    /// Closes what nobody asks for any more.
    pub fn expire(&mut self, now: Instant) {
        self.open.retain(|session| now.since(session.used) < SILENCE);
    }

    /// How many are open.
    pub fn count(&self) -> usize {
        self.open.len()
    }
}
