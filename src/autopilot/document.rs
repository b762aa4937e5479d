//! The failsafe table as a page for people.

use std::fmt::Write;

use super::AutopilotParams;
use super::failsafe::{Action, Clears, TABLE};

const HEAD: &str = "\
# Failsafes

What can go wrong while driving, how soon it is noticed, what is done about it, and how it is
cleared. Written by the program's own tests from the table that the autopilot acts on
(`src/autopilot/failsafe.rs`); after a change, `APEXD_BLESS=1 cargo test failsafe` writes it anew.

The first active row decides; rows that only report decide nothing. Detectors run at every control
tick; the times hold for the default of `autopilot.control_rate_hz`. Beneath all of this lies the committed plan, which ends at rest inside space that was seen to
be free, and beneath that the braking tail in the car's own controller, which is driven when
setpoints stop coming.

";

/// `docs/failsafes.md`.
pub fn markdown() -> String {
    let mut page = HEAD.to_owned();
    page += "| what | how it is noticed | within | what is done | what clears it |\n";
    page += "|---|---|---|---|---|\n";
    let params = AutopilotParams::default();
    for row in TABLE {
        let within_ms = row.within_s(&params) * 1e3;
        let (what, detection) = (row.fault.name(), row.detection);
        let (action, clears) = (action_text(row.action), clears_text(row.clears));
        writeln!(page, "| {what} | {detection} | {within_ms:.0} ms | {action} | {clears} |")
            .expect("a String takes every write");
    }
    page
}

const fn action_text(action: Action) -> &'static str {
    match action {
        Action::BrakeNow => "brakes along the newest tail, as hard as the tyres allow",
        Action::FinishPlan => "drives the committed plan to its end and adopts no new one",
        Action::Report => "reports it",
    }
}

const fn clears_text(clears: Clears) -> &'static str {
    match clears {
        Clears::ByItself => "the end of its cause",
        Clears::ByArming => "the end of its cause, and arming anew",
        Clears::ByNewGoal => "a new goal",
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
