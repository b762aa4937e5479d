//! What the vehicle says about itself: each message from the newest view of the core.

use super::core::{CoreMode, CoreView, FaultAction, PlanPoint};
use super::modes::Mode;
use super::settings::{Identity, MavlinkParams};
use super::{Home, obstacles};
use crate::frames::Point;
use crate::wire::mavlink::common::{
    self as c, MavAutopilot, MavBatteryChargeState, MavBatteryFault, MavBatteryFunction,
    MavBatteryMode, MavBatteryType, MavEstimatorType, MavFrame, MavLandedState, MavMessage,
    MavModeFlag, MavModeProperty, MavProtocolCapability, MavState, MavSysStatusSensor as Sensor,
    MavSysStatusSensorExtended, MavType, MavVtolState, PositionTargetTypemask,
};
use crate::wire::mavlink::{CharArray, MessageData, Origin, ned_of, yaw_of};

/// Places of the plan in one message.
const WAYPOINTS: usize = 5;

/// Everything that messages are made from.
pub struct Facts<'a> {
    /// The configuration.
    pub params: &'a MavlinkParams,
    /// The core.
    pub view: &'a CoreView,
    /// The mode that was chosen.
    pub mode: Mode,
    /// Where the map lies on the earth.
    pub origin: Option<Origin>,
    /// Where the car returns to.
    pub home: Home,
    /// What the services add.
    pub capabilities: MavProtocolCapability,
    /// Microseconds since 1970, if anybody knows.
    pub unix_us: u64,
    /// Messages that were not sent because of full queues.
    pub dropped: u64,
}

impl Facts<'_> {
    /// The mode that is shown: a failsafe holds the car whatever was chosen.
    pub fn shown_mode(&self) -> Mode {
        match (self.view.mode, self.mode) {
            (CoreMode::Stop | CoreMode::Terminated, _) => Mode::Hold,
            // Somebody else gave it a goal.
            (CoreMode::Drive, Mode::Hold) => Mode::Guided,
            (_, mode) => mode,
        }
    }

    fn boot_ms(&self) -> u32 {
        (self.view.at.as_nanos() / 1_000_000) as u32
    }

    fn boot_us(&self) -> u64 {
        self.view.at.as_nanos() / 1000
    }

    /// North and east velocity, m/s.
    fn velocity(&self) -> [f64; 2] {
        let heading = self.view.pose.map_or(0.0, |pose| pose.heading_rad);
        ned_of(Point::from(crate::frames::heading_vector(heading) * self.view.speed_mps))
    }
}

/// The messages of a number as they are now; empty if this vehicle has no such message, or nothing
/// to say in it. `which` chooses among several (0: all).
pub fn messages(id: u32, which: u32, facts: &Facts<'_>) -> Vec<MavMessage> {
    if id == c::AVAILABLE_MODES_DATA::ID {
        return available_modes(which, facts);
    }
    one(id, facts).into_iter().collect()
}

/// Whether this vehicle knows a message, though there may be nothing to say in it yet.
pub fn knows(id: u32) -> bool {
    KNOWN.contains(&id)
}

const KNOWN: &[u32] = &[
    c::HEARTBEAT_DATA::ID,
    c::SYS_STATUS_DATA::ID,
    c::SYSTEM_TIME_DATA::ID,
    c::ATTITUDE_DATA::ID,
    c::ATTITUDE_QUATERNION_DATA::ID,
    c::LOCAL_POSITION_NED_DATA::ID,
    c::GLOBAL_POSITION_INT_DATA::ID,
    c::GPS_GLOBAL_ORIGIN_DATA::ID,
    c::NAV_CONTROLLER_OUTPUT_DATA::ID,
    c::VFR_HUD_DATA::ID,
    c::POSITION_TARGET_LOCAL_NED_DATA::ID,
    c::BATTERY_STATUS_DATA::ID,
    c::AUTOPILOT_VERSION_DATA::ID,
    c::HOME_POSITION_DATA::ID,
    c::EXTENDED_SYS_STATE_DATA::ID,
    c::PROTOCOL_VERSION_DATA::ID,
    c::OBSTACLE_DISTANCE_DATA::ID,
    c::ODOMETRY_DATA::ID,
    c::TRAJECTORY_REPRESENTATION_WAYPOINTS_DATA::ID,
    c::AVAILABLE_MODES_DATA::ID,
    c::CURRENT_MODE_DATA::ID,
    c::AVAILABLE_MODES_MONITOR_DATA::ID,
];

