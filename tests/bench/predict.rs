//! A network by itself: encoding a scene, decoding what a planning step asks for.
//!
//! `cargo bench --bench predict`; `APEXD_MODEL` names another network than the one that ships,
//! `APEXD_ONNXRUNTIME` a native runtime.

use apexd::predict::{Answers, Network, PredictParams, load};
use criterion::{Criterion, criterion_group, criterion_main};

fn network() -> Network {
    let variable = |name: &str| std::env::var(name).unwrap_or_default();
    let params = PredictParams {
        model: variable("APEXD_MODEL"),
        onnxruntime: variable("APEXD_ONNXRUNTIME"),
        fallback: false,
        ..PredictParams::default()
    };
    load(&params).expect("the network fits")
}

/// The cells of a disc around the car, every seventh of them a wall.
fn disc(radius: i32) -> Vec<[f32; 3]> {
    let mut cells = Vec::new();
    for y in -radius..=radius {
        for x in -radius..=radius {
            if x * x + y * y <= radius * radius {
                let wall = (x + 3 * y).rem_euclid(7) == 0;
                let centre = |k: i32| (k as f32 + 0.5) * 0.25;
                cells.push([centre(x), centre(y), f32::from(u8::from(wall))]);
            }
        }
    }
    cells
}

fn bench(criterion: &mut Criterion) {
    let mut network = network();
    for radius in [12, 30] {
        let context = disc(radius);
        criterion.bench_function(&format!("encode/{} cells", context.len()), |b| {
            b.iter(|| network.encode(&context).expect("it runs"));
        });
    }
    let mut answers = Answers::default();
    for radius in [2, 6, 20] {
        let targets: Vec<[f32; 2]> = disc(radius).iter().map(|[x, y, _]| [*x, *y]).collect();
        criterion.bench_function(&format!("decode/{} cells", targets.len()), |b| {
            b.iter(|| network.decode(&targets, &mut answers).expect("it runs"));
        });
    }
}

criterion_group!(benches, bench);
criterion_main!(benches);
