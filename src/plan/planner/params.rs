//! How a planning step is put together, as far as one may choose.

use super::JansonParams;
use crate::plan::certify::CertifyParams;
use crate::plan::foreseen::ForeseenParams;
use crate::plan::search::{ManoeuvreParams, SearchParams};
use crate::plan::smooth::SmoothParams;
use crate::plan::speed::SpeedParams;
use crate::vehicle::VehicleParams;
use crate::{choices, tunables};

choices! {
    /// How the way is chosen.
    pub enum Policy {
        /// All the way to the goal over known and predicted map (the paper's method).
        MapPredictive = "map-predictive",
        /// To the frontier whose centroid is nearest to the goal (the paper's naive baseline).
        Frontier = "frontier",
        /// Through the exit from known space that promises the earliest arrival, each one's path
        /// shaped and timed, no faster than what will have been seen allows (after Janson, Hu and
        /// Pavone 2018).
        Janson = "janson",
        /// The same, timed without regard to what will have been seen, but with a price for
        /// arriving at the exit in another direction than the way goes on.
        JansonLite = "janson-lite",
        /// All the way over a map that is known from the start (the reference).
        KnownMap = "known-map",
    }
}

choices! {
    /// How the policy map-predictive gets to the goal (the paper's text allows both).
    pub enum Reading {
        /// One search, from the car to the goal.
        Direct = "direct",
        /// The cheapest over all frontiers of the way through known space to the frontier's middle
        /// and on to the goal.
        ViaFrontier = "via-frontier",
    }
}

choices! {
    /// Where a plan may come to rest. Every stop is safe; the question is whether a car without
    /// reverse gear gets on from there.
    pub enum StopRule {
        /// Where there is room for a quarter turn, or for a turning radius straight on, as far as
        /// occupied space is known.
        Optimistic = "optimistic",
        /// The same with all unknown space taken for occupied.
        Seen = "seen",
        /// Where the car can turn back onto the way that it came by, in space known to be free.
        TurnRound = "turn-round",
    }
}

tunables! {
    /// How a planning step is put together.
    pub struct PlanParams in "plan" {
        /// How the way is chosen.
        policy: Policy = Policy::MapPredictive, at_rest, one of;
        /// How the policy map-predictive gets to the goal.
        reading: Reading = Reading::Direct, live, one of;
        /// Clearance granted to the path's shape beside unknown space, beyond what the certificate
        /// asks for; the certificate then ends the executable part before it.
        unknown_room_m: f64 = 0.3, live, in 0.0..=2.0, "m";
        /// Kept from walls, where there is room, in the path's shape through space that is foreseen,
        /// beyond what the certificate asks for: a car farther from a corner looks round it earlier,
        /// and need not slow down for what it cannot see yet.
        wall_room_m: f64 = 0.05, live, in 0.0..=1.0, "m";
        /// What a stop must leave room for.
        stop_rule: StopRule = StopRule::TurnRound, live, one of;
        /// How long a plan could go on at each of its speeds before it had to brake for its stop, where
        /// shapes rely on nothing foreseen: a car that brakes as hard as it can has nothing left to
        /// turn with when a view opens to the side. A stop at the goal and the policy known-map ask
        /// for none.
        caution_s: f64 = 0.15, live, in 0.0..=2.0, "s";
        /// Up to this speed no plan is cautious: a car this slow gets round most corners anyway, and
        /// one in tight places must get on.
        caution_above_mps: f64 = 4.0, live, in 0.0..=20.0, "m/s";
        /// Plans end this far inside the goal disc.
        goal_depth_m: f64 = 0.1, live, in 0.0..=1.0, "m";
    }
}

impl Policy {
    /// Whether what is foreseen has a say in the way.
    pub(super) const fn is_predictive(self) -> bool {
        matches!(self, Self::MapPredictive | Self::Janson | Self::JansonLite)
    }
}

/// Everything that a planner is made of.
#[derive(Clone, Debug, Default)]
pub struct PlannerParams {
    /// The car.
    pub vehicle: VehicleParams,
    /// Composition.
    pub plan: PlanParams,
    /// Guide search.
    pub search: SearchParams,
    /// Start manoeuvres.
    pub manoeuvre: ManoeuvreParams,
    /// Smoothing.
    pub smooth: SmoothParams,
    /// Speed profile.
    pub speed: SpeedParams,
    /// Certificate.
    pub certify: CertifyParams,
    /// What of a prediction shapes rely on.
    pub foreseen: ForeseenParams,
    /// How exits from known space are weighed.
    pub janson: JansonParams,
}
