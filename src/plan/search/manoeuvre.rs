//! The first metres of a plan where the guide leaves the car's heading: a car that neither turns on
//! the spot nor reverses has to swing round.
//!
//! A hybrid A* (Dolgov et al. 2010) over `(x, y, heading)`: states are expanded by short arcs, and
//! from each state the shortest way of a forward-only car onto the guide is tried directly.

mod arcs;
mod field;
mod room;

use std::cmp::Reverse;
use std::collections::BinaryHeap;

pub use room::{MaskRoom, Room};

use super::Guide;
use super::dubins::{self, Dubins};
use crate::frames::{Point, Pose, Vector};
use crate::plan::{Path, PathPoint};
use crate::tunables;
use arcs::{Arc, Turning, parts_of};
use field::{FAR_M, Field, Lattice};
use room::Ground;

tunables! {
    /// The search for a drivable start where the guide leaves the car's heading.
    pub struct ManoeuvreParams in "manoeuvre" {
        /// No manoeuvre is looked for while the guide's first metre lies within this angle of the
        /// car's heading.
        skip_turn_rad: f64 = 0.35, live, in 0.05..=1.5, "rad";
        /// The manoeuvre joins the guide at least this far along it, if that much is known.
        join_from_m: f64 = 1.5, live, in 0.1..=10.0, "m";
        /// The manoeuvre joins the guide at most this far along it (farther at speed).
        join_to_m: f64 = 3.0, live, in 0.2..=20.0, "m";
        /// Share of the steering's largest curvature that a manoeuvre uses; the rest is left to
        /// smoothing.
        curvature_share: f64 = 0.9, live, in 0.3..=1.0, "";
        /// Length of one arc of the search.
        step_m: f64 = 0.15, live, in 0.05..=0.5, "m";
        /// States that are expanded before the search near the car gives up; as many again are
        /// then spent on a wider one.
        effort: u32 = 4000, live, in 100..=100000, "";
    }
}

/// What is asked of [`ManoeuvreSearch::find`].
#[derive(Clone, Copy, Debug)]
pub struct ManoeuvreQuery<'a> {
    /// Where the car is and where it looks, map frame.
    pub pose: Pose,
    /// How fast it is there, m/s; arcs are no tighter than tyres allow while it slows down.
    pub speed_mps: f64,
    /// The way to be joined.
    pub guide: &'a Guide,
    /// The steering's largest curvature, 1/m.
    pub curvature_limit_pm: f64,
    /// What the tyres transmit, m/s^2.
    pub acceleration_limit_mps2: f64,
}

/// A drivable start.
#[derive(Clone, Debug, PartialEq)]
pub struct Manoeuvre {
    /// From the car's pose on, samples at most 0.05 m apart; pieces of constant curvature. A
    /// sample carries the curvature of the piece that follows it.
    pub path: Path,
    /// The guide's point that the path ends on, in the guide's direction. `None` where none could
    /// be reached: the path then leads closer to the guide (in metres that a forward-only car
    /// drives) and is to be driven to its end.
    pub joins_at: Option<usize>,
    /// What is left to drive from the path's end to the guide's end, metres: along the guide, or, where
    /// the path does not join it, at the least.
    pub left_m: f64,
    /// How many states were expanded.
    pub expanded: usize,
}

/// Nothing that the car can drive in known-free space brings it closer to the guide.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("no drivable way from ({x_m:.2}, {y_m:.2}) m, heading {heading_rad:.2} rad, to the guide")]
pub struct NoManoeuvre {
    /// Where the car is, metres.
    pub x_m: f64,
    /// Where the car is, metres.
    pub y_m: f64,
    /// Where it looks, radians.
    pub heading_rad: f64,
    /// How many states were expanded.
    pub expanded: usize,
}

