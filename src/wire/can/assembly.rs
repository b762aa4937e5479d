//! Putting together a message that was split over frames: all of it or nothing.

use crate::time::Instant;

use super::ASSEMBLY_MAX_S;
use super::e2e::crc16;
use super::fields::{BLOCK_MODULUS, END, HEAD};
use super::frame::{CanFrame, DATA_MAX};
use super::receiver::Fault;

/// Whether a message begun at `begun` is too old to be continued at `now`.
pub(super) fn expired(begun: Instant, now: Instant) -> bool {
    now.seconds_after(begun) > ASSEMBLY_MAX_S
}

/// Payload bytes of a classic frame: what follows CRC and counter.
const PAYLOAD: usize = 6;

/// Cuts a message into classic frames' data: heads, blocks, end.
pub(super) fn split_classic(
    heads: &[[u8; DATA_MAX]],
    blocks: impl Iterator<Item = [u8; DATA_MAX]>,
    mut end: [u8; DATA_MAX],
    put_seal: impl Fn(&mut [u8; DATA_MAX], u16),
    bytes: &mut Vec<u8>,
    mut emit: impl FnMut([u8; DATA_MAX]),
) {
    bytes.clear();
    let mut send = |mut data: [u8; DATA_MAX], part: u8, bytes: &mut Vec<u8>| {
        data[1] = part << 4;
        bytes.extend_from_slice(&data[2..8]);
        emit(data);
    };
    for (i, head) in heads.iter().enumerate() {
        send(*head, HEAD + i as u8, bytes);
    }
    for (i, block) in blocks.enumerate() {
        send(block, (i % usize::from(BLOCK_MODULUS)) as u8, bytes);
    }
    put_seal(&mut end, crc16(bytes));
    send(end, END, bytes);
}

/// Gathers the classic frames of one message at a time.
///
/// The order is fixed: head frames, blocks, end. A frame missing in between shows in the counter of
/// its protection; a whole turn of that counter shows in the part number; the seal over all
/// payloads and the count in the end frame close the rest.
#[derive(Clone, Debug)]
pub(super) struct ClassicAssembly {
    heads: u8,
    bytes_max: usize,
    begun: Option<Instant>,
    /// Payloads so far, heads first.
    bytes: Vec<u8>,
}

impl ClassicAssembly {
    /// For messages of that many head frames and at most that many blocks.
    pub(super) fn new(heads: u8, blocks_max: usize) -> Self {
        Self {
            heads,
            bytes_max: (usize::from(heads) + blocks_max) * PAYLOAD,
            begun: None,
            bytes: Vec::new(),
        }
    }

    /// Bytes that it holds on to.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        self.bytes.capacity()
    }

    /// Forgets a message in the making; whether there was one.
    pub(super) fn give_up(&mut self) -> bool {
        self.begun.take().is_some()
    }

    /// Takes one frame. When it was the end of a whole message, the payloads before it come out.
    pub(super) fn take(
        &mut self,
        now: Instant,
        lost: u8,
        frame: &CanFrame,
        seal: impl Fn(&[u8; DATA_MAX]) -> u16,
    ) -> Result<Option<&[u8]>, Fault> {
        let data = frame.padded();
        let part = data[1] >> 4;
        if part == BLOCK_MODULUS || (HEAD + self.heads..END).contains(&part) {
            self.begun = None;
            return Err(Fault::BadValue);
        }
        let mut broken = false;
        if lost > 0 || self.begun.is_some_and(|begun| expired(begun, now)) {
            broken = self.give_up();
        }
        if part == HEAD {
            broken |= self.give_up();
            self.bytes.clear();
            self.begun = Some(now);
        }
        if self.begun.is_none() {
            return Err(if broken { Fault::Incomplete } else { Fault::Orphan });
        }
        let frames = self.bytes.len() / PAYLOAD;
        let heads = usize::from(self.heads);
        let in_order = if part == END {
            frames > heads && seal(data) == crc16(&self.bytes)
        } else if frames < heads {
            part == HEAD + frames as u8
        } else {
            usize::from(part) == (frames - heads) % usize::from(BLOCK_MODULUS)
                && self.bytes.len() < self.bytes_max
        };
        if !in_order {
            self.begun = None;
            return Err(Fault::Incomplete);
        }
        if part == END {
            self.begun = None;
            return Ok(Some(&self.bytes));
        }
        self.bytes.extend_from_slice(&data[2..8]);
        // A head that displaced an unfinished message is itself taken; the loss is reported.
        if broken { Err(Fault::Incomplete) } else { Ok(None) }
    }
}

/// The data of a classic frame rebuilt from the payloads of an assembly, for reading its signals.
pub(super) fn payload_frame(bytes: &[u8], index: usize) -> [u8; DATA_MAX] {
    let mut data = [0; DATA_MAX];
    data[2..8].copy_from_slice(&bytes[index * PAYLOAD..(index + 1) * PAYLOAD]);
    data
}
