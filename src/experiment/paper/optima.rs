//! True time optima, computed offline (`tests/bench/optimum`).

use std::collections::BTreeMap;

/// Optimal times by maze and speed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Optima(BTreeMap<(u64, u64), f64>);

/// A file of optima that cannot be read.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("line {line}: {why}")]
pub struct OptimaError {
    /// Its number, from 1.
    pub line: usize,
    /// What is wrong with it.
    pub why: String,
}

/// Speeds as whole millimetres a second, so that they can be looked up.
fn key(seed: u64, speed_mps: f64) -> (u64, u64) {
    (seed, (speed_mps * 1e3).round() as u64)
}

impl Optima {
    /// Reads a CSV file with the columns `seed`, `speed_max_mps` and `optimum_s`, for mazes of the
    /// family `thin`.
    ///
    /// # Errors
    /// If a column is missing or a figure is none.
    pub fn parse(text: &str) -> Result<Self, OptimaError> {
        let fail = |line: usize, why: String| OptimaError { line, why };
        let mut lines = text.lines().enumerate();
        let header: Vec<&str> = lines.next().map_or_else(Vec::new, |(_, l)| l.split(',').collect());
        let column = |name: &str| {
            let found = header.iter().position(|column| column.trim() == name);
            found.ok_or_else(|| fail(1, format!("there is no column {name}")))
        };
        let columns = [column("seed")?, column("speed_max_mps")?, column("optimum_s")?];
        let mut optima = BTreeMap::new();
        for (i, line) in lines.filter(|(_, line)| !line.trim().is_empty()) {
            let fields: Vec<&str> = line.split(',').map(str::trim).collect();
            let [seed, speed, time] =
                columns.map(|column| fields.get(column).copied().unwrap_or_default());
            let wrong = |what: &str| fail(i + 1, format!("{what:?} is no number"));
            let seed = seed.parse().map_err(|_| wrong(seed))?;
            let number = |text: &str| {
                let number = text.parse::<f64>().ok().filter(|v| v.is_finite() && *v > 0.0);
                number.ok_or_else(|| wrong(text))
            };
            optima.insert(key(seed, number(speed)?), number(time)?);
        }
        Ok(Self(optima))
    }

    /// The optimum of a maze of the family `thin`, seconds.
    pub fn time_s(&self, seed: u64, speed_mps: f64) -> Option<f64> {
        self.0.get(&key(seed, speed_mps)).copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_file_of_the_offline_solver_is_read() {
        let optima =
            Optima::parse(include_str!("../../../tests/bench/optimum/optima.csv")).unwrap();
        assert_eq!(optima.time_s(1, 1.0), Some(142.2867));
        assert_eq!((optima.time_s(1, 3.5), optima.time_s(999, 1.0)), (None, None));
    }

    #[test]
    fn what_is_wrong_with_a_file_is_said() {
        let error = |text: &str| Optima::parse(text).unwrap_err().to_string();
        assert_eq!(error("seed,optimum_s\n1,2\n"), "line 1: there is no column speed_max_mps");
        let header = "seed,speed_max_mps,optimum_s\n";
        assert_eq!(error(&format!("{header}1,4,soon\n")), "line 2: \"soon\" is no number");
        assert_eq!(error(&format!("{header}1,4\n")), "line 2: \"\" is no number");
    }
}
