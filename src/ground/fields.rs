//! What the fields of a command may hold, as far as obeying it does not look at them anyway.
//!
//! Fields that mean nothing to this car may hold any number: stations differ in what they put there.
//! Only an infinite one is refused everywhere, it shows that something is wrong with the sender.
//! Not-a-number stands for "left out" where a field may be left out, and is refused where it may not.

use super::wanted::{Denial, Wanted};
use crate::wire::mavlink::common::MavCmd;

/// The number that forces arming and disarming.
pub const FORCE: f32 = 21196.0;
/// The number that an old QGroundControl forces arming with.
pub const FORCE_OLD: f32 = 2989.0;

/// The last number of the enumeration of what can be done to a component besides letting it run.
const ACTION_MAX: u32 = 5;

/// The commands that are understood; all others are answered as unsupported, whatever they hold.
pub const UNDERSTOOD: &[MavCmd] = &[
    MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
    MavCmd::MAV_CMD_RUN_PREARM_CHECKS,
    MavCmd::MAV_CMD_DO_SET_MODE,
    MavCmd::MAV_CMD_DO_SET_STANDARD_MODE,
    MavCmd::MAV_CMD_DO_REPOSITION,
    MavCmd::MAV_CMD_DO_PAUSE_CONTINUE,
    MavCmd::MAV_CMD_DO_CHANGE_SPEED,
    MavCmd::MAV_CMD_NAV_RETURN_TO_LAUNCH,
    MavCmd::MAV_CMD_MISSION_START,
    MavCmd::MAV_CMD_DO_SET_MISSION_CURRENT,
    MavCmd::MAV_CMD_DO_FLIGHTTERMINATION,
    MavCmd::MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN,
    MavCmd::MAV_CMD_PREFLIGHT_STORAGE,
    MavCmd::MAV_CMD_DO_SET_HOME,
    MavCmd::MAV_CMD_DO_SET_GLOBAL_ORIGIN,
    MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL,
    MavCmd::MAV_CMD_GET_MESSAGE_INTERVAL,
    MavCmd::MAV_CMD_REQUEST_MESSAGE,
    MavCmd::MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
    MavCmd::MAV_CMD_REQUEST_PROTOCOL_VERSION,
    MavCmd::MAV_CMD_GET_HOME_POSITION,
];

/// Looks at the fields of a command.
///
/// # Errors
/// If one of them holds what it must not.
pub fn check(wanted: &Wanted) -> Result<(), Denial> {
    if !UNDERSTOOD.contains(&wanted.command) {
        return Ok(());
    }
    for number in 1..=wanted.params.len() {
        wanted.optional(number)?;
    }
    match wanted.command {
        MavCmd::MAV_CMD_COMPONENT_ARM_DISARM => {
            // A car is stopped whatever stands where arming has a meaning.
            if wanted.whole(1, 1)? == 0 {
                return Ok(());
            }
            one_of(wanted, 2, &[0.0, FORCE, FORCE_OLD])
        }
        MavCmd::MAV_CMD_DO_SET_MODE => {
            wanted.whole(1, 255)?;
            wanted.whole(2, 255)?;
            wanted.optional_whole(3, 255).map(drop)
        }
        MavCmd::MAV_CMD_DO_SET_STANDARD_MODE => wanted.whole(1, 255).map(drop),
        // No throttle can be set. QGroundControl and MAVSDK say -1 (as it is), MAVProxy 0.
        MavCmd::MAV_CMD_DO_CHANGE_SPEED => one_of(wanted, 3, &[-1.0, -2.0, 0.0]),
        MavCmd::MAV_CMD_DO_FLIGHTTERMINATION => {
            let value = wanted.finite(1)?;
            if (0.0..=1.0).contains(&value) {
                return Ok(());
            }
            Err(Denial::denied(format!("parameter 1 is {value}, allowed is 0 to 1")))
        }
        MavCmd::MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN => {
            // MAVSDK asks for companion, camera and gimbal in the same breath: there are none.
            let companion = wanted.optional_whole(2, ACTION_MAX)?;
            let component = wanted.optional_whole(3, ACTION_MAX)?;
            wanted.optional_whole(4, 255)?;
            let others = companion.unwrap_or(0) > 0 || component.unwrap_or(0) > 0;
            if others && wanted.params[0] == 0.0 {
                return Err(Denial::denied(
                    "there is nothing but the autopilot to be started anew",
                ));
            }
            Ok(())
        }
        // Once this was about missions: -1 leaves them alone, 0 reads, 1 writes. They are kept as
        // soon as they are there. 2 would have cleared them, which has a message of its own.
        MavCmd::MAV_CMD_PREFLIGHT_STORAGE => one_of(wanted, 2, &[-1.0, 0.0, 1.0]),
        MavCmd::MAV_CMD_DO_SET_MISSION_CURRENT => one_of(wanted, 2, &[0.0, 1.0]),
        // To whom it is sent: as the vehicle likes, to who asks, to all. Here always to who asks.
        MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL | MavCmd::MAV_CMD_REQUEST_MESSAGE => {
            wanted.optional_whole(7, 2).map(drop)
        }
        _ => Ok(()),
    }
}