/// Share of the steering's largest curvature where a lesser one has led nowhere.
const LAST_RESORT_SHARE: f64 = 0.99;
/// A way found is taken when nothing better than this factor can be left.
const GOOD_ENOUGH: f64 = 1.1;
/// A manoeuvre that does not reach the guide must bring it at least this much closer, metres.
const GAIN_MIN_M: f64 = 0.2;
/// Points of the guide that are tried as an end.
const ENDS: usize = 4;
/// The nearest point of the guide that is worth joining, metres.
const NEAREST_END_M: f64 = 0.3;
const NONE: u32 = u32::MAX;

/// A pose on the guide.
#[derive(Clone, Copy)]
struct End {
    index: usize,
    pose: Pose,
    /// From there along the guide to the farthest end, metres.
    rest_m: f64,
    /// Whether the disc fits there; otherwise it only shows the direction.
    fits: bool,
}

#[derive(Clone, Copy)]
struct State {
    pose: Pose,
    /// Driven from the start, metres, and in how many arcs.
    s_m: f64,
    arcs: usize,
    parent: u32,
    /// Of the arc that led here, 1/m.
    curvature_pm: f64,
    slot: u32,
    /// Estimate of the way left, metres.
    left_m: f64,
    /// Whether an arc leads on from here.
    leads_on: bool,
}

/// How far around the car, and where on the guide.
struct Level {
    window_m: f64,
    from_m: f64,
    to_m: f64,
    effort: usize,
    curvature_share: f64,
    /// Whether to search on without an end that can be reached, only for a direction.
    keeps_direction: bool,
}

/// The search for a manoeuvre. Holds its working memory.
#[derive(Default)]
pub struct ManoeuvreSearch {
    ends: Vec<End>,
    /// Points of the guide where the disc fits: index, distance along the guide.
    fitting: Vec<(usize, f64)>,
    states: Vec<State>,
    /// Per slot of the lattice: number of the search, least distance driven there; minus one once
    /// expanded.
    slots: Vec<(u32, f32)>,
    generation: u32,
    /// Length in all, order of pushing, state, whether its estimate is the full one.
    heap: BinaryHeap<(Reverse<u32>, u32, u32, bool)>,
    heap_order: u32,
    field: Field,
}

/// A way onto the guide.
struct Joined {
    state: u32,
    end: usize,
    way: Dubins,
}

impl ManoeuvreSearch {
    /// A drivable start onto the guide, or `None` where the guide starts out in the car's heading
    /// and none is needed.
    ///
    /// Looks near the car first, then wider, at all of the guide's known part and with the tightest
    /// turns; where nothing reaches the guide, it gives the longest gain towards it.
    pub fn find<R: Room>(
        &mut self,
        room: &R,
        query: &ManoeuvreQuery<'_>,
        params: &ManoeuvreParams,
    ) -> Result<Option<Manoeuvre>, NoManoeuvre> {
        let pose = query.pose;
        if !leaves_heading(query, params.skip_turn_rad) {
            return Ok(None);
        }
        let v2 = query.speed_mps * query.speed_mps;
        let braking_m = v2 / query.acceleration_limit_mps2;
        let effort = params.effort as usize;
        let to_m = params.join_to_m.max(params.join_from_m) + braking_m;
        let near = Level {
            window_m: 1.0 + to_m,
            from_m: params.join_from_m,
            to_m,
            effort,
            curvature_share: params.curvature_share,
            keeps_direction: false,
        };
        let wide = Level {
            window_m: 3.0 + to_m,
            from_m: 0.0,
            to_m: 3.0 + to_m,
            effort,
            curvature_share: params.curvature_share.max(LAST_RESORT_SHARE),
            keeps_direction: true,
        };
        let ground = Ground::new(room, pose.position);
        let mut expanded = 0;
        for level in [near, wide] {
            if !self.choose_ends(room, query.guide, &level) {
                continue;
            }
            let turning = Turning {
                curvature_pm: level.curvature_share * query.curvature_limit_pm,
                v2,
                acceleration: query.acceleration_limit_mps2,
            };
            // A mere direction is worth less effort: there is no end that would be found.
            let fits = self.ends.iter().any(|end| end.fits);
            let effort = if fits { level.effort } else { level.effort / 4 };
            let level = Level { effort, ..level };
            let (found, spent) = self.search(&ground, pose, turning, &level, params.step_m);
            expanded += spent;
            if let Some(Joined { state, end, way }) = found {
                let path = self.path(state, Some(&way), params.step_m);
                let index = self.ends[end].index;
                let (joins_at, left_m) = (Some(index), length_from(query.guide, index));
                return Ok(Some(Manoeuvre { path, joins_at, left_m, expanded }));
            }
        }
        if let Some(state) = self.best_gain() {
            let path = self.path(state, None, params.step_m);
            let State { pose, left_m, .. } = self.states[state as usize];
            let left_m = self.ends.last().map_or(left_m, |end| {
                let straight_m = (end.pose.position - pose.position).norm();
                // A distance that stands for no way over the plane is no length.
                let to_end_m = if left_m > 0.5 * FAR_M { straight_m } else { left_m };
                to_end_m + length_from(query.guide, end.index)
            });
            return Ok(Some(Manoeuvre { path, joins_at: None, left_m, expanded }));
        }
        let Point { coords } = pose.position;
        Err(NoManoeuvre { x_m: coords.x, y_m: coords.y, heading_rad: pose.heading_rad, expanded })
    }

