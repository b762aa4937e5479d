//! The failsafe table, as data: what can go wrong, how soon it is noticed, what is done, and how
//! it is cleared.
//!
//! Every action ends at rest. [`Action::FinishPlan`] relies on the committed plan, which ends at
//! rest in known free space whatever happens; [`Action::BrakeNow`] is for faults that take away
//! the means of following it (the pose, the car's own word, the sight of the way) or the belief in
//! it. A car that cannot be told anything stops by itself, along the newest tail that it holds.

use super::CoreParams;

/// Something that can go wrong while driving.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Fault {
    /// A ground station ended the drive for good.
    Terminated,
    /// The emergency-stop button is pressed.
    EmergencyStop,
    /// The car's controller reports that setpoints did not reach it.
    SetpointLost,
    /// The car drove on unobserved, or its totals began anew: nobody knows where it is.
    PoseLost,
    /// The computer's CAN controller has left the bus.
    BusOff,
    /// The car's stamps or our own clock jumped, or this process stood still.
    ClockJump,
    /// No odometry for too long.
    OdometryLate,
    /// The car strays from the committed plan.
    TrackingError,
    /// Something was set down on the committed plan, and no stop before it could be certified.
    PathBlocked,
    /// No status from the car's controller for too long.
    StatusLost,
    /// No complete scan for far too long.
    ScanMissing,
    /// No complete scan for too long.
    ScanLate,
    /// The car's controller holds no braking tail, or an old one.
    TailNotHeld,
    /// Too many frames arrive corrupt, out of order, or not at all.
    CorruptFrames,
    /// The bus itself reports too many errors.
    BusErrors,
    /// The control tick is persistently late.
    Overload,
    /// The battery is nearly empty.
    BatteryLow,
    /// Every ground station has gone silent.
    StationLost,
    /// The map proves that no way to the goal exists.
    GoalUnreachable,
    /// The guard had to take over.
    GuardStop,
    /// A planning step does not come back.
    PlannerLate,
    /// No plan was adopted for too long although the goal is not reached.
    NoPlan,
    /// The planner goes on without prediction.
    NoPrediction,
    /// The log cannot be written.
    DiskFull,
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
    /// By itself, once the cause has been gone for [`CALM_S`].
    ByItself,
    /// When the car stands.
    AtRest,
    /// When the cause is gone and the car is armed anew.
    ByArming,
    /// With a new goal.
    ByNewGoal,
    /// With the next start of the program.
    ByRestart,
}

/// One row of the table.
#[derive(Clone, Copy, Debug)]
pub struct Row {
    /// What goes wrong.
    pub fault: Fault,
    /// How it is noticed, in words.
    pub detection: &'static str,
    /// Longest time from the cause until the next control tick finds it, seconds.
    pub after_s: fn(&CoreParams) -> f64,
    /// What is done.
    pub action: Action,
    /// How it is cleared.
    pub clears: Clears,
}

impl Row {
    /// Longest time from the cause to the action, seconds: detectors run at each control tick.
    pub fn within_s(&self, params: &CoreParams) -> f64 {
        (self.after_s)(params) + params.autopilot.tick_s()
    }
}

