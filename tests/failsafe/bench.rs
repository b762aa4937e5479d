//! Every row is also brought about on a bus of the kernel (`hil/scenarios`), with its detection held to
//! ten times the limit of the table.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::collections::BTreeMap;
use std::path::Path;

use apexd::autopilot::{CoreParams, Fault, TABLE};

/// Rows that only virtual time can bring about without harm: what appears must block the way so closely
/// that no stop before it can be certified, and yet not be touched; the planner must be a reckless one.
const VIRTUAL_ONLY: [Fault; 2] = [Fault::PathBlocked, Fault::GuardStop];

/// Scenarios in which the cause follows so long after what the time is counted from: the daemon is
/// stopped for 0.2 s, odometry is back after half a second, a ground station is missed after one, and half
/// a second more is left to the sockets between.
const LATER_S: [(Fault, f64); 3] =
    [(Fault::ClockJump, 0.2), (Fault::PoseLost, 0.5), (Fault::StationLost, 1.5)];

/// Of every fault that a scenario expects the shortest time allowed, seconds; none where it has nothing to
/// be counted from.
fn expected() -> BTreeMap<String, Option<f64>> {
    let mut limits = BTreeMap::new();
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("hil/scenarios");
    for entry in folder.read_dir().unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|extension| extension != "toml") {
            continue;
        }
        let scenario: toml::Table = std::fs::read_to_string(&path).unwrap().parse().unwrap();
        let Some(faults) = scenario["expect"].get("faults") else { continue };
        for (name, limit) in faults.as_table().unwrap() {
            let limit_s = match limit {
                toml::Value::Boolean(true) => None,
                toml::Value::Float(limit_s) => Some(*limit_s),
                other => panic!("{path:?}: {name} = {other}"),
            };
            let least = limits.entry(name.clone()).or_insert(limit_s);
            *least = (*least).into_iter().chain(limit_s).min_by(f64::total_cmp);
        }
    }
    limits
}

#[test]
fn every_row_is_tried_on_the_bench() {
    let expected = expected();
    for row in TABLE {
        let tried = expected.contains_key(row.fault.name());
        assert_eq!(tried, !VIRTUAL_ONLY.contains(&row.fault), "{:?}", row.fault);
    }
    let known: Vec<&str> = TABLE.iter().map(|row| row.fault.name()).collect();
    for name in expected.keys() {
        assert!(known.contains(&name.as_str()), "no row is called {name:?}");
    }
}

#[test]
fn one_scenario_of_each_row_allows_no_more_than_ten_times_its_limit() {
    let params = CoreParams::default();
    for (name, limit_s) in expected() {
        let Some(limit_s) = limit_s else { continue };
        let row = TABLE.iter().find(|row| row.fault.name() == name).unwrap();
        let later_s = LATER_S.iter().find(|(fault, _)| *fault == row.fault).map_or(0.0, |l| l.1);
        let most_s = 10.0 * row.within_s(&params) + later_s;
        assert!(limit_s <= most_s + 1e-9, "{name}: {limit_s} s are allowed, not {most_s:.2} s");
    }
}
