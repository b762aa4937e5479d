//! The kernel's frames: `struct can_frame` and `struct canfd_frame` of `linux/can.h`, byte for byte.

use super::fault::BusFault;
use crate::time::Instant;
use crate::wire::can::{CanFrame, CanId, DATA_MAX};

/// Bytes of a `struct can_frame` (`CAN_MTU`).
pub const CLASSIC_BYTES: usize = 16;
/// Bytes of a `struct canfd_frame` (`CANFD_MTU`).
pub const FD_BYTES: usize = 72;

/// Identifier, length, flags and two reserved bytes come before the data.
const HEADER_BYTES: usize = 8;
/// Flags in the identifier: 29 bits, remote request, error report.
pub const EXTENDED: u32 = 0x8000_0000;
pub const REMOTE: u32 = 0x4000_0000;
const ERROR: u32 = 0x2000_0000;
/// All bits of a standard identifier.
pub const STANDARD_MASK: u32 = 0x7FF;
/// `CANFD_BRS`: the data phase has a bit rate of its own.
const BIT_RATE_SWITCH: u8 = 0x01;

/// What a read from the socket gives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Raw {
    /// A data frame.
    Frame(CanFrame),
    /// The driver's report of an error.
    Fault(BusFault),
    /// Remote requests and anything else that the interface has no use for.
    Other,
}

/// Reads what `bytes` hold; an error report came at `at`.
pub fn decode(bytes: &[u8], at: Instant) -> Raw {
    let fd = match bytes.len() {
        CLASSIC_BYTES => false,
        FD_BYTES => true,
        _ => return Raw::Other,
    };
    let mut id = [0; 4];
    id.copy_from_slice(&bytes[..4]);
    let id = u32::from_ne_bytes(id);
    let Some(data) = bytes[HEADER_BYTES..].get(..usize::from(bytes[4])) else { return Raw::Other };
    if id & ERROR != 0 {
        return Raw::Fault(BusFault::decode(at, id, data));
    }
    if id & REMOTE != 0 {
        return Raw::Other;
    }
    let id = match id & EXTENDED {
        0 => CanId::standard((id & STANDARD_MASK) as u16),
        _ => CanId::extended(id),
    };
    CanFrame::new(id, fd, data).map_or(Raw::Other, Raw::Frame)
}

/// Writes a frame as the kernel takes it and gives its bytes.
pub fn encode<'a>(frame: &CanFrame, bytes: &'a mut [u8; FD_BYTES]) -> &'a [u8] {
    let id = frame.id.raw() | if frame.id.is_extended() { EXTENDED } else { 0 };
    let data = frame.data();
    *bytes = [0; FD_BYTES];
    bytes[..4].copy_from_slice(&id.to_ne_bytes());
    // At most `DATA_MAX`, by construction of a frame.
    bytes[4] = data.len() as u8;
    bytes[5] = if frame.fd { BIT_RATE_SWITCH } else { 0 };
    bytes[HEADER_BYTES..HEADER_BYTES + data.len()].copy_from_slice(data);
    &bytes[..if frame.fd { FD_BYTES } else { CLASSIC_BYTES }]
}

const _: () = assert!(HEADER_BYTES + DATA_MAX == FD_BYTES);

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use socketcan::frame::AsPtr;
    use socketcan::{CanFdFrame, EmbeddedFrame, ExtendedId, Frame, StandardId};

    use super::*;

    const AT: Instant = Instant::ZERO;

    fn frame() -> impl Strategy<Value = CanFrame> {
        let id = prop_oneof![
            (0u16..0x800).prop_map(CanId::standard),
            (0u32..0x2000_0000).prop_map(CanId::extended),
        ];
        let lengths = vec![0usize, 1, 7, 8, 12, 16, 20, 24, 32, 48, 64];
        (id, any::<bool>(), prop::sample::select(lengths), any::<[u8; 64]>()).prop_map(
            |(id, fd, len, data)| {
                let len = if fd { len } else { len.min(8) };
                CanFrame::new(id, fd, &data[..len]).unwrap()
            },
        )
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        #[test]
        fn a_frame_survives_the_way_through_the_kernels_form(frame in frame()) {
            let mut bytes = [0xFF; FD_BYTES];
            let bytes = encode(&frame, &mut bytes);
            prop_assert_eq!(decode(bytes, AT), Raw::Frame(frame));
        }

        #[test]
        fn another_library_reads_the_same_in_it(frame in frame()) {
            let mut bytes = [0; FD_BYTES];
            let bytes = encode(&frame, &mut bytes);
            let id: socketcan::Id = if frame.id.is_extended() {
                ExtendedId::new(frame.id.raw()).unwrap().into()
            } else {
                StandardId::new(frame.id.raw() as u16).unwrap().into()
            };
            if frame.fd {
                let mut other = CanFdFrame::new(id, frame.data()).unwrap();
                other.set_brs(true);
                let raw: &_ = AsRef::as_ref(&other);
                prop_assert_eq!(bytes.len(), other.size());
                prop_assert_eq!(raw.len as usize, frame.data().len());
                prop_assert_eq!(u32::from_ne_bytes(bytes[..4].try_into().unwrap()), raw.can_id);
                prop_assert_eq!(bytes[5], raw.flags & 1);
                prop_assert_eq!(&bytes[8..], &raw.data[..]);
            } else {
                let other = socketcan::CanFrame::new(id, frame.data()).unwrap();
                prop_assert_eq!(bytes.len(), other.size());
                prop_assert_eq!(u32::from_ne_bytes(bytes[..4].try_into().unwrap()), other.id_word());
                prop_assert_eq!(usize::from(bytes[4]), other.dlc());
                prop_assert_eq!(&bytes[8..8 + other.dlc()], other.data());
            }
        }

        #[test]
        fn no_bytes_break_it(bytes in prop::collection::vec(any::<u8>(), 0..80)) {
            decode(&bytes, AT);
            for len in [CLASSIC_BYTES, FD_BYTES] {
                let mut whole = bytes.clone();
                whole.resize(len, 0);
                decode(&whole, AT);
            }
        }
    }

    #[test]
    fn remote_requests_and_impossible_lengths_are_set_aside() {
        let mut bytes = [0; FD_BYTES];
        let frame = CanFrame::new(CanId::standard(0x20), false, &[1, 2]).unwrap();
        let mut classic = encode(&frame, &mut bytes).to_vec();
        classic[..4].copy_from_slice(&(0x20 | REMOTE).to_ne_bytes());
        assert_eq!(decode(&classic, AT), Raw::Other);
        classic[..4].copy_from_slice(&0x20u32.to_ne_bytes());
        classic[4] = 9;
        assert_eq!(decode(&classic, AT), Raw::Other, "nine bytes in a classic frame");
        let mut fd = [0; FD_BYTES];
        fd[4] = 13;
        assert_eq!(decode(&fd, AT), Raw::Other, "thirteen bytes are no length");
    }
}
