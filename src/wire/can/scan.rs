//! Lidar scans to frames and back.

use crate::scan::Scan;
use crate::time::Instant;

use super::assembly::{ClassicAssembly, expired, payload_frame, split_classic};
use super::fields::{
    BEAMS_CLASSIC, BEAMS_FD, RANGE_INVALID, RANGE_M, RANGE_NO_RETURN, SCAN_CLASSIC, SCAN_FD,
};
use super::frame::{CanFrame, DATA_MAX, Layout};
use super::receiver::Fault;
use super::{BEAMS_MAX, CarTime, WireError};

/// The scan's frame-independent numbers, raw.
#[derive(Clone, Copy, Debug, Default)]
struct Head {
    stamp: u32,
    boot: u8,
    sequence: u16,
    count: usize,
    range_max: i64,
    angle_first_rad: f64,
    angle_step_rad: f64,
}

/// A whole scan; the time is still the bare stamp.
pub(super) struct RawScan {
    pub(super) stamp: u32,
    pub(super) boot: u8,
    pub(super) sequence: u16,
    pub(super) angle_first_rad: f64,
    pub(super) angle_step_rad: f64,
    pub(super) range_max_m: f64,
    pub(super) ranges_m: Vec<f32>,
}

/// The raw range of a beam. A surface stays a surface: what lies just below the range limit is not
/// rounded up to "nothing seen".
fn range_to_raw(range_m: f32, range_max: i64) -> i64 {
    let counts = (f64::from(range_m) / RANGE_M).round();
    if range_m.is_nan() || range_m < 0.0 {
        RANGE_INVALID
    } else if counts >= range_max as f64 && f64::from(range_m) >= range_max as f64 * RANGE_M {
        RANGE_NO_RETURN
    } else {
        (counts as i64).min(range_max - 1)
    }
}

fn range_from_raw(raw: i64, no_return_m: f32) -> f32 {
    match raw {
        RANGE_INVALID => f32::NAN,
        RANGE_NO_RETURN => no_return_m,
        counts => (counts as f64 * RANGE_M) as f32,
    }
}

/// The smallest single-precision number that is not below the range limit: "nothing seen".
fn at_least(range_max_m: f64) -> f32 {
    let near = range_max_m as f32;
    if f64::from(near) < range_max_m { near.next_up() } else { near }
}

/// Writes a scan's frame data, in order, without protection.
pub(super) fn encode(
    layout: Layout,
    time: CarTime,
    boot: u8,
    scan: &Scan,
    bytes: &mut Vec<u8>,
    mut emit: impl FnMut([u8; DATA_MAX]),
) -> Result<(), WireError> {
    let beams = &scan.ranges_m;
    if beams.is_empty() || beams.len() > BEAMS_MAX {
        return Err(WireError::WrongCount { count: beams.len(), max: BEAMS_MAX });
    }
    let count = beams.len() as i64 - 1;
    let stamp = i64::from(time.as_micros() as u32);
    let sequence = i64::from(scan.sequence);
    let boot = i64::from(boot);
    // Rounded down, so that a beam without return frees no more than the lidar saw. The slack
    // is for limits that are whole counts.
    let range_max = (scan.range_max_m / RANGE_M + 1e-6).floor();
    if !(range_max >= 1.0 && range_max < RANGE_NO_RETURN as f64) {
        return Err(WireError::OutOfRange { signal: "RangeMax", value: scan.range_max_m });
    }
    let range_max = range_max as i64;
    match layout {
        Layout::Fd => {
            let s = &SCAN_FD;
            let mut head = [0; DATA_MAX];
            s.boot.put(&mut head, boot);
            s.scan.put(&mut head, sequence);
            s.stamp.put(&mut head, stamp);
            s.count.put(&mut head, count);
            s.range_max.put(&mut head, range_max);
            s.angle_first.put(&mut head, s.angle_first.quantise(scan.angle_first_rad)?);
            s.angle_step.put(&mut head, s.angle_step.quantise(scan.angle_step_rad)?);
            emit(head);
            for (i, block) in beams.chunks(BEAMS_FD).enumerate() {
                let mut data = [0; DATA_MAX];
                let first = i * BEAMS_FD;
                s.part.put(&mut data, 1);
                s.last.put(&mut data, i64::from(first + block.len() == beams.len()));
                s.boot.put(&mut data, boot);
                s.scan.put(&mut data, sequence);
                s.first_beam.put(&mut data, first as i64);
                for j in 0..BEAMS_FD {
                    let raw = block.get(j).map_or(RANGE_INVALID, |r| range_to_raw(*r, range_max));
                    s.range.put_at(&mut data, j as u16, raw);
                }
                emit(data);
            }
        }
        Layout::Classic => {
            let s = &SCAN_CLASSIC;
            let mut heads = [[0; DATA_MAX]; 3];
            s.stamp.put(&mut heads[0], stamp);
            s.scan.put(&mut heads[0], sequence);
            s.angle_first.put(&mut heads[1], s.angle_first.quantise(scan.angle_first_rad)?);
            s.count.put(&mut heads[1], count);
            s.boot.put(&mut heads[1], boot);
            s.angle_step.put(&mut heads[2], s.angle_step.quantise(scan.angle_step_rad)?);
            s.range_max.put(&mut heads[2], range_max);
            let blocks = beams.chunks(BEAMS_CLASSIC).map(|block| {
                let mut data = [0; DATA_MAX];
                for j in 0..BEAMS_CLASSIC {
                    let raw = block.get(j).map_or(RANGE_INVALID, |r| range_to_raw(*r, range_max));
                    s.range.put_at(&mut data, j as u16, raw);
                }
                data
            });
            let mut end = [0; DATA_MAX];
            s.end_scan.put(&mut end, sequence);
            s.end_count.put(&mut end, count);
            let seal = |data: &mut _, seal| s.seal.put(data, i64::from(seal));
            split_classic(&heads, blocks, end, seal, bytes, emit);
        }
    }
    Ok(())
}

