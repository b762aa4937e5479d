//! What the daemon itself can be told.

use crate::tunables;

tunables! {
    /// The daemon.
    pub struct DaemonParams in "daemon" {
        /// Real-time priority (SCHED_FIFO) of the control thread; 0 leaves it to the ordinary
        /// scheduler.
        priority: u32 = 50, restart, in 0..=99, "";
        /// Keep all memory in RAM, so that no page fault holds up the control thread.
        lock_memory: bool = true, restart;
        /// Granted to the car for coming to rest along its plan when the daemon is told to end; it is
        /// told to brake then.
        stop_time_limit_s: f64 = 10.0, live, in 0.1..=120.0, "s";
        /// A planner that has not answered for this long is given up: the daemon ends, with the car
        /// at rest, for a fresh one to be started.
        planner_limit_s: f64 = 10.0, live, in 0.5..=600.0, "s";
        /// Where the daemon notes that it runs, to tell after a crash; if empty, the folder that
        /// systemd names (STATE_DIRECTORY), else none.
        state_directory: String = "", restart;
        /// Less free space than this on the disk of the state directory or the logs counts as a full
        /// disk.
        disk_free_min_mb: u32 = 16, live, in 0..=1000000, "MB";
        /// Keep a log of every run, from which `apexd replay` drives it again.
        record: bool = true, restart;
        /// The folder of these logs; if empty, the one that systemd names (LOGS_DIRECTORY), else
        /// `logs` in the state directory, and no logs without one.
        log_directory: String = "", restart;
        /// A log that is longer goes on in another file.
        log_part_mb: u32 = 256, restart, in 1..=4000, "MB";
        /// When all logs together are longer than this, the oldest ones are deleted.
        log_kept_mb: u32 = 2000, restart, in 2..=10000000, "MB";
        /// When there are more files than this, the oldest ones are deleted.
        log_kept_files: u32 = 100, restart, in 2..=100000, "";
    }
}
