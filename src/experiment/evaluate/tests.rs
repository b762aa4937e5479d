use super::*;
use crate::experiment::dataset::{self, HELD_OUT_FROM, Settings};
use crate::map::Cell;

/// The truth, blurred: 1 becomes `sure`, 0 becomes `1 - sure`.
struct Oracle {
    sure: f32,
}

impl Probabilities for Oracle {
    fn name(&self) -> String {
        "oracle".into()
    }

    fn probabilities(
        &mut self,
        view: &View,
        cells: &[usize],
        out: &mut [f32],
    ) -> Result<(), PredictionError> {
        for (k, p) in cells.iter().zip(out) {
            assert_eq!(view.crop.cells[*k], Cell::Unknown, "asked for a cell that is observed");
            *p = if view.truth[*k] == 1 { self.sure } else { 1.0 - self.sure };
        }
        Ok(())
    }
}

fn settings(seeds: [u64; 2]) -> Settings {
    Settings {
        families: vec!["thin".into()],
        seeds,
        scenes_per_world: 5,
        resolution_m: 0.25,
        world_resolution_m: 0.25,
        lidar_ranges_m: vec![5.0],
        beams: 2880,
        along_drive: 0.2,
        drive_max_m: 20.0,
        clearance_m: 0.5,
        held_out: seeds[0] >= HELD_OUT_FROM,
        seed: 1,
    }
}

fn request() -> Request {
    let made = |seeds| SceneSource::Made { settings: settings(seeds), maps: Vec::new() };
    Request {
        sets: vec![SetRequest {
            name: "thin".into(),
            scenes: made([1_000_000, 1_000_006]),
            fit: Some(made([0, 12])),
        }],
        radii_m: vec![7.5, 5.0],
        pictures: 2,
    }
}

#[test]
fn a_predictor_that_knows_is_scored_above_all_baselines() {
    let mut models: Vec<Box<dyn Probabilities>> = vec![Box::new(Oracle { sure: 0.9 })];
    let (evaluation, samples) = evaluate(&request(), &mut models, &|_, _| {}).unwrap();
    let set = &evaluation.sets[0];
    assert_eq!((set.scenes, set.worlds, set.held_out), (30, 6, Some(true)));
    assert_eq!(set.baselines_fitted_on, "thin mazes, seeds 0..12");
    for radius in &set.radii {
        let names: Vec<&str> = radius.predictors.iter().map(|p| p.name.as_str()).collect();
        assert_eq!(names.len(), 7);
        let oracle = &radius.predictors[0];
        assert_eq!((oracle.scores.accuracy, oracle.scores.auc), (1.0, Some(1.0)));
        assert!((oracle.scores.log_loss + 0.9f64.ln()).abs() < 1e-6);
        assert!((oracle.scores.ece - 0.1).abs() < 1e-6);
        for baseline in &radius.predictors[1..] {
            assert!(baseline.scores.count == oracle.scores.count);
            assert!(baseline.scores.log_loss > 0.105 || baseline.name.contains("boundary"));
            assert!(baseline.log_loss_ci95.unwrap() > 0.0);
            let against = baseline.against_first.unwrap();
            let difference = baseline.scores.log_loss - oracle.scores.log_loss;
            assert!((against.mean - difference).abs() < 1e-9, "{}", baseline.name);
            // The oracle's loss is the same everywhere, so pairing gains nothing.
            assert!((against.ci95.unwrap() - baseline.log_loss_ci95.unwrap()).abs() < 1e-6);
        }
        // The bands hold every cell once.
        let banded: u64 = oracle.by_distance.iter().map(|band| band.scores.count).sum();
        assert_eq!(banded, oracle.scores.count);
        let binned: u64 = oracle.reliability.iter().map(|bin| bin.count).sum();
        assert_eq!(binned, oracle.scores.count);
        let loss =
            |name: &str| radius.predictors.iter().find(|p| p.name == name).unwrap().scores.log_loss;
        assert!(loss("lattice oracle") < 0.6 * loss("prior"));
        assert!(loss("nearest label x wall distance") < loss("prior"));
    }
    let edges = &set.edges[0];
    assert!(edges.near.count > 20, "{}", edges.near.count);
    assert_eq!((edges.near.auc, edges.near.accuracy), (Some(1.0), 1.0));
    let prior = set.edges.iter().find(|e| e.name == "prior").unwrap();
    assert_eq!(prior.near.auc, Some(0.5));

    assert_eq!(samples.len(), 2);
    let (name, p) = &samples[0].predictions[0];
    assert_eq!(name, "oracle");
    let asked = p.iter().filter(|p| !p.is_nan()).count();
    assert!(asked > 1000, "{asked}");

    let text = table(&evaluation);
    assert!(text.contains("held out") && text.contains("lattice oracle with boundary"), "{text}");
    let json = serde_json::to_value(&evaluation).unwrap();
    assert!(json["sets"][0]["radii"][0]["predictors"][0]["log_loss"].is_number());
    let facts = ModelFacts {
        name: "oracle".into(),
        file: "oracle.onnx".into(),
        bytes: 12,
        sha256: "ab".into(),
        metadata: vec![("architecture".into(), "a|b".into())],
    };
    let page = card(&facts, &evaluation, &["prior".into()]);
    assert!(page.contains("a\\|b") && page.contains("| oracle |"), "{page}");
    assert!(!page.contains("| prior |"));
    let columns = |line: &str| line.matches(" |").count();
    let rows: Vec<&str> = page
        .lines()
        .filter(|l| l.starts_with("| predictor | log loss | accuracy | AUC | ECE"))
        .collect();
    let row = page.lines().find(|l| l.starts_with("| oracle | 0.1054")).unwrap();
    assert_eq!(columns(rows[0]), columns(row), "{}\n{row}", rows[0]);
}