/// Puts scans together.
#[derive(Clone, Debug)]
pub(super) struct ScanAssembly {
    classic: ClassicAssembly,
    begun: Option<Instant>,
    head: Head,
    ranges_m: Vec<f32>,
}

impl ScanAssembly {
    pub(super) fn new() -> Self {
        Self {
            classic: ClassicAssembly::new(3, BEAMS_MAX.div_ceil(BEAMS_CLASSIC)),
            begun: None,
            head: Head::default(),
            ranges_m: Vec::new(),
        }
    }

    /// Bytes that it holds on to.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        self.classic.capacity() + self.ranges_m.capacity() * size_of::<f32>()
    }

    /// Forgets a scan in the making.
    pub(super) fn give_up(&mut self) -> bool {
        self.ranges_m.clear();
        self.classic.give_up() | self.begun.take().is_some()
    }

    pub(super) fn take(
        &mut self,
        now: Instant,
        layout: Layout,
        lost: u8,
        frame: &CanFrame,
    ) -> Result<Option<RawScan>, Fault> {
        match layout {
            Layout::Classic => self.take_classic(now, lost, frame),
            Layout::Fd => self.take_fd(now, lost, frame),
        }
    }

    fn whole(&mut self) -> RawScan {
        let head = self.head;
        RawScan {
            stamp: head.stamp,
            boot: head.boot,
            sequence: head.sequence,
            angle_first_rad: head.angle_first_rad,
            angle_step_rad: head.angle_step_rad,
            range_max_m: head.range_max as f64 * RANGE_M,
            ranges_m: std::mem::take(&mut self.ranges_m),
        }
    }

    fn take_classic(
        &mut self,
        now: Instant,
        lost: u8,
        frame: &CanFrame,
    ) -> Result<Option<RawScan>, Fault> {
        let s = &SCAN_CLASSIC;
        let seal = |data: &_| s.seal.get(data) as u16;
        let Some(bytes) = self.classic.take(now, lost, frame, seal)? else {
            return Ok(None);
        };
        let [first, second, third] = [0, 1, 2].map(|i| payload_frame(bytes, i));
        self.head = Head {
            stamp: s.stamp.get(&first) as u32,
            boot: s.boot.get(&second) as u8,
            sequence: s.scan.get(&first) as u16,
            count: s.count.get(&second) as usize + 1,
            range_max: s.range_max.get(&third),
            angle_first_rad: s.angle_first.value(&second),
            angle_step_rad: s.angle_step.value(&third),
        };
        let end = frame.padded();
        let count = self.head.count;
        if s.end_scan.get(end) != i64::from(self.head.sequence)
            || s.end_count.get(end) + 1 != count as i64
            || bytes.len() / 6 - 3 != count.div_ceil(BEAMS_CLASSIC)
        {
            return Err(Fault::Incomplete);
        }
        if !plausible(&self.head) {
            return Err(Fault::BadValue);
        }
        let no_return_m = at_least(self.head.range_max as f64 * RANGE_M);
        self.ranges_m.clear();
        self.ranges_m.reserve_exact(count);
        for i in 0..count {
            let block = payload_frame(bytes, 3 + i / BEAMS_CLASSIC);
            let raw = s.range.get_at(&block, (i % BEAMS_CLASSIC) as u16);
            self.ranges_m.push(range_from_raw(raw, no_return_m));
        }
        Ok(Some(self.whole()))
    }

    fn take_fd(
        &mut self,
        now: Instant,
        lost: u8,
        frame: &CanFrame,
    ) -> Result<Option<RawScan>, Fault> {
        let s = &SCAN_FD;
        let data = frame.padded();
        let mut broken = false;
        if lost > 0 || self.begun.is_some_and(|begun| expired(begun, now)) {
            broken = self.give_up();
        }
        let sequence = s.scan.get(data) as u16;
        let last = s.last.get(data) != 0;
        if s.part.get(data) == 0 {
            broken |= self.give_up();
            self.head = Head {
                stamp: s.stamp.get(data) as u32,
                boot: s.boot.get(data) as u8,
                sequence,
                count: s.count.get(data) as usize + 1,
                range_max: s.range_max.get(data),
                angle_first_rad: s.angle_first.value(data),
                angle_step_rad: s.angle_step.value(data),
            };
            if last || !plausible(&self.head) {
                return Err(Fault::BadValue);
            }
            self.begun = Some(now);
            self.ranges_m.reserve_exact(self.head.count);
            return if broken { Err(Fault::Incomplete) } else { Ok(None) };
        }
        if self.begun.is_none() {
            return Err(if broken { Fault::Incomplete } else { Fault::Orphan });
        }
        let done = self.ranges_m.len();
        let here = (self.head.count - done).min(BEAMS_FD);
        if sequence != self.head.sequence
            || s.boot.get(data) != i64::from(self.head.boot)
            || s.first_beam.get(data) != done as i64
            || last != (done + here == self.head.count)
        {
            self.give_up();
            return Err(Fault::Incomplete);
        }
        let no_return_m = at_least(self.head.range_max as f64 * RANGE_M);
        for j in 0..here {
            self.ranges_m.push(range_from_raw(s.range.get_at(data, j as u16), no_return_m));
        }
        if !last {
            return Ok(None);
        }
        self.begun = None;
        Ok(Some(self.whole()))
    }
}

fn plausible(head: &Head) -> bool {
    (1..RANGE_NO_RETURN).contains(&head.range_max) && head.angle_step_rad != 0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_surface_just_below_the_range_limit_stays_a_surface() {
        let raw = range_to_raw(9.99999, 20_000);
        assert_eq!(raw, 19_999);
        assert!(range_from_raw(raw, 10.0) < 10.0);
    }

    #[test]
    fn special_ranges_have_codes_of_their_own() {
        for (range, raw) in [
            (f32::NAN, RANGE_INVALID),
            (-0.1, RANGE_INVALID),
            (f32::NEG_INFINITY, RANGE_INVALID),
            (10.0, RANGE_NO_RETURN),
            (f32::INFINITY, RANGE_NO_RETURN),
            (0.0, 0),
            (-0.0, 0),
            (1.2345, 2469),
        ] {
            assert_eq!(range_to_raw(range, 20_000), raw, "{range}");
        }
    }

    #[test]
    fn nothing_seen_is_never_below_the_range_limit() {
        for counts in 1..RANGE_NO_RETURN {
            let limit_m = counts as f64 * RANGE_M;
            assert!(f64::from(at_least(limit_m)) >= limit_m);
        }
    }
}
