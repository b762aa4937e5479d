//! One bit per cell: where the search may run straight on without looking at the cells one by one.
//!
//! In a region of equal weight the cheapest ways have a normal form: diagonal steps first, then
//! straight ones, turning only where the end of an obstacle is passed. A search in this form can
//! jump over all cells in between (Harabor and Grastien, "Online Graph Pruning for Pathfinding on
//! Grid Maps", AAAI 2011; without cutting corners and by words of bits: "Improving Jump Point
//! Search", ICAPS 2014). Here such regions are what is known to be free, and what is
//! unknown and not foreseen either.

use super::window::Class;

/// Rows or columns of bits, each of whole words. Lines run along x or along y.
#[derive(Default)]
struct Lines {
    words: usize,
    /// Cells of a region of equal weight.
    plain: Vec<u64>,
    /// Where a run in rising direction ends: at a cell that is not plain, at a mixed cell, or
    /// where a cell beside the run is plain whose predecessor is not.
    rising: Vec<u64>,
    /// The same in falling direction.
    falling: Vec<u64>,
}

/// How a straight run ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Run {
    /// The cell that ends it, along the line.
    pub(super) at: u32,
    /// Whether that is a plain cell, at which a cheapest way may turn.
    pub(super) plain: bool,
}

/// Each bit moved to the next cell of the line.
fn next(line: &[u64], word: usize) -> u64 {
    line[word] << 1 | if word > 0 { line[word - 1] >> 63 } else { 0 }
}

/// Each bit moved to the previous cell of the line.
fn previous(line: &[u64], word: usize) -> u64 {
    line[word] >> 1 | if word + 1 < line.len() { line[word + 1] << 63 } else { 0 }
}

impl Lines {
    fn resize(&mut self, words: usize, lines: usize) {
        self.words = words;
        for board in [&mut self.plain, &mut self.rising, &mut self.falling] {
            board.clear();
            board.resize(words * lines, 0);
        }
    }

    /// Ends of runs in all lines but the first and the last, which hold no plain cell.
    fn mark_ends(&mut self, mixed: &[u64]) {
        let n = self.words;
        let lines = self.plain.len() / n;
        for line in 1..lines - 1 {
            let row = |line: usize| &self.plain[line * n..(line + 1) * n];
            let (low, own, high) = (row(line - 1), row(line), row(line + 1));
            for word in 0..n {
                let at = line * n + word;
                let (l, f, h) = (low[word], own[word], high[word]);
                if f == 0 {
                    (self.rising[at], self.falling[at]) = (u64::MAX, u64::MAX);
                    continue;
                }
                let ends = !f | mixed[at];
                self.rising[at] = ends | (l & !next(low, word)) | (h & !next(high, word));
                self.falling[at] = ends | (l & !previous(low, word)) | (h & !previous(high, word));
            }
        }
    }

    #[inline(always)]
    fn run(&self, line: u32, from: u32, rising: bool) -> Run {
        let base = line as usize * self.words;
        let at = if rising {
            let from = from + 1;
            let mut word = base + from as usize / 64;
            let mut bits = self.rising[word] & (u64::MAX << (from % 64));
            // The ring around the window ends every run.
            while bits == 0 {
                word += 1;
                bits = self.rising[word];
            }
            ((word - base) * 64) as u32 + bits.trailing_zeros()
        } else {
            let from = from - 1;
            let mut word = base + from as usize / 64;
            let mut bits = self.falling[word] & (u64::MAX >> (63 - from % 64));
            while bits == 0 {
                word -= 1;
                bits = self.falling[word];
            }
            ((word - base) * 64) as u32 + 63 - bits.leading_zeros()
        };
        let plain = self.plain[base + at as usize / 64] >> (at % 64) & 1 != 0;
        Run { at, plain }
    }
}

/// The window as bits, by rows and by columns.
#[derive(Default)]
pub(super) struct Boards {
    rows: Lines,
    columns: Lines,
    free: Vec<u64>,
    silent: Vec<u64>,
    unknown: Vec<u64>,
    mixed: Vec<u64>,
    height: usize,
}

