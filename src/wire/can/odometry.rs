//! Wheel odometry to frames and back, and the counters that wrap.

use crate::time::Instant;

use super::assembly::expired;
use super::fields::{OdometrySignals, odometry};
use super::frame::{CanFrame, DATA_MAX, Layout};
use super::receiver::Fault;
use super::{CarOdometry, WireError};

/// A whole measurement; stamp and totals are still wrapped.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct RawOdometry {
    pub(super) boot: u8,
    pub(super) stamp: u32,
    pub(super) travelled: u32,
    pub(super) turned: i32,
    pub(super) wheel_left_mps: f64,
    pub(super) wheel_right_mps: f64,
    pub(super) steering_rad: f64,
    pub(super) yaw_rate_rps: f64,
}

const CLASSIC: OdometrySignals = odometry(Layout::Classic);
const FD: OdometrySignals = odometry(Layout::Fd);

fn signals(layout: Layout) -> &'static OdometrySignals {
    static BOTH: [OdometrySignals; 2] = [CLASSIC, FD];
    &BOTH[layout.index()]
}

/// Writes a measurement's frame data, in order, without protection. Rates that do not fit are sent
/// at the end of their range; totals wrap.
pub(super) fn encode(
    layout: Layout,
    boot: u8,
    value: &CarOdometry,
    mut emit: impl FnMut([u8; DATA_MAX]),
) -> Result<(), WireError> {
    let s = signals(layout);
    let stamp = i64::from(value.time.as_micros() as u32);
    let travelled = s.travelled.wrap(value.travelled_m)?;
    let turned = s.turned.wrap(value.turned_rad)?;
    let rate = |signal: &super::Signal, value: f64| {
        if value.is_nan() {
            Err(WireError::OutOfRange { signal: signal.name, value })
        } else {
            Ok(signal.saturate(value, 0.0))
        }
    };
    let wheel_left = rate(&s.wheel_left, value.wheel_left_mps)?;
    let wheel_right = rate(&s.wheel_right, value.wheel_right_mps)?;
    let steering = rate(&s.steering, value.steering_rad)?;
    let yaw_rate = rate(&s.yaw_rate, value.yaw_rate_rps)?;
    let mut parts = [[0; DATA_MAX]; 4];
    // In the FD layout all parts are the same frame.
    let part = |i: usize| if layout == Layout::Fd { 0 } else { i };
    s.stamp.put(&mut parts[part(0)], stamp);
    s.wheel_left.put(&mut parts[part(0)], wheel_left);
    s.travelled.put(&mut parts[part(1)], travelled);
    s.wheel_right.put(&mut parts[part(1)], wheel_right);
    s.turned.put(&mut parts[part(2)], turned);
    s.steering.put(&mut parts[part(2)], steering);
    s.yaw_rate.put(&mut parts[part(3)], yaw_rate);
    if layout == Layout::Classic {
        s.stamp_again.put(&mut parts[3], stamp);
    }
    for (i, mut data) in parts.into_iter().enumerate().take(part(3) + 1) {
        if layout == Layout::Classic {
            s.part.put(&mut data, i as i64);
        }
        s.boot.put(&mut data, i64::from(boot));
        emit(data);
    }
    Ok(())
}

/// Puts measurements together.
#[derive(Clone, Debug, Default)]
pub(super) struct OdometryAssembly {
    begun: Option<Instant>,
    parts: u8,
    value: RawOdometry,
}

impl OdometryAssembly {
    pub(super) fn take(
        &mut self,
        now: Instant,
        layout: Layout,
        lost: u8,
        frame: &CanFrame,
    ) -> Result<Option<RawOdometry>, Fault> {
        let s = signals(layout);
        let data = frame.padded();
        let boot = s.boot.get(data) as u8;
        if layout == Layout::Fd {
            return Ok(Some(RawOdometry {
                boot,
                stamp: s.stamp.get(data) as u32,
                travelled: s.travelled.get(data) as u32,
                turned: s.turned.get(data) as i32,
                wheel_left_mps: s.wheel_left.value(data),
                wheel_right_mps: s.wheel_right.value(data),
                steering_rad: s.steering.value(data),
                yaw_rate_rps: s.yaw_rate.value(data),
            }));
        }
        let part = s.part.get(data) as u8;
        let mut broken = false;
        if lost > 0 || self.begun.is_some_and(|begun| expired(begun, now)) {
            broken = self.begun.take().is_some();
        }
        if part == 0 {
            broken |= self.begun.replace(now).is_some();
            self.parts = 0;
            self.value = RawOdometry { boot, ..RawOdometry::default() };
        }
        if self.begun.is_none() {
            return Err(if broken { Fault::Incomplete } else { Fault::Orphan });
        }
        let value = &mut self.value;
        let fits = part == self.parts
            && boot == value.boot
            && (part != 3 || s.stamp_again.get(data) as u32 == value.stamp);
        if !fits {
            self.begun = None;
            return Err(Fault::Incomplete);
        }
        self.parts += 1;
        match part {
            0 => {
                value.stamp = s.stamp.get(data) as u32;
                value.wheel_left_mps = s.wheel_left.value(data);
            }
            1 => {
                value.travelled = s.travelled.get(data) as u32;
                value.wheel_right_mps = s.wheel_right.value(data);
            }
            2 => {
                value.turned = s.turned.get(data) as i32;
                value.steering_rad = s.steering.value(data);
            }
            _ => {
                value.yaw_rate_rps = s.yaw_rate.value(data);
                self.begun = None;
                return Ok(Some(*value));
            }
        }
        if broken { Err(Fault::Incomplete) } else { Ok(None) }
    }
}

/// Makes a wrapping 32-bit counter endless: each reading is taken as the one nearest to the last.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Unwrapper(Option<i64>);

impl Unwrapper {
    /// The endless count; `raw` itself (with its sign) the first time.
    pub(super) fn next(&mut self, raw: i64) -> i64 {
        let count = match self.0 {
            None => raw,
            Some(last) => nearest(last, raw as u32),
        };
        self.0 = Some(count);
        count
    }
}

/// The count nearest to `reference` whose low 32 bits are `raw`.
pub(super) fn nearest(reference: i64, raw: u32) -> i64 {
    reference.saturating_add(i64::from(raw.wrapping_sub(reference as u32) as i32))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wrapping_counter_becomes_endless_both_ways() {
        let mut counter = Unwrapper::default();
        assert_eq!(counter.next(0xFFFF_FFF0), 0xFFFF_FFF0);
        assert_eq!(counter.next(0x10), 0x1_0000_0010);
        assert_eq!(counter.next(0xFFFF_FFFF), 0xFFFF_FFFF);
        let mut signed = Unwrapper::default();
        assert_eq!(signed.next(-5), -5);
        assert_eq!(signed.next(3), 3);
        assert_eq!(signed.next(i64::from(i32::MAX)), i64::from(i32::MAX));
        assert_eq!(signed.next(i64::from(i32::MIN)), i64::from(i32::MAX) + 1);
    }
}
