//! Numbers and texts as bytes, little-endian, as MCAP has them.

/// Bytes being read. Whatever is asked for beyond their end is `None`, and takes nothing.
#[derive(Clone, Copy, Debug)]
pub struct Input<'a> {
    rest: &'a [u8],
}

impl<'a> Input<'a> {
    /// From the first byte on.
    pub const fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes }
    }

    /// Bytes left.
    pub const fn len(&self) -> usize {
        self.rest.len()
    }

    /// Whether none is left.
    pub const fn is_empty(&self) -> bool {
        self.rest.is_empty()
    }

    /// So many bytes.
    pub fn take(&mut self, length: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.rest.split_at_checked(length)?;
        self.rest = rest;
        Some(taken)
    }

    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        self.take(N)?.try_into().ok()
    }

    /// One byte.
    pub fn u8(&mut self) -> Option<u8> {
        self.array().map(u8::from_le_bytes)
    }

    /// Two bytes.
    pub fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }

    /// Four bytes.
    pub fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    /// Four bytes.
    pub fn i32(&mut self) -> Option<i32> {
        self.array().map(i32::from_le_bytes)
    }

    /// Eight bytes.
    pub fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }

    /// Eight bytes: to the last bit what was written.
    pub fn f64(&mut self) -> Option<f64> {
        self.u64().map(f64::from_bits)
    }

    /// Yes or no; any other byte is none.
    pub fn bool(&mut self) -> Option<bool> {
        match self.u8()? {
            0 => Some(false),
            1 => Some(true),
            _ => None,
        }
    }

    /// A number of things that take at least `size` bytes each: as many as can still follow.
    pub fn count(&mut self, size: usize) -> Option<usize> {
        let count = self.u32()? as usize;
        (count.checked_mul(size)? <= self.rest.len()).then_some(count)
    }

    /// A text.
    pub fn text(&mut self) -> Option<&'a str> {
        let length = self.u32()? as usize;
        std::str::from_utf8(self.take(length)?).ok()
    }

    /// A whole number in as few bytes as it needs (LEB128).
    pub fn varint(&mut self) -> Option<u64> {
        let mut number = 0u64;
        for shift in (0..64).step_by(7) {
            let byte = self.u8()?;
            let part = u64::from(byte & 0x7F);
            if shift == 63 && part > 1 {
                return None;
            }
            number |= part << shift;
            if byte < 0x80 {
                return Some(number);
            }
        }
        None
    }
}

/// Bytes being written.
pub trait Output {
    /// Two bytes.
    fn put_u16(&mut self, number: u16);
    /// Four bytes.
    fn put_u32(&mut self, number: u32);
    /// Four bytes.
    fn put_i32(&mut self, number: i32);
    /// Eight bytes.
    fn put_u64(&mut self, number: u64);
    /// Eight bytes.
    fn put_f64(&mut self, number: f64);
    /// A text.
    fn put_text(&mut self, text: &str);
    /// A whole number in as few bytes as it needs (LEB128).
    fn put_varint(&mut self, number: u64);
}

impl Output for Vec<u8> {
    fn put_u16(&mut self, number: u16) {
        self.extend_from_slice(&number.to_le_bytes());
    }

    fn put_u32(&mut self, number: u32) {
        self.extend_from_slice(&number.to_le_bytes());
    }

    fn put_i32(&mut self, number: i32) {
        self.extend_from_slice(&number.to_le_bytes());
    }

    fn put_u64(&mut self, number: u64) {
        self.extend_from_slice(&number.to_le_bytes());
    }

    fn put_f64(&mut self, number: f64) {
        self.put_u64(number.to_bits());
    }

    fn put_text(&mut self, text: &str) {
        self.put_u32(u32::try_from(text.len()).expect("texts are short"));
        self.extend_from_slice(text.as_bytes());
    }

    fn put_varint(&mut self, mut number: u64) {
        while number >= 0x80 {
            self.push(number as u8 | 0x80);
            number >>= 7;
        }
        self.push(number as u8);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_come_back_and_what_is_missing_is_none() {
        for number in [0, 1, 127, 128, 300, u64::from(u32::MAX), u64::MAX - 1, u64::MAX] {
            let mut bytes = Vec::new();
            bytes.put_varint(number);
            bytes.put_f64(f64::from_bits(number));
            let mut input = Input::new(&bytes);
            assert_eq!(input.varint(), Some(number));
            assert_eq!(input.f64().map(f64::to_bits), Some(number));
            assert!(input.is_empty());
            assert_eq!(Input::new(&bytes[..bytes.len() - 8]).varint(), Some(number));
            assert_eq!(Input::new(&bytes[..bytes.len() - 9]).varint(), None);
        }
        assert_eq!(Input::new(&[0xFF; 10]).varint(), None, "more than 64 bits");
        assert_eq!(Input::new(&[2]).bool(), None);
        let mut bytes = Vec::new();
        bytes.put_u32(u32::MAX);
        assert_eq!(Input::new(&bytes).text(), None);
        assert_eq!(Input::new(&bytes).count(1), None);
    }
}
