//! The newest raw scan, prepared for one question: is this disc clear?

use crate::frames::{Point, Pose, heading_vector};
use crate::scan::Scan;
use crate::time::Instant;

/// Beams whose shortest reach is kept together.
const BLOCK: usize = 16;
/// So many neighbouring beams without a word are bridged by the shorter of their neighbours.
const SILENT_MAX: usize = 2;

/// What has to hold for a disc to be clear.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Proof {
    /// No return inside it.
    NoReturn,
    /// No return inside it, and every part of it in sight of the scan.
    InSight,
}

/// One scan in the frame of the guard's odometry.
#[derive(Clone, Debug)]
pub(super) struct ScanView {
    pub(super) stamp: Instant,
    /// Pose of the lidar when it was measured.
    origin: Pose,
    angle_first_rad: f64,
    angle_step_rad: f64,
    full_circle: bool,
    /// Unit vectors of the beams, scan frame. Single precision (a micrometre at the lidar's range)
    /// lets the processor take four beams at a time.
    direction_x: Vec<f32>,
    direction_y: Vec<f32>,
    /// How far each beam saw, metres.
    reach_m: Vec<f32>,
    /// Range of its return, metres; infinite without one.
    return_m: Vec<f32>,
    /// Smallest reach of every [`BLOCK`] beams.
    block_reach_m: Vec<f32>,
}

impl ScanView {
    pub(super) fn empty() -> Self {
        Self {
            stamp: Instant::ZERO,
            origin: Pose::new(0.0, 0.0, 0.0),
            angle_first_rad: 0.0,
            angle_step_rad: 0.0,
            full_circle: false,
            direction_x: Vec::new(),
            direction_y: Vec::new(),
            reach_m: Vec::new(),
            return_m: Vec::new(),
            block_reach_m: Vec::new(),
        }
    }

    /// Takes a scan measured at `origin`; buffers and directions are kept from scan to scan.
    pub(super) fn take(&mut self, scan: &Scan, origin: Pose) {
        self.stamp = scan.stamp;
        self.origin = origin;
        self.full_circle = scan.is_full_circle();
        let n = scan.ranges_m.len();
        if self.direction_x.len() != n
            || self.angle_first_rad != scan.angle_first_rad
            || self.angle_step_rad != scan.angle_step_rad
        {
            self.angle_first_rad = scan.angle_first_rad;
            self.angle_step_rad = scan.angle_step_rad;
            self.direction_x.clear();
            self.direction_y.clear();
            for i in 0..n {
                let direction = heading_vector(scan.angle_rad(i));
                self.direction_x.push(direction.x as f32);
                self.direction_y.push(direction.y as f32);
            }
        }
        let range_max = scan.range_max_m as f32;
        self.reach_m.clear();
        self.return_m.clear();
        for range in &scan.ranges_m {
            let said = *range > 0.0;
            self.reach_m.push(if said { range.min(range_max) } else { f32::NAN });
            self.return_m.push(if said && *range < range_max { *range } else { f32::INFINITY });
        }
        self.bridge_silent();
        self.block_reach_m.clear();
        let shortest = |block: &[f32]| block.iter().copied().fold(f32::INFINITY, f32::min);
        self.block_reach_m.extend(self.reach_m.chunks(BLOCK).map(shortest));
    }

    /// Gives beams that said nothing a reach: the shorter neighbour's for one or two of them, none
    /// for a wider gap.
    fn bridge_silent(&mut self) {
        let n = self.reach_m.len();
        let mut i = 0;
        while i < n {
            if !self.reach_m[i].is_nan() {
                i += 1;
                continue;
            }
            let end = (i..n).find(|j| !self.reach_m[*j].is_nan()).unwrap_or(n);
            let bridged = if i > 0 && end < n && end - i <= SILENT_MAX {
                self.reach_m[i - 1].min(self.reach_m[end])
            } else {
                0.0
            };
            self.reach_m[i..end].fill(bridged);
            i = end;
        }
    }

    /// Distance from a point (odometry frame) to the nearest return, metres; infinite without one.
    pub(super) fn nearest_return_m(&self, point: Point) -> f64 {
        let p = self.origin.to_body(point);
        let (x, y) = (p.x as f32, p.y as f32);
        let beams = self.direction_x.iter().zip(&self.direction_y).zip(&self.return_m);
        let nearest = beams
            .filter(|(_, range)| range.is_finite())
            .map(|((dx, dy), range)| (range * dx - x).powi(2) + (range * dy - y).powi(2))
            .fold(f32::INFINITY, f32::min);
        f64::from(nearest).sqrt()
    }

