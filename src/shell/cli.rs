//! The command line's grammar.

mod config;
mod drive;
pub mod experiment;
mod run;
mod scene;
mod value;

use std::path::PathBuf;

use clap::{ArgAction, Args, Parser, Subcommand};

pub use config::{ConfigArgs, Flag};
pub use drive::{CarArgs, SilArgs};
pub use run::RunArgs;
pub use scene::{DatasetArgs, EvaluateArgs};

use crate::sim::maze::Family;
use experiment::ExperimentArgs;
use value::family;

/// Drives an RC-scale car fast and safely through places it has never seen.
///
/// Exit codes: 0 done and goal reached; 1 the run failed (stuck, out of time, collision,
/// unreachable); 2 bad usage or bad input; 75 a ground station asked for a restart; 78 bad
/// configuration (file, environment or --set).
#[derive(Debug, Parser)]
#[command(name = "apexd", version)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
    /// Log more to standard error; twice for even more.
    #[arg(short, long, global = true, action = ArgAction::Count)]
    pub verbose: u8,
}

/// What the program can do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Drive a simulated car to a goal.
    Sil(Box<SilArgs>),
    /// Drive the car on a CAN bus: the daemon.
    Run(Box<RunArgs>),
    /// Be the simulated car on a CAN interface.
    ///
    /// In real time, with the worlds, the lidar and the controller of `apexd sil`; the daemon
    /// (`apexd run`) is another process. The car starts when it is told to and the drive is over
    /// when it has stood at the goal for a second.
    Car(Box<CarArgs>),
    /// Write a maze as ROS map_server files.
    Maze(MazeArgs),
    /// Make training or held-out data for the predictor.
    Dataset(Box<DatasetArgs>),
    /// Score what predicts occupancy, on scenes that it has not seen.
    Evaluate(Box<EvaluateArgs>),
    /// Re-run the paper's experiments, or look for unsafe drives at random.
    Experiment(ExperimentArgs),
    /// Feed the log of a drive to the autopilot again, and compare what it does.
    ///
    /// The log is one of `apexd sil --log` or of the daemon (`apexd run`). Exit codes: 0 everything
    /// is to the last bit what it was (or --set was given), 1 something differs or a part of the log
    /// is missing, 2 the log cannot be read or replayed.
    Replay(ReplayArgs),
    /// Print the table of parameters.
    Params(ParamsArgs),
    /// Say what is wrong with a configuration file.
    Check(CheckArgs),
}

/// Options of `apexd maze`.
#[derive(Args, Debug)]
pub struct MazeArgs {
    /// Number of the maze.
    #[arg(long)]
    pub seed: u64,
    /// Kind of maze.
    #[arg(long, value_parser = family(), default_value = Family::Thin.name())]
    pub family: Family,
    /// The YAML file to write; the picture is put beside it.
    #[arg(long, value_name = "FILE.yaml")]
    pub out: PathBuf,
}

/// Options of `apexd replay`.
#[derive(Args, Clone, Debug)]
pub struct ReplayArgs {
    /// The log, or its first part; further parts are read from files beside it.
    #[arg(value_name = "FILE.mcap")]
    pub file: PathBuf,
    /// Set one parameter, over those of the log, to see what would have come of it; may be repeated.
    /// The car still moves as it did then. Differences are no failure then.
    #[arg(
        long,
        value_name = "SECTION.KEY=VALUE",
        allow_hyphen_values = true,
        help_heading = "Configuration"
    )]
    pub set: Vec<String>,
    /// Print the comparison as one JSON object.
    #[arg(long, help_heading = "Output")]
    pub json: bool,
}

/// Options of `apexd params`.
#[derive(Args, Clone, Copy, Debug)]
pub struct ParamsArgs {
    /// As one JSON object.
    #[arg(long)]
    pub json: bool,
    /// As a Markdown page.
    #[arg(long, conflicts_with = "json")]
    pub markdown: bool,
}

/// Options of `apexd check`.
#[derive(Args, Debug)]
pub struct CheckArgs {
    /// The file to check.
    pub file: PathBuf,
    /// As one JSON object.
    #[arg(long)]
    pub json: bool,
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_grammar_is_sound() {
        Cli::command().debug_assert();
    }

    #[test]
    fn every_command_and_option_has_a_help_text() {
        for command in Cli::command().get_subcommands() {
            assert!(command.get_about().is_some(), "{}", command.get_name());
            for option in command.get_arguments() {
                let text = option.get_help().map(ToString::to_string).unwrap_or_default();
                assert!(!text.is_empty(), "{} {}", command.get_name(), option.get_id());
            }
        }
    }
}
