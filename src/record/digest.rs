//! Numbers that tell whether two things are the same to the last bit.

use crc::{CRC_64_XZ, Crc, Digest};

use crate::plan::{PathPoint, StepReport, Verdict};
use crate::time::Instant;
use crate::wire::can::CanFrame;

static CRC: Crc<u64> = Crc::<u64>::new(&CRC_64_XZ);

struct Sum(Digest<'static, u64>);

impl Sum {
    fn whole(&mut self, number: u64) {
        self.0.update(&number.to_le_bytes());
    }

    fn reals<const N: usize>(&mut self, numbers: [f64; N]) {
        numbers.into_iter().for_each(|number| self.whole(number.to_bits()));
    }

    fn instant(&mut self, at: Instant) {
        self.whole(at.as_nanos());
    }

    fn point(&mut self, point: &PathPoint) {
        let PathPoint { s_m, position, heading_rad, curvature_pm } = *point;
        self.reals([s_m, position.x, position.y, heading_rad, curvature_pm]);
    }
}

/// What a planning step came to, in a number: its verdict with every sample of the plan, and what was
/// foreseen beyond it. Wall times are left out.
pub fn plan_digest(report: &StepReport) -> u64 {
    let mut sum = Sum(CRC.digest());
    sum.whole(u64::from(report.number));
    sum.whole(u64::from(report.base));
    sum.instant(report.takes_over);
    sum.whole(u64::from(report.candidates));
    match &report.verdict {
        Verdict::Plan(plan) => {
            sum.whole(0);
            sum.whole(u64::from(plan.number));
            sum.instant(plan.scan_stamp);
            sum.instant(plan.trajectory.start);
            for point in &plan.trajectory.points {
                sum.point(&point.path);
                sum.reals([point.t_s, point.speed_mps, point.accel_mps2]);
            }
            plan.beyond.points.iter().for_each(|point| sum.point(point));
        }
        Verdict::Keep => sum.whole(1),
        Verdict::Rejected(rejection) => {
            sum.whole(2);
            sum.0.update(format!("{rejection:?}").as_bytes());
        }
        Verdict::Unreachable => sum.whole(3),
    }
    sum.0.finalize()
}

/// The digest over frames that `apexd sil` prints.
pub(super) struct FrameDigest(Digest<'static, u64>);

impl FrameDigest {
    pub(super) fn new() -> Self {
        Self(CRC.digest())
    }

    pub(super) fn note(&mut self, frame: &CanFrame) {
        self.0.update(frame.data());
    }

    pub(super) fn text(self) -> String {
        format!("{:016x}", self.0.finalize())
    }
}
