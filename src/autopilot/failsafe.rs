//! The failsafe table, as data: what can go wrong, how soon it is noticed, what is done, and how
//! it is cleared.
//!
//! Every action ends at rest. [`Action::FinishPlan`] relies on the committed plan, which ends at
//! rest in known free space whatever happens; [`Action::BrakeNow`] is for faults that take away
//! the means of following it (the pose, the car's own word) or the belief in it.

use super::AutopilotParams;

/// Something that can go wrong while driving.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Fault {
    /// No complete scan for too long.
    ScanLate,
    /// No odometry for too long.
    OdometryLate,
    /// No status from the car's controller for too long.
    StatusLost,
    /// The emergency-stop button is pressed.
    EmergencyStop,
    /// The car's controller reports that setpoints did not reach it.
    SetpointLost,
    /// Too many frames arrive corrupt.
    CorruptFrames,
    /// The car strays from the committed plan.
    TrackingError,
    /// No plan was adopted for too long although the goal is not reached.
    PlannerLate,
    /// The map proves that no way to the goal exists.
    GoalUnreachable,
    /// Something was set down on the committed plan, and no stop before it could be certified.
    PathBlocked,
    /// The guard had to take over.
    GuardStop,
    /// The planner goes on without prediction.
    NoPrediction,
}

/// What is done about a fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// Adopt no new plan; the committed one ends at rest in known free space.
    FinishPlan,
    /// Tell the car's controller to brake along the newest tail, as hard as the tyres allow.
    BrakeNow,
    /// Nothing but a report: the committed plan runs on, newer ones are welcome.
    Report,
}

/// How a fault goes away.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Clears {
    /// By itself, when the cause is gone.
    ByItself,
    /// When the cause is gone and the car is armed anew.
    ByArming,
    /// With a new goal.
    ByNewGoal,
}

/// One row of the table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// What goes wrong.
    pub fault: Fault,
    /// How it is noticed, in words.
    pub detection: &'static str,
    /// Longest time from the cause to the first control tick that is due to act on it, seconds.
    pub after_s: f64,
    /// What is done.
    pub action: Action,
    /// How it is cleared.
    pub clears: Clears,
}

impl Row {
    /// Longest time from the cause to the action, seconds: detectors run at each control tick.
    pub fn within_s(&self, params: &AutopilotParams) -> f64 {
        self.after_s + params.tick_s()
    }
}

/// No scan for this long means that the lidar or its frames are lost: three scans at 20 Hz.
pub const SCAN_TIMEOUT_S: f64 = 0.15;
/// No odometry for this long: five frames at 100 Hz. Dead reckoning by rates is good for less than
/// a centimetre over it.
pub const ODOMETRY_TIMEOUT_S: f64 = 0.05;
/// No word from the car's controller for this long: five frames at 20 Hz.
pub const STATUS_TIMEOUT_S: f64 = 0.25;
/// No adopted plan for this long is reported; the committed plan has stopped the car by then or is
/// about to.
pub const PLAN_TIMEOUT_S: f64 = 0.5;
/// Corrupt frames within one second that make the bus untrustworthy.
pub const CORRUPT_FRAMES_PER_S: u32 = 100;
/// The failsafe table, in order of precedence: the first active row decides.
pub const TABLE: &[Row] = &[
    Row {
        fault: Fault::EmergencyStop,
        detection: "car status frame says that the button is pressed",
        after_s: 0.05,
        action: Action::BrakeNow,
        clears: Clears::ByArming,
    },
    Row {
        fault: Fault::SetpointLost,
        detection: "car status frame says that setpoints stopped coming",
        after_s: 0.05,
        action: Action::BrakeNow,
        clears: Clears::ByArming,
    },
    Row {
        fault: Fault::OdometryLate,
        detection: "newest odometry frame is too old",
        after_s: ODOMETRY_TIMEOUT_S,
        action: Action::BrakeNow,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::TrackingError,
        detection: "estimated pose is off the committed plan by more than the certified margin",
        after_s: 0.0,
        action: Action::BrakeNow,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::PathBlocked,
        detection: "a beam ended on the committed plan and no stop before it could be certified",
        after_s: 0.0,
        action: Action::BrakeNow,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::StatusLost,
        detection: "newest car status frame is too old",
        after_s: STATUS_TIMEOUT_S,
        action: Action::BrakeNow,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::ScanLate,
        detection: "newest complete scan is too old",
        after_s: SCAN_TIMEOUT_S,
        action: Action::FinishPlan,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::CorruptFrames,
        detection: "frames with a wrong CRC within one second",
        after_s: 1.0,
        action: Action::FinishPlan,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::GoalUnreachable,
        detection: "the search exhausted all space that is not occupied",
        after_s: 0.0,
        action: Action::FinishPlan,
        clears: Clears::ByNewGoal,
    },
    Row {
        fault: Fault::GuardStop,
        detection: "the guard overrode a setpoint",
        after_s: 0.0,
        action: Action::Report,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::PlannerLate,
        detection: "no plan was adopted although the goal is not reached",
        after_s: PLAN_TIMEOUT_S,
        action: Action::Report,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::NoPrediction,
        detection: "the network is missing, fails, is too slow, or its answers are no probabilities",
        after_s: PLAN_TIMEOUT_S,
        action: Action::Report,
        clears: Clears::ByItself,
    },
];