    /// Whether the disc about `centre` (odometry frame) is clear.
    pub(super) fn is_clear(&self, centre: Point, radius_m: f64, proof: Proof) -> bool {
        let n = self.reach_m.len();
        if n == 0 {
            return false;
        }
        let c = self.origin.to_body(centre);
        let distance = c.coords.norm();
        let disc = Disc::new(c, radius_m, proof);
        if distance <= radius_m * 1.001 {
            return self.beams_clear(&disc, 0, n);
        }
        // The beams that can meet the disc, one more on either side.
        let half = (radius_m / distance).asin();
        let step = self.angle_step_rad.abs();
        let bearing = c.y.atan2(c.x);
        let turn = std::f64::consts::TAU;
        let ahead = (bearing - self.angle_first_rad) * self.angle_step_rad.signum();
        let middle = ahead.rem_euclid(turn) / step;
        let low = (middle - half / step).floor() as isize - 1;
        let high = (middle + half / step).ceil() as isize + 2;
        let count = n as isize;
        if high - low >= count {
            return self.beams_clear(&disc, 0, n);
        }
        if self.full_circle {
            let (low, high) = if low < 0 { (low + count, high + count) } else { (low, high) };
            let first = self.beams_clear(&disc, low.min(count) as usize, high.min(count) as usize);
            let (low, high) = ((low - count).max(0), (high - count).max(0));
            return first && self.beams_clear(&disc, low as usize, high as usize);
        }
        // A fan: what lies beside it is out of sight.
        let around = (turn / step).round() as isize;
        let (mut low, mut high) = (low, high);
        if middle > 0.5 * (n as f64 - 1.0 + turn / step) {
            (low, high) = (low - around, high - around);
        }
        let inside = low >= -1 && high <= count + 1;
        (inside || proof == Proof::NoReturn)
            && self.beams_clear(&disc, low.clamp(0, count) as usize, high.clamp(0, count) as usize)
    }

    fn beams_clear(&self, disc: &Disc, low: usize, high: usize) -> bool {
        let mut i = low;
        while i < high {
            let block = i / BLOCK;
            let end = ((block + 1) * BLOCK).min(high);
            if self.block_reach_m[block] < disc.beyond {
                let beams = i..end;
                let (x, y) = (&self.direction_x[beams.clone()], &self.direction_y[beams.clone()]);
                let hidden = match disc.proof {
                    Proof::InSight => disc.hidden(x, y, &self.reach_m[beams]),
                    Proof::NoReturn => disc.touched(x, y, &self.return_m[beams]),
                };
                if hidden {
                    return false;
                }
            }
            i = end;
        }
        true
    }
}

/// A disc in the scan's frame. A beam cuts it between `along - h` and `along + h`, where `along` is
/// the centre's projection on the beam and `h^2 = radius^2 - distance^2 + along^2`.
struct Disc {
    x: f32,
    y: f32,
    /// `radius^2 - distance^2`: negative if the lidar is outside.
    inside: f32,
    /// Where no beam is in it any more.
    beyond: f32,
    proof: Proof,
}

impl Disc {
    fn new(centre: Point, radius_m: f64, proof: Proof) -> Self {
        let squared = centre.coords.norm_squared();
        Self {
            x: centre.x as f32,
            y: centre.y as f32,
            inside: (radius_m * radius_m - squared) as f32,
            beyond: (squared.sqrt() + radius_m) as f32,
            proof,
        }
    }

    /// Whether a beam that meets the disc does not reach its far side (no branches, no roots).
    fn hidden(&self, x: &[f32], y: &[f32], reach: &[f32]) -> bool {
        let mut any = false;
        for ((x, y), reach) in x.iter().zip(y).zip(reach) {
            let along = x * self.x + y * self.y;
            let half_squared = self.inside + along * along;
            let short = reach - along;
            let meets = (half_squared > 0.0) & ((along > 0.0) | (self.inside > 0.0));
            any |= meets & ((short < 0.0) | (short * short < half_squared));
        }
        any
    }

