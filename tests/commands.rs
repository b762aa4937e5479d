//! What a ground station may ask of a car under way, in the simulator: a lower speed, the way back,
//! the stop when nobody listens any more, the stop for good.

use apexd::autopilot::{Command, Fault, Mode, Refusal};
use apexd::map::Cell;
use apexd::params::Params;
use apexd::predict::PredictorKind;
use apexd::sim::maze::{Family, generate};
use apexd::sim::rig::{Rig, RigSetup};

/// A car in a maze that waits for commands, armed.
fn armed() -> (Rig, apexd::frames::Point) {
    let maze = generate(Family::Thin, 3, 0.1).expect("the maze exists");
    let goal = maze.goal;
    let mut params = Params::default();
    params.predict.kind = PredictorKind::None;
    let mut rig = Rig::new(RigSetup {
        time_limit_s: Some(f64::INFINITY),
        ..RigSetup::new(&params, maze.world, maze.start, None)
    })
    .expect("start and goal are free");
    for _ in 0..100 {
        run(&mut rig, 0.05);
        if tell(&mut rig, Command::Arm).is_ok() {
            return (rig, goal);
        }
    }
    panic!("{:?}", rig.core().pre_arm(rig.now()));
}

fn tell(rig: &mut Rig, command: Command) -> Result<(), Refusal> {
    let now = rig.now();
    rig.core_mut().handle_command(now, command)
}

/// Lets time pass; nothing may be touched, and nothing entered that no beam has shown.
fn run(rig: &mut Rig, seconds: f64) {
    for _ in 0..(seconds * 1000.0).round() as u32 {
        rig.step();
    }
    assert_eq!((rig.judge().collisions(), rig.judge().unknown_entries()), (0, 0));
}

/// Lets time pass until something holds, or for too long.
fn run_until(rig: &mut Rig, limit_s: f64, holds: impl Fn(&Rig) -> bool) {
    let mut spent = 0.0;
    while !holds(rig) {
        assert!(spent < limit_s, "after {limit_s} s: {:?}", rig.core().mode());
        run(rig, 0.01);
        spent += 0.01;
    }
}

fn speed(rig: &Rig) -> f64 {
    rig.car().speed_mps
}

#[test]
fn a_lower_speed_is_taken_up_gently_under_way_and_given_back() {
    let (mut rig, goal) = armed();
    tell(&mut rig, Command::Goto(goal)).unwrap();
    run_until(&mut rig, 10.0, |rig| speed(rig) > 2.5);
    tell(&mut rig, Command::SpeedLimit(Some(1.0))).unwrap();
    let before = speed(&rig);
    run(&mut rig, 0.3);
    assert!(speed(&rig) > before - 1.2, "a wish is no emergency: {before} {}", speed(&rig));
    run(&mut rig, 1.2);
    for _ in 0..100 {
        run(&mut rig, 0.02);
        assert!(speed(&rig) < 1.05, "{}", speed(&rig));
    }
    assert!(rig.core().mode() == Mode::Drive && speed(&rig) > 0.5);
    tell(&mut rig, Command::SpeedLimit(None)).unwrap();
    run_until(&mut rig, 10.0, |rig| speed(rig) > 2.0);
    for nonsense in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let refused = tell(&mut rig, Command::SpeedLimit(Some(nonsense)));
        assert!(matches!(refused, Err(Refusal::SpeedNotPositive { .. })), "{nonsense}");
    }
}

#[test]
fn the_way_back_leads_through_what_is_known() {
    let (mut rig, goal) = armed();
    let start = rig.car().pose.position;
    tell(&mut rig, Command::Goto(goal)).unwrap();
    run_until(&mut rig, 20.0, |rig| (rig.car().pose.position - start).norm() > 6.0);
    tell(&mut rig, Command::Pause).unwrap();
    run_until(&mut rig, 10.0, |rig| speed(rig) == 0.0);
    tell(&mut rig, Command::Return(start)).unwrap();
    let mut plans = 0;
    let mut number = rig.core().committed().newest().number;
    let mut spent = 0;
    while rig.core().goal().is_some() {
        run(&mut rig, 0.02);
        spent += 1;
        assert!(spent < 3000, "not back after a minute");
        let plan = rig.core().committed().newest();
        if plan.number != number && plan.trajectory.points.len() > 1 {
            number = plan.number;
            plans += 1;
            let grid = rig.core().grid();
            for point in &plan.beyond.points {
                let cell = grid.get(grid.cell_at(point.position));
                assert!(cell != Cell::Unknown, "{point:?} of plan {number}");
            }
        }
    }
    assert!(plans > 3, "{plans}");
    assert!((rig.car().pose.position - start).norm() < 0.55);
}

#[test]
fn a_car_that_nobody_hears_stops_and_goes_on_when_somebody_does() {
    let (mut rig, goal) = armed();
    tell(&mut rig, Command::Goto(goal)).unwrap();
    run_until(&mut rig, 10.0, |rig| speed(rig) > 2.0);
    tell(&mut rig, Command::StationLost(true)).unwrap();
    run(&mut rig, 0.02);
    assert!(rig.core().faults().contains(Fault::StationLost));
    assert_eq!(rig.core().mode(), Mode::Stop);
    run_until(&mut rig, 5.0, |rig| speed(rig) == 0.0);
    run(&mut rig, 2.0);
    assert_eq!((speed(&rig), rig.core().mode()), (0.0, Mode::Stop));
    tell(&mut rig, Command::StationLost(false)).unwrap();
    run_until(&mut rig, 3.0, |rig| speed(rig) > 1.0);
    assert_eq!(rig.core().mode(), Mode::Drive);
}

#[test]
fn a_terminated_drive_is_over_for_good() {
    let (mut rig, goal) = armed();
    tell(&mut rig, Command::Goto(goal)).unwrap();
    run_until(&mut rig, 10.0, |rig| speed(rig) > 2.0);
    tell(&mut rig, Command::Terminate).unwrap();
    let before = rig.car().pose.position;
    run_until(&mut rig, 2.0, |rig| speed(rig) == 0.0);
    assert!((rig.car().pose.position - before).norm() < 1.0);
    for command in [Command::Arm, Command::Goto(goal), Command::Return(goal), Command::Continue] {
        assert_eq!(tell(&mut rig, command), Err(Refusal::Terminated));
    }
    tell(&mut rig, Command::Disarm).unwrap();
    assert_eq!(tell(&mut rig, Command::Arm), Err(Refusal::Terminated));
    run(&mut rig, 2.0);
    assert_eq!(speed(&rig), 0.0);
    assert_eq!(rig.core().pre_arm(rig.now()), [Refusal::Terminated]);
}