/// A fault that clears by itself stays for this long after its cause was seen last: what flickers
/// does not let go of the car.
pub const CALM_S: f64 = 0.5;
/// Share of the guard's limit (`guard.scan_age_max_s`) at which scans are late. With the defaults
/// 160 ms: two scans in a row may be lost at 20 Hz, delivery included.
pub const SCAN_LATE_SHARE: f64 = 0.8;
/// The same for missing scans: the core stops the car before the guard has to.
pub const SCAN_MISSING_SHARE: f64 = 0.95;
/// Share of the guard's limit (`guard.odometry_age_max_s`) at which odometry is late. With the
/// defaults 50 ms, five frames at 100 Hz: dead reckoning by rates is good for less than a centimetre
/// over it.
pub const ODOMETRY_LATE_SHARE: f64 = 5.0 / 6.0;
/// No word from the car's controller for this long: five frames at 50 Hz, the same time after which
/// the controller misses ours.
pub const STATUS_TIMEOUT_S: f64 = 0.1;
/// A status frame may be lost and the next one is sent a period later.
pub const STATUS_LATENCY_S: f64 = 0.05;
/// The free space on the disk is looked at this often.
pub const DISK_PERIOD_S: f64 = 1.0;
/// The car's controller takes setpoints for lost after this long (`docs/can-interface.md`).
pub const SETPOINT_LOST_S: f64 = 0.1;
/// A tail that is not the newest one may still be on its way to the car for this long: two periods
/// of tails, in case one is lost.
pub const TAIL_SUPERSEDED_S: f64 = 0.1;
/// So long the car may go on without a valid tail: as long again for the next ones.
pub const TAIL_TIMEOUT_S: f64 = 0.2;
/// A planning step that takes longer than this hangs: ten steps at 20 Hz. The committed plan has
/// stopped the car by then or is about to.
pub const PLAN_TIMEOUT_S: f64 = 0.5;
/// Window over which frames and errors are counted, seconds.
pub const WINDOW_S: f64 = 1.0;
/// Frames with a wrong CRC, format or value in a second that make the data untrustworthy. The bus
/// checks its own CRC before: such frames come from a gateway, a driver or memory, and one in 256
/// (classic) or 65,536 (FD) of them passes unnoticed.
pub const CORRUPT_PER_S: usize = 10;
/// Frames missing, repeated or out of order in a second that make the link untrustworthy: one in
/// eleven of the car's frames.
pub const DISORDER_PER_S: usize = 100;
/// Frames of ours that the computer could not send in a second: one setpoint in ten at 100 Hz.
pub const UNSENT_PER_S: usize = 10;
/// The process stood still, or its clock jumped, if a tick comes later than this: by then the car
/// has stopped believing us.
pub const GAP_S: f64 = SETPOINT_LOST_S;
/// A jump of the car's clock shows after five stamped frames at 100 Hz.
pub const CLOCK_SETTLES_S: f64 = 0.06;
/// A tick is late beyond this share of its period.
pub const LATE_TICK_SHARE: f64 = 0.5;
/// Share of the ticks of a second that may be late.
pub const OVERLOAD_SHARE: f64 = 0.2;
/// Frames handled this long after they arrived make a tick late too: as late as the car takes the
/// oldest setpoint for fresh.
pub const FRAME_LATE_S: f64 = 0.025;
/// The battery counts as low after this long below the limit: the voltage sags for less than that
/// when the car speeds up.
pub const BATTERY_HOLD_S: f64 = 1.0;
/// No heartbeat of the car for this long: three periods.
pub const HEARTBEAT_TIMEOUT_S: f64 = 0.35;
/// How far off the car may be after a gap in its odometry, metres: the certified margin's share for
/// localisation.
pub const POSE_ERROR_MAX_M: f64 = 0.02;