#[test]
fn the_scores_are_the_same_from_a_stored_data_set() {
    let folder = tempfile::tempdir().unwrap();
    let mut request = request();
    let SceneSource::Made { settings, .. } = &request.sets[0].scenes else { panic!() };
    dataset::generate(settings, &[], folder.path(), true, &|_, _| {}).unwrap();
    let run = |request: &Request| {
        let mut models: Vec<Box<dyn Probabilities>> = vec![Box::new(Oracle { sure: 0.7 })];
        evaluate(request, &mut models, &|_, _| {}).unwrap().0
    };
    let made = run(&request);
    request.sets[0].scenes =
        SceneSource::Stored { folder: folder.path().to_owned(), most: usize::MAX };
    let stored = run(&request);
    assert_eq!(stored.sets[0].radii, made.sets[0].radii);
    assert_eq!(stored.sets[0].edges, made.sets[0].edges);
    assert_eq!(stored.sets[0].held_out, Some(true));
    assert!(stored.sets[0].manifest_sha256.is_some());
}

#[test]
fn training_scenes_are_named_as_such() {
    let mut request = request();
    request.sets[0].fit = None;
    request.sets[0].scenes = SceneSource::Made { settings: settings([3, 5]), maps: Vec::new() };
    let (evaluation, _) = evaluate(&request, &mut [], &|_, _| {}).unwrap();
    let set = &evaluation.sets[0];
    assert_eq!(set.held_out, Some(false));
    assert_eq!(set.baselines_fitted_on, "the scored scenes themselves");
    assert!(table(&evaluation).contains("NOT held out"));
}

#[test]
fn a_predictor_that_gives_no_probabilities_or_fails_ends_the_evaluation() {
    struct Bad(Result<f32, PredictionError>);
    impl Probabilities for Bad {
        fn name(&self) -> String {
            "bad".into()
        }
        fn probabilities(
            &mut self,
            _: &View,
            _: &[usize],
            out: &mut [f32],
        ) -> Result<(), PredictionError> {
            out.fill(self.0.clone()?);
            Ok(())
        }
    }
    for (bad, wanted) in [
        (Bad(Ok(f32::NAN)), "bad cannot be scored: it gives the probability NaN"),
        (Bad(Ok(1.5)), "probability 1.5"),
        (Bad(Err(PredictionError::Failed("no room".into()))), "no room"),
    ] {
        let mut models: Vec<Box<dyn Probabilities>> = vec![Box::new(bad)];
        let error = evaluate(&request(), &mut models, &|_, _| {}).err().unwrap().to_string();
        assert!(error.contains(wanted), "{error}");
    }
}
