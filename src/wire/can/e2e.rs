//! End-to-end protection: AUTOSAR profile 11 on classic frames, profile 5 on CAN FD frames
//! (AUTOSAR PRS_E2EProtocol).
//!
//! | | profile 11, Data ID mode "both" (11A) | profile 5 |
//! |---|---|---|
//! | byte 0 | CRC-8 SAE J1850 | CRC-16 CCITT, low byte |
//! | byte 1 | counter 0 to 14 in the low four bits, the high four are user data | CRC, high byte |
//! | byte 2 | user data | counter 0 to 255 |
//!
//! The Data ID is never sent: it goes into the CRC on both sides, so a frame under a wrong
//! identifier fails.

use crc::{CRC_16_IBM_3740, Crc};

use super::frame::Layout;

/// Profile 11 starts at 0 and ends without inversion (the library call's 0xFF undone on both ends),
/// which makes it the plain polynomial of SAE J1850.
const J1850_PLAIN: crc::Algorithm<u8> = crc::Algorithm {
    width: 8,
    poly: 0x1D,
    init: 0,
    refin: false,
    refout: false,
    xorout: 0,
    check: 0x37,
    residue: 0,
};
static CRC8: Crc<u8> = Crc::<u8>::new(&J1850_PLAIN);
// Sixteen bytes a step: most of what a scan costs.
static CRC16: Crc<u16, crc::Table<16>> = Crc::<u16, crc::Table<16>>::new(&CRC_16_IBM_3740);

/// CRC-16 CCITT (start 0xFFFF) of a byte string: what seals a message made of many classic frames.
pub(super) fn crc16(bytes: &[u8]) -> u16 {
    CRC16.checksum(bytes)
}

fn crc11(data_id: u16, data: &[u8]) -> u8 {
    let mut digest = CRC8.digest();
    digest.update(&data_id.to_le_bytes());
    digest.update(&data[1..]);
    digest.finalize()
}

fn crc05(data_id: u16, data: &[u8]) -> u16 {
    let mut digest = CRC16.digest();
    digest.update(&data[2..]);
    digest.update(&data_id.to_le_bytes());
    digest.finalize()
}

/// Counter values of a layout: the modulus.
const fn modulus(layout: Layout) -> u8 {
    match layout {
        Layout::Classic => 15,
        Layout::Fd => 0, // 256
    }
}

/// The sender's side of one stream: owns its counter.
#[derive(Clone, Debug)]
pub(super) struct Protector {
    layout: Layout,
    data_id: u16,
    counter: u8,
}

impl Protector {
    pub(super) fn new(layout: Layout, data_id: u16) -> Self {
        Self { layout, data_id, counter: 0 }
    }

    /// Writes counter and CRC into a frame's data (at least 2 bytes classic, 3 bytes FD).
    pub(super) fn protect(&mut self, data: &mut [u8]) {
        match self.layout {
            Layout::Classic => {
                data[1] = (data[1] & 0xF0) | self.counter;
                data[0] = crc11(self.data_id, data);
            }
            Layout::Fd => {
                data[2] = self.counter;
                let crc = crc05(self.data_id, data).to_le_bytes();
                data[..2].copy_from_slice(&crc);
            }
        }
        self.counter = self.counter.wrapping_add(1);
        if self.counter == modulus(self.layout) {
            self.counter = 0;
        }
    }
}

/// What the receiver makes of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Check {
    /// Accept; that many frames were lost before it.
    Accept { lost: u8 },
    /// Drop: the same counter as the frame before.
    Repeated,
    /// Drop: the counter went back, or further ahead than half its range. The next frame is judged
    /// from here.
    WrongSequence,
    /// Drop: wrong CRC (or a counter that the profile does not know).
    WrongCrc,
}

/// The receiver's side of one stream.
#[derive(Clone, Debug)]
pub(super) struct Checker {
    layout: Layout,
    data_id: u16,
    last: Option<u8>,
}

impl Checker {
    pub(super) fn new(layout: Layout, data_id: u16) -> Self {
        Self { layout, data_id, last: None }
    }

