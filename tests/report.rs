//! The report of a made-up drive. The pictures stay in `target/tmp/report` to be looked at.

use std::f64::consts::{FRAC_PI_2, PI};
use std::path::{Path, PathBuf};

use apexd::frames::{Point, Pose};
use apexd::map::{Cell, CellIndex, CellRect, Grid};
use apexd::shell::report::{DriveRecord, outline, write};
use apexd::sim::drive::{Outcome, PlanMark, Spread, Summary, Trace, TraceSample};
use apexd::sim::rig::Snapshot;

const ROWS: usize = 6;
const CELLS: usize = 250;
const RESOLUTION_M: f64 = 0.1;
const FORCE_LIMIT_N: f64 = 2.5 * 8.829;

/// Walls of a maze that winds from row to row, 2.5 m apart, open at alternating ends.
fn solid(x: usize, y: usize) -> bool {
    let wall_row = y.is_multiple_of(25);
    let open_left = (y / 25).is_multiple_of(2);
    let in_gap = if open_left { x < 25 } else { x >= CELLS - 25 };
    let edge = x == 0 || x == CELLS - 1 || y == 0 || y == CELLS - 1;
    edge || (wall_row && !in_gap)
}

/// Position, heading and curvature at a distance along the middle of the corridor.
fn centre_line(s: f64) -> (Point, f64, f64) {
    let (straight, radius) = (20.0, 1.25);
    let piece = straight + PI * radius;
    let row = (s / piece).floor();
    let along = s - row * piece;
    let sign = if row as i64 % 2 == 0 { 1.0 } else { -1.0 };
    let middle_y = 1.25 + 2.5 * row;
    if along < straight {
        let x = 12.5 + sign * (along - 0.5 * straight);
        return (Point::new(x, middle_y), if sign > 0.0 { 0.0 } else { PI }, 0.0);
    }
    let angle = (along - straight) / radius;
    let centre = Point::new(12.5 + sign * 10.0, middle_y + radius);
    let offset = Point::new(sign * radius * angle.sin(), -radius * angle.cos());
    let heading = if sign > 0.0 { angle } else { PI - angle };
    (centre + offset.coords, heading, sign / radius)
}

fn made_up_drive(outcome: Outcome) -> DriveRecord {
    let mut grid = Grid::new(RESOLUTION_M);
    for y in 0..ROWS * 25 + 6 {
        for x in 0..CELLS {
            let walls = y >= ROWS * 25;
            let cell = if solid(x, y) {
                Cell::Occupied
            } else if walls || (x + 2 * y).is_multiple_of(331) {
                continue;
            } else {
                Cell::Free
            };
            grid.set(CellIndex::new(x as i32, y as i32), cell);
        }
    }
    let mut trace = Trace::default();
    let (mut s, mut speed, mut t) = (0.0, 0.0f64, 0.0);
    let end = 6.0 * (20.0 + PI * 1.25) - PI * 1.25;
    while s < end && t < 100.0 {
        let (position, heading, curvature) = centre_line(s);
        let ahead = (0..40).map(|i| centre_line((s + 0.1 * f64::from(i)).min(end - 0.01)).2);
        let bend = ahead.map(f64::abs).fold(0.0, f64::max);
        let wished = if bend > 0.0 { 3.0 } else { 4.0f64 }.min((2.0 * 7.0 * (end - s)).sqrt());
        let accel = ((wished - speed) * 8.0).clamp(-8.0, 7.0);
        let wobble = 0.1 * (7.0 * s).sin();
        trace.samples.push(TraceSample {
            t_s: t,
            pose: Pose::new(position.x, position.y + wobble, heading),
            speed_mps: speed,
            curvature_pm: curvature,
            longitudinal_n: 2.5 * accel * (1.0 - 0.3 * bend),
            lateral_n: 2.5 * speed * speed * curvature,
        });
        if trace.samples.len() % 5 == 0 {
            let (stop, ..) = centre_line((s + 2.0 + 0.8 * (3.0 * s).sin()).min(end));
            trace.plans.push(PlanMark { t_s: t, stop });
        }
        speed = (speed + 0.01 * accel).max(0.05);
        s += 0.01 * speed;
        t += 0.01;
    }
    let rows = [25 * ROWS, CELLS];
    DriveRecord {
        title: "maze 7 (thin) · map-predictive, oracle".into(),
        summary: Summary {
            outcome,
            time_s: t,
            path_m: end,
            collisions: 0,
            unknown_entries: 0,
            min_clearance_m: 0.412,
            replans: (t * 20.0) as u64,
            plans_rejected: 3,
            guard_stops: 0,
            candidates: 1.4,
            plan_ms: Spread { p50: 1.2, p99: 3.4, max: 6.0 },
            predict_ms: Spread::default(),
            predict_context: 0.0,
            predict_decoded: 0.0,
            prediction_faults: 0,
            age_ms: Spread { p50: 42.0, p99: 71.0, max: 73.0 },
            realtime_factor: 31.0,
            digest: "0123456789abcdef".into(),
        },
        trace,
        grid,
        truth: outline(rows[1], rows[1], solid, |p| Point::from(p.coords * RESOLUTION_M)),
        snapshot: None,
        start: Pose::new(2.5, 1.25, 0.0),
        goal: centre_line(end).0,
        goal_radius_m: 0.5,
        speed_limit_mps: 4.0,
        force_limit_n: FORCE_LIMIT_N,
    }
}

