//! What commands mean to a car, and whether they can be obeyed.

use super::super::core::{CoreMode, CoreRequest, CoreView, StorageAction};
use super::super::fields::{FORCE, FORCE_OLD};
use super::super::modes::Mode;
use super::super::outbox::Outbox;
use super::super::settings::MavlinkParams;
use super::super::wanted::{Denial, Step, Wanted};
use super::super::{Home, places};
use super::{Commander, NO_SUCH_COMMAND};
use crate::time::Instant;
use crate::wire::mavlink::Origin;
use crate::wire::mavlink::common::{self as c, MavCmd, MavModeFlag, MavSeverity};

/// The lowest speed that can be asked for, m/s.
const SPEED_MIN_MPS: f64 = 0.1;
/// A setpoint this near to the goal is the goal, metres.
const SAME_GOAL_M: f64 = 0.01;

/// What commands may look at and change besides the core.
pub struct Scope<'a> {
    /// The configuration.
    pub params: &'a MavlinkParams,
    /// The core, if it is alive.
    pub view: Option<&'a CoreView>,
    /// Where the map lies on the earth.
    pub origin: &'a mut Option<Origin>,
    /// Where the car returns to.
    pub home: &'a mut Home,
}

impl Scope<'_> {
    fn alive(&self) -> Result<&CoreView, Denial> {
        self.view.ok_or_else(|| Denial::later("the autopilot does not answer"))
    }
}

impl Commander {
    /// Does what a command says.
    ///
    /// # Errors
    /// Says why not, and how that is acknowledged.
    pub fn obey(
        &mut self,
        wanted: &Wanted,
        scope: &mut Scope<'_>,
        out: &mut Outbox,
    ) -> Result<Step, Denial> {
        let ask = |request: CoreRequest| Ok(Step::Ask(vec![request], None));
        match wanted.command {
            MavCmd::MAV_CMD_COMPONENT_ARM_DISARM => arm(wanted, scope),
            MavCmd::MAV_CMD_RUN_PREARM_CHECKS => run_checks(scope, out),
            MavCmd::MAV_CMD_DO_SET_MODE => {
                let flags = wanted.whole(1, 255)? as u8;
                if flags & MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED.bits() == 0 {
                    return Err(Denial::denied("only custom modes can be set"));
                }
                let sub = if wanted.params[2].is_nan() { 0 } else { wanted.whole(3, 255)? };
                let mode = Mode::of_command(wanted.whole(2, 255)?, sub);
                self.choose(mode.map_err(|fault| Denial::failed(fault.to_string()))?, scope)
            }
            MavCmd::MAV_CMD_DO_SET_STANDARD_MODE => {
                let mode = Mode::of_standard(wanted.whole(1, 255)?);
                let mode = mode.ok_or_else(|| Denial::failed("this car has no such mode"))?;
                self.choose(mode, scope)
            }
            MavCmd::MAV_CMD_DO_REPOSITION => self.reposition(wanted, scope),
            MavCmd::MAV_CMD_DO_PAUSE_CONTINUE => match wanted.whole(1, 1)? {
                0 => self.choose(Mode::Hold, scope),
                _ => {
                    scope.alive()?;
                    let mode = self.paused.unwrap_or(match self.mode {
                        Mode::Hold => Mode::Guided,
                        mode => mode,
                    });
                    Ok(Step::Ask(vec![CoreRequest::Continue], Some(mode)))
                }
            },
            MavCmd::MAV_CMD_DO_CHANGE_SPEED => {
                if wanted.whole(1, 3)? > 1 {
                    return Err(Denial::denied("a car does not climb"));
                }
                match wanted.finite(2)? {
                    -1.0 => Ok(Step::Done),
                    -2.0 => ask(CoreRequest::SpeedLimit(None)),
                    speed => ask(CoreRequest::SpeedLimit(Some(checked_speed(speed, scope)?))),
                }
            }
            MavCmd::MAV_CMD_NAV_RETURN_TO_LAUNCH => self.choose(Mode::Return, scope),
            // Nobody has a mission: whoever has answers before.
            MavCmd::MAV_CMD_MISSION_START => Err(Denial::failed("there is no mission")),
            MavCmd::MAV_CMD_DO_FLIGHTTERMINATION => {
                if wanted.finite(1)? > 0.5 {
                    ask(CoreRequest::Terminate)
                } else {
                    // Stations ask this way whether there is such a thing: "failed" says yes.
                    Err(Denial::failed("only 1 ends the drive, and that until the next start"))
                }
            }
            MavCmd::MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN => reboot(wanted, scope),
            MavCmd::MAV_CMD_PREFLIGHT_STORAGE => match wanted.whole(1, 4)? {
                0 => ask(CoreRequest::Storage(StorageAction::Load)),
                1 => ask(CoreRequest::Storage(StorageAction::Save)),
                2 => ask(CoreRequest::Storage(StorageAction::Reset)),
                other => Err(Denial::denied(format!("action {other} on parameters is not known"))),
            },
            MavCmd::MAV_CMD_DO_SET_HOME => set_home(wanted, scope),
            MavCmd::MAV_CMD_DO_SET_GLOBAL_ORIGIN => {
                let (place, altitude_m) = places::place_of_command(wanted)?;
                *scope.origin = Some(Origin { place, altitude_m });
                Ok(Step::Done)
            }
            _ => Err(Denial { reason: NO_SUCH_COMMAND.into(), ..Denial::unsupported() }),
        }
    }

