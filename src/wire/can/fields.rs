//! The signals of each message, bit by bit, in both layouts.

use super::frame::Layout;
use super::signal::Signal;

/// First bit of the flags: four of them in classic frames (beside the counter), eight in FD.
const fn flags(layout: Layout) -> u16 {
    match layout {
        Layout::Classic => 12,
        Layout::Fd => 24,
    }
}

/// First bit of the payload.
const fn payload(layout: Layout) -> u16 {
    match layout {
        Layout::Classic => 16,
        Layout::Fd => 32,
    }
}

macro_rules! signals {
    ($(#[$meta:meta])* $name:ident { $($field:ident),+ $(,)? }) => {
        $(#[$meta])*
        #[derive(Clone, Copy)]
        pub(super) struct $name { $(pub(super) $field: Signal),+ }
        impl $name {
            pub(super) fn list(&self) -> Vec<Signal> {
                vec![$(self.$field),+]
            }
        }
    };
}

signals!(StatusSignals {
    emergency_stop,
    setpoint_lost,
    tail_held,
    loss_toggle,
    battery,
    setpoint_age,
    tail_plan
});
signals!(SetpointSignals { drive, longitudinal, lateral, curvature });
signals!(CarHeartbeatSignals { stamp, boot, version });
signals!(DaemonHeartbeatSignals { uptime, mode, version });
signals!(
    /// `part` and `stamp_again` are absent (of width 1 and unused) in the FD layout, which sends
    /// everything at once.
    OdometrySignals {
        part, boot, stamp, travelled, turned, wheel_left, wheel_right, steering, yaw_rate, stamp_again
    }
);
signals!(ScanFdSignals {
    part,
    last,
    boot,
    scan,
    stamp,
    count,
    range_max,
    angle_first,
    angle_step,
    first_beam,
    range
});
signals!(ScanClassicSignals {
    part,
    range,
    stamp,
    scan,
    angle_first,
    count,
    boot,
    angle_step,
    range_max,
    end_scan,
    end_count,
    seal
});
signals!(TailFdSignals {
    part,
    last,
    plan,
    count,
    anchor_travelled,
    anchor_turned,
    anchor_offset,
    spacing,
    first_sample,
    curvature,
    speed
});
signals!(TailClassicSignals {
    part,
    curvature,
    speed,
    anchor_travelled,
    plan,
    anchor_turned,
    spacing,
    end_plan,
    end_count,
    anchor_offset,
    seal
});

/// Distance of one count of a running total, metres.
const TRAVELLED_M: f64 = 1e-5;
/// Angle of one count of a running total, radians.
const TURNED_RAD: f64 = 1e-6;
/// Range of one count, metres.
pub(super) const RANGE_M: f64 = 5e-4;
/// Raw range of a beam that hit nothing.
pub(super) const RANGE_NO_RETURN: i64 = 0xFFFE;
/// Raw range of a beam that says nothing.
pub(super) const RANGE_INVALID: i64 = 0xFFFF;
/// Beams in a block.
pub(super) const BEAMS_FD: usize = 28;
/// Beams in a classic block.
pub(super) const BEAMS_CLASSIC: usize = 3;
/// Samples in a block.
pub(super) const SAMPLES_FD: usize = 14;
/// Samples in a classic block.
pub(super) const SAMPLES_CLASSIC: usize = 2;

/// Classic streams: selector values 0 to 10 number the blocks modulo 11. Together with the counter
/// modulo 15 that tells 165 frames in a row apart.
pub(super) const BLOCK_MODULUS: u8 = 11;
/// Selector of the first head frame.
pub(super) const HEAD: u8 = 12;
/// Selector of the closing frame.
pub(super) const END: u8 = 15;

const BOOT_TEXT: &str =
    "Low bits of the controller's boot number: a change means that stamps and totals started anew";
const RANGE_VALUES: &[(u32, &str)] =
    &[(RANGE_NO_RETURN as u32, "NoReturn"), (RANGE_INVALID as u32, "Invalid")];
const PART_FD: &[(u32, &str)] = &[(0, "Head"), (1, "Block")];

pub(super) const fn status(layout: Layout) -> StatusSignals {
    let (f, p) = (flags(layout), payload(layout));
    StatusSignals {
        emergency_stop: Signal::new(
            "EmergencyStop",
            f,
            1,
            1.0,
            "",
            "The emergency-stop button is pressed or its wire is cut",
        ),
        setpoint_lost: Signal::new(
            "SetpointLost",
            f + 1,
            1,
            1.0,
            "",
            "Setpoints stopped while driving; latched until a setpoint with Drive = 0",
        ),
        tail_held: Signal::new(
            "TailHeld",
            f + 2,
            1,
            1.0,
            "",
            "The controller holds a complete braking tail, TailPlan is its number",
        ),
        loss_toggle: Signal::new(
            "LossToggle",
            f + 3,
            1,
            1.0,
            "",
            "Changes with every loss of setpoints; 0 after the controller's start",
        ),
        battery: Signal::new("BatteryVoltage", p, 16, 1e-3, "V", "Battery voltage"),
        setpoint_age: Signal::new(
            "SetpointAge",
            p + 16,
            16,
            1e-3,
            "s",
            "Age of the newest valid setpoint; the largest value also means never",
        ),
        tail_plan: Signal::new(
            "TailPlan",
            p + 32,
            16,
            1.0,
            "",
            "Plan number of the braking tail that the controller holds",
        ),
    }
}

pub(super) const fn setpoint(layout: Layout) -> SetpointSignals {
    let (f, p) = (flags(layout), payload(layout));
    SetpointSignals {
        drive: Signal::new(
            "Drive",
            f,
            1,
            1.0,
            "",
            "The car shall move; 0: brake along the newest tail and hold",
        ),
        longitudinal: Signal::new(
            "LongitudinalForce",
            p,
            16,
            0.02,
            "N",
            "Force along the car, forward positive; braking never turns into reversing",
        )
        .signed(),
        lateral: Signal::new("LateralForce", p + 16, 16, 0.02, "N", "Force to the left").signed(),
        curvature: Signal::new(
            "PathCurvature",
            p + 32,
            16,
            5e-4,
            "1/m",
            "Curvature of the path here, left positive; the car steers by it below 0.5 m/s",
        )
        .signed(),
    }
}

pub(super) const fn car_heartbeat(layout: Layout) -> CarHeartbeatSignals {
    let p = payload(layout);
    CarHeartbeatSignals {
        stamp: Signal::new("Stamp", p, 32, 1e-6, "s", "The controller's clock, wrapping"),
        boot: Signal::new("Boot", p + 32, 8, 1.0, "", "Counts starts of the controller, wrapping"),
        version: Signal::new("InterfaceVersion", p + 40, 8, 1.0, "", "Version of these frames"),
    }
}

pub(super) const fn daemon_heartbeat(layout: Layout) -> DaemonHeartbeatSignals {
    let p = payload(layout);
    DaemonHeartbeatSignals {
        uptime: Signal::new("Uptime", p, 32, 1e-3, "s", "Time since the daemon's start, wrapping"),
        mode: Signal::new("Mode", p + 32, 8, 1.0, "", "The daemon's mode").values(&[
            (0, "Standby"),
            (1, "Hold"),
            (2, "Guided"),
            (3, "Auto"),
            (4, "Return"),
            (5, "Stop"),
        ]),
        version: Signal::new("InterfaceVersion", p + 40, 8, 1.0, "", "Version of these frames"),
    }
}

pub(super) const fn odometry(layout: Layout) -> OdometrySignals {
    // Classic: part 0 stamp + left wheel, 1 travelled + right wheel, 2 turned + steering, 3 stamp
    // again + yaw rate. FD: all in a row.
    let p = payload(layout);
    let f = flags(layout);
    let fd = matches!(layout, Layout::Fd);
    let stamp = Signal::new(
        "Stamp",
        p,
        32,
        1e-6,
        "s",
        "When it was measured, on the controller's clock, wrapping",
    );
    let travelled = Signal::new(
        "Travelled",
        if fd { p + 32 } else { p },
        32,
        TRAVELLED_M,
        "m",
        "Distance travelled by the body origin since the controller's start, wrapping",
    );
    let turned = Signal::new(
        "Turned",
        if fd { p + 64 } else { p },
        32,
        TURNED_RAD,
        "rad",
        "Angle turned since the controller's start, left positive, wrapping",
    )
    .signed();
    let wheel_left = Signal::new(
        "WheelSpeedLeft",
        if fd { p + 96 } else { p + 32 },
        16,
        1e-3,
        "m/s",
        "Speed of the left rear wheel's rim, forward positive",
    )
    .signed();
    let wheel_right = Signal::new(
        "WheelSpeedRight",
        if fd { p + 112 } else { p + 32 },
        16,
        1e-3,
        "m/s",
        "Speed of the right rear wheel's rim, forward positive",
    )
    .signed();
    let steering = Signal::new(
        "SteeringAngle",
        if fd { p + 128 } else { p + 32 },
        16,
        5e-5,
        "rad",
        "Angle of the (virtual middle) front wheel, left positive",
    )
    .signed();
    let yaw_rate = Signal::new(
        "YawRate",
        if fd { p + 144 } else { p + 32 },
        16,
        1e-3,
        "rad/s",
        "Yaw rate, left positive",
    )
    .signed();
    let stamp_again = Signal::new(
        "StampAgain",
        p,
        32,
        1e-6,
        "s",
        "The stamp of part 0 once more: parts with different stamps do not belong together",
    );
    let part = Signal::new("Part", f, 2, 1.0, "", "Which quarter of the measurement this is");
    let boot = Signal::new("Boot", if fd { f } else { f + 2 }, 2, 1.0, "", BOOT_TEXT);
    if fd {
        OdometrySignals {
            part,
            boot,
            stamp,
            travelled,
            turned,
            wheel_left,
            wheel_right,
            steering,
            yaw_rate,
            stamp_again,
        }
    } else {
        OdometrySignals {
            part: part.selector(),
            boot,
            stamp: stamp.on(0, 0),
            travelled: travelled.on(1, 1),
            turned: turned.on(2, 2),
            wheel_left: wheel_left.on(0, 0),
            wheel_right: wheel_right.on(1, 1),
            steering: steering.on(2, 2),
            yaw_rate: yaw_rate.on(3, 3),
            stamp_again: stamp_again.on(3, 3),
        }
    }
}

const SCAN_STAMP: &str = "When the scan was measured, on the controller's clock, wrapping";
const SCAN_NUMBER: &str = "Scan number, wrapping";
const SCAN_COUNT: &str = "Beams in the scan";
const SCAN_RANGE_MAX: &str = "The lidar's range";
const SCAN_ANGLE_FIRST: &str = "Direction of beam 0 in the body frame, left positive";
const SCAN_ANGLE_STEP: &str = "Angle from one beam to the next, left positive";
const SCAN_RANGE: &str = "Range of one beam; beams past the scan's last one are Invalid";

pub(super) const SCAN_FD: ScanFdSignals = {
    let (f, p) = (flags(Layout::Fd), payload(Layout::Fd));
    ScanFdSignals {
        part: Signal::new("Part", f, 1, 1.0, "", "Head or block of beams")
            .values(PART_FD)
            .selector(),
        last: Signal::new("Last", f + 1, 1, 1.0, "", "End marker: the scan's last frame"),
        boot: Signal::new("Boot", f + 2, 2, 1.0, "", BOOT_TEXT),
        scan: Signal::new("Scan", p, 16, 1.0, "", SCAN_NUMBER),
        stamp: Signal::new("Stamp", p + 16, 32, 1e-6, "s", SCAN_STAMP).on(0, 0),
        count: Signal::new("BeamCount", p + 48, 12, 1.0, "", SCAN_COUNT).offset(1.0).on(0, 0),
        range_max: Signal::new("RangeMax", p + 64, 16, RANGE_M, "m", SCAN_RANGE_MAX).on(0, 0),
        angle_first: Signal::new("AngleFirst", p + 80, 32, 1e-8, "rad", SCAN_ANGLE_FIRST)
            .signed()
            .on(0, 0),
        angle_step: Signal::new("AngleStep", p + 112, 32, 1e-9, "rad", SCAN_ANGLE_STEP)
            .signed()
            .on(0, 0),
        first_beam: Signal::new("FirstBeam", p + 16, 16, 1.0, "", "Number of the beam in Range00")
            .on(1, 1),
        range: Signal::new("Range", p + 32, 16, RANGE_M, "m", SCAN_RANGE)
            .values(RANGE_VALUES)
            .times(BEAMS_FD as u16, 16)
            .on(1, 1),
    }
};

pub(super) const SCAN_CLASSIC: ScanClassicSignals = {
    let (f, p) = (flags(Layout::Classic), payload(Layout::Classic));
    ScanClassicSignals {
        part: Signal::new(
            "Part",
            f,
            4,
            1.0,
            "",
            "0 to 10: number of the block of beams, modulo 11; 12 to 14: head; 15: end",
        )
        .selector(),
        range: Signal::new("Range", p, 16, RANGE_M, "m", SCAN_RANGE)
            .values(RANGE_VALUES)
            .times(BEAMS_CLASSIC as u16, 16)
            .on(0, BLOCK_MODULUS - 1),
        stamp: Signal::new("Stamp", p, 32, 1e-6, "s", SCAN_STAMP).on(12, 12),
        scan: Signal::new("Scan", p + 32, 16, 1.0, "", SCAN_NUMBER).on(12, 12),
        angle_first: Signal::new("AngleFirst", p, 32, 1e-8, "rad", SCAN_ANGLE_FIRST)
            .signed()
            .on(13, 13),
        count: Signal::new("BeamCount", p + 32, 12, 1.0, "", SCAN_COUNT).offset(1.0).on(13, 13),
        boot: Signal::new("Boot", p + 44, 2, 1.0, "", BOOT_TEXT).on(13, 13),
        angle_step: Signal::new("AngleStep", p, 32, 1e-9, "rad", SCAN_ANGLE_STEP)
            .signed()
            .on(14, 14),
        range_max: Signal::new("RangeMax", p + 32, 16, RANGE_M, "m", SCAN_RANGE_MAX).on(14, 14),
        end_scan: Signal::new("EndScan", p, 16, 1.0, "", "Scan number, as in the head").on(15, 15),
        end_count: Signal::new("EndBeamCount", p + 16, 12, 1.0, "", "Beams, as in the head")
            .offset(1.0)
            .on(15, 15),
        seal: Signal::new("Seal", p + 32, 16, 1.0, "", SEAL).on(15, 15),
    }
};

const SEAL: &str = "CRC-16 CCITT (start 0xFFFF) over bytes 2 to 7 of every frame from the first head frame to the last block";
const TAIL_PLAN: &str = "Number of the committed plan, wrapping";
const TAIL_TRAVELLED: &str = "Travelled where the tail begins, wrapping like Travelled";
const TAIL_TURNED: &str = "Turned where the tail begins, wrapping like Turned";
const TAIL_OFFSET: &str = "How far the car was to the left of the path where the tail begins";
const TAIL_SPACING: &str = "Distance from one sample to the next";
const TAIL_CURVATURE: &str = "Curvature of the path at the sample, left positive";
const TAIL_SPEED: &str = "Largest speed at the sample from which the tail still ends at rest";
const TAIL_COUNT: &str = "Samples in the tail";

pub(super) const TAIL_FD: TailFdSignals = {
    let (f, p) = (flags(Layout::Fd), payload(Layout::Fd));
    TailFdSignals {
        part: Signal::new("Part", f, 1, 1.0, "", "Head or block of samples")
            .values(PART_FD)
            .selector(),
        last: Signal::new("Last", f + 1, 1, 1.0, "", "End marker: the tail's last frame"),
        plan: Signal::new("Plan", p, 16, 1.0, "", TAIL_PLAN),
        count: Signal::new("SampleCount", p + 16, 7, 1.0, "", TAIL_COUNT).offset(1.0).on(0, 0),
        anchor_travelled: Signal::new(
            "AnchorTravelled",
            p + 24,
            32,
            TRAVELLED_M,
            "m",
            TAIL_TRAVELLED,
        )
        .on(0, 0),
        anchor_turned: Signal::new("AnchorTurned", p + 56, 32, TURNED_RAD, "rad", TAIL_TURNED)
            .signed()
            .on(0, 0),
        spacing: Signal::new("Spacing", p + 88, 16, TRAVELLED_M, "m", TAIL_SPACING).on(0, 0),
        anchor_offset: Signal::new("AnchorOffset", p + 104, 16, TRAVELLED_M, "m", TAIL_OFFSET)
            .signed()
            .on(0, 0),
        first_sample: Signal::new("FirstSample", p + 16, 8, 1.0, "", "Number of the first sample")
            .on(1, 1),
        curvature: Signal::new("Curvature", p + 24, 16, 5e-4, "1/m", TAIL_CURVATURE)
            .signed()
            .times(SAMPLES_FD as u16, 32)
            .on(1, 1),
        speed: Signal::new("Speed", p + 40, 16, 1e-3, "m/s", TAIL_SPEED)
            .times(SAMPLES_FD as u16, 32)
            .on(1, 1),
    }
};

pub(super) const TAIL_CLASSIC: TailClassicSignals = {
    let (f, p) = (flags(Layout::Classic), payload(Layout::Classic));
    TailClassicSignals {
        part: Signal::new(
            "Part",
            f,
            4,
            1.0,
            "",
            "0 to 10: number of the block of samples, modulo 11; 12 and 13: head; 15: end",
        )
        .selector(),
        curvature: Signal::new("Curvature", p, 14, 1.25e-3, "1/m", TAIL_CURVATURE)
            .signed()
            .times(SAMPLES_CLASSIC as u16, 24)
            .on(0, BLOCK_MODULUS - 1),
        speed: Signal::new("Speed", p + 14, 10, 0.02, "m/s", TAIL_SPEED)
            .times(SAMPLES_CLASSIC as u16, 24)
            .on(0, BLOCK_MODULUS - 1),
        anchor_travelled: Signal::new("AnchorTravelled", p, 32, TRAVELLED_M, "m", TAIL_TRAVELLED)
            .on(12, 12),
        plan: Signal::new("Plan", p + 32, 16, 1.0, "", TAIL_PLAN).on(12, 12),
        anchor_turned: Signal::new("AnchorTurned", p, 32, TURNED_RAD, "rad", TAIL_TURNED)
            .signed()
            .on(13, 13),
        spacing: Signal::new("Spacing", p + 32, 16, TRAVELLED_M, "m", TAIL_SPACING).on(13, 13),
        end_plan: Signal::new("EndPlan", p, 16, 1.0, "", "Plan number, as in the head").on(15, 15),
        end_count: Signal::new("EndSampleCount", p + 16, 7, 1.0, "", TAIL_COUNT)
            .offset(1.0)
            .on(15, 15),
        anchor_offset: Signal::new("AnchorOffset", p + 23, 9, 1e-3, "m", TAIL_OFFSET)
            .signed()
            .on(15, 15),
        seal: Signal::new("Seal", p + 32, 16, 1.0, "", SEAL).on(15, 15),
    }
};
