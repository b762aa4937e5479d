//! The learned predictor: a trained network asked about the cells around the car.

use super::fault::PredictFault;
use super::lattice::{CROP_CELLS, CROP_CENTRE, Crop, Lattice};
use super::network::{Answers, Network};
use super::reach::Reach;
use super::trust::faded;
use super::{Effort, OccupancyView, PredictParams, Predictor, SILENT, Scene};
use crate::frames::{Point, Vector};
use crate::map::Cell;
use crate::time::Duration;

/// A decoder that works for every target is asked for squares of this many coarse cells by as many
/// (2 m by 2 m at 0.25 m): each question costs a little by itself, each target more.
const TILE_CELLS: usize = 8;
/// The pieces of the frontier from which calibration measures: the nearest eight of at least three
/// cells, as in the data sets.
const FRONTIERS_MAX: usize = 8;
const FRONTIER_CELLS_MIN: usize = 3;

/// Asks a trained network.
///
/// The network sees coarse cells, 26 m by 26 m of them around the car. A scene is encoded when the
/// first of its cells is asked for, and each coarse cell is decoded at most once a scene. The
/// answer is 0.5 where the network has nothing to say: in coarse cells that have been seen,
/// outside the square, and beyond the prediction range of the frontier.
pub struct CnpPredictor {
    network: Network,
    lattice: Lattice,
    crop: Crop,
    reach: Reach,
    fade: bool,
    time_limit: Option<Duration>,
    frontier: FrontierDistance,
    context: Vec<[f32; 3]>,
    encoded: bool,
    fault: Option<PredictFault>,
    /// One for each cell of the crop; NaN where the network is to be asked.
    answers: Vec<f32>,
    within: Vec<bool>,
    wanted: Vec<u32>,
    targets: Vec<[f32; 2]>,
    decoded: Answers,
    effort: Effort,
}

impl CnpPredictor {
    /// A predictor that asks this network. Its range is the parameters', or the one that the
    /// network was trained for if that is shorter.
    pub(super) fn new(network: Network, params: &PredictParams) -> Self {
        let metadata = network.metadata();
        let range_m = params.range_m.min(metadata.prediction_range_m);
        Self {
            lattice: Lattice::new(metadata.resolution_m),
            crop: Crop::default(),
            reach: Reach::new(range_m),
            fade: params.fade,
            // An infinite limit is none.
            time_limit: Duration::try_from_secs_f64(params.time_limit_s).ok(),
            frontier: FrontierDistance::default(),
            context: Vec::new(),
            encoded: false,
            fault: None,
            answers: vec![SILENT; CROP_CELLS * CROP_CELLS],
            within: Vec::new(),
            wanted: Vec::new(),
            targets: Vec::new(),
            decoded: Answers::default(),
            effort: Effort::default(),
            network,
        }
    }

    /// The crop's cell that holds a point.
    fn cell(&self, p: Point) -> Option<usize> {
        let index = |v: f64, car: i32| {
            let at = whole_below(v / self.crop.resolution_m) - i64::from(car) + CROP_CENTRE as i64;
            usize::try_from(at).ok().filter(|k| *k < CROP_CELLS)
        };
        let (column, row) = (index(p.x, self.crop.car.ix)?, index(p.y, self.crop.car.iy)?);
        Some(row * CROP_CELLS + column)
    }

    /// Nothing has been asked for yet: NaN where the network may have something to say.
    fn forget_answers(&mut self) {
        let size_m = self.crop.resolution_m;
        let middle = Vector::repeat((0.5 - CROP_CENTRE as f64) * size_m);
        self.reach.mark(self.crop.origin() + middle, size_m, CROP_CELLS, &mut self.within);
        let cells = self.crop.cells.iter().zip(&self.within);
        for (answer, (cell, within)) in self.answers.iter_mut().zip(cells) {
            let open = *cell == Cell::Unknown && *within;
            *answer = if open { f32::NAN } else { SILENT };
        }
    }

    /// Decodes the cells of `wanted`, and what goes with them.
    fn decode(&mut self) -> Result<(), PredictFault> {
        if !self.encoded {
            self.crop.context(self.network.metadata().context, &mut self.context);
            if self.context.is_empty() {
                self.answers.fill(SILENT);
                return Ok(());
            }
            self.network.encode(&self.context).map_err(PredictFault::Failed)?;
            self.effort.context = self.context.len() as u32;
            self.encoded = true;
        }
        self.add_company();
        self.targets.clear();
        let centre =
            |at: &u32| self.crop.centre(*at as usize % CROP_CELLS, *at as usize / CROP_CELLS);
        self.targets.extend(self.wanted.iter().map(centre));
        self.network.decode(&self.targets, &mut self.decoded).map_err(PredictFault::Failed)?;
        self.effort.decoded += self.wanted.len() as u32;
        let familiarity = if self.fade { &self.decoded.familiarity[..] } else { &[] };
        let outside = |p: &&f32| !(0.0..=1.0).contains(*p);
        let mut given = self.decoded.probability.iter().chain(familiarity);
        if let Some(value) = given.find(outside) {
            return Err(PredictFault::NotAProbability { value: *value });
        }
        let calibration = self.network.metadata().calibration.as_ref();
        for (i, (at, p)) in self.wanted.iter().zip(&self.decoded.probability).enumerate() {
            let calibrated = calibration.map_or(*p, |calibration| {
                calibration.calibrated(*p, self.frontier.metres(&self.crop, *at as usize))
            });
            let weight = match familiarity {
                [] => 1.0,
                [scene] => *scene,
                each => each[i],
            };
            self.answers[*at as usize] = faded(calibrated, weight);
        }
        Ok(())
    }

