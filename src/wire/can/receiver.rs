//! What both receivers share: telling frames apart, end-to-end checks, statistics.

use super::database::{Kind, Sender};
use super::e2e::{Check, Checker};
use super::frame::{CanFrame, Layout};
use super::{WireError, WireStats};

/// Finds the message that a frame belongs to and judges it.
#[derive(Clone, Debug)]
pub(super) struct Receiver {
    layout: Layout,
    from: Sender,
    checkers: [Checker; Kind::ALL.len()],
    pub(super) stats: WireStats,
}

/// A frame that passed.
pub(super) struct Passed {
    pub(super) kind: Kind,
    /// Frames of this message lost just before.
    pub(super) lost: u8,
}

impl Receiver {
    pub(super) fn new(layout: Layout, from: Sender) -> Self {
        Self {
            layout,
            from,
            checkers: Kind::ALL.map(|kind| Checker::new(layout, kind.data_id(layout))),
            stats: WireStats::default(),
        }
    }

    pub(super) fn pass(&mut self, frame: &CanFrame) -> Result<Option<Passed>, WireError> {
        let ours = Kind::ALL.iter().position(|kind| {
            !frame.id.is_extended()
                && kind.sender() == self.from
                && u32::from(kind.id(self.layout)) == frame.id.raw()
        });
        let Some(index) = ours else {
            self.stats.foreign += 1;
            return Ok(None);
        };
        let kind = Kind::ALL[index];
        let id = kind.id(self.layout);
        let len = frame.data().len();
        if len != kind.len(self.layout) || frame.fd != (self.layout == Layout::Fd) {
            self.stats.wrong_length += 1;
            return Err(WireError::WrongLength { id, len: len as u8 });
        }
        match self.checkers[index].check(frame.data()) {
            Check::Accept { lost } => {
                self.stats.accepted += 1;
                self.stats.lost += u64::from(lost);
                Ok(Some(Passed { kind, lost }))
            }
            Check::Repeated => {
                self.stats.repeated += 1;
                Err(WireError::Repeated { id })
            }
            Check::WrongSequence => {
                self.stats.wrong_sequence += 1;
                Err(WireError::WrongSequence { id })
            }
            Check::WrongCrc => {
                self.stats.wrong_crc += 1;
                Err(WireError::WrongCrc { id })
            }
        }
    }

    /// Counts what became of a frame that passed, and turns it into an error where it is one.
    pub(super) fn settle<T>(
        &mut self,
        kind: Kind,
        outcome: Result<Option<T>, Fault>,
    ) -> Result<Option<T>, WireError> {
        let id = kind.id(self.layout);
        match outcome {
            Ok(done) => Ok(done),
            Err(Fault::BadValue) => {
                self.stats.bad_value += 1;
                Err(WireError::BadValue { id })
            }
            Err(Fault::Incomplete) => {
                self.stats.incomplete += 1;
                Err(WireError::Incomplete { id })
            }
            Err(Fault::Orphan) => {
                self.stats.orphans += 1;
                Err(WireError::Incomplete { id })
            }
        }
    }
}

/// What may be wrong with a frame that passed its checks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Fault {
    /// Unknown value.
    BadValue,
    /// A message in the making was given up.
    Incomplete,
    /// It continues a message that was never begun.
    Orphan,
}
