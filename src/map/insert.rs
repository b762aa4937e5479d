//! Scans into the grid: which cells a scan proves free and which it shows occupied.

use std::sync::Arc;

use super::fan::{Fan, Hit, Limits};
use super::{Cell, CellIndex, CellRect, Grid};
use crate::frames::{Point, Pose, Vector};
use crate::scan::Scan;
use crate::tunables;

tunables! {
    /// The occupancy grid and the rules by which scans change it.
    pub struct MapParams in "map" {
        /// Side of a cell.
        resolution_m: f64 = 0.1, restart, in 0.02..=0.5, "m";
        /// A cell counts as seen when all of it but a rim of this width has been seen. Keeps
        /// rounding of ranges from costing the cells along walls; part of the certificate's margin.
        free_tolerance_m: f64 = 0.01, restart, in 0.0..=0.05, "m";
        /// A beam that ends this close to something known to be occupied (or to unknown space
        /// behind) has found nothing new. Should exceed pose drift and four standard deviations of
        /// the range.
        hit_tolerance_m: f64 = 0.03, restart, in 0.0..=0.2, "m";
        /// The occupied cell is looked up this far behind the surface, so that a wall on a cell
        /// boundary falls into the cell behind it.
        hit_depth_m: f64 = 0.01, restart, in 0.0..=0.05, "m";
        /// Obstacles thinner than this may be missed. Beams farther apart than this (or than half a
        /// cell) prove nothing free.
        min_obstacle_m: f64 = 0.05, restart, in 0.01..=0.5, "m";
    }
}

/// Why a scan changed nothing.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// Pose, angles or range are not usable numbers.
    #[error("the scan's {what} is {value}, but must be {wanted}")]
    BadNumber {
        /// Which number.
        what: &'static str,
        /// Its value.
        value: f64,
        /// What is allowed, in words.
        wanted: &'static str,
    },
    /// The grid would grow beyond [`CELLS_MAX`].
    #[error("the grid would grow to {cells} cells, allowed are {CELLS_MAX}")]
    TooLarge {
        /// Cells needed.
        cells: u64,
    },
}

/// The most cells that a grid may grow to: 640 m by 640 m at 0.1 m.
pub const CELLS_MAX: u64 = 1 << 26;

/// Ranges are cut here, metres: no lidar of a small car measures farther, and a wrong setting must
/// not make the grid explode.
const RANGE_CAP_M: f64 = 100.0;

/// Room that the grid keeps around everything seen, metres, so that distances up to this one are
/// right up to the grid's edge.
const BORDER_M: f64 = 2.0;

/// What one scan changed.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct Insertion {
    /// Holds every cell whose state changed (a quarter that was seen changes none).
    pub changed: CellRect,
    /// Unknown cells that became free.
    pub newly_free: usize,
    /// Unknown cells that became occupied.
    pub newly_occupied: usize,
    /// Cells that were free, or of which the quarter that was hit had been seen, and became occupied:
    /// something was set down in free space, and the plan under way must be certified again.
    pub turned_occupied: usize,
    /// Why the scan was not used, if it was not.
    pub refused: Option<Refusal>,
}

impl Insertion {
    fn record(&mut self, c: CellIndex) {
        let cell = CellRect { x0: c.ix, y0: c.iy, x1: c.ix + 1, y1: c.iy + 1 };
        self.changed = self.changed.union(&cell);
    }
}

/// Owns the grid and changes it by scans. Within one drive cells only ever go from unknown to free
/// or occupied, and from free to occupied.
#[derive(Clone, Debug)]
pub struct Mapper {
    params: MapParams,
    grid: Arc<Grid>,
    fan: Fan,
    freed: Vec<CellIndex>,
    /// Quarters of unknown cells that the scan proves free.
    glimpsed: Vec<(CellIndex, u8)>,
    /// Hits that may belong to a neighbouring cell: end point, cell to mark, and how near to it an
    /// occupied cell explains the hit, metres.
    doubtful: Vec<(Point, CellIndex, f64)>,
    /// Hits inside free space, with the place that each would turn.
    surprises: Vec<(Point, Point)>,
}

