//! Writes down what happens to the core.

use std::sync::{Arc, Mutex, PoisonError};

use super::digest::plan_digest;
use super::entry::Entry;
use crate::autopilot::{Event, Happening, Witness};
use crate::plan::{StepReport, Stopwatch};
use crate::predict::PredictFault;
use crate::time::{Duration, Instant};

/// Between two notes of where the car is.
const STATE_PERIOD: Duration = Duration::from_millis(50);

/// What the planner's clock showed during the step under way. A step whose prediction takes too long
/// goes on without: there, and only there, the clock has a say in a plan. Nothing is kept until a
/// [Scribe] begins to forget: nobody else does.
#[derive(Clone, Debug, Default)]
pub struct Readings(Arc<Mutex<Option<Vec<Duration>>>>);

impl Readings {
    /// Keeps what a clock shows, from the first step on that a [Scribe] has seen begin.
    pub fn keep(&self, clock: Stopwatch) -> Stopwatch {
        let readings = Arc::clone(&self.0);
        Box::new(move || {
            let now = clock();
            if let Some(kept) = &mut *readings.lock().unwrap_or_else(PoisonError::into_inner) {
                kept.push(now);
            }
            now
        })
    }

    /// A step begins.
    fn forget(&self) {
        let mut readings = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        readings.get_or_insert_default().clear();
    }

    /// Time after the reading before, of each.
    fn steps(&self) -> Vec<Duration> {
        let readings = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let readings = readings.as_deref().unwrap_or_default();
        let first = readings.first().copied().unwrap_or_default();
        let before = std::iter::once(first).chain(readings.iter().copied());
        readings.iter().zip(before).map(|(now, before)| now.saturating_sub(before)).collect()
    }
}

/// Whether the clock had a say in a step.
fn is_timed(report: &StepReport) -> bool {
    matches!(report.prediction.fault, Some(PredictFault::TooSlow { .. }))
}

/// The witness that makes entries of what happens.
pub struct Scribe<F> {
    put: F,
    readings: Readings,
    next_state: Instant,
}

impl<F: FnMut(Instant, Entry) + Send> Scribe<F> {
    /// Hands entries to `put`; `readings` are those of the planner's clock.
    pub fn new(readings: Readings, put: F) -> Self {
        Self { put, readings, next_state: Instant::ZERO }
    }
}

impl<F: FnMut(Instant, Entry) + Send> Witness for Scribe<F> {
    fn note(&mut self, at: Instant, happening: Happening<'_>) {
        let entry = match happening {
            Happening::Frame(frame) => Entry::Received(*frame),
            Happening::Time => Entry::Time,
            Happening::JobDone(report) => Entry::PlanDone {
                number: report.number,
                digest: plan_digest(report),
                readings: if is_timed(report) { self.readings.steps() } else { Vec::new() },
            },
            Happening::JobLost { number } => Entry::PlanLost { number },
            Happening::Command(command) => Entry::Command(*command),
            Happening::Bus(health) => Entry::Bus(*health),
            Happening::Host(health) => Entry::Host(*health),
            Happening::Fence(fence) => Entry::Fence(Box::new(fence.clone())),
            Happening::Sent(frame) => Entry::Sent(*frame),
            Happening::JobAsked { number } => {
                self.readings.forget();
                Entry::PlanAsked { number }
            }
            Happening::Event(event) => Entry::Event(event_json(event)),
            Happening::State { state, mode } => {
                if at < self.next_state {
                    return;
                }
                self.next_state = at + STATE_PERIOD;
                let mut json = serde_json::json!({ "mode": mode.name() });
                if let Some((pose, speed_mps)) = state {
                    json["x_m"] = pose.position.x.into();
                    json["y_m"] = pose.position.y.into();
                    json["heading_rad"] = pose.heading_rad.into();
                    json["speed_mps"] = speed_mps.into();
                }
                Entry::State(json.to_string())
            }
        };
        (self.put)(at, entry);
    }
}

/// An event as a reader of logs sees it.
fn event_json(event: &Event) -> String {
    let (name, text) = match event {
        Event::ModeChanged { from, to, .. } => {
            ("mode", format!("{} -> {}", from.name(), to.name()))
        }
        Event::FaultRaised { fault, .. } => ("fault raised", fault.name().to_owned()),
        Event::FaultCleared { fault, .. } => ("fault cleared", fault.name().to_owned()),
        Event::PlanAdopted { number, length_m, .. } => {
            ("plan adopted", format!("plan {number}, {length_m:.2} m"))
        }
        Event::PlanRejected { number, rejection } => {
            ("no plan", format!("plan {number}: {rejection:?}"))
        }
        Event::PredictionPassedOver { number, .. } => {
            ("prediction passed over", format!("plan {number}"))
        }
        Event::PredictionFault { number, fault, .. } => {
            ("prediction fault", format!("plan {number}: {fault}"))
        }
        Event::PlanLate { number } => ("plan late", format!("plan {number}")),
        Event::PlanShortened { number, .. } => ("plan shortened", format!("plan {number}")),
        Event::GoalReached { position, .. } => {
            ("goal reached", format!("({:.3}, {:.3}) m", position.x, position.y))
        }
    };
    serde_json::json!({ "event": name, "text": text }).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_a_scribe_nothing_that_a_clock_shows_is_kept() {
        let readings = Readings::default();
        let mut passed = 0;
        let clock = std::sync::atomic::AtomicU64::new(0);
        let ticking =
            move || Duration::from_millis(clock.fetch_add(1, std::sync::atomic::Ordering::Relaxed));
        let clock = readings.keep(Box::new(ticking));
        for _ in 0..1000 {
            passed = clock().as_millis();
        }
        assert_eq!(passed, 999, "the clock goes on");
        assert!(readings.0.lock().unwrap().is_none() && readings.steps().is_empty());
        let mut scribe = Scribe::new(readings.clone(), |_, _| {});
        for number in 0..3 {
            scribe.note(Instant::ZERO, Happening::JobAsked { number });
            let _ = (clock(), clock());
            let step = Duration::from_millis(1);
            assert_eq!(readings.steps(), [Duration::ZERO, step], "those of one step");
        }
    }
}
