use super::*;
use crate::mapfile::{self, MapFile};

fn settings() -> Settings {
    Settings {
        families: ["thin", "solid", "branching"].map(str::to_owned).to_vec(),
        seeds: [3, 5],
        scenes_per_world: 7,
        resolution_m: 0.25,
        world_resolution_m: 0.1,
        lidar_ranges_m: vec![7.5, 5.0],
        beams: 1080,
        along_drive: 0.5,
        drive_max_m: 20.0,
        clearance_m: 0.3,
        held_out: false,
        seed: 1,
    }
}

fn make(settings: &Settings, maps: &[PathBuf], out: &Path) -> Result<Manifest, DatasetError> {
    generate(settings, maps, out, false, &|_, _| {})
}

/// Rows of an array file of bytes.
fn rows(folder: &Path, name: &str, row: usize) -> Vec<Vec<u8>> {
    let bytes = std::fs::read(folder.join(name)).unwrap();
    bytes[128..].chunks_exact(row).map(<[u8]>::to_vec).collect()
}

#[test]
fn the_bytes_follow_from_the_settings_whatever_the_number_of_threads() {
    let root = tempfile::tempdir().unwrap();
    let run = |threads: usize, name: &str| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| make(&settings(), &[], &root.path().join(name))).unwrap()
    };
    let (one, two) = (run(1, "one"), run(2, "two"));
    assert_eq!(one, two);
    assert_eq!(one.scenes, 42);
    for array in &one.arrays {
        let bytes = |name: &str| std::fs::read(root.path().join(name).join(&array.file)).unwrap();
        assert_eq!(bytes("one"), bytes("two"), "{}", array.file);
        assert_eq!(sha256(&bytes("one")), array.sha256);
    }
    let other = Settings { seed: 2, ..settings() };
    let other = make(&other, &[], &root.path().join("other")).unwrap();
    assert_ne!(one.arrays[0], other.arrays[0], "another seed gives other scenes");
}

#[test]
fn what_is_observed_agrees_with_the_truth() {
    let root = tempfile::tempdir().unwrap();
    for (name, settings) in [
        ("fine", settings()),
        ("coarse", Settings { world_resolution_m: 0.25, beams: 2880, ..settings() }),
    ] {
        let folder = root.path().join(name);
        make(&settings, &[], &folder).unwrap();
        let cells = CROP_CELLS * CROP_CELLS;
        let observed = rows(&folder, "observed.npy", cells);
        let truth = rows(&folder, "truth.npy", cells);
        assert_eq!(observed.len(), 42);
        let (mut free, mut occupied, mut wrong) = (0, 0, 0);
        for (seen, there) in observed.iter().zip(&truth) {
            let middle = CROP_CELLS / 2 * CROP_CELLS + CROP_CELLS / 2;
            assert_eq!(there[middle], 0, "the car stands in a free cell");
            for (seen, there) in seen.iter().zip(there) {
                match (seen, there) {
                    (1, 0) => free += 1,
                    (2, 1) => occupied += 1,
                    (0, _) => {}
                    _ => wrong += 1,
                }
            }
        }
        assert!(free > 5_000 && occupied > 1_000, "{name}: {free} {occupied}");
        assert_eq!(wrong, 0, "{name}: cells observed otherwise than they are");
    }
}

#[test]
fn held_out_seeds_and_training_seeds_are_kept_apart() {
    let root = tempfile::tempdir().unwrap();
    let out = root.path().join("data");
    let with = |seeds, held_out| Settings { seeds, held_out, scenes_per_world: 1, ..settings() };
    let refused = make(&with([999_999, 1_000_001], false), &[], &out).unwrap_err();
    assert!(matches!(refused, DatasetError::HeldOut { .. }), "{refused}");
    assert!(refused.to_string().contains("1000000"), "{refused}");
    let refused = make(&with([999_999, 1_000_001], true), &[], &out).unwrap_err();
    assert!(matches!(refused, DatasetError::NotHeldOut { from: 999_999 }), "{refused}");
    assert!(!out.exists(), "nothing is written before the seeds are checked");
    let manifest = make(&with([1_000_000, 1_000_001], true), &[], &out).unwrap();
    assert!(manifest.settings.held_out);
    make(&with([999_999, 1_000_000], false), &[], &root.path().join("training")).unwrap();
}

