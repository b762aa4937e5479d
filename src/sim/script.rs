//! What happens to the car and the bus during a drive, as a file says it (TOML).
//!
//! An event strikes once, as soon as all of its conditions hold; one without conditions strikes at
//! the start. Times count from the first motion. Whoever writes such a file finds every key in
//! `docs/car.md`.

use serde::Deserialize;

use super::car_end::MessageClass;
use super::faults::{FaultPlan, Harm};

/// Everything that is to happen.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Script {
    /// In any order.
    #[serde(default)]
    pub event: Vec<ScriptEvent>,
}

/// When something happens, and what. Several things may happen at once.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ScriptEvent {
    /// Not before so many seconds after the first motion.
    pub after_s: Option<f64>,
    /// Not before the true speed is at least this, m/s.
    pub speed_mps: Option<f64>,
    /// Not before the car drives at least this curvature, to either side, 1/m.
    pub curvature_pm: Option<f64>,
    /// Is undone after so many seconds (a box stays).
    pub for_s: Option<f64>,
    /// Presses the emergency-stop button, or releases it.
    pub emergency_stop: Option<bool>,
    /// Sets a box down on the car's way.
    pub drop_box: Option<DropBox>,
    /// Battery voltage, volts.
    pub battery_v: Option<f64>,
    /// Messages that are not sent any more.
    pub silence: Option<Vec<MessageClass>>,
    /// Scans leave this much later, seconds.
    pub scan_delay_s: Option<f64>,
    /// What goes wrong on the bus; times count from the event. Node 0 is the daemon, node 1 the car.
    pub bus: Option<FaultPlan>,
}

/// A box on the way: where the car comes to if it goes on along the bend that it is driving.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DropBox {
    /// Way from the car's centre to the box's, metres.
    pub ahead_m: f64,
    /// Its size along the way, metres.
    pub length_m: f64,
    /// Its size across the way, metres.
    pub width_m: f64,
}

/// Why a script was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ScriptError {
    /// It is no TOML, or has keys that do not exist.
    #[error("{0}")]
    Syntax(String),
    /// A number is not one that makes sense.
    #[error("event {event}: {key} is {value}, allowed is {wanted}")]
    OutOfRange {
        /// Counted from 1.
        event: usize,
        /// The key.
        key: &'static str,
        /// Its value.
        value: f64,
        /// What would be allowed.
        wanted: &'static str,
    },
    /// An event that does nothing.
    #[error(
        "event {event} does nothing: it needs emergency_stop, drop_box, battery_v, silence, scan_delay_s or bus"
    )]
    Nothing {
        /// Counted from 1.
        event: usize,
    },
    /// An event with an end and nothing that could end.
    #[error("event {event}: a box stays where it is, for_s needs something that can be undone")]
    NothingToUndo {
        /// Counted from 1.
        event: usize,
    },
}

const NOT_NEGATIVE: &str = "a number from 0 up";
const POSITIVE: &str = "a number above 0";

impl Script {
    /// Reads a script.
    ///
    /// # Errors
    /// If it is not a script, or would do what makes no sense.
    pub fn parse(text: &str) -> Result<Self, ScriptError> {
        let script: Self =
            toml::from_str(text).map_err(|error| ScriptError::Syntax(error.to_string()))?;
        for (i, event) in script.event.iter().enumerate() {
            event.check(i + 1)?;
        }
        Ok(script)
    }
}

