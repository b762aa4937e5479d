//! The only part that knows clocks, files, terminals and threads: the command line, what a run
//! shows while it lasts, and what it leaves behind.

pub mod can;
pub mod car;
pub mod cli;
pub mod clock;
mod configuration;
pub mod daemon;
mod dataset;
mod evaluate;
mod experiment;
mod folder;
mod load;
mod logbook;
pub mod mavlink;
mod pace;
pub mod place;
mod progress;
mod replay;
pub mod report;
mod shelved;
pub mod sil;
mod simulator;
mod watch;

use std::ffi::OsString;
use std::io::Write;
use std::path::Path;
use std::process::ExitCode;

use clap::Parser;

use crate::params::{Origin, Params, document};
use crate::sim::drive::Outcome;
use cli::{CarArgs, CheckArgs, Cli, Command, ConfigArgs, Flag, MazeArgs, ParamsArgs, SilArgs};
use progress::Terminal;
use sil::{RunError, Simulator};
use simulator::RigSimulator;

/// How a command ends, for scripts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Exit {
    /// Done, and the goal was reached where there is one.
    Done = 0,
    /// The run failed: stuck, out of time, collision, unreachable.
    Failed = 1,
    /// Bad usage or bad input.
    Usage = 2,
    /// Ended in order to be started anew (`EX_TEMPFAIL`): a service manager takes it for a failure.
    Restart = 75,
    /// Bad configuration: file, environment or `--set` (`EX_CONFIG` of sysexits.h).
    Configuration = 78,
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit as u8)
    }
}

/// The whole program: reads command line and environment, does what they say.
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    let environment: Vec<(OsString, OsString)> = std::env::vars_os().collect();
    // The daemon has a log of its own.
    if let Command::Run(args) = &cli.command {
        return daemon::run(args, &environment, cli.verbose, &mut std::io::stdout()).into();
    }
    let terminal = Terminal::new(cli.verbose);
    execute(&cli, &environment, &RigSimulator, &terminal, &mut std::io::stdout()).into()
}

/// Does what a parsed command line says; results go to `out`, everything else to standard error.
fn execute(
    cli: &Cli,
    environment: &[(OsString, OsString)],
    simulator: &dyn Simulator,
    terminal: &Terminal,
    out: &mut dyn Write,
) -> Exit {
    match &cli.command {
        Command::Sil(args) => drive(args, environment, simulator, terminal, out),
        Command::Run(args) => daemon::run(args, environment, cli.verbose, out),
        Command::Car(args) => car(args, environment, out),
        Command::Maze(args) => maze(args, simulator, out),
        Command::Dataset(args) => dataset::run(args, terminal, out),
        Command::Evaluate(args) => evaluate::run(args, terminal, out),
        Command::Experiment(args) => experiment::run(args, terminal, out),
        Command::Replay(args) => replay::run(args, terminal, out),
        Command::Params(args) => params(*args, out),
        Command::Check(args) => check(args, out),
    }
}

fn drive(
    args: &SilArgs,
    environment: &[(OsString, OsString)],
    simulator: &dyn Simulator,
    terminal: &Terminal,
    out: &mut dyn Write,
) -> Exit {
    let params = match configured(&args.config, environment, &args.flags()) {
        Ok(params) => params,
        Err(exit) => return exit,
    };
    let folder = match folder::prepare(args.out.as_deref()) {
        Ok(folder) => folder,
        Err(error) => {
            complain(&error.to_string());
            return Exit::Usage;
        }
    };
    let request = args.request(params, folder);
    tracing::info!(title = request.title(), out = %request.out.display(), "driving");
    let bar = terminal.bar();
    let result = simulator.drive(&request, &mut |progress| bar.show(progress));
    bar.finish();
    let record = match result {
        Ok(record) => record,
        Err(error) => {
            folder::discard_if_empty(&request.out);
            return refuse(&error);
        }
    };
    let written = report::write(&request.out, &record);
    let summary = &record.summary;
    if args.json {
        say(out, &serde_json::to_string(summary).expect("a summary is plain data"));
    } else {
        say(out, &sil::summary_text(summary));
        if written.is_ok() {
            say(out, &format!("  report          {}", request.out.display()));
        }
    }
    if let Err(error) = written {
        complain(&error.to_string());
        return Exit::Failed;
    }
    let done = match summary.outcome {
        Outcome::Goal => true,
        // Nothing was asked of the drive itself.
        Outcome::Interrupted => request.is_attended(),
        _ => false,
    };
    if done { Exit::Done } else { Exit::Failed }
}