#[test]
fn a_folder_that_is_not_empty_is_refused() {
    let root = tempfile::tempdir().unwrap();
    std::fs::write(root.path().join("kept"), "x").unwrap();
    let small = Settings { seeds: [1, 2], scenes_per_world: 1, ..settings() };
    let refused = make(&small, &[], root.path()).unwrap_err();
    assert!(matches!(refused, DatasetError::NotEmpty { .. }), "{refused}");
    generate(&small, &[], root.path(), true, &|_, _| {}).unwrap();
    assert!(root.path().join("kept").exists());
}

#[test]
fn settings_out_of_range_are_named() {
    let root = tempfile::tempdir().unwrap();
    for (wanted, settings) in [
        ("a family is thick", Settings { families: vec!["thick".into()], ..settings() }),
        ("scenes a world is 0", Settings { scenes_per_world: 0, ..settings() }),
        ("resolution is 0.05", Settings { resolution_m: 0.05, ..settings() }),
        ("along drives is 1.5", Settings { along_drive: 1.5, ..settings() }),
        ("clearance is 0", Settings { clearance_m: 0.0, ..settings() }),
        ("beams is 3", Settings { beams: 3, ..settings() }),
        ("lidar range is NaN", Settings { lidar_ranges_m: vec![5.0, f64::NAN], ..settings() }),
        ("lidar ranges is empty", Settings { lidar_ranges_m: vec![], ..settings() }),
        ("maze's resolution is 0.3", Settings { world_resolution_m: 0.3, ..settings() }),
        ("no world", Settings { seeds: [0, 0], ..settings() }),
        ("range of seeds is 5..3", Settings { seeds: [5, 3], ..settings() }),
    ] {
        let error = make(&settings, &[], &root.path().join("x")).unwrap_err().to_string();
        assert!(error.contains(wanted), "{wanted}: {error}");
    }
}

#[test]
fn maps_in_folders_give_scenes_without_targets_where_nobody_has_looked() {
    let root = tempfile::tempdir().unwrap();
    let maps = root.path().join("maps/deep");
    std::fs::create_dir_all(&maps).unwrap();
    // A room of 8 by 6 m with a pillar, and a strip of unknown pixels behind its right wall.
    let (width, height) = (200, 120);
    let cells = (0..width * height)
        .map(|k| {
            let (x, y) = (k % width, k / width);
            match (x, y) {
                (161.., _) => mapfile::MapCell::Unknown,
                (0 | 160, _) | (_, 0 | 119) | (60..70, 60..70) => mapfile::MapCell::Occupied,
                _ => mapfile::MapCell::Free,
            }
        })
        .collect();
    let origin = crate::frames::Pose::new(-3.3, 4.7, 0.1);
    let map = MapFile { resolution_m: 0.05, origin, width, height, cells };
    mapfile::save(maps.join("room.yaml"), &map).unwrap();
    std::fs::write(maps.join("other.yaml"), "unrelated: 1\n").unwrap();
    let folders = [root.path().join("maps")];
    for world_resolution_m in [0.1, 0.25] {
        let settings = Settings { seeds: [0, 0], world_resolution_m, ..settings() };
        let out = root.path().join(format!("data-{world_resolution_m}"));
        let manifest = make(&settings, &folders, &out).unwrap();
        assert_eq!((manifest.scenes, manifest.maps.len()), (7, 1));
        assert_eq!(manifest.maps[0].scenes, 7);
        assert_eq!(manifest.maps[0].sha256, map_hash(&map));
        assert!(manifest.maps[0].file.ends_with("room.yaml"));
        assert_eq!(rows(&out, "family.npy", 1), vec![vec![FAMILY_MAP]; 7]);
        let truth = rows(&out, "truth.npy", CROP_CELLS * CROP_CELLS);
        let count = |label| truth[0].iter().filter(|t| **t == label).count();
        assert!(count(0) > 600 && count(1) > 80, "{} {}", count(0), count(1));
        assert_eq!(count(0) + count(1) + count(NO_TARGET), CROP_CELLS * CROP_CELLS);
    }
    let none = make(&settings(), &[root.path().join("data-0.1")], &root.path().join("y"));
    assert!(matches!(none.unwrap_err(), DatasetError::NoMaps { .. }));
}
