//! The learned predictor: a trained network asked about the cells around the car.

use super::crop_network::CropNetwork;
use super::fault::PredictFault;
use super::lattice::{CROP_CELLS, CROP_CENTRE, Crop, Lattice};
use super::network::Network;
use super::reach::Reach;
use super::{Effort, OccupancyView, PredictParams, Predictor, SILENT, Scene};
use crate::frames::{Point, Vector};
use crate::map::Cell;
use crate::time::Duration;

/// A decoder that works for every target is asked for squares of this many coarse cells by as many
/// (2 m by 2 m at 0.25 m): each question costs a little by itself, each target more.
const TILE_CELLS: usize = 8;
/// No place in the crop.
const NOWHERE: usize = usize::MAX;

/// Asks a trained network.
///
/// The network sees coarse cells, 26 m by 26 m of them around the car. A scene is encoded when the
/// first of its cells is asked for, and each coarse cell is decoded at most once a scene. The
/// answer is 0.5 where the network has nothing to say: in coarse cells that have been seen,
/// outside the square, and beyond the prediction range of the frontier.
pub struct CnpPredictor {
    network: CropNetwork,
    lattice: Lattice,
    crop: Crop,
    reach: Reach,
    time_limit: Option<Duration>,
    fault: Option<PredictFault>,
    /// One for each cell of the crop; NaN where the network is to be asked.
    answers: Vec<f32>,
    within: Vec<bool>,
    /// Places in the crop of the points asked for, [`NOWHERE`] outside.
    places: Vec<usize>,
    wanted: Vec<u32>,
    given: Vec<f32>,
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
            // An infinite limit is none.
            time_limit: Duration::try_from_secs_f64(params.time_limit_s).ok(),
            fault: None,
            answers: vec![SILENT; CROP_CELLS * CROP_CELLS],
            within: Vec::new(),
            places: Vec::new(),
            wanted: Vec::new(),
            given: Vec::new(),
            network: CropNetwork::new(network, params.fade),
        }
    }

    /// The crop's cell that holds a point.
    fn cell(&self, p: Point) -> Option<usize> {
        let index = |v: f64, car: i32| {
            let at = whole_below(v / self.crop.resolution_m)
                .saturating_sub(i64::from(car) - CROP_CENTRE as i64);
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

    /// Asks the network for the cells of `wanted`, and what goes with them.
    fn decode(&mut self) -> Result<(), PredictFault> {
        self.add_company();
        self.network.answer(&self.crop, &self.wanted, &mut self.given)?;
        for (at, answer) in self.wanted.iter().zip(&self.given) {
            self.answers[*at as usize] = *answer;
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
    towards_zero.saturating_sub(i64::from(towards_zero as f64 > v))
}

impl OccupancyView for CnpPredictor {
    fn occupied(&mut self, points: &[Point], out: &mut [f32]) {
        out.fill(SILENT);
        if self.fault.is_some() {
            return;
        }
        self.wanted.clear();
        let mut places = std::mem::take(&mut self.places);
        places.clear();
        for point in points {
            let at = self.cell(*point).unwrap_or(NOWHERE);
            if self.answers.get(at).is_some_and(|answer| answer.is_nan()) {
                self.wanted.push(at as u32);
            }
            places.push(at);
        }
        self.places = places;
        if !self.wanted.is_empty()
            && let Err(fault) = self.decode()
        {
            self.fault = Some(fault);
            return;
        }
        for (at, out) in self.places.iter().zip(out) {
            if let Some(answer) = self.answers.get(*at) {
                *out = *answer;
            }
        }
    }

    fn familiarity(&mut self) -> f64 {
        if self.fault.is_some() {
            return 0.0;
        }
        self.network.familiarity(&self.crop).unwrap_or_else(|fault| {
            self.fault = Some(fault);
            0.0
        })
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
        self.forget_answers();
        self.network.begin();
        self.fault = None;
    }

    fn fault(&self) -> Option<&PredictFault> {
        self.fault.as_ref()
    }

    fn effort(&self) -> Effort {
        self.network.effort()
    }

    fn time_limit(&self) -> Option<Duration> {
        self.time_limit
    }
}

#[cfg(test)]
#[path = "cnp_tests.rs"]
mod tests;