impl Mapper {
    /// A mapper that knows nothing yet.
    pub fn new(params: &MapParams) -> Self {
        Self {
            params: params.clone(),
            grid: Arc::new(Grid::new(params.resolution_m)),
            fan: Fan::default(),
            freed: Vec::new(),
            glimpsed: Vec::new(),
            doubtful: Vec::new(),
            surprises: Vec::new(),
        }
    }

    /// A mapper that starts from a known map; the grid's resolution counts.
    pub fn with_grid(params: &MapParams, grid: Grid) -> Self {
        let params = MapParams { resolution_m: grid.resolution_m(), ..params.clone() };
        Self { grid: Arc::new(grid), ..Self::new(&params) }
    }

    /// The grid as it is now.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// The grid as it is now, to keep. Costs nothing unless it is still held when the grid changes
    /// next; then the grid is copied once.
    pub fn snapshot(&self) -> Arc<Grid> {
        Arc::clone(&self.grid)
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        self.grid = Arc::new(Grid::new(self.params.resolution_m));
    }

    /// Forgets everything but the bounds: cells go back to unknown.
    pub fn forget(&mut self) {
        let bounds = self.grid.bounds();
        let mut blank = Grid::new(self.grid.resolution_m());
        blank.grow_to(bounds);
        self.grid = Arc::new(blank);
    }

    /// Takes a scan measured at `pose` (body frame in the map frame; the lidar sits at the body
    /// origin).
    ///
    /// First every beam that ended on a surface marks the cell just behind that surface occupied,
    /// unless something known explains the hit: an occupied cell within `hit_tolerance_m`, or, if
    /// the hit lies in a free cell, an unknown cell that close behind it (which is marked instead).
    /// A free cell turns occupied only where nothing explains the hit. So does a cell of which the
    /// quarter that was hit has been seen.
    ///
    /// Then an unknown cell becomes free if its square, less a rim of `free_tolerance_m`, lies
    /// inside the triangles spanned by neighbouring beams (see `fan`), and these stand at most half
    /// a cell (and `min_obstacle_m`) apart at its far corner. Occupied cells are never freed. Of a
    /// cell that stays unknown the quarters are noted of which this holds, unless they are so small
    /// that little but rim would be left.
    pub fn insert(&mut self, pose: &Pose, scan: &Scan) -> Insertion {
        let mut insertion = Insertion::default();
        if let Err(refusal) = self.prepare(pose, scan) {
            insertion.refused = Some(refusal);
            return insertion;
        }
        self.mark_hits(&mut insertion);
        self.mark_free(pose.position, &mut insertion);
        insertion
    }

    /// Marks the cells wholly inside the car's own disc free (position in the map frame, metres):
    /// where the car stands there is nothing else. Occupied cells stay occupied.
    pub fn mark_footprint(&mut self, position: Point, radius_m: f64) -> Insertion {
        let mut insertion = Insertion::default();
        let radius = Vector::repeat(radius_m);
        match self.reserve(position - radius, position + radius) {
            Err(refusal) => {
                insertion.refused = Some(refusal);
                return insertion;
            }
            Ok(()) => self.freed.clear(),
        }
        let low = self.grid.cell_at(position - radius);
        let high = self.grid.cell_at(position + radius);
        for iy in low.iy..=high.iy {
            for ix in low.ix..=high.ix {
                let c = CellIndex::new(ix, iy);
                let offset = (self.grid.centre(c) - position).abs();
                let corner = offset + Vector::repeat(0.5 * self.grid.resolution_m());
                if corner.norm() <= radius_m && self.grid.get(c) == Cell::Unknown {
                    self.freed.push(c);
                }
            }
        }
        self.apply_freed(&mut insertion);
        insertion
    }