impl Boards {
    /// Takes the size of a window; all rows are blocked until they are [set](Self::set_row).
    pub(super) fn resize(&mut self, stride: usize, height: usize) {
        self.height = height;
        self.rows.resize(stride.div_ceil(64), height);
        self.columns.resize(height.div_ceil(64), stride);
        for board in [&mut self.free, &mut self.silent, &mut self.unknown, &mut self.mixed] {
            board.clear();
            board.resize(self.rows.words * height, 0);
        }
    }

    /// Sets the cells of a row; `classes` is padded to whole words.
    pub(super) fn set_row(&mut self, y: usize, classes: &[Class]) {
        const LOWEST: u64 = 0x0101_0101_0101_0101;
        // Gathers the lowest bits of eight bytes.
        let pack = |lowest: u64| lowest.wrapping_mul(0x0102_0408_1020_4080) >> 56;
        let at = y * self.rows.words;
        for (word, classes) in classes.chunks_exact(64).enumerate() {
            let (mut free, mut silent, mut unknown) = (0, 0, 0);
            for (byte, eight) in classes.as_chunks::<8>().0.iter().enumerate() {
                let eight = u64::from_le_bytes(*eight);
                free |= pack(eight & LOWEST) << (8 * byte);
                silent |= pack(eight >> 1 & LOWEST) << (8 * byte);
                unknown |= pack(eight >> 2 & LOWEST) << (8 * byte);
            }
            self.rows.plain[at + word] = free | silent;
            self.free[at + word] = free;
            self.silent[at + word] = silent;
            self.unknown[at + word] = unknown;
        }
    }

    /// Marks a cell (of the goal) at which every run ends. Only before [`finish`](Self::finish).
    pub(super) fn mark(&mut self, x: u32, y: u32) {
        self.mixed[y as usize * self.rows.words + x as usize / 64] |= 1 << (x % 64);
    }

    /// Works out where runs end.
    pub(super) fn finish(&mut self) {
        let n = self.rows.words;
        for y in 1..self.height - 1 {
            let around = |board: &[u64], word: usize| {
                [y - 1, y, y + 1].iter().fold(0, |any, y| {
                    let row = &board[y * n..(y + 1) * n];
                    any | row[word] | next(row, word) | previous(row, word)
                })
            };
            for word in 0..n {
                let at = y * n + word;
                let other = around(&self.unknown, word)
                    | (self.free[at] & around(&self.silent, word))
                    | (self.silent[at] & around(&self.free, word));
                self.mixed[at] = (self.mixed[at] | other) & self.rows.plain[at];
            }
        }
        self.rows.mark_ends(&self.mixed);
        transpose(&self.rows.plain, n, self.height, &mut self.columns.plain, self.columns.words);
        // The unknown is not needed any more: its memory serves for the mixed cells by columns.
        self.unknown.clear();
        self.unknown.resize(self.columns.plain.len(), 0);
        transpose(&self.mixed, n, self.height, &mut self.unknown, self.columns.words);
        self.columns.mark_ends(&self.unknown);
    }

    /// Whether a cell is known to be free, or unknown without being foreseen.
    #[inline(always)]
    pub(super) fn plain(&self, x: u32, y: u32) -> bool {
        self.rows.plain[y as usize * self.rows.words + x as usize / 64] >> (x % 64) & 1 != 0
    }

    /// Whether a plain cell has a cell of another weight around it, or is a goal.
    #[inline(always)]
    pub(super) fn mixed(&self, x: u32, y: u32) -> bool {
        self.mixed[y as usize * self.rows.words + x as usize / 64] >> (x % 64) & 1 != 0
    }

    /// Runs along x from a plain cell that is not mixed.
    #[inline(always)]
    pub(super) fn run_x(&self, x: u32, y: u32, rising: bool) -> Run {
        self.rows.run(y, x, rising)
    }

    /// Runs along y from a plain cell that is not mixed.
    #[inline(always)]
    pub(super) fn run_y(&self, x: u32, y: u32, rising: bool) -> Run {
        self.columns.run(x, y, rising)
    }
}