impl ScriptEvent {
    fn check(&self, event: usize) -> Result<(), ScriptError> {
        let range = |key, value: f64, ok: bool, wanted| {
            if ok { Ok(()) } else { Err(ScriptError::OutOfRange { event, key, value, wanted }) }
        };
        let not_negative =
            |key, value: f64| range(key, value, value.is_finite() && value >= 0.0, NOT_NEGATIVE);
        let positive =
            |key, value: f64| range(key, value, value.is_finite() && value > 0.0, POSITIVE);
        for (key, value) in [
            ("after_s", self.after_s),
            ("speed_mps", self.speed_mps),
            ("curvature_pm", self.curvature_pm),
            ("battery_v", self.battery_v),
            ("scan_delay_s", self.scan_delay_s),
        ] {
            value.map_or(Ok(()), |value| not_negative(key, value))?;
        }
        self.for_s.map_or(Ok(()), |value| positive("for_s", value))?;
        if let Some(thing) = self.drop_box {
            positive("drop_box.ahead_m", thing.ahead_m)?;
            positive("drop_box.length_m", thing.length_m)?;
            positive("drop_box.width_m", thing.width_m)?;
        }
        if let Some(plan) = &self.bus {
            let node = |key, node: usize| {
                range(key, node as f64, node <= 1, "0 (the daemon) or 1 (the car)")
            };
            let window = |from: f64, until: f64| {
                not_negative("from_s", from)?;
                range("until_s", until, until >= from, "a time that is not before from_s")
            };
            for fault in &plan.frames {
                let share = (0.0..=1.0).contains(&fault.probability);
                range("probability", fault.probability, share, "0 to 1")?;
                if let Harm::Delay { up_to_s } = fault.harm {
                    not_negative("up_to_s", up_to_s)?;
                }
                fault.receiver.map_or(Ok(()), |receiver| node("receiver", receiver))?;
                window(fault.from_s, fault.until_s)?;
            }
            for cut in &plan.cuts {
                node("node", cut.node)?;
                window(cut.from_s, cut.until_s)?;
            }
            for flood in &plan.floods {
                positive("period_s", flood.period_s)?;
                window(flood.from_s, flood.until_s)?;
            }
        }
        if !self.can_be_undone() {
            if self.drop_box.is_none() {
                return Err(ScriptError::Nothing { event });
            }
            if self.for_s.is_some() {
                return Err(ScriptError::NothingToUndo { event });
            }
        }
        Ok(())
    }

    fn can_be_undone(&self) -> bool {
        self.emergency_stop.is_some()
            || self.battery_v.is_some()
            || self.silence.as_ref().is_some_and(|classes| !classes.is_empty())
            || self.scan_delay_s.is_some()
            || self.bus.is_some()
    }

    /// Whether it strikes at a car of that speed (m/s) and curvature (1/m), so many seconds after
    /// its first motion, if it has moved at all.
    pub fn strikes(&self, moved_s: Option<f64>, speed_mps: f64, curvature_pm: f64) -> bool {
        let reached = |limit: Option<f64>, value: f64| limit.is_none_or(|limit| value >= limit);
        reached(self.after_s, moved_s.unwrap_or(f64::NEG_INFINITY))
            && reached(self.speed_mps, speed_mps)
            && reached(self.curvature_pm, curvature_pm.abs())
    }