/// The failsafe table, in order of precedence: the first active row decides.
pub const TABLE: &[Row] = &[
    Row {
        fault: Fault::Terminated,
        detection: "a ground station ordered the termination",
        after_s: |_| 0.0,
        action: Action::BrakeNow,
        clears: Clears::ByRestart,
    },
    Row {
        fault: Fault::EmergencyStop,
        detection: "the car's status says that the button is pressed",
        after_s: |_| STATUS_LATENCY_S,
        action: Action::BrakeNow,
        clears: Clears::ByArming,
    },
    Row {
        fault: Fault::SetpointLost,
        detection: "the car's status says that setpoints stopped coming for 100 ms, or did so \
                    since the car was armed",
        after_s: |_| SETPOINT_LOST_S + STATUS_LATENCY_S,
        action: Action::BrakeNow,
        clears: Clears::ByArming,
    },
    Row {
        fault: Fault::PoseLost,
        detection: "the car's controller was restarted, or the car drove on through a gap in its \
                    odometry so far that its place is uncertain by more than 2 cm, or turned \
                    further than it can; the map and the goal are forgotten",
        after_s: |p| odometry_late_s(p),
        action: Action::BrakeNow,
        clears: Clears::ByArming,
    },
    Row {
        fault: Fault::BusOff,
        detection: "the CAN controller of this computer has left the bus",
        after_s: |_| 0.0,
        action: Action::BrakeNow,
        clears: Clears::ByArming,
    },
    Row {
        fault: Fault::ClockJump,
        detection: "the car's stamps jump against our clock, or a control tick comes 100 ms late: \
                    this process was stopped, or its clock jumped",
        after_s: |_| CLOCK_SETTLES_S,
        action: Action::BrakeNow,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::OdometryLate,
        detection: "the newest odometry is older than 5/6 of `guard.odometry_age_max_s`",
        after_s: odometry_late_s,
        action: Action::BrakeNow,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::TrackingError,
        detection: "the estimated pose is off the committed plan by more than \
                    `autopilot.tracking_error_max_m`",
        after_s: |_| 0.0,
        action: Action::BrakeNow,
        clears: Clears::AtRest,
    },
    Row {
        fault: Fault::PathBlocked,
        detection: "a beam ended on the committed plan and no stop before it could be certified",
        after_s: |_| 0.0,
        action: Action::BrakeNow,
        clears: Clears::AtRest,
    },
    Row {
        fault: Fault::StatusLost,
        detection: "no status of the car for 100 ms",
        after_s: |_| STATUS_TIMEOUT_S,
        action: Action::BrakeNow,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::ScanMissing,
        detection: "the newest complete scan is older than 95 % of `guard.scan_age_max_s`",
        after_s: |p| SCAN_MISSING_SHARE * p.guard.scan_age_max_s,
        action: Action::BrakeNow,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::ScanLate,
        detection: "the newest complete scan is older than 80 % of `guard.scan_age_max_s`",
        after_s: |p| SCAN_LATE_SHARE * p.guard.scan_age_max_s,
        action: Action::FinishPlan,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::TailNotHeld,
        detection: "the car's status has not named a braking tail of the last 100 ms for 200 ms",
        after_s: |_| TAIL_SUPERSEDED_S + TAIL_TIMEOUT_S + STATUS_LATENCY_S,
        action: Action::FinishPlan,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::CorruptFrames,
        detection: "within a second 10 frames with a wrong CRC, format or value, or 100 missing, \
                    repeated or out of order",
        after_s: |_| WINDOW_S,
        action: Action::FinishPlan,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::BusErrors,
        detection: "the CAN controller of this computer is error-passive, or within a second it \
                    reports `autopilot.bus_errors_max_ps` error frames or could not send 10 frames",
        after_s: |_| WINDOW_S,
        action: Action::FinishPlan,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::Overload,
        detection: "a fifth of the control ticks of a second are late by half a period, or \
                    frames wait for more than 25 ms",
        after_s: |_| WINDOW_S,
        action: Action::FinishPlan,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::BatteryLow,
        detection: "the car's battery is below `autopilot.battery_low_v` for a second",
        after_s: |_| BATTERY_HOLD_S + STATUS_LATENCY_S,
        action: Action::FinishPlan,
        clears: Clears::ByArming,
    },
    Row {
        fault: Fault::StationLost,
        detection: "no ground station was heard for `mavlink.station_timeout_s`, if \
                    `mavlink.station_lost` says that this stops the car",
        after_s: |_| 0.0,
        action: Action::FinishPlan,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::GoalUnreachable,
        detection: "the search exhausted all space that is not occupied",
        after_s: |p| p.autopilot.plan_budget_s,
        action: Action::FinishPlan,
        clears: Clears::ByNewGoal,
    },
    Row {
        fault: Fault::GuardStop,
        detection: "the guard overrode a setpoint to stop the car",
        after_s: |_| 0.0,
        action: Action::Report,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::PlannerLate,
        detection: "a planning step has not come back for 500 ms",
        after_s: |_| PLAN_TIMEOUT_S,
        action: Action::Report,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::NoPlan,
        detection: "no plan was adopted for 500 ms although the goal is not reached",
        after_s: |params| PLAN_TIMEOUT_S + params.autopilot.plan_period_s,
        action: Action::Report,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::NoPrediction,
        detection: "the network is missing, fails, is too slow, or its answers are no probabilities",
        after_s: |_| PLAN_TIMEOUT_S,
        action: Action::Report,
        clears: Clears::ByItself,
    },
    Row {
        fault: Fault::DiskFull,
        detection: "less free space than `daemon.disk_free_min_mb` on the disk of the state directory or \
                    of a log being written; the car cannot be armed meanwhile",
        after_s: |_| DISK_PERIOD_S,
        action: Action::Report,
        clears: Clears::ByItself,
    },
];

/// When odometry is late, seconds.
pub fn odometry_late_s(params: &CoreParams) -> f64 {
    ODOMETRY_LATE_SHARE * params.guard.odometry_age_max_s
}

