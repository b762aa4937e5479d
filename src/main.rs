//! The `apexd` binary.

fn main() {}
