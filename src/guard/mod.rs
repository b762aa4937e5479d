//! The last word on every setpoint. Knows neither map nor plan nor prediction: odometry, the newest
//! raw scan, the newest braking tail, and the car's limits.
//!
//! A setpoint passes if, after obeying it for one period, the car can still stop: on the arc that the
//! setpoint drives, through space that the scan shows to be free, or on the committed braking tail,
//! free of returns (whether space out of sight is free, only the map can know). The way to stop that
//! was proved last is kept. When a setpoint does not pass, the car brakes along that way, so a stop
//! that was proved once is always there to be taken (the scheme of the planner's certificate, with
//! no code in common).

mod view;

use crate::command::{BrakingTail, ForceSetpoint};
use crate::frames::Pose;
use crate::odometry::{OdometryTrack, Reading};
use crate::scan::{Odometry, Scan};
use crate::tail::{TailCurve, TailError, bend_share};
use crate::time::Instant;
use crate::tunables;
use crate::vehicle::VehicleParams;
use view::{Proof, ScanView};

tunables! {
    /// The last gate before the car.
    pub struct GuardParams in "guard" {
        /// A car whose newest odometry is older than this is stopped.
        odometry_age_max_s: f64 = 0.06, at_rest, in 0.01..=1.0, "s";
        /// A car whose newest scan is older than this is stopped.
        scan_age_max_s: f64 = 0.2, at_rest, in 0.02..=2.0, "s";
        /// Free space kept about the car's disc.
        margin_m: f64 = 0.02, at_rest, in 0.005..=0.5, "m";
        /// Time from making a setpoint until the car acts on it.
        delay_s: f64 = 0.003, at_rest, in 0.0..=0.5, "s";
        /// Share of the tyres' grip that a stop counts on.
        grip_share: f64 = 0.95, at_rest, in 0.2..=1.0, "";
        /// After a stop the car moves on only if it could go this much further.
        release_m: f64 = 0.1, at_rest, in 0.0..=2.0, "m";
        /// Fastest change of the lateral force, over the mass. A tenth of a second from left to right.
        lateral_jerk_max_mps3: f64 = 1200.0, at_rest, in 10.0..=10000.0, "m/s^3";
        /// Fastest rise of the longitudinal force, over the mass; braking is never held back. A
        /// full reversal within one period of 10 ms passes.
        drive_jerk_max_mps3: f64 = 1800.0, at_rest, in 10.0..=10000.0, "m/s^3";
    }
}

/// How long the guard remembers where the car was: longer than a scan may be old.
const MEMORY_S: f64 = 3.0;
/// Distance between the discs that stand for the swept strip, metres.
const SPACING_M: f64 = 0.08;
/// Slowest car that counts as moving, m/s.
const STANDING_MPS: f64 = 0.01;
/// Smallest margin in a place that is narrower than the margin, metres: enough to leave it.
const NARROW_M: f64 = 0.005;
/// A tail further off than this to the side, or turned by more, is not where the car is.
const TAIL_OFFSET_MAX_M: f64 = 0.06;
const TAIL_HEADING_MAX_RAD: f64 = 0.2;
/// The car counts as driving within the tail's speed up to this excess, m/s. Where a plan changes
/// from full acceleration to full braking, half a sample spacing and one period take up to 0.26 m/s
/// off the tail's speed; it has been taken back by braking a period later.
const TAIL_OVERSPEED_MPS: f64 = 0.3;
/// Settling onto the way to stop: time, and shortest distance.
const SETTLE_S: f64 = 0.1;
const SETTLE_MIN_M: f64 = 0.15;
/// Share of the grip with which a car is held.
const HOLD_SHARE: f64 = 0.1;

/// Why the guard changed a setpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reason {
    /// A force or curvature was not a number.
    NotFinite,
    /// The odometry is too old, or there is none.
    OdometryStale,
    /// The newest scan is too old, or there is none.
    ScanStale,
    /// There would be no clear way to stop.
    Obstacle,
    /// The forces left the friction circle, or the curvature the turning circle: cut down.
    Force,
    /// The forces changed too fast: held back.
    Rate,
}

impl Reason {
    /// All of them, in the order of [`GuardCounts::periods`].
    pub const ALL: [Self; 6] = [
        Self::NotFinite,
        Self::OdometryStale,
        Self::ScanStale,
        Self::Obstacle,
        Self::Force,
        Self::Rate,
    ];

    /// Whether the guard stops the car for it (otherwise the setpoint was only trimmed).
    pub const fn stops(self) -> bool {
        !matches!(self, Self::Force | Self::Rate)
    }
}

/// The guard's word on one setpoint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GuardDecision {
    /// What goes to the car.
    pub setpoint: ForceSetpoint,
    /// Why it is not the setpoint that came in.
    pub intervened: Option<Reason>,
}