    /// What it does, in a few words.
    pub fn text(&self) -> String {
        let mut parts = Vec::new();
        match self.emergency_stop {
            Some(true) => parts.push("emergency stop pressed".to_owned()),
            Some(false) => parts.push("emergency stop released".to_owned()),
            None => {}
        }
        if let Some(thing) = self.drop_box {
            parts.push(format!("a box {} m ahead", thing.ahead_m));
        }
        if let Some(volts) = self.battery_v {
            parts.push(format!("battery at {volts} V"));
        }
        if let Some(classes) = &self.silence {
            parts.push(format!("silent: {classes:?}").to_lowercase());
        }
        if let Some(seconds) = self.scan_delay_s {
            parts.push(format!("scans late by {seconds} s"));
        }
        if self.bus.is_some() {
            parts.push("faults on the bus".to_owned());
        }
        parts.join(", ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EVERYTHING: &str = r#"
        [[event]]
        emergency_stop = true

        [[event]]
        after_s = 2.0
        speed_mps = 2.5
        curvature_pm = 0.5
        for_s = 0.5
        silence = ["scan", "odometry", "status", "heartbeat"]
        scan_delay_s = 0.3
        battery_v = 9.0

        [[event]]
        speed_mps = 1
        drop_box = { ahead_m = 3.0, length_m = 0.2, width_m = 0.4 }

        [[event]]
        after_s = 1.0
        [event.bus]
        frames = [
            { harm = "loss", probability = 0.05 },
            { harm = { flip = { bits = 2 } }, probability = 0.1, receiver = 0, ids = [256, 257] },
            { harm = { delay = { up_to_s = 0.1 } }, probability = 1.0, from_s = 1, until_s = 2 },
            { harm = "duplicate", probability = 0.5 },
        ]
        cuts = [{ node = 1, from_s = 0.0, until_s = 0.2 }]
        floods = [{ id = 2047, period_s = 0.001, from_s = 0.0 }]
    "#;

    #[test]
    fn everything_that_can_happen_can_be_written() {
        let script = Script::parse(EVERYTHING).unwrap();
        assert_eq!(script.event.len(), 4);
        assert_eq!(script.event[0].emergency_stop, Some(true));
        assert_eq!(script.event[1].silence.as_deref(), Some(&MessageClass::ALL[..]));
        assert_eq!(script.event[2].drop_box.unwrap().width_m, 0.4);
        let bus = script.event[3].bus.as_ref().unwrap();
        assert_eq!((bus.frames.len(), bus.cuts.len(), bus.floods.len()), (4, 1, 1));
        assert_eq!(bus.frames[1].harm, Harm::Flip { bits: 2 });
        assert!(Script::parse("").unwrap().event.is_empty());
        assert!(script.event.iter().all(|event| !event.text().is_empty()));
    }

    #[test]
    fn unknown_keys_and_values_are_refused_by_name() {
        for (text, wanted) in [
            ("[[events]]\nafter_s = 1", "events"),
            ("[[event]]\nafter = 1\nbattery_v = 1.0", "after_s"),
            ("[[event]]\nemergency_stop = \"pressed\"", "emergency_stop"),
            ("[[event]]\nsilence = [\"lidar\"]", "scan"),
            ("[[event]]\n[event.bus]\nframe = []", "frames"),
            (
                "[[event]]\n[event.bus]\nframes = [{ harm = \"explode\", probability = 1.0 }]",
                "loss",
            ),
            ("[[event]]\ndrop_box = { ahead_m = 3.0, length_m = 0.2 }", "width_m"),
            ("[[event]]\nafter_s = 1", "event 1 does nothing"),
            ("[[event]]\nsilence = []", "event 1 does nothing"),
            ("[[event]]\nafter_s = -1\nbattery_v = 1.0", "event 1: after_s is -1"),
            ("[[event]]\nbattery_v = 1.0\n[[event]]\nscan_delay_s = nan", "event 2: scan_delay_s"),
            ("[[event]]\nbattery_v = 1.0\nfor_s = 0", "for_s is 0, allowed is a number above 0"),
            (
                "[[event]]\nfor_s = 1.0\ndrop_box = { ahead_m = 3.0, length_m = 0.2, width_m = 1.0 }",
                "a box stays",
            ),
            (
                "[[event]]\n[event.bus]\nframes = [{ harm = \"loss\", probability = 5 }]",
                "probability is 5, allowed is 0 to 1",
            ),
            ("[[event]]\n[event.bus]\ncuts = [{ node = 2, from_s = 0.0 }]", "node is 2"),
            (
                "[[event]]\n[event.bus]\nfloods = [{ id = 1, period_s = 0.0, from_s = 0.0 }]",
                "period_s is 0",
            ),
        ] {
            let error = Script::parse(text).unwrap_err().to_string();
            assert!(error.contains(wanted), "{text}: {error}");
        }
    }

    #[test]
    fn an_event_strikes_when_all_of_its_conditions_hold() {
        let event = |after_s, speed_mps, curvature_pm| ScriptEvent {
            after_s,
            speed_mps,
            curvature_pm,
            ..ScriptEvent::default()
        };
        assert!(event(None, None, None).strikes(None, 0.0, 0.0));
        assert!(!event(Some(0.0), None, None).strikes(None, 3.0, 0.0), "has not moved");
        assert!(event(Some(0.0), None, None).strikes(Some(0.0), 0.0, 0.0));
        let all = event(Some(2.0), Some(1.5), Some(0.5));
        assert!(all.strikes(Some(2.0), 1.5, -0.5));
        assert!(!all.strikes(Some(1.9), 1.5, 0.5));
        assert!(!all.strikes(Some(2.0), 1.4, 0.5));
        assert!(!all.strikes(Some(2.0), 1.5, 0.4));
    }
}