/// Refuses a number that is neither left out nor one of those.
fn one_of(wanted: &Wanted, number: usize, allowed: &[f32]) -> Result<(), Denial> {
    let value = wanted.params[number - 1];
    if value.is_nan() || allowed.contains(&value) {
        return Ok(());
    }
    let allowed: Vec<String> = allowed.iter().map(ToString::to_string).collect();
    let allowed = allowed.join(", ");
    Err(Denial::denied(format!("parameter {number} is {value}, allowed is {allowed}")))
}

#[cfg(test)]
mod tests {
    use super::super::tests::{Talk, long, result, texts};
    use super::super::{CoreMode, Keeper, MavlinkParams, Mission, Parameters};
    use super::*;
    use crate::params::Params;
    use crate::wire::mavlink::common::{self as c, MavFrame, MavMessage, MavResult};
    use crate::wire::mavlink::{MavlinkVersion, Message, MessageData};

    /// None of them is a small whole number from zero on, which is what most fields hold.
    const ODD: [(&str, f32); 7] = [
        ("nan", f32::NAN),
        ("inf", f32::INFINITY),
        ("-inf", f32::NEG_INFINITY),
        ("big", f32::MAX),
        ("-big", f32::MIN),
        ("half", 0.5),
        ("-1", -1.0),
    ];

    const MISSION: &str = "QGC WPL 110\n0\t0\t1\t16\t0\t0\t0\t0\t1\t2\t0\t1\n\
                           1\t0\t1\t16\t0\t0\t0\t0\t3\t4\t0\t1\n";

    struct Kept;

    impl Keeper for Kept {
        fn keep(&mut self, _name: &str, _text: &str) -> Result<(), String> {
            Ok(())
        }
    }

    /// A car with a mission, parameters and a place on the earth.
    fn talk(armed: bool) -> Talk {
        let params = MavlinkParams { origin_known: true, ..MavlinkParams::default() };
        let kept = |name: &str| (name == "mission.txt").then(|| MISSION.to_owned());
        let mut talk = Talk::serving(
            params,
            vec![
                Box::new(Mission::new(1, None, kept)),
                Box::new(Parameters::new(
                    &Params::default(),
                    Default::default(),
                    Some(Box::new(Kept)),
                )),
            ],
        );
        talk.mode = if armed { CoreMode::Standby } else { CoreMode::Disarmed };
        talk.look();
        talk.drain();
        talk
    }