    /// Poses on the guide's known part between the level's distances, or, where the disc fits at
    /// none of them, nearer. The wide level keeps at least a direction; false if there is nothing
    /// to aim at.
    fn choose_ends<R: Room>(&mut self, room: &R, guide: &Guide, level: &Level) -> bool {
        self.ends.clear();
        self.fitting.clear();
        let mut s = 0.0;
        let mut ahead = 0;
        for (index, point) in guide.points.iter().enumerate() {
            if index > 0 {
                s += (point - guide.points[index - 1]).norm();
            }
            if s > level.to_m {
                break;
            }
            if s <= 1.0 {
                ahead = index;
            }
            if s >= NEAREST_END_M && index < guide.known_until && room.fits(*point) {
                self.fitting.push((index, s));
            }
        }
        let beyond = self.fitting.partition_point(|(_, s)| *s < level.from_m);
        let usable = &self.fitting[if beyond < self.fitting.len() { beyond } else { 0 }..];
        let end_at = |index: usize, rest_m: f64, fits: bool| {
            let pose = Pose { position: guide.points[index], heading_rad: direction(guide, index) };
            End { index, pose, rest_m, fits }
        };
        if let Some((last, far)) = usable.last().copied() {
            let count = ENDS.min(usable.len());
            for i in 1..count {
                let (index, s) = usable[(i - 1) * (usable.len() - 1) / (count - 1)];
                self.ends.push(end_at(index, far - s, true));
            }
            self.ends.push(end_at(last, 0.0, true));
        } else if level.keeps_direction {
            self.ends.push(end_at(ahead, 0.0, false));
        }
        !self.ends.is_empty()
    }