    /// Another mode.
    fn choose(&mut self, mode: Mode, scope: &Scope<'_>) -> Result<Step, Denial> {
        let view = scope.alive()?;
        match mode {
            Mode::Hold => {
                if self.mode != Mode::Hold {
                    self.paused = Some(self.mode);
                }
                if view.mode.is_armed() {
                    Ok(Step::Ask(vec![CoreRequest::Hold], Some(Mode::Hold)))
                } else {
                    self.mode = Mode::Hold;
                    Ok(Step::Done)
                }
            }
            Mode::Guided | Mode::Offboard => {
                // A mission or a way back that is under way ends here.
                if matches!(self.mode, Mode::Auto | Mode::Return) && view.mode.is_armed() {
                    return Ok(Step::Ask(vec![CoreRequest::Hold], Some(mode)));
                }
                self.mode = mode;
                Ok(Step::Done)
            }
            Mode::Auto => Err(Denial::failed("there is no mission")),
            Mode::Return => {
                let point = scope.home.position;
                let request = CoreRequest::Goto { point, through_known: true };
                Ok(Step::Ask(vec![request], Some(Mode::Return)))
            }
        }
    }

    fn reposition(&mut self, wanted: &Wanted, scope: &Scope<'_>) -> Result<Step, Denial> {
        const CHANGE_MODE: u32 = 1;
        scope.alive()?;
        let flags = if wanted.params[1].is_nan() { 0 } else { wanted.whole(2, 3)? };
        let speed = wanted.optional(1)?.filter(|speed| *speed > 0.0);
        let speed = speed.map(|speed| checked_speed(speed, scope)).transpose()?;
        // A radius is for aeroplanes, and the heading at the goal is the car's own business.
        wanted.optional(3)?;
        wanted.optional(4)?;
        let target = places::of_command(wanted, scope.origin.as_ref())?;
        if flags & CHANGE_MODE == 0 && matches!(self.mode, Mode::Auto | Mode::Return) {
            return Err(Denial::failed("the car is not in guided mode, and the mode is to stay"));
        }
        let Some(point) = target else { return self.choose(Mode::Hold, scope) };
        let limit = speed.map(|speed| CoreRequest::SpeedLimit(Some(speed)));
        let goal = CoreRequest::Goto { point, through_known: false };
        let mode = if self.mode == Mode::Offboard { Mode::Offboard } else { Mode::Guided };
        Ok(Step::Ask(limit.into_iter().chain([goal]).collect(), Some(mode)))
    }

    /// A goal that came as a setpoint: nobody waits for an acknowledgement.
    pub fn follow(
        &mut self,
        now: Instant,
        target: Result<crate::frames::Point, Denial>,
        view: Option<&CoreView>,
        out: &mut Outbox,
    ) {
        let step = target.and_then(|point| {
            let Some(view) = view else {
                return Err(Denial::later("the autopilot does not answer"));
            };
            if !matches!(self.mode, Mode::Guided | Mode::Offboard) {
                return Err(Denial::failed("the car is not in guided or offboard mode"));
            }
            let same = view.goal.is_some_and(|goal| (goal - point).norm() <= SAME_GOAL_M)
                || view.goal.is_none()
                    && view.pose.is_some_and(|pose| (pose.position - point).norm() <= SAME_GOAL_M);
            let asked = self.pending.iter().any(|pending| pending.peer.is_none());
            if same && view.mode != CoreMode::Hold || asked {
                return Ok(Step::Done);
            }
            Ok(Step::Ask(vec![CoreRequest::Goto { point, through_known: false }], None))
        });
        let wanted = Wanted {
            command: MavCmd::MAV_CMD_DO_REPOSITION,
            params: [f32::NAN; 7],
            place: None,
            confirmation: 0,
        };
        self.proceed(now, None, wanted, step, out);
    }

