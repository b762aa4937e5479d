//! Signals: numbers at fixed bits of a frame. The same description packs, unpacks and writes the
//! CAN database, so they cannot disagree.

use super::WireError;
use super::frame::DATA_MAX;

/// When a signal is there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Multiplex {
    /// Always.
    Plain,
    /// It tells which of the others are there.
    Selector,
    /// When the selector's raw value lies in this range, both ends included.
    On(u8, u8),
}

/// One signal, or a row of equal ones. Intel byte order: the start bit is the lowest one.
#[derive(Clone, Copy, Debug)]
pub struct Signal {
    /// Name in the CAN database; a row of signals gets numbers appended.
    pub name: &'static str,
    /// Lowest bit, counted from bit 0 of byte 0.
    pub start: u16,
    /// Width in bits, at most 32.
    pub bits: u8,
    /// Two's complement.
    pub signed: bool,
    /// Physical value of one count.
    pub scale: f64,
    /// Physical value of raw zero.
    pub offset: f64,
    /// Unit of the physical value.
    pub unit: &'static str,
    /// Meaning, for the database and the document.
    pub text: &'static str,
    /// Names of raw values.
    pub values: &'static [(u32, &'static str)],
    /// When it is there.
    pub multiplex: Multiplex,
    /// How many there are.
    pub count: u16,
    /// Bits from one to the next.
    pub stride: u16,
}

impl Signal {
    /// An unsigned signal.
    pub(super) const fn new(
        name: &'static str,
        start: u16,
        bits: u8,
        scale: f64,
        unit: &'static str,
        text: &'static str,
    ) -> Self {
        Self {
            name,
            start,
            bits,
            signed: false,
            scale,
            offset: 0.0,
            unit,
            text,
            values: &[],
            multiplex: Multiplex::Plain,
            count: 1,
            stride: 0,
        }
    }

    pub(super) const fn signed(self) -> Self {
        Self { signed: true, ..self }
    }

    pub(super) const fn offset(self, offset: f64) -> Self {
        Self { offset, ..self }
    }

    pub(super) const fn values(self, values: &'static [(u32, &'static str)]) -> Self {
        Self { values, ..self }
    }

    pub(super) const fn selector(self) -> Self {
        Self { multiplex: Multiplex::Selector, ..self }
    }

    pub(super) const fn on(self, first: u8, last: u8) -> Self {
        Self { multiplex: Multiplex::On(first, last), ..self }
    }

    pub(super) const fn times(self, count: u16, stride: u16) -> Self {
        Self { count, stride, ..self }
    }

    /// Smallest raw value.
    pub const fn raw_min(&self) -> i64 {
        if self.signed { -(1 << (self.bits - 1)) } else { 0 }
    }

    /// Largest raw value.
    pub const fn raw_max(&self) -> i64 {
        if self.signed { (1 << (self.bits - 1)) - 1 } else { (1 << self.bits) - 1 }
    }

    /// The physical value of a raw one.
    pub fn physical(&self, raw: i64) -> f64 {
        raw as f64 * self.scale + self.offset
    }

    /// The nearest raw value, or an error if the signal cannot hold it.
    pub(super) fn quantise(&self, physical: f64) -> Result<i64, WireError> {
        let raw = ((physical - self.offset) / self.scale).round();
        // NaN fails both comparisons.
        if raw >= self.raw_min() as f64 && raw <= self.raw_max() as f64 {
            Ok(raw as i64)
        } else {
            Err(WireError::OutOfRange { signal: self.name, value: physical })
        }
    }

    /// The nearest raw value that the signal can hold; NaN counts as `nan`.
    pub(super) fn saturate(&self, physical: f64, nan: f64) -> i64 {
        let physical = if physical.is_nan() { nan } else { physical };
        let raw = ((physical - self.offset) / self.scale).round();
        raw.clamp(self.raw_min() as f64, self.raw_max() as f64) as i64
    }

    /// The nearest count of a running total, whole turns of the counter left out.
    pub(super) fn wrap(&self, total: f64) -> Result<i64, WireError> {
        let counts = (total / self.scale).round();
        // Beyond 2^53 counts a total has lost its resolution.
        if counts.abs() < (1u64 << 53) as f64 {
            Ok(self.sign_extend(counts as i64 as u64))
        } else {
            Err(WireError::OutOfRange { signal: self.name, value: total })
        }
    }

    const fn mask(&self) -> u64 {
        (1 << self.bits) - 1
    }

    fn sign_extend(&self, bits: u64) -> i64 {
        let bits = bits & self.mask();
        if self.signed && bits > self.mask() >> 1 {
            bits as i64 - (1i64 << self.bits)
        } else {
            bits as i64
        }
    }

    /// Reads the `index`-th of a row from a frame's padded data.
    pub(super) fn get_at(&self, data: &[u8; DATA_MAX], index: u16) -> i64 {
        let (byte, shift) = self.window(index);
        self.sign_extend(u64::from_le_bytes(array_at(data, byte)) >> shift)
    }

    /// Where eight bytes begin that hold the whole signal, and its lowest bit therein. Near the end
    /// of the frame they begin earlier: a signal that fits the frame fits them.
    fn window(&self, index: u16) -> (usize, usize) {
        let start = usize::from(self.start + index * self.stride);
        let byte = (start / 8).min(DATA_MAX - 8);
        (byte, start - 8 * byte)
    }

    /// Reads it from a frame's padded data.
    pub(super) fn get(&self, data: &[u8; DATA_MAX]) -> i64 {
        self.get_at(data, 0)
    }

    /// Reads its physical value.
    pub(super) fn value(&self, data: &[u8; DATA_MAX]) -> f64 {
        self.physical(self.get(data))
    }

    /// Writes the `index`-th of a row; bits above the width are cut off.
    pub(super) fn put_at(&self, data: &mut [u8; DATA_MAX], index: u16, raw: i64) {
        let (byte, shift) = self.window(index);
        let word = u64::from_le_bytes(array_at(data, byte)) & !(self.mask() << shift)
            | (raw as u64 & self.mask()) << shift;
        data[byte..byte + 8].copy_from_slice(&word.to_le_bytes());
    }

    /// Writes it.
    pub(super) fn put(&self, data: &mut [u8; DATA_MAX], raw: i64) {
        self.put_at(data, 0, raw);
    }
}