    fn search<R: Room>(
        &mut self,
        ground: &Ground<'_, R>,
        start: Pose,
        turning: Turning,
        level: &Level,
        step_m: f64,
    ) -> (Option<Joined>, usize) {
        let lattice = Lattice::around(start.position, level.window_m);
        if self.ends.iter().any(|end| end.fits) {
            let ends = self.ends.iter().map(|end| (end.pose.position, end.rest_m));
            self.field.spread(ground, lattice, ends);
        } else {
            self.field.clear();
        }
        self.begin(lattice.slots());
        let slot = lattice.slot(start).expect("the start is the middle of the lattice");
        let left = self.field.left_m(lattice, start.position);
        self.add(State {
            pose: start,
            s_m: 0.0,
            arcs: 0,
            parent: NONE,
            curvature_pm: 0.0,
            slot,
            left_m: left,
            leads_on: false,
        });
        let (mut expanded, mut best, mut best_m) = (0, None, f64::INFINITY);
        // By the number of arcs that led to a state: that says how fast the car is there at most.
        let mut fans: Vec<[Arc; 5]> = Vec::new();
        while let Some((Reverse(key), _, id, refined)) = self.heap.pop() {
            if key_m(key) * GOOD_ENOUGH >= best_m || expanded >= level.effort {
                break;
            }
            let state = self.states[id as usize];
            let slot = self.slots[state.slot as usize];
            if slot.1 < 0.0 || f64::from(slot.1) < state.s_m - 1e-6 {
                continue;
            }
            let tightest = turning.at(state.s_m);
            if !refined {
                let left = self.try_ends(ground, id, 1.0 / tightest, &mut best, &mut best_m);
                let left = left.max(state.left_m);
                self.states[id as usize].left_m = left;
                if left > state.left_m + 1e-3 {
                    self.push(id, state.s_m + left, true);
                    continue;
                }
            }
            self.slots[state.slot as usize].1 = -1.0;
            expanded += 1;
            // Parents are expanded before their children.
            if fans.len() == state.arcs {
                fans.push(Arc::fan(tightest, step_m));
            }
            for arc in &fans[state.arcs] {
                let pose = state.pose.along_chord(arc.whole.chord_m, arc.whole.turn_rad);
                let s_m = state.s_m + step_m;
                // Most squares have been reached before: that is sooner seen than room.
                let slot = lattice.slot(pose).filter(|slot| {
                    let (generation, least) = self.slots[*slot as usize];
                    generation != self.generation || f64::from(least) > s_m
                });
                if slot.is_none() && self.states[id as usize].leads_on {
                    continue;
                }
                if !ground.is_open_along(state.pose, arc, pose) {
                    continue;
                }
                self.states[id as usize].leads_on = true;
                let Some(slot) = slot else { continue };
                let left_m = self.field.left_m(lattice, pose.position).max(state.left_m - step_m);
                self.add(State {
                    pose,
                    s_m,
                    arcs: state.arcs + 1,
                    parent: id,
                    curvature_pm: arc.curvature_pm,
                    slot,
                    left_m,
                    leads_on: false,
                });
            }
        }
        (best, expanded)
    }

    fn begin(&mut self, slots: usize) {
        if self.slots.len() < slots {
            self.slots.resize(slots, (0, 0.0));
        }
        self.generation = self.generation.wrapping_add(1);
        if self.generation == 0 {
            self.slots.fill((0, 0.0));
            self.generation = 1;
        }
        self.states.clear();
        self.heap.clear();
        self.heap_order = 0;
    }

    fn add(&mut self, state: State) {
        let id = self.states.len() as u32;
        self.slots[state.slot as usize] = (self.generation, state.s_m as f32);
        self.states.push(state);
        self.push(id, state.s_m + state.left_m, false);
    }

    fn push(&mut self, id: u32, total_m: f64, refined: bool) {
        // Among equals the one pushed last: straight to the end where the estimate is right.
        let order = self.heap_order;
        self.heap_order += 1;
        self.heap.push((Reverse(m_key(total_m)), order, id, refined));
    }

    /// Least length to go that a forward-only car needs to the ends, obstacles apart; remembers the
    /// best way that is open from here.
    fn try_ends<R: Room>(
        &self,
        ground: &Ground<'_, R>,
        id: u32,
        radius_m: f64,
        best: &mut Option<Joined>,
        best_m: &mut f64,
    ) -> f64 {
        let state = &self.states[id as usize];
        let mut least = f64::INFINITY;
        for (end, goal) in self.ends.iter().enumerate() {
            let way = dubins::shortest(state.pose, goal.pose, radius_m);
            let left = way.length_m + goal.rest_m;
            least = least.min(left);
            let total = state.s_m + left;
            if goal.fits && total < *best_m && ground.drive_all(state.pose, &way) {
                *best_m = total;
                *best = Some(Joined { state: id, end, way });
            }
        }
        least
    }

