//! What the system grants to a thread that must not be late.

use nix::sys::mman::{MlockAllFlags, mlockall};
use thread_priority::unix::{
    RealtimeThreadSchedulePolicy, ThreadSchedulePolicy, set_thread_priority_and_policy,
    thread_native_id,
};
use thread_priority::{ThreadPriority, ThreadPriorityValue};

/// Keeps all memory of the process in RAM, now and later.
pub fn lock_memory() {
    match mlockall(MlockAllFlags::MCL_CURRENT | MlockAllFlags::MCL_FUTURE) {
        Ok(()) => tracing::info!("memory locked"),
        Err(error) => tracing::warn!(
            "memory is not locked ({error}): page faults may delay the control tick; grant \
             CAP_IPC_LOCK or a larger memlock limit, or set daemon.lock_memory to false"
        ),
    }
}

/// Gives the calling thread a priority over all ordinary ones; 0 leaves it as it is.
pub fn raise_priority(priority: u32) {
    if priority == 0 {
        return;
    }
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    let set = u8::try_from(priority)
        .ok()
        .and_then(|priority| ThreadPriorityValue::try_from(priority).ok())
        .map(|value| {
            let value = ThreadPriority::Crossplatform(value);
            set_thread_priority_and_policy(thread_native_id(), value, policy)
        });
    match set {
        Some(Ok(())) => tracing::info!(priority, "control thread has real-time priority"),
        refused => tracing::warn!(
            priority,
            "control thread has no real-time priority ({}): grant CAP_SYS_NICE or a real-time \
             priority limit, or set daemon.priority to 0",
            refused.map_or("not a priority".to_owned(), |result| {
                result.expect_err("the other arm takes success").to_string()
            })
        ),
    }
}