    /// A command that is obeyed as it is, and for each field with a meaning what of the odd numbers
    /// it takes.
    type Row = (MavCmd, [f32; 7], &'static [(usize, &'static [&'static str])]);

    fn rows() -> Vec<Row> {
        const NAN: f32 = f32::NAN;
        let zeros = [0.0; 7];
        let with = |values: &[f32]| {
            let mut all = zeros;
            all[..values.len()].copy_from_slice(values);
            all
        };
        vec![
            (MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, with(&[1.0]), &[(1, &[]), (2, &["nan"])]),
            // What stops the car is refused only for what cannot be meant.
            (MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, zeros, &[(1, &[])]),
            (MavCmd::MAV_CMD_RUN_PREARM_CHECKS, zeros, &[]),
            (MavCmd::MAV_CMD_DO_SET_MODE, with(&[1.0, 15.0]), &[(1, &[]), (2, &[]), (3, &["nan"])]),
            // The mission, in both alphabets: another way through the program.
            (MavCmd::MAV_CMD_DO_SET_MODE, with(&[1.0, 10.0]), &[(1, &[]), (2, &[]), (3, &["nan"])]),
            (
                MavCmd::MAV_CMD_DO_SET_MODE,
                with(&[1.0, 4.0, 4.0]),
                &[(1, &[]), (2, &[]), (3, &["nan"])],
            ),
            (MavCmd::MAV_CMD_DO_SET_STANDARD_MODE, with(&[6.0]), &[(1, &[])]),
            (
                MavCmd::MAV_CMD_DO_REPOSITION,
                with(&[-1.0, 1.0, 0.0, NAN]),
                // Half a degree is too far away; without one of the two coordinates there is no place.
                &[(1, &["nan", "-big", "half", "-1"]), (2, &["nan"]), (5, &[]), (6, &[])],
            ),
            (MavCmd::MAV_CMD_DO_PAUSE_CONTINUE, zeros, &[(1, &[])]),
            (
                MavCmd::MAV_CMD_DO_CHANGE_SPEED,
                with(&[1.0, 1.5, -1.0]),
                &[(1, &[]), (2, &["half", "-1"]), (3, &["nan", "-1"])],
            ),
            (MavCmd::MAV_CMD_NAV_RETURN_TO_LAUNCH, zeros, &[]),
            (MavCmd::MAV_CMD_MISSION_START, zeros, &[(1, &["nan"]), (2, &["nan"])]),
            (MavCmd::MAV_CMD_DO_SET_MISSION_CURRENT, with(&[1.0]), &[(1, &["-1"]), (2, &["nan"])]),
            (MavCmd::MAV_CMD_DO_FLIGHTTERMINATION, with(&[1.0]), &[(1, &[])]),
            (
                MavCmd::MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN,
                with(&[1.0, 1.0, 1.0, 1.0]),
                &[(1, &[]), (2, &["nan"]), (3, &["nan"]), (4, &["nan"])],
            ),
            (
                MavCmd::MAV_CMD_PREFLIGHT_STORAGE,
                with(&[1.0, -1.0]),
                &[(1, &[]), (2, &["nan", "-1"])],
            ),
            (MavCmd::MAV_CMD_DO_SET_HOME, with(&[1.0]), &[(1, &[])]),
            (MavCmd::MAV_CMD_DO_SET_HOME, zeros, &[(1, &[]), (5, &[]), (6, &[])]),
            (
                MavCmd::MAV_CMD_DO_SET_GLOBAL_ORIGIN,
                with(&[0.0, 0.0, 0.0, 0.0, 47.0, 8.0, 400.0]),
                &[(5, &["half", "-1"]), (6, &["half", "-1"]), (7, &["nan", "half", "-1"])],
            ),
            (
                MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL,
                with(&[30.0, 1e5]),
                &[(1, &[]), (2, &["-1"]), (7, &["nan"])],
            ),
            (MavCmd::MAV_CMD_GET_MESSAGE_INTERVAL, with(&[30.0]), &[(1, &[])]),
            (MavCmd::MAV_CMD_REQUEST_MESSAGE, with(&[148.0]), &[(1, &[]), (7, &["nan"])]),
            (
                MavCmd::MAV_CMD_REQUEST_MESSAGE,
                with(&[435.0]),
                &[(1, &[]), (2, &["nan"]), (7, &["nan"])],
            ),
            (MavCmd::MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, zeros, &[]),
            (MavCmd::MAV_CMD_REQUEST_PROTOCOL_VERSION, zeros, &[]),
            (MavCmd::MAV_CMD_GET_HOME_POSITION, zeros, &[]),
        ]
    }

    #[test]
    fn odd_numbers_in_any_field_of_any_command_are_refused_with_a_reason_and_change_nothing() {
        let rows = rows();
        for command in UNDERSTOOD {
            assert!(rows.iter().any(|(other, ..)| other == command), "{command:?}");
        }
        for (command, good, fields) in rows {
            let disarmed =
                [MavCmd::MAV_CMD_RUN_PREARM_CHECKS, MavCmd::MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN];
            let armed = !disarmed.contains(&command);
            assert_eq!(
                talk(armed).ack(command, good),
                MavResult::MAV_RESULT_ACCEPTED,
                "{command:?} {good:?}"
            );
            for field in 1..=7 {
                let takes = fields.iter().find(|(number, _)| *number == field);
                for (label, value) in ODD {
                    let mut params = good;
                    params[field - 1] = value;
                    let takes = match takes {
                        Some((_, taken)) => taken.contains(&label),
                        // It means nothing to this car.
                        None => value.is_nan() || value.is_finite(),
                    };
                    refused_or_not(&mut talk(armed), command, params, takes);
                }
            }
        }
    }

    fn refused_or_not(talk: &mut Talk, command: MavCmd, params: [f32; 7], takes: bool) {
        let before = (talk.ground.origin, talk.ground.home, talk.ground.mode());
        let sent = talk.long(command, params);
        let what = format!("{command:?} {params:?}");
        if takes {
            assert_eq!(result(&sent), MavResult::MAV_RESULT_ACCEPTED, "{what}");
            return;
        }
        // Half a termination is none, and that is how stations ask whether there is such a thing.
        let half = command == MavCmd::MAV_CMD_DO_FLIGHTTERMINATION && params[0] == 0.5;
        let no = if half { MavResult::MAV_RESULT_FAILED } else { MavResult::MAV_RESULT_DENIED };
        assert_eq!(result(&sent), no, "{what}");
        let said = texts(&sent);
        assert!(said.contains("refused: "), "{what}: {said:?}");
        assert_eq!(talk.asked, [], "{what}");
        assert_eq!((talk.ground.origin, talk.ground.home, talk.ground.mode()), before, "{what}");
    }

    #[test]
    fn places_that_are_none_are_refused_in_the_integer_form_too() {
        use MavCmd::{MAV_CMD_DO_REPOSITION, MAV_CMD_DO_SET_GLOBAL_ORIGIN, MAV_CMD_DO_SET_HOME};
        use MavFrame::{MAV_FRAME_GLOBAL, MAV_FRAME_LOCAL_NED};
        for command in [MAV_CMD_DO_REPOSITION, MAV_CMD_DO_SET_HOME, MAV_CMD_DO_SET_GLOBAL_ORIGIN] {
            let frames: &[MavFrame] = match command {
                MAV_CMD_DO_SET_GLOBAL_ORIGIN => &[MAV_FRAME_GLOBAL],
                _ => &[MAV_FRAME_GLOBAL, MAV_FRAME_LOCAL_NED],
            };
            for frame in frames {
                for (x, y) in [(i32::MAX, 0), (0, i32::MAX), (i32::MIN, 0), (0, i32::MIN)] {
                    let mut talk = talk(true);
                    let mut data = super::super::tests::int(command, *frame, x, y);
                    if command == MAV_CMD_DO_SET_HOME {
                        data.param1 = 0.0;
                    }
                    let sent = talk.hear(&MavMessage::COMMAND_INT(data));
                    let what = format!("{command:?} {frame:?} {x} {y}");
                    assert_eq!(result(&sent), MavResult::MAV_RESULT_DENIED, "{what}");
                    assert!(texts(&sent).contains("refused: "), "{what}");
                    assert_eq!(talk.asked, [], "{what}");
                }
            }
            for height in [f32::INFINITY, f32::NEG_INFINITY] {
                let mut talk = talk(true);
                let data = c::COMMAND_INT_DATA {
                    z: height,
                    param1: 0.0,
                    ..super::super::tests::int(command, MAV_FRAME_GLOBAL, 0, 0)
                };
                let sent = talk.hear(&MavMessage::COMMAND_INT(data));
                assert_eq!(result(&sent), MavResult::MAV_RESULT_DENIED, "{command:?}");
                assert_eq!(talk.asked, []);
            }
        }
    }

    #[test]
    fn no_command_is_understood_whose_fields_nobody_looks_at() {
        let mut understood = 0;
        for number in 0..=u16::MAX {
            let mut payload = [0; 33];
            payload[28..30].copy_from_slice(&number.to_le_bytes());
            payload[30..32].copy_from_slice(&[1, 1]);
            let id = c::COMMAND_LONG_DATA::ID;
            let Ok(message) = MavMessage::parse(MavlinkVersion::V2, id, &payload) else { continue };
            let MavMessage::COMMAND_LONG(data) = &message else { unreachable!("by its number") };
            let command = data.command;
            let known = result(&talk(true).hear(&message)) != MavResult::MAV_RESULT_UNSUPPORTED;
            // A message of the number 0 can be asked for, so nothing is unsupported for its zeros
            // but the interval of the heartbeat, which has none of its own.
            let known = known || command == MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL;
            assert_eq!(known, UNDERSTOOD.contains(&command), "{command:?}");
            understood += usize::from(known);
        }
        assert_eq!(understood, UNDERSTOOD.len());
    }

    /// As their sources have it: QGroundControl (`PX4FirmwarePlugin.cc`, `Vehicle.cc`), MAVSDK
    /// (`action_impl.cpp`; what is left out there is sent as not-a-number), MAVProxy
    /// (`mavproxy_arm.py`, `mavproxy_cmdlong.py`, `mavproxy_misc.py`, `mavproxy_mode.py`).
    #[test]
    fn what_stations_put_into_their_commands_is_taken() {
        use MavCmd::*;
        const NAN: f32 = f32::NAN;
        let rest = |values: &[f32], fill: f32| {
            let mut all = [fill; 7];
            all[..values.len()].copy_from_slice(values);
            all
        };
        for (armed, command, params) in [
            // QGroundControl: disarm, stop at once, hold, drive on at another speed, reset, restart.
            (true, MAV_CMD_COMPONENT_ARM_DISARM, rest(&[0.0], 0.0)),
            (true, MAV_CMD_COMPONENT_ARM_DISARM, rest(&[0.0, FORCE], 0.0)),
            (true, MAV_CMD_DO_REPOSITION, rest(&[-1.0, 1.0, 0.0], NAN)),
            (true, MAV_CMD_DO_CHANGE_SPEED, rest(&[1.0, 1.5, -1.0, 0.0], NAN)),
            (false, MAV_CMD_PREFLIGHT_STORAGE, rest(&[2.0, -1.0], 0.0)),
            (false, MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, rest(&[1.0], 0.0)),
            // MAVSDK.
            (false, MAV_CMD_COMPONENT_ARM_DISARM, rest(&[1.0], NAN)),
            (true, MAV_CMD_DO_SET_MODE, rest(&[1.0, 4.0, 3.0], NAN)),
            (true, MAV_CMD_MISSION_START, rest(&[0.0, 0.0], NAN)),
            (true, MAV_CMD_DO_FLIGHTTERMINATION, rest(&[1.0], NAN)),
            (false, MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, rest(&[1.0; 4], NAN)),
            (false, MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, rest(&[2.0; 4], NAN)),
            (false, MAV_CMD_REQUEST_MESSAGE, rest(&[148.0, 0.0], NAN)),
            (false, MAV_CMD_SET_MESSAGE_INTERVAL, rest(&[30.0, 1e6], NAN)),
            // MAVProxy.
            (true, MAV_CMD_DO_CHANGE_SPEED, rest(&[0.0, 1.5], 0.0)),
            (true, MAV_CMD_DO_SET_MISSION_CURRENT, rest(&[1.0, 1.0], 0.0)),
            (true, MAV_CMD_DO_PAUSE_CONTINUE, rest(&[0.0], 0.0)),
            (false, MAV_CMD_RUN_PREARM_CHECKS, rest(&[], 0.0)),
            (false, MAV_CMD_PREFLIGHT_STORAGE, rest(&[2.0], 0.0)),
            // With its "force", which means nothing here: the car is disarmed.
            (
                false,
                MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN,
                rest(&[1.0, 0.0, 0.0, 0.0, 0.0, 20_190_226.0], 0.0),
            ),
        ] {
            let result = talk(armed).ack(command, params);
            assert_eq!(result, MavResult::MAV_RESULT_ACCEPTED, "{command:?} {params:?}");
        }
        // "Crash the autopilot", in MAVProxy's words.
        let nasty = rest(&[42.0, 24.0, 71.0, 93.0], 0.0);
        let result = talk(false).ack(MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, nasty);
        assert_eq!(result, MavResult::MAV_RESULT_DENIED);
    }

    #[test]
    fn what_is_not_understood_is_unsupported_whatever_it_holds() {
        for (_, value) in ODD {
            let takeoff = long(MavCmd::MAV_CMD_NAV_TAKEOFF, [value; 7]);
            let sent = talk(true).hear(&MavMessage::COMMAND_LONG(takeoff));
            assert_eq!(result(&sent), MavResult::MAV_RESULT_UNSUPPORTED);
            assert_eq!(texts(&sent), "NAV_TAKEOFF refused: there is no such command here");
        }
    }
}