fn one(id: u32, facts: &Facts<'_>) -> Option<MavMessage> {
    Some(match id {
        c::HEARTBEAT_DATA::ID => MavMessage::HEARTBEAT(heartbeat(facts)),
        c::SYS_STATUS_DATA::ID => MavMessage::SYS_STATUS(sys_status(facts)),
        c::SYSTEM_TIME_DATA::ID => MavMessage::SYSTEM_TIME(c::SYSTEM_TIME_DATA {
            time_unix_usec: facts.unix_us,
            time_boot_ms: facts.boot_ms(),
        }),
        c::ATTITUDE_DATA::ID => MavMessage::ATTITUDE(attitude(facts)?),
        c::ATTITUDE_QUATERNION_DATA::ID => {
            MavMessage::ATTITUDE_QUATERNION(attitude_quaternion(facts)?)
        }
        c::LOCAL_POSITION_NED_DATA::ID => MavMessage::LOCAL_POSITION_NED(local_position(facts)?),
        c::ODOMETRY_DATA::ID => MavMessage::ODOMETRY(odometry(facts)?),
        c::GLOBAL_POSITION_INT_DATA::ID => MavMessage::GLOBAL_POSITION_INT(global_position(facts)?),
        c::GPS_GLOBAL_ORIGIN_DATA::ID => MavMessage::GPS_GLOBAL_ORIGIN(global_origin(facts)?),
        c::HOME_POSITION_DATA::ID => MavMessage::HOME_POSITION(home_position(facts)?),
        c::NAV_CONTROLLER_OUTPUT_DATA::ID => {
            MavMessage::NAV_CONTROLLER_OUTPUT(controller_output(facts)?)
        }
        c::POSITION_TARGET_LOCAL_NED_DATA::ID => {
            MavMessage::POSITION_TARGET_LOCAL_NED(position_target(facts)?)
        }
        c::TRAJECTORY_REPRESENTATION_WAYPOINTS_DATA::ID => {
            MavMessage::TRAJECTORY_REPRESENTATION_WAYPOINTS(waypoints(facts))
        }
        c::VFR_HUD_DATA::ID => MavMessage::VFR_HUD(hud(facts)?),
        c::OBSTACLE_DISTANCE_DATA::ID => {
            let scan = facts.view.scan.as_ref().filter(|_| facts.view.fresh.scan)?;
            MavMessage::OBSTACLE_DISTANCE(obstacles::distances(scan))
        }
        c::BATTERY_STATUS_DATA::ID => MavMessage::BATTERY_STATUS(battery(facts)),
        c::EXTENDED_SYS_STATE_DATA::ID => {
            MavMessage::EXTENDED_SYS_STATE(c::EXTENDED_SYS_STATE_DATA {
                vtol_state: MavVtolState::MAV_VTOL_STATE_UNDEFINED,
                landed_state: landed_state(facts),
            })
        }
        c::AUTOPILOT_VERSION_DATA::ID => MavMessage::AUTOPILOT_VERSION(version(facts)),
        c::PROTOCOL_VERSION_DATA::ID => MavMessage::PROTOCOL_VERSION(c::PROTOCOL_VERSION_DATA {
            version: 200,
            min_version: 200,
            max_version: 200,
            ..Default::default()
        }),
        c::CURRENT_MODE_DATA::ID => MavMessage::CURRENT_MODE(current_mode(facts)),
        c::AVAILABLE_MODES_MONITOR_DATA::ID => {
            MavMessage::AVAILABLE_MODES_MONITOR(c::AVAILABLE_MODES_MONITOR_DATA { seq: 0 })
        }
        _ => return None,
    })
}

