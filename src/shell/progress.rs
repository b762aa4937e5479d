//! What a person sees while a run lasts: a bar and the log, both on standard error.

use std::io::{IsTerminal, Write};

use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};
use tracing::level_filters::LevelFilter;

use super::sil::Progress;

/// Steps of a full bar.
const STEPS: u64 = 1000;

/// Standard error: where it is a terminal, log lines go above the bar.
pub struct Terminal {
    bars: MultiProgress,
}

impl Terminal {
    /// Sets up the log: warnings, with one `-v` what is done, with two why.
    pub fn new(verbose: u8) -> Self {
        let level = match verbose {
            0 => LevelFilter::WARN,
            1 => LevelFilter::INFO,
            2 => LevelFilter::DEBUG,
            _ => LevelFilter::TRACE,
        };
        // Draws nothing where standard error is no terminal.
        let bars = MultiProgress::with_draw_target(ProgressDrawTarget::stderr());
        let above = bars.clone();
        let log = tracing_subscriber::fmt()
            .with_max_level(level)
            .with_target(verbose > 1)
            .with_ansi(std::io::stderr().is_terminal())
            .with_writer(move || AboveBar(above.clone()))
            .finish();
        // A second log in one process (tests) is not worth a word: the first one serves.
        let _ = tracing::subscriber::set_global_default(log);
        Self { bars }
    }

    /// A bar for one drive.
    pub fn bar(&self) -> Bar {
        let style = ProgressStyle::with_template("{bar:18} {wide_msg}")
            .expect("the template is valid")
            .progress_chars("━╸ ");
        let bar = self.bars.add(ProgressBar::new(STEPS).with_style(style));
        Bar { bar }
    }

    /// A bar that counts; `what` names the things counted.
    pub fn count_bar(&self, what: &'static str) -> CountBar {
        let style =
            ProgressStyle::with_template("{bar:18} {pos} of {len} {msg}, {elapsed}, {eta} to go")
                .expect("the template is valid")
                .progress_chars("━╸ ");
        let bar = self.bars.add(ProgressBar::new(0).with_style(style).with_message(what));
        CountBar { bar }
    }
}

/// The bar of something that is counted.
pub struct CountBar {
    bar: ProgressBar,
}

impl CountBar {
    /// Shows how many are done.
    pub fn show(&self, done: usize, total: usize) {
        self.bar.set_length(total as u64);
        self.bar.set_position(done as u64);
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

/// The bar of one drive.
pub struct Bar {
    bar: ProgressBar,
}

impl Bar {
    /// Shows how far the drive has come. In a place nobody has seen the way that remains is a
    /// guess, so the bar may go back.
    pub fn show(&self, progress: &Progress) {
        self.bar.set_position((share(progress) * STEPS as f64) as u64);
        self.bar.set_message(text(progress));
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

/// Which part of the way is done, from 0 to 1.
fn share(progress: &Progress) -> f64 {
    let whole = progress.distance_m + progress.remaining_m;
    if whole > 0.0 { (progress.distance_m / whole).clamp(0.0, 1.0) } else { 0.0 }
}

fn text(progress: &Progress) -> String {
    format!(
        "{:5.1} m driven {:5.1} m to go {:4.1} m/s {:4} replans {:5.1} s",
        progress.distance_m,
        progress.remaining_m,
        progress.speed_mps,
        progress.replans,
        progress.time_s
    )
}

/// Writes log lines so that they do not end up inside the bar.
struct AboveBar(MultiProgress);

impl Write for AboveBar {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.suspend(|| std::io::stderr().write(bytes))
    }

    fn flush(&mut self) -> std::io::Result<()> {
        std::io::stderr().flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bar_shows_the_part_of_the_way_that_is_done() {
        let at = |distance_m, remaining_m| {
            share(&Progress { distance_m, remaining_m, ..Progress::default() })
        };
        assert_eq!((at(0.0, 0.0), at(0.0, 10.0), at(5.0, 15.0)), (0.0, 0.0, 0.25));
        assert_eq!((at(5.0, 0.0), at(5.0, f64::INFINITY), at(5.0, f64::NAN)), (1.0, 0.0, 0.0));
    }

    #[test]
    fn the_text_names_speed_distance_and_replans() {
        let progress = Progress {
            time_s: 6.25,
            speed_mps: 3.94,
            distance_m: 12.3,
            remaining_m: 20.1,
            replans: 214,
        };
        assert_eq!(text(&progress), " 12.3 m driven  20.1 m to go  3.9 m/s  214 replans   6.2 s");
    }
}