fn folder(name: &str) -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join("report").join(name)
}

/// Every text of a picture lies on its page.
fn assert_texts_on_page(svg: &Path) {
    let mut fonts = resvg::usvg::fontdb::Database::new();
    fonts.load_font_data(epaint_default_fonts::UBUNTU_LIGHT.to_vec());
    fonts.set_sans_serif_family("Ubuntu");
    let options = resvg::usvg::Options { fontdb: fonts.into(), ..resvg::usvg::Options::default() };
    let text = std::fs::read_to_string(svg).expect("the picture was written");
    let tree = resvg::usvg::Tree::from_str(&text, &options).expect("the picture is valid SVG");
    let mut texts = Vec::new();
    collect_texts(tree.root(), &mut texts);
    assert!(texts.len() > 10, "{} has {} texts", svg.display(), texts.len());
    for (i, (text, at)) in texts.iter().enumerate() {
        let inside = at.left() >= 2.0
            && at.top() >= 2.0
            && at.right() <= tree.size().width() - 2.0
            && at.bottom() <= tree.size().height() - 2.0;
        assert!(inside, "{}: {text:?} at {at:?}", svg.display());
        for (other, place) in &texts[..i] {
            let apart = at.left() >= place.right()
                || place.left() >= at.right()
                || at.top() >= place.bottom()
                || place.top() >= at.bottom();
            assert!(apart, "{}: {text:?} covers {other:?}", svg.display());
        }
    }
}

fn collect_texts(group: &resvg::usvg::Group, texts: &mut Vec<(String, resvg::usvg::Rect)>) {
    for node in group.children() {
        match node {
            resvg::usvg::Node::Group(inner) => collect_texts(inner, texts),
            resvg::usvg::Node::Text(text) => {
                let content = text.chunks().iter().map(|chunk| chunk.text()).collect();
                texts.push((content, text.abs_bounding_box()));
            }
            _ => {}
        }
    }
}

#[test]
fn a_drive_is_written_as_small_pictures_and_figures() {
    let folder = folder("goal");
    let written = write(&folder, &made_up_drive(Outcome::Goal)).unwrap();
    let names: Vec<_> = written.iter().map(|p| p.file_name().unwrap().to_str().unwrap()).collect();
    assert_eq!(names, ["drive.svg", "drive.png", "speed.svg", "speed.png", "summary.json"]);
    for path in &written {
        let bytes = std::fs::metadata(path).unwrap().len();
        assert!((300..400_000).contains(&bytes), "{}: {bytes} bytes", path.display());
    }
    assert_texts_on_page(&folder.join("drive.svg"));
    assert_texts_on_page(&folder.join("speed.svg"));
    assert!(!folder.join("prediction.svg").exists());
    let json = std::fs::read_to_string(folder.join("summary.json")).unwrap();
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!((&json["outcome"], &json["replans"]), (&"goal".into(), &json["replans"]));
    assert_eq!(json["plan_ms"]["p99"], 3.4);
}

