//! The `apexd` binary.

use std::path::Path;
use std::process::ExitCode;

use apexd::shell::cli::Family;
use apexd::shell::report::DriveRecord;
use apexd::shell::sil::{Progress, RunError, SilRequest, Simulator};

/// Stands where the simulator is to be connected.
struct NotConnected;

impl Simulator for NotConnected {
    fn drive(
        &self,
        _request: &SilRequest,
        _progress: &mut dyn FnMut(&Progress),
    ) -> Result<DriveRecord, RunError> {
        Err(RunError::Failed("no simulator is connected".into()))
    }

    fn write_maze(&self, _seed: u64, _family: Family, _out: &Path) -> Result<(), RunError> {
        Err(RunError::Failed("no simulator is connected".into()))
    }
}

fn main() -> ExitCode {
    apexd::shell::main(&NotConnected)
}