    /// Whether a return lies in the disc.
    fn touched(&self, x: &[f32], y: &[f32], range: &[f32]) -> bool {
        let mut any = false;
        for ((x, y), range) in x.iter().zip(y).zip(range) {
            let along = x * self.x + y * self.y;
            let half_squared = self.inside + along * along;
            let short = range - along;
            any |= short * short < half_squared;
        }
        any
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    /// A wall across the way at x = 2, seen by `n` beams over `sweep` radians from `first` on.
    fn wall(n: usize, first: f64, sweep: f64) -> ScanView {
        let step = sweep / n as f64;
        let ranges_m = (0..n)
            .map(|i| {
                let x = (first + step * i as f64).cos();
                if x > 0.4 { (2.0 / x) as f32 } else { 9.0 }
            })
            .collect();
        let scan = Scan {
            stamp: Instant::ZERO,
            sequence: 0,
            angle_first_rad: first,
            angle_step_rad: step,
            range_max_m: 7.5,
            ranges_m,
        };
        let mut view = ScanView::empty();
        view.take(&scan, Pose::new(10.0, 5.0, 0.3));
        view
    }

    fn at(view: &ScanView, x: f64, y: f64) -> Point {
        view.origin.to_map(Point::new(x, y))
    }

    #[test]
    fn a_disc_is_clear_up_to_the_wall_whatever_the_first_beam() {
        for (first, sweep) in [(0.0, TAU), (-3.0, TAU), (2.0, TAU), (1.0, -TAU)] {
            let view = wall(1080, first, sweep);
            for proof in [Proof::NoReturn, Proof::InSight] {
                for y in [-1.0, -0.1, 0.0, 0.7] {
                    assert!(view.is_clear(at(&view, 1.79, y), 0.2, proof), "{first} {y}");
                    assert!(!view.is_clear(at(&view, 1.81, y), 0.2, proof), "{first} {y}");
                }
                assert!(view.is_clear(at(&view, -3.0, 0.0), 0.2, proof));
                assert!(view.is_clear(at(&view, 0.0, 0.05), 0.2, proof));
            }
            assert!(view.is_clear(at(&view, 2.5, 0.0), 0.2, Proof::NoReturn));
            assert!(!view.is_clear(at(&view, 2.5, 0.0), 0.2, Proof::InSight));
            assert!(!view.is_clear(at(&view, -7.4, 0.0), 0.2, Proof::InSight));
            let nearest = view.nearest_return_m(at(&view, 1.5, 0.2));
            assert!((nearest - 0.5).abs() < 1e-3, "{nearest}");
        }
    }

    #[test]
    fn beside_a_fan_nothing_is_in_sight_but_the_car_itself() {
        let view = wall(720, -0.75 * std::f64::consts::PI, 1.5 * std::f64::consts::PI);
        assert!(view.is_clear(at(&view, 1.0, 0.0), 0.2, Proof::InSight));
        assert!(view.is_clear(at(&view, 0.1, 0.0), 0.2, Proof::InSight));
        assert!(!view.is_clear(at(&view, -1.0, 0.0), 0.2, Proof::InSight));
        assert!(view.is_clear(at(&view, -1.0, 0.0), 0.2, Proof::NoReturn));
        assert!(!view.is_clear(at(&view, -1.0, 1.0), 0.2, Proof::InSight));
        assert!(!view.is_clear(at(&view, -1.0, -1.0), 0.2, Proof::InSight));
    }

    #[test]
    fn one_silent_beam_is_bridged_and_a_gap_is_out_of_sight() {
        let mut view = wall(1080, 0.0, TAU);
        let scan = |silent: std::ops::Range<usize>| {
            let mut ranges_m = vec![5.0_f32; 1080];
            ranges_m[silent].fill(f32::NAN);
            Scan {
                stamp: Instant::ZERO,
                sequence: 0,
                angle_first_rad: 0.0,
                angle_step_rad: TAU / 1080.0,
                range_max_m: 7.5,
                ranges_m,
            }
        };
        view.take(&scan(0..0), view.origin);
        let ahead = at(&view, 2.0, 2.0);
        assert!(view.is_clear(ahead, 0.2, Proof::InSight));
        view.take(&scan(135..137), view.origin);
        assert!(view.is_clear(ahead, 0.2, Proof::InSight));
        view.take(&scan(135..145), view.origin);
        assert!(!view.is_clear(ahead, 0.2, Proof::InSight));
        assert!(view.is_clear(ahead, 0.2, Proof::NoReturn));
    }

    #[test]
    fn an_empty_scan_shows_nothing() {
        assert!(!ScanView::empty().is_clear(Point::new(0.0, 0.0), 0.1, Proof::NoReturn));
    }
}
