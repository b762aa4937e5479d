use super::corridors::*;
use super::*;
use crate::frames::{Point, Pose};

pub const GRIP: f64 = 0.9 * 9.81;

pub fn request<'a>(guide: &'a [Point], start: Pose) -> SmoothRequest<'a> {
    SmoothRequest {
        guide,
        warm: false,
        start,
        start_curvature_pm: None,
        held: &[],
        start_speed_mps: 0.0,
        end_radius_m: 0.0,
        radius_m: 0.25,
        curvature_limit_pm: 2.0,
        acceleration_limit_mps2: GRIP,
        speed_max_mps: 4.0,
    }
}

#[test]
#[ignore]
fn explore() {
    let env = |k: &str, d: f64| std::env::var(k).ok().map_or(d, |v| v.parse().unwrap());
    let speed = env("V", 4.0);
    let mut params = SmoothParams {
        horizon_m: env("HORIZON", 200.0),
        spacing_m: env("D", 0.12),
        bubble_wanted_m: env("WANT", 0.6),
        bubble_radius_max_m: env("RMAX", 1.2),
        length_weight_pm2: env("LAM", 0.1),
        ..SmoothParams::default()
    };
    let mut smoother = Smoother::default();
    let mut table = vec![Vec::new(); 8];
    for seed in 0..env("N", 10.0) as u64 {
        let route = random_route(seed, env("CELLS", 30.0) as usize);
        let field = corridor(&route);
        let (from, to) = (cell_centre(route[0]), cell_centre(*route.last().unwrap()));
        let guide = guide_on_cells(&field, from, to, 0.25);
        let d = cell_centre(route[1]) - from;
        let start = Pose::new(from.x, from.y, d.y.atan2(d.x) + env("OFF", 0.0));
        for passes in 1..=8 {
            params.passes = passes;
            let mut r = request(&guide, start);
            r.speed_max_mps = speed;
            let clock = std::time::Instant::now();
            let result = smoother.smooth(&params, &field, &r);
            let ms = clock.elapsed().as_secs_f64() * 1e3;
            match result {
                Ok(s) => {
                    let t = travel_time_s(&s.path, GRIP, speed, 0.0).unwrap();
                    if std::env::var("VERBOSE").is_ok() {
                        println!(
                            "{seed} {passes} T {t:.4} L {:.2} {:?} {ms:.2} ms",
                            s.path.length_m(),
                            s.stats
                        );
                    }
                    table[passes as usize - 1].push(t);
                }
                Err(e) => {
                    if passes % 4 == 0 {
                        println!("{seed} {passes} {e}")
                    }
                }
            }
        }
    }
    let best = &table[7];
    for (i, row) in table.iter().enumerate() {
        let mean: f64 = row.iter().sum::<f64>() / row.len() as f64;
        println!(
            "passes {} mean T {mean:.4} n {} rel {:.4}",
            i + 1,
            row.len(),
            mean / (best.iter().sum::<f64>() / best.len() as f64)
        );
    }
}
