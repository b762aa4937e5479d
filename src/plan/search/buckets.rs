//! A monotone priority queue over whole-number keys: one list per key, in a ring.

/// Number of keys between the smallest and the largest one in the queue, plus one, at most.
pub(super) const SPAN: usize = 1 << 16;
const WORDS: usize = SPAN / 64;
const END: u32 = u32::MAX;

#[derive(Clone, Copy)]
struct Entry {
    item: u32,
    next: u32,
}

/// The smallest key comes first; among equal keys the one pushed last (so a search with a perfect
/// heuristic runs straight to its goal).
///
/// Keys never fall below the last one popped and never exceed it by [`SPAN`] or more. Push and pop
/// take constant time: two levels of bit sets find the next list that is not empty. A new queue is to
/// be reset before its first use, which is when it gets its memory.
#[derive(Default)]
pub(super) struct Buckets {
    heads: Vec<u32>,
    /// Bit `b` of word `w`: list `64 w + b` is not empty.
    occupied: Vec<u64>,
    /// Bit `b` of word `w`: `occupied[64 w + b]` is not zero.
    summary: [u64; WORDS / 64],
    entries: Vec<Entry>,
    free: u32,
    cursor: u32,
    len: usize,
}

impl Buckets {
    /// Empties the queue; keys start at `key`.
    pub(super) fn reset(&mut self, key: u32) {
        self.heads.resize(SPAN, END);
        self.occupied.resize(WORDS, 0);
        for top in 0..self.summary.len() {
            while self.summary[top] != 0 {
                let word = top * 64 + self.summary[top].trailing_zeros() as usize;
                while self.occupied[word] != 0 {
                    let bit = self.occupied[word].trailing_zeros() as usize;
                    self.heads[word * 64 + bit] = END;
                    self.occupied[word] &= self.occupied[word] - 1;
                }
                self.summary[top] &= self.summary[top] - 1;
            }
        }
        self.entries.clear();
        self.free = END;
        self.cursor = key;
        self.len = 0;
    }

    #[inline(always)]
    pub(super) fn push(&mut self, key: u32, item: u32) {
        debug_assert!(key >= self.cursor && ((key - self.cursor) as usize) < SPAN);
        let slot = key as usize % SPAN;
        let entry = Entry { item, next: self.heads[slot] };
        let at = if self.free == END {
            self.entries.push(entry);
            (self.entries.len() - 1) as u32
        } else {
            let at = self.free;
            self.free = self.entries[at as usize].next;
            self.entries[at as usize] = entry;
            at
        };
        self.heads[slot] = at;
        self.occupied[slot / 64] |= 1 << (slot % 64);
        self.summary[slot / 4096] |= 1 << (slot / 64 % 64);
        self.len += 1;
    }

    #[inline(always)]
    pub(super) fn pop(&mut self) -> Option<(u32, u32)> {
        if self.len == 0 {
            return None;
        }
        self.len -= 1;
        let here = self.cursor as usize % SPAN;
        let slot = if self.heads[here] == END { self.next_slot(here) } else { here };
        self.cursor += ((slot + SPAN - here) % SPAN) as u32;
        let at = self.heads[slot];
        let Entry { item, next } = self.entries[at as usize];
        self.entries[at as usize].next = self.free;
        self.free = at;
        self.heads[slot] = next;
        if next == END {
            self.occupied[slot / 64] &= !(1 << (slot % 64));
            if self.occupied[slot / 64] == 0 {
                self.summary[slot / 4096] &= !(1 << (slot / 64 % 64));
            }
        }
        Some((self.cursor, item))
    }

    /// The next list that is not empty, going round the ring from `here`. There is one.
    fn next_slot(&self, here: usize) -> usize {
        let word = here / 64;
        let rest = self.occupied[word] & (u64::MAX << (here % 64));
        if rest != 0 {
            return word * 64 + rest.trailing_zeros() as usize;
        }
        let tops = self.summary.len();
        let start = (word + 1) % WORDS;
        let mut top = start / 64;
        let mut bits = self.summary[top] & (u64::MAX << (start % 64));
        // One step more than there are words: the first one is looked at again from its start.
        for _ in 0..=tops {
            if bits != 0 {
                let word = top * 64 + bits.trailing_zeros() as usize;
                return word * 64 + self.occupied[word].trailing_zeros() as usize;
            }
            top = (top + 1) % tops;
            bits = self.summary[top];
        }
        unreachable!("a queue that is not empty has a list that is not empty")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use std::collections::BTreeMap;

    #[test]
    fn keys_leave_in_order_and_equal_keys_last_in_first_out() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        let mut queue = Buckets::default();
        for round in 0..20 {
            let mut model: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
            let mut low = rng.random_range(0..200_000);
            queue.reset(low);
            for item in 0..3_000 {
                if rng.random_bool(0.6) {
                    let wide = if rng.random_bool(0.1) { SPAN as u32 } else { 300 };
                    let key = low + rng.random_range(0..wide);
                    queue.push(key, item);
                    model.entry(key).or_default().push(item);
                } else {
                    let expected = model.first_entry().map(|mut e| {
                        let item = e.get_mut().pop().unwrap();
                        let key = *e.key();
                        if e.get().is_empty() {
                            e.remove();
                        }
                        (key, item)
                    });
                    low = expected.map_or(low, |(key, _)| key);
                    assert_eq!(queue.pop(), expected, "round {round}");
                }
            }
        }
    }
}