/// The heartbeat.
pub fn heartbeat(facts: &Facts<'_>) -> c::HEARTBEAT_DATA {
    let identity = facts.params.identity;
    let mode = facts.shown_mode();
    let mut base_mode = MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED;
    if facts.view.mode.is_armed() {
        base_mode |= MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED;
    }
    if matches!(mode, Mode::Guided | Mode::Offboard | Mode::Auto | Mode::Return) {
        base_mode |= MavModeFlag::MAV_MODE_FLAG_GUIDED_ENABLED;
    }
    if matches!(mode, Mode::Auto | Mode::Return) {
        base_mode |= MavModeFlag::MAV_MODE_FLAG_AUTO_ENABLED;
    }
    let system_status = match facts.view.mode {
        CoreMode::Terminated => MavState::MAV_STATE_FLIGHT_TERMINATION,
        CoreMode::Stop => match facts.view.acting_fault().map(|fault| fault.action) {
            Some(FaultAction::Brakes) => MavState::MAV_STATE_EMERGENCY,
            _ => MavState::MAV_STATE_CRITICAL,
        },
        CoreMode::Disarmed => MavState::MAV_STATE_STANDBY,
        CoreMode::Standby | CoreMode::Hold | CoreMode::Drive => MavState::MAV_STATE_ACTIVE,
    };
    c::HEARTBEAT_DATA {
        custom_mode: mode.custom_mode(identity),
        mavtype: MavType::MAV_TYPE_GROUND_ROVER,
        autopilot: match identity {
            Identity::Generic => MavAutopilot::MAV_AUTOPILOT_GENERIC,
            Identity::Px4 => MavAutopilot::MAV_AUTOPILOT_PX4,
        },
        base_mode,
        system_status,
        mavlink_version: 3,
    }
}

fn current_mode(facts: &Facts<'_>) -> c::CURRENT_MODE_DATA {
    let identity = facts.params.identity;
    let shown = facts.shown_mode();
    c::CURRENT_MODE_DATA {
        custom_mode: shown.custom_mode(identity),
        intended_custom_mode: facts.mode.custom_mode(identity),
        standard_mode: shown.standard(),
    }
}

fn available_modes(which: u32, facts: &Facts<'_>) -> Vec<MavMessage> {
    let identity = facts.params.identity;
    let modes = Mode::all(identity);
    let of = |(index, mode): (usize, &Mode)| {
        MavMessage::AVAILABLE_MODES(c::AVAILABLE_MODES_DATA {
            custom_mode: mode.custom_mode(identity),
            properties: MavModeProperty::MAV_MODE_PROPERTY_AUTO_MODE,
            number_modes: modes.len() as u8,
            mode_index: index as u8 + 1,
            standard_mode: mode.standard(),
            mode_name: CharArray::from(mode.name(identity)),
        })
    };
    let all = modes.iter().enumerate();
    all.filter(|(index, _)| which == 0 || *index as u32 + 1 == which).map(of).collect()
}

/// Saturating, as counts in messages are.
fn count(value: u64) -> u16 {
    value.min(u64::from(u16::MAX)) as u16
}