    /// Adds the cells to `wanted` that will be asked for next and are cheap to decode along.
    fn add_company(&mut self) {
        let side = if self.network.asks_all_at_once() { CROP_CELLS } else { TILE_CELLS };
        let mut tiles: Vec<usize> = Vec::new();
        for at in self.wanted.drain(..) {
            let (column, row) = (at as usize % CROP_CELLS, at as usize / CROP_CELLS);
            let tile = row / side * side * CROP_CELLS + column / side * side;
            if !tiles.contains(&tile) {
                tiles.push(tile);
            }
        }
        for tile in tiles {
            for row in 0..side {
                let cells = tile + row * CROP_CELLS..tile + row * CROP_CELLS + side;
                let open = cells.filter(|at| self.answers[*at].is_nan());
                self.wanted.extend(open.map(|at| at as u32));
            }
        }
    }
}

/// The largest whole number not above a finite one of moderate size (`f64::floor` is a call into the
/// C library on the oldest x86-64).
fn whole_below(v: f64) -> i64 {
    let towards_zero = v as i64;
    towards_zero - i64::from(towards_zero as f64 > v)
}

impl OccupancyView for CnpPredictor {
    fn occupied(&mut self, points: &[Point], out: &mut [f32]) {
        out.fill(SILENT);
        if self.fault.is_some() {
            return;
        }
        self.wanted.clear();
        for point in points {
            if let Some(at) = self.cell(*point).filter(|at| self.answers[*at].is_nan()) {
                self.wanted.push(at as u32);
            }
        }
        if !self.wanted.is_empty()
            && let Err(fault) = self.decode()
        {
            self.fault = Some(fault);
            return;
        }
        for (point, out) in points.iter().zip(out) {
            if let Some(at) = self.cell(*point) {
                *out = self.answers[at];
            }
        }
    }

    fn silent(&self, low: Point, high: Point) -> bool {
        let (first, last) = (self.lattice.cell_at(low), self.lattice.cell_at(high));
        let car = self.crop.car;
        let beyond = |first: i32, last: i32, car: i32| {
            last < car - CROP_CENTRE as i32 || first >= car + (CROP_CELLS - CROP_CENTRE) as i32
        };
        // The range is told by the centre of the coarse cell, which may lie outside the rectangle.
        let (first_centre, last_centre) =
            (self.lattice.cells().centre(first), self.lattice.cells().centre(last));
        self.fault.is_some()
            || beyond(first.ix, last.ix, car.ix)
            || beyond(first.iy, last.iy, car.iy)
            || !self.reach.touches(low.inf(&first_centre), high.sup(&last_centre))
    }
}

impl Predictor for CnpPredictor {
    fn observe(&mut self, scene: &Scene<'_>) {
        self.lattice.update(scene.grid, scene.changed);
        self.reach.update(scene.grid, scene.changed);
        self.lattice.crop(scene.pose.position, &mut self.crop);
        self.frontier.stale = true;
        self.forget_answers();
        self.encoded = false;
        self.fault = None;
        self.effort = Effort::default();
    }

    fn fault(&self) -> Option<&PredictFault> {
        self.fault.as_ref()
    }

    fn effort(&self) -> Effort {
        self.effort
    }

    fn time_limit(&self) -> Option<Duration> {
        self.time_limit
    }
}

/// Distance to the nearest piece of the frontier, as the data sets have it.
#[derive(Clone, Debug)]
struct FrontierDistance {
    stale: bool,
    /// Columns and rows of the pieces' centres, nearest to the car first.
    centres: Vec<[usize; 2]>,
}

impl Default for FrontierDistance {
    fn default() -> Self {
        Self { stale: true, centres: Vec::new() }
    }
}

impl FrontierDistance {
    /// Metres from a cell's centre to that of the nearest piece; infinite if there is none.
    fn metres(&mut self, crop: &Crop, at: usize) -> f32 {
        if std::mem::take(&mut self.stale) {
            self.centres = crop.frontier_centres(FRONTIER_CELLS_MIN);
            self.centres.truncate(FRONTIERS_MAX);
        }
        let (column, row) = (at % CROP_CELLS, at / CROP_CELLS);
        let square = |c: &[usize; 2]| c[0].abs_diff(column).pow(2) + c[1].abs_diff(row).pow(2);
        let least = self.centres.iter().map(square).min();
        least.map_or(f32::INFINITY, |least| (least as f32).sqrt() * crop.resolution_m as f32)
    }
}

#[cfg(test)]
#[path = "cnp_tests.rs"]
mod tests;