/// What the guard has done so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GuardCounts {
    /// Times it took over to stop the car.
    pub stops: u64,
    /// Periods with an intervention, by reason ([`Reason::ALL`]).
    pub periods: [u64; Reason::ALL.len()],
}

/// A way to come to rest, proved clear.
#[derive(Clone, Debug)]
struct Escape {
    curve: TailCurve,
    s_m: f64,
}

/// The guard.
#[derive(Clone, Debug)]
pub struct Guard {
    params: GuardParams,
    period_s: f64,
    radius_m: f64,
    mass_kg: f64,
    accel_limit_mps2: f64,
    curvature_limit_pm: f64,
    track: OdometryTrack,
    view: Option<ScanView>,
    tail: Option<Escape>,
    escape: Option<Escape>,
    /// The last setpoint let out, and when.
    last: Option<(Instant, ForceSetpoint)>,
    stopping: Option<Reason>,
    counts: GuardCounts,
}

impl Guard {
    /// A guard that has seen nothing: it lets nothing move. It is asked every `period_s` seconds.
    pub fn new(vehicle: &VehicleParams, params: &GuardParams, period_s: f64) -> Self {
        Self {
            params: params.clone(),
            period_s,
            radius_m: vehicle.radius_m,
            mass_kg: vehicle.mass_kg,
            accel_limit_mps2: vehicle.acceleration_limit_mps2(),
            curvature_limit_pm: vehicle.curvature_limit_pm(),
            track: OdometryTrack::in_own_frame(MEMORY_S),
            view: None,
            tail: None,
            escape: None,
            last: None,
            stopping: None,
            counts: GuardCounts::default(),
        }
    }

    /// Takes new limits; what was seen and proved stays.
    pub fn set_params(&mut self, vehicle: &VehicleParams, params: &GuardParams) {
        self.params = params.clone();
        self.radius_m = vehicle.radius_m;
        self.mass_kg = vehicle.mass_kg;
        self.accel_limit_mps2 = vehicle.acceleration_limit_mps2();
        self.curvature_limit_pm = vehicle.curvature_limit_pm();
    }

    /// Takes up an odometry reading.
    pub fn handle_odometry(&mut self, odometry: &Odometry) {
        if self.track.push(odometry) == Reading::Restarted {
            self.forget_places();
        }
    }

    /// The next reading belongs to other totals: the car's controller was restarted.
    pub fn begin_anew(&mut self) {
        self.track.begin_anew();
        self.forget_places();
    }

    /// All positions belong to a frame that has gone.
    fn forget_places(&mut self) {
        (self.view, self.tail, self.escape) = (None, None, None);
    }

    /// Takes up a raw scan. One without a known pose at its stamp is not used.
    pub fn handle_scan(&mut self, scan: &Scan) {
        let Some(origin) = self.track.pose_at(scan.stamp) else { return };
        if self.view.as_ref().is_some_and(|v| v.stamp >= scan.stamp) {
            return;
        }
        self.view.get_or_insert_with(ScanView::empty).take(scan, origin);
    }

    /// Takes up the braking tail that goes to the car.
    pub fn handle_tail(&mut self, tail: &BrakingTail) -> Result<(), TailError> {
        self.tail = Some(Escape { curve: TailCurve::anchored(tail, &self.track)?, s_m: 0.0 });
        Ok(())
    }

    /// What the guard has done so far.
    pub const fn counts(&self) -> &GuardCounts {
        &self.counts
    }

    /// Why the car is being stopped, while it is.
    pub const fn stopping(&self) -> Option<Reason> {
        self.stopping
    }

    /// The setpoint that goes to the car at `now`.
    pub fn check(&mut self, now: Instant, wished: ForceSetpoint) -> GuardDecision {
        let (setpoint, intervened) = self.decide(now, wished);
        if let Some(reason) = intervened {
            self.counts.periods[reason as usize] += 1;
        }
        let stopping = intervened.filter(|r| r.stops());
        if stopping.is_some() && self.stopping.is_none() {
            self.counts.stops += 1;
        }
        self.stopping = stopping;
        self.last = Some((now, setpoint));
        GuardDecision { setpoint, intervened }
    }

