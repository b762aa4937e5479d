//! The options of the daemon.

use clap::Args;

use super::value::{point, pose, positive};
use super::{ConfigArgs, Flag};
use crate::frames::{Point, Pose};
use crate::tunable::Value;

/// Options of `apexd run`.
///
/// Runs until it is told to end (Ctrl-C, SIGTERM): the car then comes to rest first, and the exit
/// code is 0; told again, it ends at once. SIGHUP or a change of the configuration file re-reads
/// the configuration: parameters that take effect at once do so, those that wait for rest if the
/// car is at rest, and the others are refused by name.
#[derive(Args, Debug)]
pub struct RunArgs {
    /// Where the car stands when the daemon starts: metres in the map frame, degrees
    /// counter-clockwise from map x. 0,0,0 if not given.
    #[arg(
        long,
        value_name = "X,Y,DEG",
        value_parser = pose,
        allow_hyphen_values = true,
        help_heading = "Drive"
    )]
    pub start: Option<Pose>,
    /// Where to drive: metres in the map frame. The daemon arms by itself as soon as the checks
    /// pass, and says what it waits for; not after a run that ended unexpectedly.
    #[arg(
        long,
        value_name = "X,Y",
        value_parser = point,
        allow_hyphen_values = true,
        help_heading = "Drive"
    )]
    pub goal: Option<Point>,
    /// End at the goal instead of waiting there, armed, for another one.
    #[arg(long, requires = "goal", help_heading = "Drive")]
    pub until_goal: bool,
    /// End after so many seconds, the car at rest; a goal not reached by then is a failure.
    #[arg(long, value_name = "SECONDS", value_parser = positive, help_heading = "Drive")]
    pub time_limit: Option<f64>,

    /// The CAN interface [parameter can.interface].
    #[arg(long, value_name = "IFACE", help_heading = "Configuration")]
    pub can: Option<String>,
    /// Where parameters come from.
    #[command(flatten)]
    pub config: ConfigArgs,

    /// Print the statistics as one JSON object at the end.
    #[arg(long, help_heading = "Output")]
    pub json: bool,
}

impl RunArgs {
    /// The parameters that have options of their own, as far as they are given.
    pub(in crate::shell) fn flags(&self) -> Vec<Flag> {
        let interface = self.can.clone().map(Value::Text);
        Flag::given("--can", "can.interface", interface).into_iter().collect()
    }
}