fn sys_status(facts: &Facts<'_>) -> c::SYS_STATUS_DATA {
    let view = facts.view;
    let acting = view.acting_fault();
    let present = Sensor::MAV_SYS_STATUS_SENSOR_VISION_POSITION
        | Sensor::MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL
        | Sensor::MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS
        | Sensor::MAV_SYS_STATUS_SENSOR_BATTERY
        | Sensor::MAV_SYS_STATUS_SENSOR_PROXIMITY
        | Sensor::MAV_SYS_STATUS_PREARM_CHECK
        | Sensor::MAV_SYS_STATUS_OBSTACLE_AVOIDANCE
        | Sensor::MAV_SYS_STATUS_SENSOR_PROPULSION;
    let mut health = Sensor::empty();
    let position = view.fresh.odometry && view.pose.is_some();
    for (bit, healthy) in [
        (Sensor::MAV_SYS_STATUS_SENSOR_VISION_POSITION, position),
        (Sensor::MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL, position && acting.is_none()),
        (Sensor::MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS, view.fresh.status),
        (Sensor::MAV_SYS_STATUS_SENSOR_BATTERY, view.battery_v.is_some() && view.fresh.status),
        (Sensor::MAV_SYS_STATUS_SENSOR_PROXIMITY, view.fresh.scan),
        // By its definition it is always well when armed.
        (Sensor::MAV_SYS_STATUS_PREARM_CHECK, view.mode.is_armed() || view.not_ready.is_empty()),
        (Sensor::MAV_SYS_STATUS_OBSTACLE_AVOIDANCE, view.fresh.scan && acting.is_none()),
        (Sensor::MAV_SYS_STATUS_SENSOR_PROPULSION, view.fresh.status),
    ] {
        health.set(bit, healthy);
    }
    let mut enabled = present;
    if !view.mode.is_armed() {
        enabled.remove(Sensor::MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS);
        enabled.remove(Sensor::MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL);
    }
    c::SYS_STATUS_DATA {
        onboard_control_sensors_present: present,
        onboard_control_sensors_enabled: enabled,
        onboard_control_sensors_health: health,
        load: (view.load.clamp(0.0, 1.0) * 1000.0).round() as u16,
        voltage_battery: view.battery_v.map_or(u16::MAX, millivolts),
        current_battery: -1,
        battery_remaining: battery_remaining(facts),
        drop_rate_comm: 0,
        errors_comm: count(facts.dropped),
        errors_count1: count(view.counts.frames_refused),
        errors_count2: count(view.counts.error_frames),
        errors_count3: count(view.counts.plans_rejected),
        errors_count4: count(view.counts.guard_stops),
        onboard_control_sensors_present_extended: MavSysStatusSensorExtended::empty(),
        onboard_control_sensors_enabled_extended: MavSysStatusSensorExtended::empty(),
        onboard_control_sensors_health_extended: MavSysStatusSensorExtended::empty(),
    }
}

/// A rover of PX4 says that it flies as long as it is armed (`RoverLandDetector.cpp`), and
/// QGroundControl offers go-to, pause and going on with a mission only to what flies
/// (`GuidedActionsController.qml`).
fn landed_state(facts: &Facts<'_>) -> MavLandedState {
    if facts.params.identity == Identity::Px4 && facts.view.mode.is_armed() {
        MavLandedState::MAV_LANDED_STATE_IN_AIR
    } else {
        MavLandedState::MAV_LANDED_STATE_ON_GROUND
    }
}

/// What fits the field; its highest value means "unknown".
fn millivolts(volts: f64) -> u16 {
    (volts * 1e3).round().clamp(0.0, f64::from(u16::MAX - 1)) as u16
}

/// Per cent, or -1 if nobody said what full and empty are.
fn battery_remaining(facts: &Facts<'_>) -> i8 {
    let (empty, full) = (facts.params.battery_empty_v, facts.params.battery_full_v);
    match facts.view.battery_v {
        Some(volts) if full > empty => {
            ((volts - empty) / (full - empty) * 100.0).clamp(0.0, 100.0).round() as i8
        }
        _ => -1,
    }
}