    /// The state of the last search that is closest to the guide by more than a little and from
    /// which an arc leads on.
    fn best_gain(&self) -> Option<u32> {
        let start = self.states.first()?;
        let mut best = None;
        let mut least = start.left_m - GAIN_MIN_M;
        for (id, state) in self.states.iter().enumerate().skip(1) {
            if state.leads_on && state.left_m < least {
                least = state.left_m;
                best = Some(id as u32);
            }
        }
        best
    }

    /// The arcs that lead to a state, and then the way onto the guide.
    fn path(&self, last: u32, way: Option<&Dubins>, step_m: f64) -> Path {
        let mut arcs = Vec::new();
        let mut id = last;
        while self.states[id as usize].parent != NONE {
            arcs.push((self.states[id as usize].curvature_pm, step_m));
            id = self.states[id as usize].parent;
        }
        arcs.reverse();
        arcs.extend(
            way.into_iter().flat_map(|way| way.pieces).filter(|(_, length)| *length > 1e-6),
        );
        let mut points = Vec::new();
        let (mut pose, mut s) = (self.states[id as usize].pose, 0.0);
        let mut last_curvature = 0.0;
        for (curvature_pm, length) in arcs {
            let pieces = parts_of(length);
            for i in 0..pieces as u32 {
                let along = length * f64::from(i) / pieces;
                points.push(sample(
                    pose.along_arc(along, curvature_pm * along),
                    s + along,
                    curvature_pm,
                ));
            }
            pose = pose.along_arc(length, curvature_pm * length);
            s += length;
            last_curvature = curvature_pm;
        }
        points.push(sample(pose, s, last_curvature));
        Path { points }
    }
}

fn sample(pose: Pose, s_m: f64, curvature_pm: f64) -> PathPoint {
    PathPoint { s_m, position: pose.position, heading_rad: pose.heading_rad, curvature_pm }
}

/// Lengths as queue keys, in tenths of a millimetre.
fn m_key(length_m: f64) -> u32 {
    (length_m * 1.0e4).round() as u32
}

fn key_m(key: u32) -> f64 {
    f64::from(key) * 1.0e-4
}

/// Direction of the guide around one of its points, over about half a metre.
fn direction(guide: &Guide, index: usize) -> f64 {
    const REACH_M: f64 = 0.25;
    let here = guide.points[index];
    let far = |p: &&Point| (*p - here).norm() >= REACH_M;
    let ends = (guide.points.first(), guide.points.last());
    let (Some(first), Some(last)) = ends else { return 0.0 };
    let before = guide.points[..index].iter().rev().find(far).unwrap_or(first);
    let after = guide.points[index..].iter().find(far).unwrap_or(last);
    let along = after - before;
    along.y.atan2(along.x)
}

/// Length of a guide from one of its points on, metres.
fn length_from(guide: &Guide, index: usize) -> f64 {
    guide.points[index..].windows(2).map(|w| (w[1] - w[0]).norm()).sum()
}

/// Whether the guide's first metre points away from the car's heading.
fn leaves_heading(query: &ManoeuvreQuery<'_>, skip_turn_rad: f64) -> bool {
    let here = query.pose.position;
    let points = &query.guide.points;
    let ahead = points.iter().find(|p| (*p - here).norm() >= 1.0).or(points.last());
    let Some(ahead) = ahead.filter(|p| (*p - here).norm() >= NEAREST_END_M) else { return false };
    query.pose.to_body(*ahead).coords.angle(&Vector::x()) > skip_turn_rad
}

#[cfg(test)]
#[path = "manoeuvre_tests.rs"]
mod tests;
