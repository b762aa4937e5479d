//! Positions as commands and setpoints give them, brought to the map frame.

use super::wanted::{Denial, Wanted};
use crate::frames::Point;
use crate::wire::mavlink::common::{
    MavFrame, MavResult, PositionTargetTypemask as Mask, SET_POSITION_TARGET_GLOBAL_INT_DATA,
    SET_POSITION_TARGET_LOCAL_NED_DATA,
};
use crate::wire::mavlink::{Geodetic, Origin, point_of_ned};

/// Goals further from the map's origin than this are a mistake, metres.
const REACH_M: f64 = 1000.0;
/// Integers of local positions are metres times this.
const LOCAL_E4: f64 = 1e4;
/// "No value" in the integer form.
const NONE: i32 = i32::MAX;

/// The position in a command; `None` means "here".
pub fn of_command(wanted: &Wanted, origin: Option<&Origin>) -> Result<Option<Point>, Denial> {
    // The height means nothing to a car, but an infinite one shows that something is wrong.
    wanted.optional(7)?;
    let Some((frame, x, y)) = wanted.place else {
        let (latitude, longitude) = (wanted.optional(5)?, wanted.optional(6)?);
        return match (latitude, longitude) {
            (Some(latitude), Some(longitude)) => {
                let place = Geodetic::checked(latitude, longitude);
                on_earth(place, origin).map(Some)
            }
            (None, None) => Ok(None),
            _ => Err(Denial::denied("only one of latitude and longitude is given")),
        };
    };
    if !is_global(frame) && !is_local(frame) {
        return Err(Denial::wrong_frame(frame));
    }
    match (x == NONE, y == NONE) {
        (true, true) => return Ok(None),
        (false, false) => {}
        _ => return Err(Denial::denied("only one of two coordinates is given")),
    }
    if is_global(frame) {
        return on_earth(Geodetic::from_e7(x, y), origin).map(Some);
    }
    let [a, b] = [x, y].map(|value| f64::from(value) / LOCAL_E4);
    let north_first = frame == MavFrame::MAV_FRAME_LOCAL_NED;
    in_reach(if north_first { point_of_ned(a, b) } else { Point::new(a, b) }).map(Some)
}

/// The place on the earth in a command: latitude, longitude, height above the sea, metres.
pub fn place_of_command(wanted: &Wanted) -> Result<(Geodetic, f64), Denial> {
    let altitude_m = wanted.optional(7)?.unwrap_or(0.0);
    let place = match wanted.place {
        None => Geodetic::checked(wanted.finite(5)?, wanted.finite(6)?),
        Some((frame, x, y)) if is_global(frame) => Geodetic::from_e7(x, y),
        Some((frame, ..)) => return Err(Denial::wrong_frame(frame)),
    };
    let place = place.ok_or_else(|| Denial::denied("the position is no place on the earth"))?;
    checked_altitude(altitude_m)?;
    Ok((place, altitude_m))
}

/// Refuses a height above the sea that is none, metres.
pub fn checked_altitude(altitude_m: f64) -> Result<(), Denial> {
    if (-500.0..=9000.0).contains(&altitude_m) {
        return Ok(());
    }
    Err(Denial::denied(format!("a height of {altitude_m} m, allowed is -500 to 9000")))
}

/// The goal in a local setpoint.
pub fn of_local_target(data: &SET_POSITION_TARGET_LOCAL_NED_DATA) -> Result<Point, Denial> {
    if data.coordinate_frame != MavFrame::MAV_FRAME_LOCAL_NED {
        return Err(Denial::wrong_frame(data.coordinate_frame));
    }
    check_mask(data.type_mask)?;
    check_numbers(&[data.z, data.yaw])?;
    let (north, east) = (f64::from(data.x), f64::from(data.y));
    if !(north.is_finite() && east.is_finite()) {
        return Err(Denial::denied(format!("the position ({north}, {east}) is not finite")));
    }
    in_reach(point_of_ned(north, east))
}

/// The goal in a global setpoint.
pub fn of_global_target(
    data: &SET_POSITION_TARGET_GLOBAL_INT_DATA,
    origin: Option<&Origin>,
) -> Result<Point, Denial> {
    if !is_global(data.coordinate_frame) {
        return Err(Denial::wrong_frame(data.coordinate_frame));
    }
    check_mask(data.type_mask)?;
    check_numbers(&[data.alt, data.yaw])?;
    on_earth(Geodetic::from_e7(data.lat_int, data.lon_int), origin)
}

fn is_global(frame: MavFrame) -> bool {
    matches!(
        frame,
        MavFrame::MAV_FRAME_GLOBAL
            | MavFrame::MAV_FRAME_GLOBAL_INT
            | MavFrame::MAV_FRAME_GLOBAL_RELATIVE_ALT
            | MavFrame::MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
    )
}

fn is_local(frame: MavFrame) -> bool {
    matches!(frame, MavFrame::MAV_FRAME_LOCAL_NED | MavFrame::MAV_FRAME_LOCAL_ENU)
}

fn on_earth(place: Option<Geodetic>, origin: Option<&Origin>) -> Result<Point, Denial> {
    let place = place.ok_or_else(|| Denial::denied("the position is no place on the earth"))?;
    let Some(origin) = origin else {
        return Err(Denial {
            result: MavResult::MAV_RESULT_FAILED,
            reason: "nobody has said where on the earth the map lies (set the origin)".into(),
        });
    };
    in_reach(origin.point_of(place))
}

/// Refuses a point of the map frame that is further away than any the car can mean.
pub fn in_reach(point: Point) -> Result<Point, Denial> {
    let distance_m = point.coords.norm();
    if distance_m <= REACH_M {
        return Ok(point);
    }
    Err(Denial::denied(format!(
        "the position is {distance_m:.0} m from the map's origin, allowed is {REACH_M:.0} m"
    )))
}

/// A setpoint must give a position and must not give a velocity, an acceleration or a turning rate:
/// how it gets there is the car's own business.
fn check_mask(mask: Mask) -> Result<(), Denial> {
    let position =
        Mask::POSITION_TARGET_TYPEMASK_X_IGNORE | Mask::POSITION_TARGET_TYPEMASK_Y_IGNORE;
    let rest = Mask::POSITION_TARGET_TYPEMASK_VX_IGNORE
        | Mask::POSITION_TARGET_TYPEMASK_VY_IGNORE
        | Mask::POSITION_TARGET_TYPEMASK_VZ_IGNORE
        | Mask::POSITION_TARGET_TYPEMASK_AX_IGNORE
        | Mask::POSITION_TARGET_TYPEMASK_AY_IGNORE
        | Mask::POSITION_TARGET_TYPEMASK_AZ_IGNORE
        | Mask::POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE;
    if mask.intersects(position) {
        return Err(Denial::denied("a setpoint without a position"));
    }
    if !mask.contains(rest) {
        return Err(Denial::denied(
            "a setpoint with velocity, acceleration or yaw rate; only positions can be followed",
        ));
    }
    Ok(())
}

/// Numbers that mean nothing to a car may be left out, but not be infinite.
fn check_numbers(numbers: &[f32]) -> Result<(), Denial> {
    match numbers.iter().find(|number| number.is_infinite()) {
        Some(number) => Err(Denial::denied(format!("a setpoint with {number} in it"))),
        None => Ok(()),
    }
}
