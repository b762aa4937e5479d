//! The core in the words of the vehicle's side: views, events, refusals.

use std::sync::Arc;

use crate::autopilot::{Action, Command, Event, Fault, Mode, Refusal};
use crate::frames::Pose;
use crate::ground::{
    self, CoreCounts, CoreEvent, CoreFault, CoreMode, CoreRequest, CoreView, FaultAction, Fresh,
    PlanPoint, RefusalKind,
};
use crate::plan::{Trajectory, TrajectoryPoint};
use crate::shell::daemon::{CommandRefusal, CoreSnapshot};

/// Places of the plan that are shown.
const PLACES: usize = 5;
/// Below this much left the plan counts as driven, metres.
const DRIVEN_M: f64 = 0.02;

/// A snapshot as the vehicle's side has it.
pub fn view(snapshot: &CoreSnapshot, start: Pose) -> CoreView {
    let s = snapshot;
    let trajectory = &s.plan.trajectory;
    let fresh = |refusal: &Refusal| !s.not_ready.contains(refusal);
    CoreView {
        at: s.at,
        mode: mode(s.mode, s.faults.contains(Fault::Terminated)),
        pose: s.state.map(|(pose, _)| pose),
        speed_mps: s.state.map_or(0.0, |(_, speed)| speed),
        yaw_rate_rps: s.yaw_rate_rps,
        start,
        goal: s.goal.map(|goal| goal.position),
        faults: s.faults.iter().map(fault).collect(),
        not_ready: s.not_ready.iter().map(ToString::to_string).collect(),
        target: Some(place(&trajectory.at(s.at))),
        plan: places(trajectory, s),
        cross_track_m: s.cross_track_m,
        scan: s.scan.as_ref().map(Arc::clone),
        battery_v: s.car_status.map(|(_, status)| status.battery_v),
        fresh: Fresh {
            odometry: fresh(&Refusal::NoOdometry),
            scan: fresh(&Refusal::NoScan),
            status: fresh(&Refusal::NoStatus),
        },
        load: s.load,
        counts: CoreCounts {
            frames_refused: s.counts.frames_refused,
            error_frames: s.counts.error_frames,
            plans_rejected: s.counts.plans_rejected,
            guard_stops: s.counts.guard_stops,
        },
        speed_max_mps: s.params.speed.speed_max_mps,
    }
}

fn place(point: &TrajectoryPoint) -> PlanPoint {
    PlanPoint {
        position: point.path.position,
        heading_rad: point.path.heading_rad,
        speed_mps: point.speed_mps,
        accel_mps2: point.accel_mps2,
        curvature_pm: point.path.curvature_pm,
    }
}

/// What is left of the plan, in equal steps to its end.
fn places(trajectory: &Trajectory, snapshot: &CoreSnapshot) -> Vec<PlanPoint> {
    let here_m = trajectory.at(snapshot.at).path.s_m;
    let left_m = trajectory.last().path.s_m - here_m;
    if left_m < DRIVEN_M {
        return Vec::new();
    }
    let step = |i: usize| here_m + left_m * i as f64 / PLACES as f64;
    (1..=PLACES).map(|i| place(&trajectory.at_distance(step(i)))).collect()
}

const fn mode(mode: Mode, terminated: bool) -> CoreMode {
    match mode {
        _ if terminated => CoreMode::Terminated,
        Mode::Disarmed => CoreMode::Disarmed,
        Mode::Standby => CoreMode::Standby,
        Mode::Hold => CoreMode::Hold,
        Mode::Drive => CoreMode::Drive,
        Mode::Stop => CoreMode::Stop,
    }
}

fn fault(fault: Fault) -> CoreFault {
    let row = fault.row();
    CoreFault {
        name: fault.name(),
        detection: row.detection,
        action: match row.action {
            Action::FinishPlan => FaultAction::FinishesPlan,
            Action::BrakeNow => FaultAction::Brakes,
            Action::Report => FaultAction::Reports,
        },
    }
}

/// An event as the vehicle's side has it, if it is anything for a person.
pub fn event(event: &Event) -> Option<CoreEvent> {
    match event {
        Event::ModeChanged { to, .. } => Some(CoreEvent::ModeChanged { to: mode(*to, false) }),
        Event::FaultRaised { fault: Fault::Terminated, .. } => {
            Some(CoreEvent::ModeChanged { to: CoreMode::Terminated })
        }
        Event::FaultRaised { fault: raised, .. } => Some(CoreEvent::FaultRaised(fault(*raised))),
        Event::FaultCleared { fault: cleared, .. } => {
            Some(CoreEvent::FaultCleared(fault(*cleared)))
        }
        Event::GoalReached { position, .. } => Some(CoreEvent::GoalReached { position: *position }),
        _ => None,
    }
}

/// A wish as the core has it, if it is one for the core.
pub const fn command(request: &CoreRequest) -> Option<Command> {
    Some(match request {
        CoreRequest::Arm => Command::Arm,
        CoreRequest::Disarm => Command::Disarm,
        CoreRequest::Goto { point, through_known: false } => Command::Goto(*point),
        CoreRequest::Goto { point, through_known: true } => Command::Return(*point),
        CoreRequest::Hold => Command::Pause,
        CoreRequest::Continue => Command::Continue,
        CoreRequest::SpeedLimit(limit) => Command::SpeedLimit(*limit),
        CoreRequest::Terminate => Command::Terminate,
        CoreRequest::GroundStationLost(lost) => Command::StationLost(*lost),
        CoreRequest::Restart
        | CoreRequest::Shutdown
        | CoreRequest::Storage(_)
        | CoreRequest::SetParameter { .. }
        | CoreRequest::SetFence(_)
        | CoreRequest::SigningKey(_) => return None,
    })
}

/// The core's answer as the vehicle's side has it. Who asks a car that stands to hold, or one that
/// drives to go on, has what was wanted.
pub fn answer(
    command: Command,
    driving: bool,
    answer: Result<(), CommandRefusal>,
) -> Result<(), ground::Refusal> {
    let refusal = match answer {
        Ok(()) => return Ok(()),
        Err(CommandRefusal::Ending) => {
            let reason = CommandRefusal::Ending.to_string();
            return Err(ground::Refusal::new(RefusalKind::Temporary, reason));
        }
        Err(CommandRefusal::Core(refusal)) => refusal,
    };
    match (command, &refusal) {
        (Command::Pause, Refusal::NotDriving) => return Ok(()),
        (Command::Continue, Refusal::NothingToContinue) if driving => return Ok(()),
        _ => {}
    }
    let kind = match refusal {
        Refusal::GoalNotFinite { .. } | Refusal::SpeedNotPositive { .. } => RefusalKind::Denied,
        _ => RefusalKind::Failed,
    };
    Err(ground::Refusal::new(kind, refusal.to_string()))
}