/// Exchanges rows and columns, block by block of 64 by 64 bits.
fn transpose(rows: &[u64], words: usize, height: usize, columns: &mut [u64], column_words: usize) {
    let lines = columns.len() / column_words;
    let mut block = [0_u64; 64];
    for band in 0..column_words {
        let count = (height - band * 64).min(64);
        for word in 0..words {
            let mut any = 0;
            for (i, line) in block.iter_mut().enumerate() {
                *line = if i < count { rows[(band * 64 + i) * words + word] } else { 0 };
                any |= *line;
            }
            let first = word * 64;
            let last = (first + 64).min(lines);
            if any != 0 {
                transpose_block(&mut block);
            }
            for (line, bits) in (first..last).zip(&block) {
                columns[line * column_words + band] = *bits;
            }
        }
    }
}

/// Hacker's Delight, section 7-3, for the bit order in which bit 0 is the first column.
fn transpose_block(block: &mut [u64; 64]) {
    let (mut half, mut mask) = (32, 0xffff_ffff_u64);
    while half != 0 {
        let mut k = 0;
        while k < 64 {
            let swap = (block[k] >> half ^ block[k + half]) & mask;
            block[k] ^= swap << half;
            block[k + half] ^= swap;
            k = (k + half + 1) & !half;
        }
        half >>= 1;
        mask ^= mask << half;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::search::window::{CLASS_BLOCKED, CLASS_FREE, CLASS_SILENT, CLASS_UNKNOWN};
    use rand::{RngExt, SeedableRng};

    #[test]
    fn runs_end_where_looking_cell_by_cell_ends_them() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        for (width, height, free) in [(200, 70, 0.9), (70, 200, 0.97), (64, 65, 0.995), (3, 3, 1.0)]
        {
            let mut classes = vec![CLASS_BLOCKED; width * height];
            for y in 1..height - 1 {
                for x in 1..width - 1 {
                    let other = if rng.random_bool(0.8) { CLASS_BLOCKED } else { CLASS_UNKNOWN };
                    let plain = if x * 3 > width { CLASS_FREE } else { CLASS_SILENT };
                    classes[y * width + x] = if rng.random_bool(free) { plain } else { other };
                }
            }
            let mut boards = Boards::default();
            boards.resize(7, 9);
            boards.resize(width, height);
            for y in 0..height {
                let mut row = classes[y * width..(y + 1) * width].to_vec();
                row.resize(width.next_multiple_of(64), CLASS_BLOCKED);
                boards.set_row(y, &row);
            }
            boards.finish();
            let class = |x: i64, y: i64| classes[y as usize * width + x as usize];
            let is_plain = |x, y| [CLASS_FREE, CLASS_SILENT].contains(&class(x, y));
            let mixed = |x: i64, y: i64| {
                let other = |other| other != CLASS_BLOCKED && other != class(x, y);
                is_plain(x, y) && (-1..=1).any(|dy| (-1..=1).any(|dx| other(class(x + dx, y + dy))))
            };
            for y in 1..height as i64 - 1 {
                for x in 1..width as i64 - 1 {
                    let (ux, uy) = (x as u32, y as u32);
                    assert_eq!(boards.plain(ux, uy), is_plain(x, y));
                    assert_eq!(boards.mixed(ux, uy), mixed(x, y));
                    if !is_plain(x, y) {
                        continue;
                    }
                    for (dx, dy) in [(1, 0), (-1, 0), (0, 1), (0, -1)] {
                        let (mut cx, mut cy) = (x, y);
                        let plain = loop {
                            (cx, cy) = (cx + dx, cy + dy);
                            if !is_plain(cx, cy) {
                                break false;
                            }
                            let opens = |side: i64| {
                                let (sx, sy) = (cx + side * dy, cy + side * dx);
                                is_plain(sx, sy) && !is_plain(sx - dx, sy - dy)
                            };
                            if mixed(cx, cy) || opens(1) || opens(-1) {
                                break true;
                            }
                        };
                        let run = if dy == 0 {
                            boards.run_x(ux, uy, dx > 0)
                        } else {
                            boards.run_y(ux, uy, dy > 0)
                        };
                        let at = if dy == 0 { cx } else { cy } as u32;
                        assert_eq!(run, Run { at, plain }, "from {x} {y} by {dx} {dy}");
                    }
                }
            }
        }
    }
}
