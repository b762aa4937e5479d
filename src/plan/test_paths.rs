//! Paths for the tests of this folder, made from their curvature alone.

use rand::{Rng, RngExt};

use super::path::{Path, PathPoint};
use crate::frames::{Pose, heading_vector, wrap_angle};

/// The path whose curvature runs linearly from sample to sample, `ds_m` apart, positions by
/// Gauss-Legendre quadrature (three points on each of four pieces per edge: exact to rounding).
pub(crate) fn from_curvature(start: Pose, curvature_pm: &[f64], ds_m: f64) -> Path {
    const NODES: [(f64, f64); 3] = [
        (0.112_701_665_379_258_3, 5.0 / 18.0),
        (0.5, 8.0 / 18.0),
        (0.887_298_334_620_741_7, 5.0 / 18.0),
    ];
    let (mut position, mut heading) = (start.position, start.heading_rad);
    let mut points = Vec::new();
    for (i, &k0) in curvature_pm.iter().enumerate() {
        points.push(PathPoint {
            s_m: i as f64 * ds_m,
            position,
            heading_rad: wrap_angle(heading),
            curvature_pm: k0,
        });
        let Some(&k1) = curvature_pm.get(i + 1) else { break };
        let at = |u: f64| heading + (k0 * u + 0.5 * (k1 - k0) * u * u) * ds_m;
        for piece in 0..4 {
            for (node, weight) in NODES {
                let u = (f64::from(piece) + node) / 4.0;
                position += heading_vector(at(u)) * (weight * ds_m / 4.0);
            }
        }
        heading = at(1.0);
    }
    Path { points }
}

/// A straight run.
pub(crate) fn straight(start: Pose, length_m: f64, ds_m: f64) -> Path {
    let n = (length_m / ds_m).round() as usize;
    from_curvature(start, &vec![0.0; n + 1], ds_m)
}

/// Straights joined by hairpins of curvature `peak_pm`, left and right in turn, with transitions
/// of 0.3 m.
pub(crate) fn hairpins(start: Pose, length_m: f64, peak_pm: f64, ds_m: f64) -> Path {
    let turn = std::f64::consts::PI / peak_pm;
    let (ramp, straight) = (0.3, 2.0);
    let period = straight + turn + ramp;
    let n = (length_m / ds_m).round() as usize;
    let curvature = (0..=n).map(|i| {
        let s = i as f64 * ds_m;
        let (lap, s) = ((s / period).floor(), s.rem_euclid(period));
        let into = ((s - straight) / ramp).min((period - s) / ramp).clamp(0.0, 1.0);
        peak_pm * into * if lap.rem_euclid(2.0) == 0.0 { 1.0 } else { -1.0 }
    });
    from_curvature(start, &curvature.collect::<Vec<_>>(), ds_m)
}

/// A smooth random path: a sum of sines, clamped to `peak_pm`.
pub(crate) fn random(
    rng: &mut impl Rng,
    start: Pose,
    length_m: f64,
    peak_pm: f64,
    ds_m: f64,
) -> Path {
    let waves: Vec<(f64, f64, f64)> = (0..5)
        .map(|_| {
            let wavelength = rng.random_range(0.8..6.0);
            let phase = rng.random_range(0.0..std::f64::consts::TAU);
            (rng.random_range(0.0..peak_pm), std::f64::consts::TAU / wavelength, phase)
        })
        .collect();
    let n = (length_m / ds_m).round() as usize;
    let curvature = (0..=n).map(|i| {
        let s = i as f64 * ds_m;
        let sum: f64 = waves.iter().map(|(a, w, p)| a * (w * s + p).sin()).sum();
        sum.clamp(-peak_pm, peak_pm)
    });
    from_curvature(start, &curvature.collect::<Vec<_>>(), ds_m)
}
