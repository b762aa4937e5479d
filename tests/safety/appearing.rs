//! Something is set down in free space ahead, beyond the stopping distance.

use apexd::frames::Pose;
use apexd::sim::rig::Rig;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::bus_cut::{RECORDINGS, run_on};
use super::geometry::to_solid_m;
use super::replay::Recording;
use super::watch::Watch;

/// What is set down.
#[derive(Clone, Copy, Debug)]
enum Thing {
    /// A disc of this radius, metres.
    Disc(f64),
    /// A box across the way, length and width in metres.
    Box(f64, f64),
}

/// Until a thing is seen, mapped and acted upon a scan period, the way over the bus, and a control
/// period pass.
fn reaction_s(recording: &Recording) -> f64 {
    1.0 / recording.trial().lidar_hz + 0.02
}

/// Sets a thing down on the committed path, just far enough that the car can stop before it. Says
/// whether there was such a place.
fn set_down(rig: &mut Rig, thing: Thing, reaction_s: f64, extra_m: f64) -> bool {
    let trajectory = rig.core().committed().current().trajectory.clone();
    let here = trajectory.at(rig.now());
    let speed = rig.car().speed_mps;
    let (reach, half_width) = match thing {
        Thing::Disc(radius) => (radius, radius),
        Thing::Box(length, width) => (0.5 * length, 0.5 * width),
    };
    // The tyres' grip in a bend is not all for braking: 0.8 of it; a cell's diagonal for the
    // raster, the car's own radius and the margin.
    let stop = speed * speed / (2.0 * 0.8 * 8.829) + speed * reaction_s;
    let ahead = stop + reach.hypot(half_width) + 0.25 + 0.15 + extra_m;
    let at = trajectory.at_distance(here.path.s_m + ahead).path;
    let inside = here.path.s_m + ahead < trajectory.last().path.s_m;
    // In sight, or it does not appear in known space at all.
    let from = rig.car().pose.position;
    let away = at.position - from;
    let seen = (1..20).all(|k| !rig.world().is_solid(from + away * (f64::from(k) / 20.0)));
    let gap = to_solid_m(rig.world(), at.position, 0.5);
    if speed < 0.5 || !inside || !seen || gap < 0.15 {
        return false;
    }
    let pose = Pose { position: at.position, heading_rad: at.heading_rad };
    let filled = match thing {
        Thing::Disc(radius) => rig.world_mut().fill_disc(pose.position, radius),
        Thing::Box(length, width) => rig.world_mut().fill_rect(pose, length, width),
    };
    filled > 0
}

#[test]
fn a_thing_that_appears_beyond_the_stopping_distance_is_not_touched() {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut tried = Vec::new();
    for recording in RECORDINGS.iter() {
        for k in 0..8 {
            let at_s = rng.random_range(0.3..recording.ended_s - 0.5);
            let thing = match k % 3 {
                0 => Thing::Disc(rng.random_range(0.06..0.3)),
                1 => Thing::Box(0.1, 1.0),
                _ => Thing::Box(0.4, 0.3),
            };
            tried.push((recording, at_s, thing, rng.random_range(0.0..0.6)));
        }
    }
    let results: Vec<bool> = tried
        .par_iter()
        .map(|(recording, at_s, thing, extra_m)| {
            let trial = recording.trial();
            let mut rig = trial.rig_with(recording.replay());
            run_on(&mut rig, *at_s);
            // The next place that allows it.
            let until = rig.now().offset_by(1.5);
            while !set_down(&mut rig, *thing, reaction_s(recording), *extra_m) {
                if rig.now() > until || rig.outcome().is_some() {
                    return false;
                }
                rig.step();
            }
            let what = format!("{}, {thing:?} at {}", trial.label(), rig.now());
            let mut watch = Watch::new(trial);
            watch.world_changes();
            watch.join(&mut rig);
            let until = rig.now().offset_by(1.6);
            while rig.now() < until && rig.outcome().is_none() {
                rig.step();
                watch.look(&mut rig);
            }
            watch.findings.assert_none(&what);
            let judge = rig.judge();
            assert_eq!(judge.collisions(), 0, "{what}: contact at {:?}", rig.car());
            assert_eq!(judge.unknown_entries(), 0, "{what}: unknown entry at {:?}", rig.car());
            true
        })
        .collect();
    let done = results.iter().filter(|done| **done).count();
    println!("{done} of {} things set down", results.len());
    assert!(done >= 20, "only {done} things were set down");
}