fn battery(facts: &Facts<'_>) -> c::BATTERY_STATUS_DATA {
    let mut voltages = [u16::MAX; 10];
    voltages[0] = facts.view.battery_v.map_or(u16::MAX, millivolts);
    c::BATTERY_STATUS_DATA {
        current_consumed: -1,
        energy_consumed: -1,
        temperature: i16::MAX,
        voltages,
        current_battery: -1,
        id: 0,
        battery_function: MavBatteryFunction::MAV_BATTERY_FUNCTION_ALL,
        mavtype: MavBatteryType::MAV_BATTERY_TYPE_UNKNOWN,
        battery_remaining: battery_remaining(facts),
        time_remaining: 0,
        charge_state: MavBatteryChargeState::MAV_BATTERY_CHARGE_STATE_UNDEFINED,
        voltages_ext: [0; 4],
        mode: MavBatteryMode::MAV_BATTERY_MODE_UNKNOWN,
        fault_bitmask: MavBatteryFault::empty(),
    }
}

fn attitude(facts: &Facts<'_>) -> Option<c::ATTITUDE_DATA> {
    let pose = facts.view.pose?;
    Some(c::ATTITUDE_DATA {
        time_boot_ms: facts.boot_ms(),
        roll: 0.0,
        pitch: 0.0,
        yaw: yaw_of(pose.heading_rad) as f32,
        rollspeed: 0.0,
        pitchspeed: 0.0,
        yawspeed: -facts.view.yaw_rate_rps as f32,
    })
}

/// A turn about the vertical: w, x, y, z.
fn quaternion(yaw_rad: f64) -> [f32; 4] {
    let (sin, cos) = (0.5 * yaw_rad).sin_cos();
    [cos as f32, 0.0, 0.0, sin as f32]
}

fn attitude_quaternion(facts: &Facts<'_>) -> Option<c::ATTITUDE_QUATERNION_DATA> {
    let [q1, q2, q3, q4] = quaternion(yaw_of(facts.view.pose?.heading_rad));
    Some(c::ATTITUDE_QUATERNION_DATA {
        time_boot_ms: facts.boot_ms(),
        q1,
        q2,
        q3,
        q4,
        yawspeed: -facts.view.yaw_rate_rps as f32,
        ..Default::default()
    })
}

fn local_position(facts: &Facts<'_>) -> Option<c::LOCAL_POSITION_NED_DATA> {
    let [north, east] = ned_of(facts.view.pose?.position);
    let [vx, vy] = facts.velocity();
    Some(c::LOCAL_POSITION_NED_DATA {
        time_boot_ms: facts.boot_ms(),
        x: north as f32,
        y: east as f32,
        z: 0.0,
        vx: vx as f32,
        vy: vy as f32,
        vz: 0.0,
    })
}

fn odometry(facts: &Facts<'_>) -> Option<c::ODOMETRY_DATA> {
    let pose = facts.view.pose?;
    let [north, east] = ned_of(pose.position);
    // The estimate comes without a covariance; that is said by a not-a-number in the first place.
    let mut unknown = [0.0; 21];
    unknown[0] = f32::NAN;
    Some(c::ODOMETRY_DATA {
        time_usec: facts.boot_us(),
        x: north as f32,
        y: east as f32,
        z: 0.0,
        q: quaternion(yaw_of(pose.heading_rad)),
        vx: facts.view.speed_mps as f32,
        vy: 0.0,
        vz: 0.0,
        rollspeed: 0.0,
        pitchspeed: 0.0,
        yawspeed: -facts.view.yaw_rate_rps as f32,
        pose_covariance: unknown,
        velocity_covariance: unknown,
        frame_id: MavFrame::MAV_FRAME_LOCAL_NED,
        child_frame_id: MavFrame::MAV_FRAME_BODY_FRD,
        reset_counter: 0,
        estimator_type: MavEstimatorType::MAV_ESTIMATOR_TYPE_AUTOPILOT,
        quality: if facts.view.fresh.odometry { 100 } else { -1 },
    })
}

fn millimetres(metres: f64) -> i32 {
    (metres * 1e3).round() as i32
}

fn centimetres_per_s(mps: f64) -> i16 {
    (mps * 1e2).round() as i16
}