fn car(args: &CarArgs, environment: &[(OsString, OsString)], out: &mut dyn Write) -> Exit {
    let params = match configured(&args.config, environment, &args.flags()) {
        Ok(params) => params,
        Err(exit) => return exit,
    };
    let end = match car::drive(&args.request(params)) {
        Ok(end) => end,
        Err(error) => return refuse(&error),
    };
    if args.json {
        say(out, &serde_json::to_string(&end).expect("a summary is plain data"));
    } else {
        say(out, &end.text());
    }
    if end.summary.outcome == Outcome::Goal { Exit::Done } else { Exit::Failed }
}

/// The parameters of a run, or how it ends because they are bad.
fn configured(
    args: &ConfigArgs,
    environment: &[(OsString, OsString)],
    flags: &[Flag],
) -> Result<Params, Exit> {
    configuration::load(args, environment, flags).map_err(|faults| {
        if faults.0.iter().all(|fault| matches!(fault.origin, Origin::Flag { .. })) {
            complain(&faults.to_string());
            Exit::Usage
        } else {
            complain(&format!("bad configuration\n{faults}"));
            Exit::Configuration
        }
    })
}

fn maze(args: &MazeArgs, simulator: &dyn Simulator, out: &mut dyn Write) -> Exit {
    match simulator.write_maze(args.seed, args.family, &args.out) {
        Ok(()) => {
            say(out, &format!("wrote {}", args.out.display()));
            Exit::Done
        }
        Err(error) => refuse(&error),
    }
}

fn params(args: ParamsArgs, out: &mut dyn Write) -> Exit {
    let text = if args.json {
        document::json().to_string()
    } else if args.markdown {
        document::markdown()
    } else {
        document::plain_text()
    };
    say(out, text.trim_end_matches('\n'));
    Exit::Done
}

fn check(args: &CheckArgs, out: &mut dyn Write) -> Exit {
    let checked = configuration::check(&args.file);
    let faults: Vec<String> = checked
        .err()
        .map_or_else(Vec::new, |faults| faults.0.iter().map(ToString::to_string).collect());
    let ok = faults.is_empty();
    if args.json {
        say(out, &serde_json::json!({ "ok": ok, "faults": faults }).to_string());
    } else if ok {
        say(out, &format!("{}: ok", args.file.display()));
    } else {
        say(out, &faults.join("\n"));
    }
    if ok { Exit::Done } else { Exit::Configuration }
}

fn refuse(error: &RunError) -> Exit {
    complain(&error.to_string());
    match error {
        RunError::Input(_) => Exit::Usage,
        RunError::Failed(_) => Exit::Failed,
    }
}

/// One or more lines of results. Nobody reading any longer (`apexd params | head`) is no fault.
fn say(out: &mut dyn Write, text: &str) {
    if let Err(error) = writeln!(out, "{text}").and_then(|()| out.flush())
        && error.kind() != std::io::ErrorKind::BrokenPipe
    {
        complain(&format!("cannot write to standard output: {error}"));
    }
}

/// What went wrong, for a person.
fn complain(text: &str) {
    eprintln!("apexd: {text}");
}

/// A path as messages show it.
fn shown(path: &Path) -> String {
    path.display().to_string()
}

#[cfg(test)]
mod tests;
