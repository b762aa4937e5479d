use super::*;
use crate::experiment::floor::SafeFloor;
use crate::sim::maze::Family;

#[test]
fn the_key_follows_the_description() {
    let task = |spec: RunSpec| Task {
        experiment: "e".into(),
        spec,
        keep: Keep::default(),
        benchmark: None,
    };
    let spec = RunSpec::maze(Family::Solid, 7);
    let key = task(spec.clone()).key();
    assert_eq!(key, task(spec.clone()).key());
    assert_eq!(key.len(), 20);
    for other in [
        RunSpec { seed: 2, ..spec.clone() },
        RunSpec { speed_max_mps: 4.5, ..spec.clone() },
        RunSpec { latency: Timing::Measured, ..spec.clone() },
        RunSpec { set: vec!["plan.wall_room_m=0".into()], ..spec.clone() },
    ] {
        assert_ne!(key, task(other).key());
    }
}

#[test]
fn a_description_survives_being_written_and_read() {
    let spec = RunSpec {
        start: Some([1.05, 2.0, -90.0]),
        latency: Timing::Measured,
        set: vec!["plan.wall_room_m=0".into()],
        ..RunSpec::maze(Family::Posts, 3)
    };
    let text = serde_json::to_string(&spec).unwrap();
    assert_eq!(serde_json::from_str::<RunSpec>(&text).unwrap(), spec);
    let floor = SafeFloor { path_s: 1.0, ratios: vec![[0.0, 1.25]] };
    let text = serde_json::to_string(&floor).unwrap();
    assert_eq!(serde_json::from_str::<SafeFloor>(&text).unwrap(), floor);
}

#[test]
fn a_command_names_what_is_not_as_usual() {
    let spec = RunSpec {
        start: Some([1.05, 2.0, -90.0]),
        goal: Some([3.5, 4.0]),
        lidar_rate_hz: 40.0,
        plan_period_s: 0.5,
        latency: Timing::Fixed(0.0),
        set: vec!["predict.model=a b".into()],
        ..RunSpec::maze(Family::Posts, 3)
    };
    assert_eq!(
        spec.command(),
        "apexd sil --maze 3 --family posts --start 1.05,2,-90 --goal 3.5,4 --policy map-predictive \
         --predictor none --speed-max 4 --latency 0 --seed 1 --set lidar.rate_hz=40 \
         --set autopilot.plan_period_s=0.5 --set 'predict.model=a b'"
    );
    assert_eq!(spec.method(), "map-predictive+none:predict.model=a b");
    assert_eq!(spec.timing(), "2 Hz, latency 0 ms");
    assert_eq!(RunSpec::maze(Family::Thin, 1).timing(), "each scan, latency 20 ms");
}

#[test]
fn what_this_program_does_not_know_is_said_by_name() {
    let spec = RunSpec::maze(Family::Thin, 1);
    let fails = |spec: RunSpec| spec.params().unwrap_err().to_string();
    let policy = fails(RunSpec { policy: "wander".into(), ..spec.clone() });
    assert!(policy.contains("no policy \"wander\"; it has map-predictive, frontier"), "{policy}");
    let predictor = fails(RunSpec { predictor: "dice".into(), ..spec.clone() });
    assert!(predictor.contains("no predictor \"dice\""), "{predictor}");
    let value = fails(RunSpec { set: vec!["speed.speed_max=fast".into()], ..spec.clone() });
    assert!(value.contains("speed.speed_max"), "{value}");
    let world = WorldSpec::Maze { family: "forest".into(), seed: 1 };
    let family = place(&RunSpec { world, ..spec }).unwrap_err().to_string();
    assert!(family.contains("no family \"forest\""), "{family}");
}