    fn decide(&mut self, now: Instant, wished: ForceSetpoint) -> (ForceSetpoint, Option<Reason>) {
        let state = self.track.newest().and_then(|(odometry, _)| {
            let age = now.seconds_after(odometry.stamp);
            let pose = self.track.pose_at(now)?;
            let speed = self.track.speed_at(now)?;
            (age <= self.params.odometry_age_max_s).then_some((pose, speed, odometry))
        });
        let finite = wished.longitudinal_n.is_finite()
            && wished.lateral_n.is_finite()
            && wished.curvature_pm.is_finite();
        let Some((pose, speed, odometry)) = state else {
            // Without a speed no force can be right: the car stops by itself, along its tail.
            let reason = if finite { Reason::OdometryStale } else { Reason::NotFinite };
            let standing = finite && !wished.drive;
            return (self.let_go(), (!standing).then_some(reason));
        };
        if !finite {
            return (self.brake(pose, speed, &odometry), Some(Reason::NotFinite));
        }
        let (setpoint, trimmed) = self.trim(now, wished, speed);
        if !setpoint.drive || (speed <= STANDING_MPS && setpoint.longitudinal_n <= 0.0) {
            return (setpoint, trimmed); // it only stops or stands
        }
        let scan_age = self.view.as_ref().map_or(f64::INFINITY, |v| now.seconds_after(v.stamp));
        if scan_age > self.params.scan_age_max_s {
            return (self.brake(pose, speed, &odometry), Some(Reason::ScanStale));
        }
        let extra = if self.stopping.is_some() { self.params.release_m } else { 0.0 };
        if self.can_stop(pose, speed, &setpoint, extra) {
            (setpoint, trimmed)
        } else {
            (self.brake(pose, speed, &odometry), Some(Reason::Obstacle))
        }
    }

    /// Whether the car can still stop after a period of `setpoint`; keeps the way if so.
    fn can_stop(&mut self, pose: Pose, speed: f64, setpoint: &ForceSetpoint, extra: f64) -> bool {
        let Some(view) = &self.view else { return false };
        let p = &self.params;
        // Where there is less room than the margin, a smaller one has to do.
        let room = view.nearest_return_m(pose.position) - 0.001;
        let radius = (self.radius_m + p.margin_m).min(room.max(self.radius_m + NARROW_M));
        // Discs of this radius at this spacing cover the strip of the wanted one.
        let radius = radius.hypot(0.5 * SPACING_M);
        let grip = self.accel_limit_mps2 * p.grip_share;

        let accel = setpoint.longitudinal_n / self.mass_kg;
        // Until the next setpoint has taken effect.
        let reaction_s = self.period_s + p.delay_s;
        let moving_s = if accel < 0.0 { reaction_s.min(speed / -accel) } else { reaction_s };
        let after = (speed + accel * moving_s).max(0.0);
        let reaction = (speed + 0.5 * accel * moving_s) * moving_s + extra;

        let curvature = self.driven_curvature(setpoint, speed);
        let length = reaction + arc_stop_m(after, curvature, grip);
        let arc = TailCurve::arc(pose, curvature, length, speed);
        if arc.centres(0.0, length, SPACING_M).all(|c| view.is_clear(c, radius, Proof::InSight)) {
            self.escape = Some(Escape { curve: arc, s_m: 0.0 });
            return true;
        }
        let Some(tail) = &mut self.tail else { return false };
        let place = tail.curve.locate_car(pose, tail.s_m);
        tail.s_m = place.s_m;
        if place.offset_m.abs() > TAIL_OFFSET_MAX_M
            || place.heading_error_rad.abs() > TAIL_HEADING_MAX_RAD
            || place.beyond_m > TAIL_OFFSET_MAX_M
        {
            return false;
        }
        let begin = place.s_m + reaction - extra;
        // A tail from rest begins at speed zero: a few centimetres on count too.
        let allowed = tail.curve.speed_at(begin).max(tail.curve.speed_at(begin + 0.03));
        if after > allowed + TAIL_OVERSPEED_MPS {
            return false;
        }
        let end = tail_stop_m(&tail.curve, begin, after, grip).min(tail.curve.length_m());
        let clear = view.is_clear(pose.position, radius, Proof::NoReturn)
            && (tail.curve.centres(place.s_m, end.max(place.s_m), SPACING_M))
                .all(|c| view.is_clear(c, radius, Proof::NoReturn));
        if clear {
            self.escape = Some(tail.clone());
        }
        clear
    }

    /// Full braking along the way that was proved last; along the present steering without one.
    fn brake(&mut self, pose: Pose, speed: f64, odometry: &Odometry) -> ForceSetpoint {
        let grip = self.accel_limit_mps2 * GRIP_USED;
        let mut curvature = odometry.steering_curvature_pm;
        if let Some(escape) = &mut self.escape {
            let place = escape.curve.locate_car(pose, escape.s_m);
            escape.s_m = place.s_m;
            let settle = (SETTLE_S * speed).max(SETTLE_MIN_M);
            curvature = escape.curve.steer(&place, 0.006 * speed, settle);
        }
        let limit = self.curvature_limit_pm;
        let curvature = curvature.clamp(-limit, limit);
        if speed <= STANDING_MPS {
            return ForceSetpoint {
                longitudinal_n: -HOLD_SHARE * self.mass_kg * grip,
                lateral_n: 0.0,
                curvature_pm: curvature,
                drive: true,
            };
        }
        // The lateral force for the speed in the middle of the period.
        let slower = (speed - 0.5 * grip * self.period_s).max(0.0);
        let lateral = bend_share(curvature * slower * slower, grip);
        ForceSetpoint {
            longitudinal_n: -self.mass_kg * (grip * grip - lateral * lateral).max(0.0).sqrt(),
            lateral_n: self.mass_kg * lateral,
            curvature_pm: curvature,
            drive: true,
        }
    }