    /// Checks the numbers, spans the fan and makes room in the grid.
    fn prepare(&mut self, pose: &Pose, scan: &Scan) -> Result<(), Refusal> {
        let positive = |what, value: f64| {
            if value.is_finite() && value > 0.0 {
                return Ok(());
            }
            Err(Refusal::BadNumber { what, value, wanted: "positive and finite" })
        };
        let finite = |what, value: f64| {
            if value.is_finite() {
                return Ok(());
            }
            Err(Refusal::BadNumber { what, value, wanted: "finite" })
        };
        finite("heading", pose.heading_rad)?;
        finite("first angle", scan.angle_first_rad)?;
        positive("absolute angle step", scan.angle_step_rad.abs())?;
        positive("range", scan.range_max_m)?;
        let limits = Limits {
            spacing_m: (0.5 * self.params.resolution_m).min(self.params.min_obstacle_m),
            straight_m: 0.5 * self.params.free_tolerance_m,
            range_m: RANGE_CAP_M,
        };
        self.fan.set(pose, scan, &limits);
        let (low, high) = self.fan.extent();
        self.reserve(low, high)
    }

    /// Grows the grid to hold a box of the map frame and the border around it.
    fn reserve(&mut self, low: Point, high: Point) -> Result<(), Refusal> {
        /// A quarter of what an index can address, in cells: quarters of cells are counted too.
        const FAR_CELLS: f64 = (i32::MAX / 4) as f64;
        let resolution = self.grid.resolution_m();
        for (what, value) in
            [("least x", low.x), ("least y", low.y), ("greatest x", high.x), ("greatest y", high.y)]
        {
            if !value.is_finite() || value.abs() > FAR_CELLS * resolution {
                let wanted = "within the addressable map";
                return Err(Refusal::BadNumber { what, value, wanted });
            }
        }
        let (a, b) = (self.grid.cell_at(low), self.grid.cell_at(high));
        let seen = CellRect { x0: a.ix, y0: a.iy, x1: b.ix + 1, y1: b.iy + 1 };
        let wanted = seen.grown((BORDER_M / resolution).ceil() as i32);
        let union = self.grid.bounds().union(&wanted);
        if union != self.grid.bounds() {
            let cells = union.width() as u64 * union.height() as u64;
            if cells > CELLS_MAX {
                return Err(Refusal::TooLarge { cells });
            }
            Arc::make_mut(&mut self.grid).grow_to(wanted);
        }
        Ok(())
    }

    fn mark_hits(&mut self, insertion: &mut Insertion) {
        let (tolerance, depth) = (self.params.hit_tolerance_m, self.params.hit_depth_m);
        self.doubtful.clear();
        self.surprises.clear();
        for Hit { end, into, lone } in self.fan.hits() {
            let at = |depth_m: f64| self.grid.cell_at(end + into * depth_m);
            let target = at(depth);
            let behind = at(tolerance);
            let state = |depth_m: f64| self.grid.state_at(end + into * depth_m);
            match state(depth) {
                Cell::Occupied => {}
                Cell::Unknown => {
                    let explained = [at(-tolerance), at(0.0), behind];
                    if explained.iter().any(|c| self.grid.get(*c) == Cell::Occupied) {
                        continue;
                    }
                    let aside = Vector::new(-into.y, into.x) * depth;
                    let inside = end + into * depth;
                    if self.grid.cell_at(inside + aside) == target
                        && self.grid.cell_at(inside - aside) == target
                    {
                        Arc::make_mut(&mut self.grid).occupy(target);
                        insertion.newly_occupied += 1;
                        insertion.record(target);
                    } else if !lone {
                        // It may have cut a corner: let the clear hits speak first. (A lone hit
                        // this near to a boundary says too little; the cell stays unknown.)
                        self.doubtful.push((end, target, 1.5 * depth));
                    }
                }
                Cell::Free => match state(tolerance) {
                    Cell::Occupied => {}
                    Cell::Unknown => self.doubtful.push((end, behind, tolerance)),
                    Cell::Free => self.surprises.push((end, end + into * depth)),
                },
            }
        }
        for (end, mark, near_m) in &self.doubtful {
            if self.grid.get(*mark) == Cell::Unknown && !occupied_near(&self.grid, *end, *near_m) {
                Arc::make_mut(&mut self.grid).occupy(*mark);
                insertion.newly_occupied += 1;
                insertion.record(*mark);
            }
        }
        // Judged against what was known before any of them is marked, so that an object is not
        // explained by its own first cell.
        let grid = &self.grid;
        self.surprises.retain(|(end, _)| !occupied_near(grid, *end, tolerance));
        for (_, inside) in &self.surprises {
            if self.grid.state_at(*inside) == Cell::Free {
                let target = self.grid.cell_at(*inside);
                Arc::make_mut(&mut self.grid).set(target, Cell::Occupied);
                insertion.turned_occupied += 1;
                insertion.record(target);
            }
        }
    }

