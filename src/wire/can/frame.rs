//! CAN frames as this crate passes them round: no socket, no operating system.

use std::fmt;

use crate::choices;

/// A CAN identifier: 11 bits (standard) or 29 bits (extended).
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct CanId(u32);

impl CanId {
    const EXTENDED: u32 = 1 << 31;

    /// A standard identifier; bits above the lowest 11 are cut off.
    pub const fn standard(id: u16) -> Self {
        Self(id as u32 & 0x7FF)
    }

    /// An extended identifier; bits above the lowest 29 are cut off.
    pub const fn extended(id: u32) -> Self {
        Self((id & 0x1FFF_FFFF) | Self::EXTENDED)
    }

    /// Whether it has 29 bits.
    pub const fn is_extended(self) -> bool {
        self.0 & Self::EXTENDED != 0
    }

    /// The identifier's bits, without the format.
    pub const fn raw(self) -> u32 {
        self.0 & 0x1FFF_FFFF
    }

    /// Rank in arbitration, the lowest wins: the first 11 bits decide, then a standard frame wins
    /// over an extended one (its bit after them is dominant), then the other 18 bits.
    pub const fn arbitration_rank(self) -> u32 {
        if self.is_extended() {
            let raw = self.raw();
            (raw >> 18) << 19 | 1 << 18 | (raw & 0x3_FFFF)
        } else {
            self.raw() << 19
        }
    }
}

impl fmt::Debug for CanId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.is_extended() {
            write!(f, "{:08X}", self.raw())
        } else {
            write!(f, "{:03X}", self.raw())
        }
    }
}

/// Longest data field, bytes (CAN FD).
pub const DATA_MAX: usize = 64;

/// A data frame. CAN FD frames are sent with the bit-rate switch.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct CanFrame {
    /// Identifier.
    pub id: CanId,
    /// CAN FD format (up to 64 bytes) or classic (up to 8).
    pub fd: bool,
    len: u8,
    data: [u8; DATA_MAX],
}

impl CanFrame {
    /// A frame of that content, or `None` if its format has no such length (classic: 0 to 8; FD: 0
    /// to 8, 12, 16, 20, 24, 32, 48, 64).
    pub fn new(id: CanId, fd: bool, data: &[u8]) -> Option<Self> {
        let fits = match data.len() {
            0..=8 => true,
            12 | 16 | 20 | 24 | 32 | 48 | 64 => fd,
            _ => false,
        };
        fits.then(|| {
            let mut padded = [0; DATA_MAX];
            padded[..data.len()].copy_from_slice(data);
            Self { id, fd, len: data.len() as u8, data: padded }
        })
    }

    /// Data field.
    pub fn data(&self) -> &[u8] {
        &self.data[..usize::from(self.len)]
    }

    /// Data field, to change in place.
    pub fn data_mut(&mut self) -> &mut [u8] {
        &mut self.data[..usize::from(self.len)]
    }

    /// The data field padded with zeros.
    pub(super) fn padded(&self) -> &[u8; DATA_MAX] {
        &self.data
    }
}

impl fmt::Debug for CanFrame {
    /// As `candump` writes it: `040#0102`, with `##` for CAN FD.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}{}", self.id, if self.fd { "##1" } else { "#" })?;
        self.data().iter().try_for_each(|byte| write!(f, "{byte:02X}"))
    }
}

choices! {
    /// Which family of frames a car speaks.
    pub enum Layout {
        /// Classic CAN, 8 bytes, AUTOSAR end-to-end profile 11.
        Classic = "classic",
        /// CAN FD, up to 64 bytes, AUTOSAR end-to-end profile 5.
        Fd = "fd",
    }
}

impl Layout {
    /// 0 or 1.
    pub(super) const fn index(self) -> usize {
        match self {
            Self::Classic => 0,
            Self::Fd => 1,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_has_a_length_that_its_format_can_code() {
        let id = CanId::standard(1);
        assert!(CanFrame::new(id, false, &[0; 8]).is_some());
        assert!(CanFrame::new(id, false, &[0; 12]).is_none());
        assert!(CanFrame::new(id, true, &[0; 12]).is_some());
        assert!(CanFrame::new(id, true, &[0; 13]).is_none());
        assert!(CanFrame::new(id, true, &[0; 65]).is_none());
    }

    #[test]
    fn arbitration_prefers_low_identifiers_and_standard_over_extended() {
        let rank = CanId::arbitration_rank;
        assert!(rank(CanId::standard(0x100)) < rank(CanId::standard(0x101)));
        // Same leading 11 bits: the standard frame wins.
        assert!(rank(CanId::standard(0x100)) < rank(CanId::extended(0x100 << 18)));
        assert!(rank(CanId::extended(0x0FF << 18 | 0x3_FFFF)) < rank(CanId::standard(0x100)));
        assert!(rank(CanId::extended(5)) < rank(CanId::extended(6)));
    }

    #[test]
    fn frames_print_as_candump_writes_them() {
        let frame = CanFrame::new(CanId::standard(0x40), false, &[1, 0xAB]).unwrap();
        assert_eq!(format!("{frame:?}"), "040#01AB");
        let frame = CanFrame::new(CanId::extended(0x40), true, &[1]).unwrap();
        assert_eq!(format!("{frame:?}"), "00000040##101");
    }
}
