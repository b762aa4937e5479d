//! Mazes of three families on ten by ten hallway cells of 2.5 m, the size of the mazes in
//! Elhafsi et al. 2020, and fields of posts.
//!
//! Lattice cell `(i, j)` reaches from `2.5 i` to `2.5 (i+1)` metres in map x and likewise in y, so
//! the lattice covers 0 to 25 m. Walls are one world cell thick and stand on the low side of the
//! lattice lines: the wall on the line `x = 2.5 i` fills world column `i n`, with `n` world cells
//! to a hallway. The closing walls on the lines at 25 m therefore lie just beyond, and the raster
//! has `10 n + 1` columns and rows. A hallway is free over `2.5 m` less one world cell.
//!
//! A maze follows from its family and seed alone, in whole-number arithmetic: it is the same on
//! every machine, and at every resolution.

mod lattice;
mod posts;

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use self::lattice::{CELLS, Lattice, SIDE};
use super::world::World;
use crate::frames::{Point, Pose};
use crate::mapfile::MapFile;

/// Side of a world cell where nothing else is asked for, metres.
pub const RESOLUTION_M: f64 = 0.1;
/// Width of a hallway from wall line to wall line, metres.
pub const HALLWAY_M: f64 = 2.5;

crate::choices! {
    /// What a maze looks like.
    pub enum Family {
        /// One hallway that winds through most of the area, thin walls between its stretches.
        Thin = "thin",
        /// One hallway between opposite corners; everything off it is solid.
        Solid = "solid",
        /// Hallways everywhere, with dead ends and some loops.
        Branching = "branching",
        /// No maze: a walled field with scattered clumps of posts, in the manner of the BARN worlds.
        Posts = "posts",
    }
}

/// Why a maze cannot be made.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MazeError {
    /// The world cells do not fit the hallway.
    #[error(
        "the maze's resolution is {resolution_m} m, but must divide the hallway's 2.5 m into 10 to \
         100 whole cells (0.1 m and 0.05 m do)"
    )]
    Resolution {
        /// Side of a world cell, metres.
        resolution_m: f64,
    },
}

/// A maze as a world, with where to start and where to go.
#[derive(Clone, Debug, PartialEq)]
pub struct Maze {
    /// Which family it is of.
    pub family: Family,
    /// Which one of the family.
    pub seed: u64,
    /// The solid cells; map frame 0 to 25 m in x and y.
    pub world: World,
    /// Centre of the route's first cell, at the lattice's lower left, heading along the route.
    pub start: Pose,
    /// Centre of the route's last cell, at the lattice's upper right.
    pub goal: Point,
    /// The lattice cells `(i, j)` from start to goal: the only way, or for
    /// [`Family::Branching`] one with the fewest cells; empty for [`Family::Posts`].
    pub route: Vec<(u8, u8)>,
}

impl Family {
    /// The families with hallways.
    pub const MAZES: [Self; 3] = [Self::Thin, Self::Solid, Self::Branching];
}

impl Maze {
    /// The maze as a map: walls occupied, everything else free.
    pub fn to_map_file(&self) -> MapFile {
        self.world.to_map_file()
    }

    /// Number of cells in which the route turns.
    pub fn corners(&self) -> usize {
        let straight = |w: &[(u8, u8)]| w[0].0 == w[2].0 || w[0].1 == w[2].1;
        self.route.windows(3).filter(|w| !straight(w)).count()
    }
}

/// The maze of a family and a seed, on world cells of `resolution_m`.
///
/// # Errors
/// If `resolution_m` does not divide the hallway into 10 to 100 whole cells.
pub fn generate(family: Family, seed: u64, resolution_m: f64) -> Result<Maze, MazeError> {
    let cells_exact = HALLWAY_M / resolution_m;
    let cells = cells_exact.round();
    if !(10.0..=100.0).contains(&cells) || (cells_exact - cells).abs() > 1e-6 {
        return Err(MazeError::Resolution { resolution_m });
    }
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    // One stream a family: equal seeds of two families have nothing in common.
    rng.set_stream(family as u64);
    let lattice = match family {
        Family::Thin => Lattice::winding(&mut rng),
        Family::Solid => Lattice::direct(&mut rng),
        Family::Branching => Lattice::branching(&mut rng),
        Family::Posts => return Ok(posts::field(seed, &mut rng, cells as usize, resolution_m)),
    };
    let n = cells as usize;
    let side = SIDE * n + 1;
    let solid = rasterise(&lattice, n, family == Family::Solid);
    let place = |cell: usize| ((cell % SIDE) as u8, (cell / SIDE) as u8);
    let centre = |(i, j): (u8, u8)| {
        Point::new((f64::from(i) + 0.5) * HALLWAY_M, (f64::from(j) + 0.5) * HALLWAY_M)
    };
    let route: Vec<(u8, u8)> = lattice.route.iter().map(|cell| place(*cell)).collect();
    let (first, second) = (route[0], route[1]);
    // The route begins at the lower left corner, so its first step is right or up.
    let heading_rad = if second.1 == first.1 { 0.0 } else { std::f64::consts::FRAC_PI_2 };
    Ok(Maze {
        family,
        seed,
        world: World::new(resolution_m, Pose::new(0.0, 0.0, 0.0), side, side, &solid),
        start: Pose { position: centre(first), heading_rad },
        goal: centre(route[route.len() - 1]),
        route,
    })
}

/// The world cells of a lattice at `n` to a hallway, `fill` making the unused lattice cells solid.
fn rasterise(lattice: &Lattice, n: usize, fill: bool) -> Vec<bool> {
    let side = SIDE * n + 1;
    let mut solid = vec![false; side * side];
    let mut block = |x0: usize, y0: usize, columns: usize, rows: usize| {
        for y in y0..y0 + rows {
            solid[y * side + x0..y * side + x0 + columns].fill(true);
        }
    };
    // Every wall has both of its posts, so walls that meet leave no gap at the corner.
    for k in 0..SIDE {
        block(0, k * n, 1, n + 1);
        block(SIDE * n, k * n, 1, n + 1);
        block(k * n, 0, n + 1, 1);
        block(k * n, SIDE * n, n + 1, 1);
    }
    for cell in 0..CELLS {
        let (i, j) = (cell % SIDE, cell / SIDE);
        if fill && !lattice.used[cell] {
            block(i * n, j * n, n + 1, n + 1);
        }
        if i + 1 < SIDE && lattice.has_wall(cell, cell + 1) {
            block((i + 1) * n, j * n, 1, n + 1);
        }
        if j + 1 < SIDE && lattice.has_wall(cell, cell + SIDE) {
            block(i * n, (j + 1) * n, n + 1, 1);
        }
    }
    solid
}

#[cfg(test)]
mod tests;