    /// Judges a frame's data (at least 2 bytes classic, 3 bytes FD). The first one is accepted
    /// whatever its counter.
    pub(super) fn check(&mut self, data: &[u8]) -> Check {
        let (intact, counter) = match self.layout {
            Layout::Classic => {
                let counter = data[1] & 0x0F;
                (crc11(self.data_id, data) == data[0] && counter < 15, counter)
            }
            Layout::Fd => (crc05(self.data_id, data).to_le_bytes() == [data[0], data[1]], data[2]),
        };
        if !intact {
            return Check::WrongCrc;
        }
        let Some(last) = self.last.replace(counter) else {
            return Check::Accept { lost: 0 };
        };
        let (ahead, half) = match self.layout {
            Layout::Classic => ((15 + counter - last) % 15, 7),
            Layout::Fd => (counter.wrapping_sub(last), 127),
        };
        match ahead {
            0 => Check::Repeated,
            n if n <= half => Check::Accept { lost: n - 1 },
            _ => Check::WrongSequence,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The protocol examples of AUTOSAR PRS_E2EProtocol: profile 11A, Data ID 0x123, zeros.
    #[test]
    fn profile_11_agrees_with_the_examples_of_the_specification() {
        let mut protector = Protector::new(Layout::Classic, 0x123);
        let mut data = [0; 8];
        protector.protect(&mut data);
        assert_eq!(data, [0xCC, 0, 0, 0, 0, 0, 0, 0]);
        protector.protect(&mut data);
        assert_eq!(data, [0x91, 1, 0, 0, 0, 0, 0, 0]);
    }

    /// Tables "E2E Profile 5 example short": Data ID 0x1234, zeros.
    #[test]
    fn profile_5_agrees_with_the_examples_of_the_specification() {
        let mut protector = Protector::new(Layout::Fd, 0x1234);
        let mut data = [0; 8];
        protector.protect(&mut data);
        assert_eq!(data, [0x1C, 0xCA, 0, 0, 0, 0, 0, 0]);
    }

    #[test]
    fn the_polynomials_have_the_check_values_of_the_catalogue() {
        assert_eq!(CRC8.checksum(b"123456789"), J1850_PLAIN.check);
        assert_eq!(crc16(b"123456789"), 0x29B1);
    }

    fn pair(layout: Layout) -> (Protector, Checker) {
        (Protector::new(layout, 0xA040), Checker::new(layout, 0xA040))
    }

    #[test]
    fn a_stream_in_step_loses_nothing_for_several_turns_of_the_counter() {
        for &layout in Layout::ALL {
            let (mut tx, mut rx) = pair(layout);
            for _ in 0..600 {
                let mut data = [7; 8];
                tx.protect(&mut data);
                assert_eq!(rx.check(&data), Check::Accept { lost: 0 });
                assert_eq!(rx.check(&data), Check::Repeated);
            }
        }
    }

    #[test]
    fn losses_are_counted_and_old_frames_dropped() {
        for &layout in Layout::ALL {
            let (mut tx, mut rx) = pair(layout);
            let frames: Vec<[u8; 8]> = (0..12)
                .map(|_| {
                    let mut data = [0; 8];
                    tx.protect(&mut data);
                    data
                })
                .collect();
            assert_eq!(rx.check(&frames[0]), Check::Accept { lost: 0 });
            assert_eq!(rx.check(&frames[5]), Check::Accept { lost: 4 });
            assert_eq!(rx.check(&frames[4]), Check::WrongSequence);
            assert_eq!(rx.check(&frames[6]), Check::Accept { lost: 1 });
            assert_eq!(rx.check(&frames[7]), Check::Accept { lost: 0 });
        }
    }

    #[test]
    fn a_frame_under_another_data_id_is_refused() {
        for &layout in Layout::ALL {
            let (mut tx, _) = pair(layout);
            let mut data = [1, 2, 3, 4, 5, 6, 7, 8];
            tx.protect(&mut data);
            assert_eq!(Checker::new(layout, 0xA041).check(&data), Check::WrongCrc);
        }
    }

    /// Bursts as long as the CRC is wide, in the order in which bits travel.
    #[test]
    fn every_burst_as_long_as_the_crc_is_refused() {
        for (layout, header, width) in [(Layout::Classic, 1, 8), (Layout::Fd, 2, 16)] {
            let (mut tx, rx) = pair(layout);
            let mut data = [0x5A, 0x31, 0x12, 0x99, 0xFF, 0x00, 0x77, 0x18];
            tx.protect(&mut data);
            for first in header * 8..=64 - width {
                for pattern in 1u32..1 << width {
                    let mut wrong = data;
                    for bit in (0..width).filter(|bit| pattern >> bit & 1 == 1) {
                        wrong[(first + bit) / 8] ^= 0x80 >> ((first + bit) % 8);
                    }
                    assert_eq!(rx.clone().check(&wrong), Check::WrongCrc);
                }
            }
        }
    }

    #[test]
    fn every_error_of_one_or_two_bits_is_refused() {
        for &layout in Layout::ALL {
            let (mut tx, rx) = pair(layout);
            let mut data = [0x5A, 0x31, 0x12, 0x99, 0xFF, 0x00, 0x77, 0x18];
            tx.protect(&mut data);
            for first in 0..64 {
                for second in first..64 {
                    let mut wrong = data;
                    wrong[first / 8] ^= 1 << (first % 8);
                    if second != first {
                        wrong[second / 8] ^= 1 << (second % 8);
                    }
                    assert_eq!(rx.clone().check(&wrong), Check::WrongCrc);
                }
            }
        }
    }
}
