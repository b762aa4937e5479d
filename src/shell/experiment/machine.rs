//! What is known of this program and the machine it runs on.

use crate::experiment::dataset::sha256;

/// Options whose values only say where results go or how they are shown.
const PLACES: [&str; 4] = ["--out", "--page", "--jobs", "--shard"];

/// Name, version, and the first digits of the hash of the program's file: results of another build
/// may differ.
pub fn program() -> String {
    let version = concat!(env!("CARGO_PKG_NAME"), " ", env!("CARGO_PKG_VERSION"));
    let hash = std::env::current_exe().and_then(std::fs::read).map(|bytes| sha256(&bytes));
    // Without a file to read there is still the version.
    hash.map_or_else(|_| version.to_owned(), |hash| format!("{version} ({})", &hash[..12]))
}

/// Cores that may be used.
pub fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Processor, cores and system.
pub fn description() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = info.lines().find_map(|line| {
        let (name, value) = line.split_once(':')?;
        (name.trim() == "model name").then(|| value.trim().to_owned())
    });
    let model = model.unwrap_or_else(|| "unknown processor".into());
    format!("{model}, {} cores, {} {}", cores(), std::env::consts::OS, std::env::consts::ARCH)
}

/// The command line, without what only says where results go.
pub fn command() -> String {
    let words: Vec<String> = std::env::args().skip(1).collect();
    format!("apexd {}", without_places(&words).join(" "))
}

fn without_places(words: &[String]) -> Vec<&str> {
    let mut kept = Vec::new();
    let mut words = words.iter();
    while let Some(word) = words.next() {
        if PLACES.contains(&&**word) {
            words.next();
        } else if !PLACES
            .iter()
            .any(|place| word.strip_prefix(place).is_some_and(|rest| rest.starts_with('=')))
        {
            kept.push(&**word);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_is_noted_without_places() {
        let words: Vec<String> = "experiment paper --out a/b --mazes 6 --page=x.md --jobs 2 --json"
            .split(' ')
            .map(str::to_owned)
            .collect();
        assert_eq!(without_places(&words), ["experiment", "paper", "--mazes", "6", "--json"]);
    }

    #[test]
    fn program_and_machine_have_names() {
        assert!(program().starts_with("apexd "), "{}", program());
        assert!(description().contains("cores"));
    }
}