fn global_position(facts: &Facts<'_>) -> Option<c::GLOBAL_POSITION_INT_DATA> {
    let (origin, pose) = (facts.origin?, facts.view.pose?);
    let [lat, lon] = origin.place_of(pose.position).as_e7();
    let [vx, vy] = facts.velocity().map(centimetres_per_s);
    let degrees = yaw_of(pose.heading_rad).to_degrees().rem_euclid(360.0);
    Some(c::GLOBAL_POSITION_INT_DATA {
        time_boot_ms: facts.boot_ms(),
        lat,
        lon,
        alt: millimetres(origin.altitude_m),
        relative_alt: 0,
        vx,
        vy,
        vz: 0,
        hdg: ((degrees * 100.0).round() as u16) % 36000,
    })
}

fn global_origin(facts: &Facts<'_>) -> Option<c::GPS_GLOBAL_ORIGIN_DATA> {
    let origin = facts.origin?;
    let [latitude, longitude] = origin.place.as_e7();
    Some(c::GPS_GLOBAL_ORIGIN_DATA {
        latitude,
        longitude,
        altitude: millimetres(origin.altitude_m),
        time_usec: facts.boot_us(),
    })
}

fn home_position(facts: &Facts<'_>) -> Option<c::HOME_POSITION_DATA> {
    let origin = facts.origin?;
    let Home { position, heading_rad } = facts.home;
    let [latitude, longitude] = origin.place_of(position).as_e7();
    let [north, east] = ned_of(position);
    Some(c::HOME_POSITION_DATA {
        latitude,
        longitude,
        altitude: millimetres(origin.altitude_m),
        x: north as f32,
        y: east as f32,
        z: 0.0,
        q: heading_rad.map_or([f32::NAN; 4], |heading| quaternion(yaw_of(heading))),
        approach_x: f32::NAN,
        approach_y: f32::NAN,
        approach_z: f32::NAN,
        time_usec: facts.boot_us(),
    })
}

fn hud(facts: &Facts<'_>) -> Option<c::VFR_HUD_DATA> {
    let pose = facts.view.pose?;
    let degrees = yaw_of(pose.heading_rad).to_degrees().rem_euclid(360.0);
    Some(c::VFR_HUD_DATA {
        airspeed: facts.view.speed_mps as f32,
        groundspeed: facts.view.speed_mps.abs() as f32,
        alt: facts.origin.map_or(0.0, |origin| origin.altitude_m) as f32,
        climb: 0.0,
        heading: (degrees.round() as i16) % 360,
        throttle: 0,
    })
}

fn position_target(facts: &Facts<'_>) -> Option<c::POSITION_TARGET_LOCAL_NED_DATA> {
    use PositionTargetTypemask as Mask;
    let target = facts.view.target?;
    let [north, east] = ned_of(target.position);
    let [forward, left] = [target.accel_mps2, target.curvature_pm * target.speed_mps.powi(2)];
    let ahead = crate::frames::heading_vector(target.heading_rad);
    let accel = ahead * forward + crate::frames::Vector::new(-ahead.y, ahead.x) * left;
    let [vx, vy] = ned_of(Point::from(ahead * target.speed_mps));
    let [afx, afy] = ned_of(Point::from(accel));
    Some(c::POSITION_TARGET_LOCAL_NED_DATA {
        time_boot_ms: facts.boot_ms(),
        x: north as f32,
        y: east as f32,
        z: 0.0,
        vx: vx as f32,
        vy: vy as f32,
        vz: 0.0,
        afx: afx as f32,
        afy: afy as f32,
        afz: 0.0,
        yaw: yaw_of(target.heading_rad) as f32,
        yaw_rate: -(target.curvature_pm * target.speed_mps) as f32,
        type_mask: Mask::POSITION_TARGET_TYPEMASK_Z_IGNORE
            | Mask::POSITION_TARGET_TYPEMASK_VZ_IGNORE
            | Mask::POSITION_TARGET_TYPEMASK_AZ_IGNORE,
        coordinate_frame: MavFrame::MAV_FRAME_LOCAL_NED,
    })
}