    /// Another mode by the old message: nobody waits for an acknowledgement.
    pub fn set_mode_message(
        &mut self,
        now: Instant,
        data: &c::SET_MODE_DATA,
        scope: &Scope<'_>,
        out: &mut Outbox,
    ) -> Option<Wanted> {
        let wanted = Wanted {
            command: MavCmd::MAV_CMD_DO_SET_MODE,
            params: [f32::NAN; 7],
            place: None,
            confirmation: 0,
        };
        let custom = data.base_mode.contains(MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED);
        let mode = if custom {
            Mode::of_custom(data.custom_mode).map_err(|fault| Denial::failed(fault.to_string()))
        } else {
            Err(Denial::denied("only custom modes can be set"))
        };
        if mode == Ok(Mode::Auto) {
            return Some(Wanted::mission_start());
        }
        let step = mode.and_then(|mode| self.choose(mode, scope));
        self.proceed(now, None, wanted, step, out);
        None
    }
}

fn arm(wanted: &Wanted, scope: &Scope<'_>) -> Result<Step, Denial> {
    let arms = wanted.whole(1, 1)? == 1;
    let forced = [FORCE, FORCE_OLD].contains(&wanted.params[1]);
    if arms && forced && !scope.params.forced_arming {
        return Err(Denial::denied("forced arming is not allowed here (mavlink.forced_arming)"));
    }
    scope.alive()?;
    Ok(Step::Ask(vec![if arms { CoreRequest::Arm } else { CoreRequest::Disarm }], None))
}

fn run_checks(scope: &Scope<'_>, out: &mut Outbox) -> Result<Step, Denial> {
    let view = scope.alive()?;
    if view.mode.is_armed() {
        return Err(Denial::later("the car is armed already"));
    }
    for reason in &view.not_ready {
        out.say(MavSeverity::MAV_SEVERITY_WARNING, &format!("PreArm: {reason}"));
    }
    if view.not_ready.is_empty() {
        out.say(MavSeverity::MAV_SEVERITY_INFO, "PreArm: ready to arm");
    }
    Ok(Step::Done)
}

fn reboot(wanted: &Wanted, scope: &Scope<'_>) -> Result<Step, Denial> {
    let request = match wanted.whole(1, 4)? {
        0 => return Ok(Step::Done),
        1 => CoreRequest::Restart,
        2 => CoreRequest::Shutdown,
        other => return Err(Denial::denied(format!("action {other} is not possible here"))),
    };
    // A core that does not answer needs a restart most of all.
    if scope.view.is_some_and(|view| view.mode.is_armed()) {
        return Err(Denial::failed("the car is armed"));
    }
    Ok(Step::Ask(vec![request], None))
}

fn set_home(wanted: &Wanted, scope: &mut Scope<'_>) -> Result<Step, Denial> {
    *scope.home = if wanted.whole(1, 1)? == 1 {
        let pose = scope.alive()?.pose;
        let pose = pose.ok_or_else(|| Denial::failed("nobody knows where the car is"))?;
        Home { position: pose.position, heading_rad: Some(pose.heading_rad) }
    } else {
        let position = places::of_command(wanted, scope.origin.as_ref())?;
        let position = position.ok_or_else(|| Denial::denied("no position is given"))?;
        Home { position, heading_rad: None }
    };
    Ok(Step::Done)
}

fn checked_speed(speed_mps: f64, scope: &Scope<'_>) -> Result<f64, Denial> {
    let max_mps = scope.alive()?.speed_max_mps;
    // Numbers come in single precision.
    if (SPEED_MIN_MPS - 1e-6..=max_mps + 1e-6).contains(&speed_mps) {
        return Ok(speed_mps.min(max_mps));
    }
    Err(Denial::denied(format!(
        "a speed of {speed_mps} m/s, allowed is {SPEED_MIN_MPS} to {max_mps} m/s"
    )))
}