    /// Lets the car's controller stop by itself.
    fn let_go(&self) -> ForceSetpoint {
        ForceSetpoint {
            longitudinal_n: -self.mass_kg * self.accel_limit_mps2 * GRIP_USED,
            lateral_n: 0.0,
            curvature_pm: 0.0,
            drive: false,
        }
    }

    /// The setpoint within the circle, the turning circle and the rates.
    fn trim(
        &self,
        now: Instant,
        wished: ForceSetpoint,
        speed: f64,
    ) -> (ForceSetpoint, Option<Reason>) {
        let mut setpoint = wished;
        let mut reason = None;
        if let Some((at, last)) = self.last {
            // After a pause nothing is known of what the car does meanwhile: no rate then.
            let dt = now.seconds_after(at).max(0.001);
            if dt <= self.params.odometry_age_max_s && last.drive && speed > STANDING_MPS {
                let rise = self.params.drive_jerk_max_mps3 * dt * self.mass_kg;
                let turn = self.params.lateral_jerk_max_mps3 * dt * self.mass_kg;
                setpoint.longitudinal_n = wished.longitudinal_n.min(last.longitudinal_n + rise);
                setpoint.lateral_n =
                    wished.lateral_n.clamp(last.lateral_n - turn, last.lateral_n + turn);
                if setpoint != wished {
                    reason = Some(Reason::Rate);
                }
            }
        }
        let limit = self.curvature_limit_pm;
        let circle = self.mass_kg * self.accel_limit_mps2;
        let norm = setpoint.longitudinal_n.hypot(setpoint.lateral_n);
        // A part in a million is rounding, here or in the frames of the bus.
        if setpoint.curvature_pm.abs() > limit * (1.0 + 1e-6) || norm > circle * (1.0 + 1e-6) {
            reason = Some(Reason::Force);
        }
        setpoint.curvature_pm = setpoint.curvature_pm.clamp(-limit, limit);
        if norm > circle {
            // The bend comes first, as in the tracker for a car that is no faster than planned.
            setpoint.lateral_n = setpoint.lateral_n.clamp(-circle, circle);
            let room = (circle * circle - setpoint.lateral_n.powi(2)).max(0.0).sqrt();
            setpoint.longitudinal_n = setpoint.longitudinal_n.clamp(-room, room);
        }
        (setpoint, reason)
    }

    /// The curvature that the car will drive on a setpoint: by the force when moving, by the
    /// curvature below 0.5 m/s.
    fn driven_curvature(&self, setpoint: &ForceSetpoint, speed: f64) -> f64 {
        let limit = self.curvature_limit_pm;
        if speed < 0.5 {
            return setpoint.curvature_pm.clamp(-limit, limit);
        }
        (setpoint.lateral_n / (self.mass_kg * speed * speed)).clamp(-limit, limit)
    }
}

/// Share of the grip that the guard brakes with: all of it but for rounding.
const GRIP_USED: f64 = 0.998;

/// Distance to rest on an arc with all of `accel` on the friction circle: with w = v^2,
/// dw/ds = -2 sqrt(accel^2 - kappa^2 w^2), so s = asin(kappa v^2 / accel) / (2 kappa).
fn arc_stop_m(speed: f64, curvature: f64, accel: f64) -> f64 {
    let w = speed * speed;
    let k = curvature.abs();
    if k * w < 1e-3 * accel {
        return w / (2.0 * accel) * 1.000_001;
    }
    (k * w / accel).min(1.0).asin() / (2.0 * k)
}

/// Where a car stops that brakes with all of `accel` along a tail from `s_m` on.
fn tail_stop_m(curve: &TailCurve, mut s_m: f64, speed: f64, accel: f64) -> f64 {
    let mut w = speed * speed;
    while s_m < curve.length_m() {
        let lateral = curve.curvature_at(s_m) * w;
        let brake = (accel * accel - lateral * lateral).max(0.0).sqrt();
        if w <= 2.0 * brake * SPACING_M {
            return if brake > 0.0 { s_m + w / (2.0 * brake) } else { s_m };
        }
        // A bend taken at the limit leaves nothing to brake with, but the tail's own speed falls.
        w = (w - 2.0 * brake * SPACING_M)
            .min((curve.speed_at(s_m + SPACING_M) + TAIL_OVERSPEED_MPS).powi(2));
        s_m += SPACING_M;
    }
    s_m
}

#[cfg(test)]
mod tests;