fn controller_output(facts: &Facts<'_>) -> Option<c::NAV_CONTROLLER_OUTPUT_DATA> {
    let (pose, target) = (facts.view.pose?, facts.view.target?);
    let bearing = |heading: f64| yaw_of(heading).to_degrees().round() as i16;
    let way = facts.view.goal.map(|goal| goal - pose.position);
    Some(c::NAV_CONTROLLER_OUTPUT_DATA {
        nav_roll: 0.0,
        nav_pitch: 0.0,
        alt_error: 0.0,
        aspd_error: (target.speed_mps - facts.view.speed_mps) as f32,
        xtrack_error: facts.view.cross_track_m as f32,
        nav_bearing: bearing(target.heading_rad),
        target_bearing: way.map_or(0, |way| bearing(way.y.atan2(way.x))),
        wp_dist: way.map_or(0, |way| way.norm().round().min(f64::from(u16::MAX)) as u16),
    })
}

fn waypoints(facts: &Facts<'_>) -> c::TRAJECTORY_REPRESENTATION_WAYPOINTS_DATA {
    let plan: &[PlanPoint] = &facts.view.plan;
    let plan = &plan[..plan.len().min(WAYPOINTS)];
    let each = |f: &dyn Fn(&PlanPoint) -> f64| -> [f32; WAYPOINTS] {
        std::array::from_fn(|i| plan.get(i).map_or(f32::NAN, |point| f(point) as f32))
    };
    let velocity = |point: &PlanPoint| {
        ned_of(Point::from(crate::frames::heading_vector(point.heading_rad) * point.speed_mps))
    };
    let flat = each(&|_| 0.0);
    let unknown = [f32::NAN; WAYPOINTS];
    c::TRAJECTORY_REPRESENTATION_WAYPOINTS_DATA {
        time_usec: facts.boot_us(),
        pos_x: each(&|point| ned_of(point.position)[0]),
        pos_y: each(&|point| ned_of(point.position)[1]),
        pos_z: flat,
        vel_x: each(&|point| velocity(point)[0]),
        vel_y: each(&|point| velocity(point)[1]),
        vel_z: flat,
        acc_x: unknown,
        acc_y: unknown,
        acc_z: unknown,
        pos_yaw: each(&|point| yaw_of(point.heading_rad)),
        vel_yaw: each(&|point| -point.curvature_pm * point.speed_mps),
        command: [u16::MAX; WAYPOINTS],
        valid_points: plan.len() as u8,
    }
}

fn version(facts: &Facts<'_>) -> c::AUTOPILOT_VERSION_DATA {
    use MavProtocolCapability as Can;
    let number = |text: &str| text.parse::<u32>().unwrap_or(0);
    let software = number(env!("CARGO_PKG_VERSION_MAJOR")) << 24
        | number(env!("CARGO_PKG_VERSION_MINOR")) << 16
        | number(env!("CARGO_PKG_VERSION_PATCH")) << 8;
    c::AUTOPILOT_VERSION_DATA {
        capabilities: Can::MAV_PROTOCOL_CAPABILITY_COMMAND_INT
            | Can::MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
            | Can::MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_GLOBAL_INT
            | Can::MAV_PROTOCOL_CAPABILITY_FLIGHT_TERMINATION
            | Can::MAV_PROTOCOL_CAPABILITY_MAVLINK2
            | facts.capabilities,
        uid: u64::from(facts.params.system_id),
        flight_sw_version: software,
        middleware_sw_version: 0,
        os_sw_version: 0,
        board_version: 0,
        vendor_id: 0,
        product_id: 0,
        flight_custom_version: [0; 8],
        middleware_custom_version: [0; 8],
        os_custom_version: [0; 8],
        uid2: [0; 18],
    }
}
