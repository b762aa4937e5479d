//! Where the car's disc has room, and along which arcs and ways.

use super::arcs::{Arc, parts_of};
use crate::frames::{Point, Pose};
use crate::map::CellRect;
use crate::plan::search::dubins::Dubins;
use crate::plan::search::{cell_at, coarse_first};

/// A car that stands where its disc does not fit by the mask (rounding) may leave that spot.
const LEAVE_M: f64 = 0.15;

/// Where the car's disc has room, as far as is known.
pub trait Room {
    /// Whether the disc with its centre there lies wholly in known-free space.
    fn fits(&self, centre: Point) -> bool;
}

/// Room looked up in a mask over cells; outside the bounds there is none.
#[derive(Clone, Copy, Debug)]
pub struct MaskRoom<'a> {
    /// Side of a cell, metres.
    pub resolution_m: f64,
    /// The cells of the mask.
    pub bounds: CellRect,
    /// Whether something occupied or unknown is closer to the cell than the disc's radius; row by
    /// row from `bounds.y0`, each row from `bounds.x0`.
    pub blocked: &'a [bool],
}

impl Room for MaskRoom<'_> {
    #[inline]
    fn fits(&self, centre: Point) -> bool {
        let c = cell_at(centre, self.resolution_m);
        self.bounds.contains(c) && {
            let row = (c.iy - self.bounds.y0) as usize * self.bounds.width();
            !self.blocked[row + (c.ix - self.bounds.x0) as usize]
        }
    }
}

/// The room around the car, and where it starts.
pub(super) struct Ground<'a, R> {
    room: &'a R,
    start: Point,
    start_fits: bool,
}

impl<'a, R: Room> Ground<'a, R> {
    pub(super) fn new(room: &'a R, start: Point) -> Self {
        Self { room, start, start_fits: room.fits(start) }
    }

    pub(super) fn open(&self, p: Point) -> bool {
        self.room.fits(p) || (!self.start_fits && (p - self.start).norm() <= LEAVE_M)
    }

    /// Whether the disc fits all along an arc that ends at `end`.
    pub(super) fn is_open_along(&self, from: Pose, arc: &Arc, end: Pose) -> bool {
        let mut within = arc.within.iter().map(|p| from.along_chord(p.chord_m, p.turn_rad));
        self.open(end.position) && within.all(|pose| self.open(pose.position))
    }

    /// Whether the disc fits all along a way. Where it is blocked is met soonest by looking at a few
    /// places all over it first: most ways that are tried are blocked.
    pub(super) fn drive_all(&self, from: Pose, way: &Dubins) -> bool {
        let mut begin = from;
        let pieces = way.pieces.map(|(curvature_pm, length_m)| {
            let parts = if length_m > 1e-9 { parts_of(length_m) } else { 0.0 };
            let piece = (begin, curvature_pm, length_m, parts);
            if parts > 0.0 {
                begin = begin.along_arc(length_m, curvature_pm * length_m);
            }
            piece
        });
        coarse_first(|first, stride| {
            pieces.iter().all(|(begin, curvature_pm, length_m, parts)| {
                let mut samples = (first + 1..=*parts as usize).step_by(stride);
                samples.all(|i| {
                    let s = length_m * i as f64 / parts;
                    self.open(begin.along_arc(s, curvature_pm * s).position)
                })
            })
        })
    }
}