#[test]
fn what_was_foreseen_is_drawn_too() {
    let mut record = made_up_drive(Outcome::Goal);
    let window = CellRect { x0: -30, y0: 20, x1: 230, y1: 280 };
    let cells = (window.y0..window.y1).flat_map(|y| (window.x0..window.x1).map(move |x| (x, y)));
    let occupied = cells.map(|(x, y)| match record.grid.get(CellIndex::new(x, y)) {
        Cell::Free => 0.0,
        Cell::Occupied => 1.0,
        Cell::Unknown => ((x + y) % 10) as f32 / 10.0,
    });
    let (position, heading_rad, _) = centre_line(130.0);
    record.snapshot = Some(Snapshot {
        t_s: 21.25,
        pose: Pose { position, heading_rad },
        window,
        occupied: occupied.collect(),
        grid: record.grid.clone().into(),
        path: (130..136).map(|s| centre_line(f64::from(s)).0).collect(),
        beyond: (137..150).map(|s| centre_line(f64::from(s)).0).collect(),
    });
    let folder = folder("foreseen");
    let written = write(&folder, &record).unwrap();
    assert!(written.iter().any(|path| path.ends_with("prediction.png")));
    assert_texts_on_page(&folder.join("prediction.svg"));
    let text = std::fs::read_to_string(folder.join("prediction.svg")).unwrap();
    assert!(text.contains("Foreseen at 21.2 s") || text.contains("Foreseen at 21.3 s"));
    // Without truth and without a way on.
    record.truth = Vec::new();
    if let Some(snapshot) = &mut record.snapshot {
        snapshot.beyond.clear();
        snapshot.occupied.fill(f32::NAN);
    }
    write(&folder, &record).unwrap();
    assert_texts_on_page(&folder.join("prediction.svg"));
}

#[test]
fn the_same_drive_gives_the_same_files() {
    let record = made_up_drive(Outcome::Goal);
    let (a, b) = (folder("first"), folder("second"));
    for (one, other) in write(&a, &record).unwrap().iter().zip(write(&b, &record).unwrap()) {
        assert_eq!(std::fs::read(one).unwrap(), std::fs::read(other).unwrap());
    }
}

#[test]
fn a_drive_that_never_began_is_still_drawn() {
    let mut record = made_up_drive(Outcome::Unreachable);
    record.trace = Trace::default();
    record.grid = Grid::new(RESOLUTION_M);
    record.truth = Vec::new();
    record.goal = Point::new(3.0, 4.0);
    record.summary.min_clearance_m = f64::INFINITY;
    record.summary.time_s = 0.0;
    record.title = "a <title> & more".into();
    let folder = folder("never-began");
    write(&folder, &record).unwrap();
    assert_texts_on_page(&folder.join("drive.svg"));
    assert_texts_on_page(&folder.join("speed.svg"));
}

#[test]
fn a_long_narrow_map_and_a_picture_taken_at_rest_fit_on_the_page() {
    let mut record = made_up_drive(Outcome::Stuck);
    record.grid = Grid::new(0.05);
    for y in 0..1200 {
        for x in 0..60 {
            let wall = x == 0 || x == 59;
            record.grid.set(CellIndex::new(x, y), if wall { Cell::Occupied } else { Cell::Free });
        }
    }
    record.start = Pose::new(1.5, 1.0, FRAC_PI_2);
    record.goal = Point::new(1.5, 58.0);
    let samples = (0..100).map(|i| TraceSample {
        t_s: f64::from(i) * 0.01,
        pose: Pose::new(1.5, 1.0, FRAC_PI_2),
        speed_mps: 0.0,
        curvature_pm: 0.0,
        longitudinal_n: 0.0,
        lateral_n: 0.0,
    });
    record.trace = Trace { samples: samples.collect(), plans: Vec::new() };
    let folder = folder("narrow");
    write(&folder, &record).unwrap();
    assert_texts_on_page(&folder.join("drive.svg"));
}

#[test]
fn a_folder_that_cannot_be_made_is_named() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let error = write(&file.path().join("x"), &made_up_drive(Outcome::Goal)).unwrap_err();
    assert!(error.to_string().contains("cannot write"), "{error}");
}
