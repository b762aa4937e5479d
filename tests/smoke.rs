#![allow(clippy::disallowed_methods, missing_docs)]
use apexd::autopilot::{CoreParams, Event};
use apexd::plan::{PlannerParams, Policy};
use apexd::sim::maze::{Family, generate};
use apexd::sim::rig::*;

#[test]
fn smoke() {
    let get = |k: &str, d: &str| std::env::var(k).unwrap_or(d.into());
    let seed: u64 = get("SEED", "1").parse().unwrap();
    let n: u64 = get("N", "1").parse().unwrap();
    let verbose = get("V", "0") == "1";
    for seed in seed..seed + n {
        let family = Family::from_name(&get("FAMILY", "thin")).unwrap();
        let maze = generate(family, seed, 0.1).unwrap();
        let t0 = std::time::Instant::now();
        let mut planner = PlannerParams::default();
        planner.plan.policy = Policy::from_name(&get("POLICY", "map-predictive")).unwrap();
        planner.speed.speed_max_mps = get("VMAX", "4").parse().unwrap();
        if let Ok(sets) = std::env::var("SET") {
            for kv in sets.split(',') {
                let (k, v) = kv.split_once('=').unwrap();
                let v: f64 = v.parse().unwrap();
                match k {
                    "lw" => planner.smooth.length_weight = v,
                    "passes" => planner.smooth.passes = v as u32,
                    "bw" => planner.smooth.bubble_wanted_m = v,
                    "bm" => planner.smooth.bubble_radius_max_m = v,
                    "fu" => planner.speed.friction_use = v,
                    "sp" => planner.smooth.spacing_m = v,
                    "hz" => planner.smooth.horizon_m = v,
                    "gd" => planner.plan.goal_depth_m = v,
                    "ur" => planner.plan.unknown_room_m = v,
                    "stop" => {
                        planner.plan.stop_rule = [
                            apexd::plan::StopRule::Optimistic,
                            apexd::plan::StopRule::Seen,
                            apexd::plan::StopRule::TurnRound,
                        ][v as usize]
                    }
                    _ => panic!("{k}"),
                }
            }
        }
        let mut predict = apexd::predict::PredictParams::default();
        predict.kind = apexd::predict::PredictorKind::from_name(&get("PRED", "none")).unwrap();
        let core = CoreParams { speed: planner.speed.clone(), ..Default::default() };
        let mut lidar = apexd::sim::lidar::LidarParams::default();
        lidar.rate_hz = get("HZ", "20").parse().unwrap();
        let setup = RigSetup {
            world: maze.world.clone(),
            start: maze.start,
            goal: Some(maze.goal),
            core,
            planner,
            predict,
            bus: Default::default(),
            lidar,
            car: Default::default(),
            controller: Default::default(),
            layout: apexd::wire::can::Layout::Fd,
            faults: Default::default(),
            seed,
            latency: Latency::Fixed(0.02),
            time_limit_s: None,
            stopwatch: Box::new(move || t0.elapsed()),
            planning: None,
        };
        let mut rig = Rig::new(setup).unwrap();
        rig.keep_reports();
        let mut worst: f64 = 0.0;
        let mut errs = String::new();
        let mut times = vec![apexd::plan::StepTimes::default(); 0];
        let mut rej = std::collections::BTreeMap::<String, usize>::new();
        let t1 = std::time::Instant::now();
        rig.drive(|rig| {
            worst = worst.max(rig.core().tracking_error().lateral_m.abs());
            if rig.now().as_nanos() % 10_000_000 == 0 {
                use std::fmt::Write;
                let e = rig.core().tracking_error();
                let c = rig.core().committed().at(rig.now());
                writeln!(
                    errs,
                    "{:.3},{:.4},{:.4},{:.4},{:.3},{:.3},{:.3}",
                    rig.now().as_secs_f64(),
                    e.along_m,
                    e.lateral_m,
                    e.speed_mps,
                    c.speed_mps,
                    rig.car().speed_mps,
                    rig.core().committed().current().trajectory.last().path.s_m - c.path.s_m
                )
                .unwrap();
            }
            for (_, r) in rig.take_reports() {
                times.push(r.times);
            }
            while let Some(e) = rig.poll_event() {
                if let Event::PlanRejected { rejection, .. } = &e {
                    *rej.entry(format!("{rejection:?}").chars().take(60).collect()).or_default() +=
                        1;
                }
                if verbose && !matches!(e, Event::PlanAdopted { .. }) {
                    eprintln!("{:.3} {:?} car {:?}", rig.now().as_secs_f64(), e, rig.car());
                }
            }
        });
        let s = rig.summary(t1.elapsed().as_secs_f64());
        eprintln!("seed {seed} {}", serde_json::to_string(&s).unwrap());
        if let Ok(dir) = std::env::var("DUMP") {
            use std::fmt::Write;
            let mut t = String::new();
            for p in &rig.trace().samples {
                writeln!(
                    t,
                    "{},{},{},{},{},{}",
                    p.t_s,
                    p.pose.position.x,
                    p.pose.position.y,
                    p.speed_mps,
                    p.longitudinal_n,
                    p.lateral_n
                )
                .unwrap();
            }
            std::fs::write(format!("{dir}/errs.csv"), &errs).unwrap();
            std::fs::write(format!("{dir}/trace.csv"), t).unwrap();
            apexd::mapfile::save(format!("{dir}/maze.yaml"), &maze.to_map_file()).unwrap();
        }
        eprintln!("  track {:.4} stats {:?}", worst, {
            let mut st = rig.core().statistics().clone();
            st.plan_ages.clear();
            st
        });
        eprintln!("  guard {:?}", rig.core().guard_counts());
        for (k, v) in rej {
            eprintln!("   {v:4} {k}");
        }
        let med = |f: fn(&apexd::plan::StepTimes) -> std::time::Duration| {
            let mut v: Vec<f64> = times.iter().map(|t| f(t).as_secs_f64() * 1e3).collect();
            v.sort_by(f64::total_cmp);
            if v.is_empty() { (0.0, 0.0) } else { (v[v.len() / 2], v[v.len() * 99 / 100]) }
        };
        eprintln!(
            "   field {:.2?} predict {:.2?} search {:.2?} man {:.2?} smooth {:.2?} speed {:.2?} cert {:.2?} total {:.2?}",
            med(|t| t.field),
            med(|t| t.predict),
            med(|t| t.search),
            med(|t| t.manoeuvre),
            med(|t| t.smooth),
            med(|t| t.speed),
            med(|t| t.certify),
            med(|t| t.total)
        );
    }
}
