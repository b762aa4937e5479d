//! The `apexd` binary.

use std::process::ExitCode;

fn main() -> ExitCode {
    apexd::shell::main()
}