impl Fault {
    /// All of them, in the order of the table.
    pub const ALL: [Self; 24] = [
        Self::Terminated,
        Self::EmergencyStop,
        Self::SetpointLost,
        Self::PoseLost,
        Self::BusOff,
        Self::ClockJump,
        Self::OdometryLate,
        Self::TrackingError,
        Self::PathBlocked,
        Self::StatusLost,
        Self::ScanMissing,
        Self::ScanLate,
        Self::TailNotHeld,
        Self::CorruptFrames,
        Self::BusErrors,
        Self::Overload,
        Self::BatteryLow,
        Self::StationLost,
        Self::GoalUnreachable,
        Self::GuardStop,
        Self::PlannerLate,
        Self::NoPlan,
        Self::NoPrediction,
        Self::DiskFull,
    ];

    /// The row of the table.
    pub fn row(self) -> &'static Row {
        &TABLE[self as usize]
    }

    /// The name used in logs and documentation.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Terminated => "terminated",
            Self::EmergencyStop => "emergency stop",
            Self::SetpointLost => "setpoint lost",
            Self::PoseLost => "pose lost",
            Self::BusOff => "bus off",
            Self::ClockJump => "clock jump",
            Self::OdometryLate => "odometry late",
            Self::TrackingError => "tracking error",
            Self::PathBlocked => "path blocked",
            Self::StatusLost => "car status lost",
            Self::ScanMissing => "scan missing",
            Self::ScanLate => "scan late",
            Self::TailNotHeld => "tail not held",
            Self::CorruptFrames => "corrupt frames",
            Self::BusErrors => "bus errors",
            Self::Overload => "overload",
            Self::BatteryLow => "battery low",
            Self::StationLost => "ground station lost",
            Self::GoalUnreachable => "goal unreachable",
            Self::GuardStop => "guard stop",
            Self::PlannerLate => "planner late",
            Self::NoPlan => "no plan",
            Self::NoPrediction => "no prediction",
            Self::DiskFull => "disk full",
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
    pub fn iter(&self) -> impl Iterator<Item = Fault> + use<> {
        let active = *self;
        Fault::ALL.into_iter().filter(move |fault| active.contains(*fault))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rows_stand_in_the_order_of_the_faults() {
        assert_eq!(TABLE.len(), Fault::ALL.len());
        for (i, (row, fault)) in TABLE.iter().zip(Fault::ALL).enumerate() {
            assert_eq!((row.fault, fault as usize), (fault, i));
            assert_eq!(fault.row().fault, fault);
        }
    }

    /// What brakes comes before what drives on, and that before what is only reported: a lesser
    /// row never hides a graver one.
    #[test]
    fn graver_actions_come_first() {
        let rank = |row: &Row| match row.action {
            Action::BrakeNow => 0,
            Action::FinishPlan => 1,
            Action::Report => 2,
        };
        assert!(TABLE.windows(2).all(|pair| rank(&pair[0]) <= rank(&pair[1])));
    }

    #[test]
    fn the_first_active_row_decides_and_reports_decide_nothing() {
        let mut active = ActiveFaults::default();
        assert!(active.set(Fault::GuardStop, true));
        assert!(active.decisive().is_none());
        active.set(Fault::ScanLate, true);
        assert_eq!(active.decisive().unwrap().fault, Fault::ScanLate);
        active.set(Fault::EmergencyStop, true);
        assert_eq!(active.decisive().unwrap().fault, Fault::EmergencyStop);
        assert!(!active.set(Fault::EmergencyStop, true));
        active.set(Fault::EmergencyStop, false);
        assert_eq!(active.decisive().unwrap().fault, Fault::ScanLate);
    }

    #[test]
    fn detection_takes_a_control_period_longer_than_its_limit() {
        let mut params = CoreParams::default();
        assert!((Fault::StatusLost.row().within_s(&params) - 0.11).abs() < 1e-9);
        params.autopilot.control_rate_hz = 20.0;
        assert!((Fault::StatusLost.row().within_s(&params) - 0.15).abs() < 1e-9);
        params.guard.scan_age_max_s = 0.4;
        assert!((Fault::ScanLate.row().within_s(&params) - 0.37).abs() < 1e-9);
    }
}