fn array_at(data: &[u8; DATA_MAX], byte: usize) -> [u8; 8] {
    *data[byte..].first_chunk().expect("windows begin at least eight bytes before the end")
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn what_is_written_is_read_and_its_neighbours_stay(
            start in 0u16..480, bits in 1u8..=32, signed: bool, bits_in: u64, fill: u8,
        ) {
            let mut signal = Signal::new("S", start, bits, 1.0, "", "");
            signal.signed = signed;
            let raw = signal.sign_extend(bits_in);
            prop_assert!(raw >= signal.raw_min() && raw <= signal.raw_max());
            let mut data = [fill; DATA_MAX];
            signal.put(&mut data, raw);
            prop_assert_eq!(signal.get(&data), raw);
            for bit in 0..512usize {
                if !(usize::from(start)..usize::from(start) + usize::from(bits)).contains(&bit) {
                    prop_assert_eq!(data[bit / 8] >> (bit % 8) & 1, fill >> (bit % 8) & 1);
                }
            }
        }
    }

    #[test]
    fn values_outside_a_signal_are_refused_or_saturated() {
        let signal = Signal::new("S", 0, 16, 0.5, "m", "").signed();
        assert_eq!(signal.quantise(100.2), Ok(200));
        assert!(signal.quantise(1e5).is_err());
        assert!(signal.quantise(f64::NAN).is_err());
        assert_eq!(signal.saturate(1e9, 0.0), 32767);
        assert_eq!(signal.saturate(f64::NEG_INFINITY, 0.0), -32768);
        assert_eq!(signal.saturate(f64::NAN, 3.0), 6);
        assert_eq!(signal.wrap(32768.0 * 0.5), Ok(-32768));
        assert!(signal.wrap(f64::INFINITY).is_err());
    }

    #[test]
    fn the_last_bits_of_the_longest_frame_are_reachable() {
        let signal = Signal::new("S", 496, 16, 1.0, "", "");
        let mut data = [0; DATA_MAX];
        signal.put(&mut data, 0xBEEF);
        assert_eq!(signal.get(&data), 0xBEEF);
        assert_eq!(&data[62..], &[0xEF, 0xBE]);
    }
}
