//! `apexd dataset`.

use std::io::Write;

use super::cli::DatasetArgs;
use super::progress::Terminal;
use super::{Exit, complain, say};
use crate::experiment::dataset::{self, DatasetError};

/// Makes the data set and says what it is.
pub fn run(args: &DatasetArgs, terminal: &Terminal, out: &mut dyn Write) -> Exit {
    let bar = terminal.count_bar("scenes");
    let made =
        dataset::generate(&args.settings(), &args.maps, &args.out, args.force, &|done, total| {
            bar.show(done, total)
        });
    bar.finish();
    match made {
        Ok(manifest) if args.json => {
            say(out, &serde_json::to_string(&manifest).expect("a manifest is plain data"));
            Exit::Done
        }
        Ok(manifest) => {
            let kind = if args.held_out { "held-out" } else { "training" };
            let scenes = manifest.scenes;
            say(out, &format!("{scenes} {kind} scenes in {}", args.out.display()));
            Exit::Done
        }
        Err(error) => {
            complain(&error.to_string());
            match error {
                DatasetError::File { .. } => Exit::Failed,
                _ => Exit::Usage,
            }
        }
    }
}