    fn mark_free(&mut self, sensor: Point, insertion: &mut Insertion) {
        self.freed.clear();
        self.glimpsed.clear();
        let resolution = self.grid.resolution_m();
        let radius = self.fan.radius_m().min(self.fan.range_m());
        let (low, high) = self.fan.extent();
        let (first, last) = (self.grid.cell_at(low), self.grid.cell_at(high));
        let bounds = self.grid.bounds();
        let tolerance = self.params.free_tolerance_m;
        let half = (0.5 * resolution - tolerance).max(0.0);
        let quarter = 0.25 * resolution - tolerance;
        for iy in first.iy..=last.iy {
            let Some(row) = self.grid.row(iy) else { continue };
            let y = (f64::from(iy) + 0.5) * resolution - sensor.y;
            let width2 = radius * radius - y * y;
            if width2 <= 0.0 {
                continue;
            }
            // Columns within the radius: the rest fails the spacing rule or is beyond the range.
            let width = width2.sqrt();
            let x0 = (((sensor.x - width) / resolution).floor() as i32).max(first.ix);
            let x1 = (((sensor.x + width) / resolution).floor() as i32).min(last.ix);
            if x1 < x0 {
                continue;
            }
            let cells = &row[(x0 - bounds.x0) as usize..=(x1 - bounds.x0) as usize];
            for (i, _) in cells.iter().enumerate().filter(|(_, cell)| **cell == Cell::Unknown) {
                let ix = x0 + i as i32;
                let x = (f64::from(ix) + 0.5) * resolution - sensor.x;
                let (c, centre) = (CellIndex::new(ix, iy), Vector::new(x, y));
                if self.fan.shows(centre, half) {
                    self.freed.push(c);
                } else if quarter >= tolerance {
                    let known = self.grid.seen_quarters(c);
                    let mut seen = 0;
                    for k in (0..4).filter(|k| known & (1 << k) == 0) {
                        let side = |bit: u8| if k & bit == 0 { -0.25 } else { 0.25 } * resolution;
                        if self.fan.shows(centre + Vector::new(side(1), side(2)), quarter) {
                            seen |= 1 << k;
                        }
                    }
                    if seen != 0 {
                        self.glimpsed.push((c, seen));
                    }
                }
            }
        }
        self.apply_freed(insertion);
        if self.glimpsed.is_empty() {
            return;
        }
        let grid = Arc::make_mut(&mut self.grid);
        for (c, seen) in &self.glimpsed {
            grid.see_quarters(*c, *seen);
        }
    }

    fn apply_freed(&mut self, insertion: &mut Insertion) {
        if self.freed.is_empty() {
            return;
        }
        let grid = Arc::make_mut(&mut self.grid);
        for c in &self.freed {
            grid.set(*c, Cell::Free);
            insertion.record(*c);
        }
        insertion.newly_free += self.freed.len();
    }
}

/// Whether something occupied lies within `distance_m` of a point: a quarter of an occupied cell that
/// has not been seen to be free.
fn occupied_near(grid: &Grid, p: Point, distance_m: f64) -> bool {
    let reach = Vector::repeat(distance_m);
    let (low, high) = (grid.cell_at(p - reach), grid.cell_at(p + reach));
    let side_m = 0.5 * grid.resolution_m();
    let is_near = |quarter: CellIndex| {
        let low = Point::new(f64::from(quarter.ix), f64::from(quarter.iy)) * side_m;
        let gap = |v: f64, low: f64| (low - v).max(v - low - side_m).max(0.0);
        gap(p.x, low.x).hypot(gap(p.y, low.y)) <= distance_m
    };
    (low.iy..=high.iy)
        .flat_map(|iy| (low.ix..=high.ix).map(move |ix| CellIndex::new(ix, iy)))
        .filter(|c| grid.get(*c) == Cell::Occupied)
        .any(|c| grid.blocked_quarters(c).any(is_near))
}

#[cfg(test)]
mod tests;
