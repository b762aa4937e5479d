//! `apexd replay`: a log, and what the autopilot makes of it now.

use std::fs::File;
use std::io::{BufReader, Write};
use std::path::Path;

use super::cli::ReplayArgs;
use super::progress::Terminal;
use super::{Exit, complain, say, shelved, shown};
use crate::record::{Comparison, Ended, LogError, LogReader, ReplayError, replay};

/// What one step of the progress bar stands for, bytes.
const STEP_BYTES: u64 = 1000;

/// Replays a log.
pub fn run(args: &ReplayArgs, terminal: &Terminal, out: &mut dyn Write) -> Exit {
    let bar = terminal.count_bar("kB");
    let compared = open(&args.file).and_then(|log| {
        let next = |part| open_part(&args.file, part);
        replay(log, next, &args.set, |part, bytes| {
            let file = shelved::part_of(&args.file, part);
            let whole = file.metadata().map_or(bytes, |about| about.len());
            bar.show((bytes / STEP_BYTES) as usize, (whole / STEP_BYTES) as usize);
        })
    });
    bar.finish();
    let comparison = match compared {
        Ok(comparison) => comparison,
        Err(ReplayError::Set(faults)) => {
            complain(&format!("bad configuration\n{faults}"));
            return Exit::Configuration;
        }
        Err(error) => {
            complain(&format!("{}: {error}", shown(&args.file)));
            return Exit::Usage;
        }
    };
    if args.json {
        say(out, &serde_json::to_string(&comparison).expect("a comparison is plain data"));
    } else {
        say(out, &text(&comparison));
    }
    let whole = comparison.identical && comparison.ended != Ended::Gap;
    if whole || !args.set.is_empty() { Exit::Done } else { Exit::Failed }
}

fn open(file: &Path) -> Result<LogReader<BufReader<File>>, ReplayError> {
    let input = File::open(file).map_err(LogError::Io)?;
    Ok(LogReader::new(BufReader::new(input))?)
}

/// A further part, if it is there.
fn open_part(first: &Path, part: u32) -> Result<Option<LogReader<BufReader<File>>>, LogError> {
    match File::open(shelved::part_of(first, part)) {
        Ok(input) => LogReader::new(BufReader::new(input)).map(Some),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error.into()),
    }
}

/// The comparison for a person, without a line break at its end.
fn text(c: &Comparison) -> String {
    let mut lines = Vec::new();
    if c.identical {
        lines.push(format!("identical: {} frames, {} plans", c.frames, c.plans));
    } else {
        lines.push(format!(
            "different: {} of {} frames, {} of {} plans",
            c.frames_differing, c.frames, c.plans_differing, c.plans
        ));
    }
    if let Some(first) = &c.first {
        lines.push(format!("  first at         {:.3} s, a {}", first.t_s, first.what));
        lines.push(format!("    then           {}", first.then));
        lines.push(format!("    now            {}", first.now));
        let s = &c.setpoints;
        lines.push(format!(
            "  setpoints apart  {:.3} N rms, {:.3} N at most, over {} ticks",
            s.rms_n, s.max_n, s.compared
        ));
    }
    let parts = if c.parts > 1 { format!(" in {} parts", c.parts) } else { String::new() };
    let source = match c.source {
        crate::record::Source::Sil => "sil",
        crate::record::Source::Run => "run",
    };
    lines.push(format!(
        "  log              {:.1} s{parts}, begun {} by apexd {} {source}",
        c.time_s, c.begun_utc, c.build
    ));
    match c.ended {
        Ended::Closed => {}
        Ended::CutOff => lines.push("  it is cut off: its writer ended unexpectedly".into()),
        Ended::Gap => lines.push("  then pieces are missing; nothing behind is compared".into()),
    }
    lines.push(format!("  setpoints        digest {} then, {} now", c.digest_then, c.digest_now));
    lines.join("\n")
}