impl Fault {
    /// The row of the table.
    pub fn row(self) -> &'static Row {
        TABLE.iter().find(|row| row.fault == self).expect("every fault has a row")
    }

    /// The name used in logs and documentation.
    pub const fn name(self) -> &'static str {
        match self {
            Self::ScanLate => "scan late",
            Self::OdometryLate => "odometry late",
            Self::StatusLost => "car status lost",
            Self::EmergencyStop => "emergency stop",
            Self::SetpointLost => "setpoint lost",
            Self::CorruptFrames => "corrupt frames",
            Self::TrackingError => "tracking error",
            Self::PlannerLate => "planner late",
            Self::GoalUnreachable => "goal unreachable",
            Self::PathBlocked => "path blocked",
            Self::GuardStop => "guard stop",
            Self::NoPrediction => "no prediction",
        }
    }
}

/// The faults that are active.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ActiveFaults(u32);

impl ActiveFaults {
    /// Raises or clears a fault; says whether that changed anything.
    pub fn set(&mut self, fault: Fault, active: bool) -> bool {
        let bit = 1 << fault as u32;
        let before = self.0;
        if active {
            self.0 |= bit;
        } else {
            self.0 &= !bit;
        }
        before != self.0
    }

    /// Whether a fault is active.
    pub const fn contains(&self, fault: Fault) -> bool {
        self.0 & (1 << fault as u32) != 0
    }

    /// The active row that decides.
    pub fn decisive(&self) -> Option<&'static Row> {
        TABLE.iter().filter(|row| row.action != Action::Report).find(|row| self.contains(row.fault))
    }

    /// The active faults in order of precedence.
    pub fn iter(&self) -> impl Iterator<Item = Fault> + '_ {
        TABLE.iter().map(|row| row.fault).filter(|fault| self.contains(*fault))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [Fault; 12] = [
        Fault::ScanLate,
        Fault::OdometryLate,
        Fault::StatusLost,
        Fault::EmergencyStop,
        Fault::SetpointLost,
        Fault::CorruptFrames,
        Fault::TrackingError,
        Fault::PlannerLate,
        Fault::GoalUnreachable,
        Fault::PathBlocked,
        Fault::GuardStop,
        Fault::NoPrediction,
    ];

    #[test]
    fn every_fault_has_exactly_one_row() {
        for fault in ALL {
            assert_eq!(TABLE.iter().filter(|row| row.fault == fault).count(), 1, "{fault:?}");
        }
        assert_eq!(TABLE.len(), ALL.len());
    }

    #[test]
    fn the_first_active_row_decides_and_reports_decide_nothing() {
        let mut active = ActiveFaults::default();
        assert!(active.set(Fault::GuardStop, true));
        assert_eq!(active.decisive(), None);
        active.set(Fault::ScanLate, true);
        assert_eq!(active.decisive().unwrap().fault, Fault::ScanLate);
        active.set(Fault::EmergencyStop, true);
        assert_eq!(active.decisive().unwrap().fault, Fault::EmergencyStop);
        assert!(!active.set(Fault::EmergencyStop, true));
        active.set(Fault::EmergencyStop, false);
        assert_eq!(active.decisive().unwrap().fault, Fault::ScanLate);
    }
}
