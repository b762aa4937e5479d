//! Lets simulated time run: as fast as the machine allows or at the pace of the clock on the wall,
//! until the drive has ended or a person ends it.

use std::time::{Duration, Instant};

use tokio::runtime;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::time::{MissedTickBehavior, interval};

use crate::sim::rig::Rig;

/// Between two looks at signals and clock at most so many simulated milliseconds pass.
const SLICE_STEPS: u32 = 50;
/// How often simulated time is brought up to the clock.
const TICK: Duration = Duration::from_millis(5);

/// The clock on the wall. It only goes forward.
#[expect(clippy::disallowed_methods, reason = "the shell may ask for the time")]
pub fn now() -> Instant {
    Instant::now()
}

/// Drives to the end; `each` is called some twenty times or more a simulated second. Ctrl-C and
/// SIGTERM bring the car to rest first; a second one ends the drive where it is.
pub fn drive(rig: &mut Rig, realtime: bool, mut each: impl FnMut(&mut Rig)) -> std::io::Result<()> {
    let runtime = runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        let mut interrupt = signal(SignalKind::interrupt())?;
        let mut terminate = signal(SignalKind::terminate())?;
        let mut asked = false;
        let mut ticks = interval(TICK);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let begin = now();
        while rig.outcome().is_none() {
            tokio::select! {
                biased;
                () = asked_to_end(&mut interrupt, &mut terminate) => {
                    if asked {
                        break;
                    }
                    asked = true;
                    tracing::warn!("interrupted: the car comes to rest");
                    rig.interrupt();
                }
                _ = ticks.tick(), if realtime => {}
                // Gives the signals their turn.
                () = tokio::task::yield_now(), if !realtime => {}
            }
            let due = if realtime { begin.elapsed() } else { Duration::MAX };
            for _ in 0..SLICE_STEPS {
                if rig.outcome().is_some() || rig.now().since(crate::time::Instant::ZERO) >= due {
                    break;
                }
                rig.step();
            }
            each(rig);
        }
        Ok(())
    })
}

async fn asked_to_end(interrupt: &mut Signal, terminate: &mut Signal) {
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
    }
}
