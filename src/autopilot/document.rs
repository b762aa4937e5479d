//! The failsafe table as a page for people.

use std::fmt::Write;

use super::CoreParams;
use super::failsafe::{Action, Clears, TABLE};

const HEAD: &str = "\
# Failsafes

What can go wrong while driving, how soon it is noticed, what is done about it, and how it is
cleared. Written by the program's own tests from the table that the autopilot acts on
(`src/autopilot/failsafe.rs`); after a change, `APEXD_BLESS=1 cargo test failsafe` writes it anew.

The first active row decides; rows that only report decide nothing. Detectors run at every control
tick; the times hold for the default parameters, a longer control period adds to them. A fault is
seen in the log, in the mode `stop`, and in what the ground station is told.

Beneath all of this lies the committed plan, which ends at rest inside space that was seen to be
free, and beneath that the braking tail in the car's own controller, which is driven when setpoints
stop coming: a computer that dies, hangs or is cut off still leaves a car that stops inside known
free space. A controller that was restarted has no tail; it brakes as hard as it can.

A car that brakes goes on braking until it stands, even if the cause is over before. What clears by
itself lets the car drive on after that, unless it was paused; what needs arming needs a person: the
command to arm is refused with a reason for as long as one of the checks below fails.

";

/// `docs/failsafes.md`.
pub fn markdown() -> String {
    let mut page = HEAD.to_owned();
    page += "| what | how it is noticed | within | what is done | what clears it |\n";
    page += "|---|---|---|---|---|\n";
    let params = CoreParams::default();
    for row in TABLE {
        let within_ms = row.within_s(&params) * 1e3;
        let (what, detection) = (row.fault.name(), row.detection);
        let (action, clears) = (action_text(row.action), clears_text(row.clears));
        writeln!(page, "| {what} | {detection} | {within_ms:.0} ms | {action} | {clears} |")
            .expect("a String takes every write");
    }
    page += ARMING;
    page
}

const ARMING: &str = "
## Before the car is armed

The car is armed only if all of this holds; otherwise the command is refused with the first reason.

| check | limit |
|---|---|
| the car's controller sends heartbeats | one in 350 ms |
| it speaks this version of the CAN interface | the same |
| it sends its status | one in 100 ms |
| the emergency stop is not pressed | |
| the controller's latch for lost setpoints is not set | |
| the battery is charged | `autopilot.battery_low_v` |
| there is odometry | as for the fault |
| there are complete scans | as for the fault |
| the car stands | 2 cm/s |
| the controller holds a valid braking tail | confirmed within 200 ms |
| the CAN controller of this computer is active | |
| the log can be written | |
| the computer is not overloaded | as for the fault |
| the drive was not terminated | since the start |
| clocks, frames and bus are quiet | half a second |

A missing network is no reason to stay: the planner works without, more carefully, and says so.
";

const fn action_text(action: Action) -> &'static str {
    match action {
        Action::BrakeNow => "brakes along the newest tail, as hard as the tyres allow",
        Action::FinishPlan => "drives the committed plan to its end and adopts no new one",
        Action::Report => "reports it",
    }
}

const fn clears_text(clears: Clears) -> &'static str {
    match clears {
        Clears::ByItself => "half a second without its cause",
        Clears::AtRest => "standing still",
        Clears::ByArming => "the end of its cause, and arming anew",
        Clears::ByNewGoal => "a new goal",
        Clears::ByRestart => "the next start",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_failsafe_page_is_up_to_date() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/failsafes.md");
        if std::env::var_os("APEXD_BLESS").is_some_and(|value| value == "1") {
            std::fs::write(path, markdown()).unwrap();
        }
        let found = std::fs::read_to_string(path).unwrap_or_default();
        assert!(found == markdown(), "{path} is out of date: APEXD_BLESS=1 cargo test failsafe");
    }
}
