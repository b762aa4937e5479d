//! A world of BARN as this program reads it, and as a raster.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::frames::{Point, Pose};
use crate::sim::world::World;

/// Open ground around all that the file names, metres: Gazebo's ground has no end, a raster has one
/// and is solid beyond.
const OPEN_M: f64 = 3.0;
/// Largest coordinate that is taken for one, metres: such a raster still fits into memory.
const FAR_M: f64 = 100.0;
/// Thinnest and thickest post, metres.
const RADIUS_M: [f64; 2] = [0.01, 1.0];
/// Finest and coarsest raster, metres.
pub const RESOLUTION_M: [f64; 2] = [0.01, 0.5];
/// Posts that touch a cell from outside are not in it, metres.
const TOUCH_M: f64 = 1e-9;

/// A field of upright round posts with a start and a goal.
#[derive(Clone, Debug, PartialEq)]
pub struct Field {
    /// Its number in the set.
    pub number: u32,
    /// Radius of every post, metres.
    pub radius_m: f64,
    /// Centres of the posts, metres.
    pub posts: Vec<Point>,
    /// Metres, metres, degrees; whole tenths of a degree, since the set writes 1.57 for a quarter
    /// turn.
    pub start: [f64; 3],
    /// Metres, metres.
    pub goal: [f64; 2],
    /// Length of the set's own way from the start by its path through the field to the goal, metres.
    pub path_m: f64,
}

/// Why there is no field to drive in.
#[derive(Debug, thiserror::Error)]
pub enum FieldError {
    /// A file or folder cannot be read.
    #[error("{}: {error}", .path.display())]
    File {
        /// Its path.
        path: PathBuf,
        /// What the operating system says.
        error: std::io::Error,
    },
    /// A file is no world.
    #[error("{}: {why}", .path.display())]
    NotAField {
        /// Its path.
        path: PathBuf,
        /// What is wrong with it.
        why: String,
    },
    /// There are no worlds in a folder.
    #[error("{}: there is no world in it (files world_*.json)", .path.display())]
    None {
        /// Its path.
        path: PathBuf,
    },
    /// Two files are of one world.
    #[error("{}: world {number} is in this folder twice", .path.display())]
    Twice {
        /// The second file.
        path: PathBuf,
        /// The world's number.
        number: u32,
    },
}

/// The file as it is written.
#[derive(Deserialize)]
struct Written {
    world: u32,
    cylinder_radius_m: f64,
    /// Radians.
    start: [f64; 3],
    goal: [f64; 2],
    obstacles_xy_m: Vec<[f64; 2]>,
    reference_path_xy_m: Vec<[f64; 2]>,
}

impl Field {
    /// Reads a world from JSON.
    ///
    /// # Errors
    /// Says what is wrong with it.
    pub fn parse(text: &str) -> Result<Self, String> {
        let written: Written = serde_json::from_str(text).map_err(|error| error.to_string())?;
        let [x, y, yaw_rad] = written.start;
        let places = [[x, y], written.goal];
        let mut points =
            places.iter().chain(&written.obstacles_xy_m).chain(&written.reference_path_xy_m);
        if let Some([x, y]) = points.find(|p| !p.iter().all(|v| v.abs() <= FAR_M)) {
            return Err(format!("({x}, {y}) is no place: at most {FAR_M} m are wanted"));
        }
        let [thin, thick] = RADIUS_M;
        let radius_m = written.cylinder_radius_m;
        if !(thin..=thick).contains(&radius_m) {
            return Err(format!("cylinder_radius_m is {radius_m}, but must be {thin} to {thick}"));
        }
        if yaw_rad.abs() > 2.0 * std::f64::consts::PI {
            return Err(format!("the start's direction is {yaw_rad}, but must be a turn at most"));
        }
        let point = |[x, y]: &[f64; 2]| Point::new(*x, *y);
        let way: Vec<Point> = std::iter::once(Point::new(x, y))
            .chain(written.reference_path_xy_m.iter().map(point))
            .chain(std::iter::once(point(&written.goal)))
            .collect();
        let path_m: f64 = way.windows(2).map(|pair| (pair[1] - pair[0]).norm()).sum();
        if path_m <= 0.0 {
            return Err("the goal is where the start is".into());
        }
        Ok(Self {
            number: written.world,
            radius_m,
            posts: written.obstacles_xy_m.iter().map(point).collect(),
            start: [x, y, (yaw_rad.to_degrees() * 10.0).round() / 10.0],
            goal: written.goal,
            path_m,
        })
    }

    /// The field in squares, of which those are solid that a post overlaps, with open ground around.
    ///
    /// # Panics
    /// If the resolution is not within [`RESOLUTION_M`].
    pub fn world(&self, resolution_m: f64) -> World {
        let [fine, coarse] = RESOLUTION_M;
        assert!((fine..=coarse).contains(&resolution_m), "resolution {resolution_m} m");
        let [x, y, _] = self.start;
        let [goal_x, goal_y] = self.goal;
        let places = [Point::new(x, y), Point::new(goal_x, goal_y)];
        let points = || places.iter().chain(&self.posts);
        let cell = |m: f64| (m / resolution_m + TOUCH_M).floor() as i64;
        let range = |value: fn(&Point) -> f64| {
            let least = points().map(value).fold(f64::INFINITY, f64::min);
            let most = points().map(value).fold(f64::NEG_INFINITY, f64::max);
            [cell(least - OPEN_M), cell(most + OPEN_M) + 1]
        };
        let ([left, right], [low, high]) = (range(|p| p.x), range(|p| p.y));
        let (width, height) = ((right - left) as usize, (high - low) as usize);
        let mut solid = vec![false; width * height];
        for post in &self.posts {
            let cells = |v: f64| cell(v - self.radius_m)..=cell(v + self.radius_m);
            for (ix, iy) in cells(post.y).flat_map(|iy| cells(post.x).map(move |ix| (ix, iy))) {
                let beside = |centre: f64, cell: i64| {
                    let near = cell as f64 * resolution_m;
                    (near - centre).max(centre - near - resolution_m).max(0.0)
                };
                if beside(post.x, ix).hypot(beside(post.y, iy)) < self.radius_m - TOUCH_M {
                    solid[(iy - low) as usize * width + (ix - left) as usize] = true;
                }
            }
        }
        let origin = Pose::new(left as f64 * resolution_m, low as f64 * resolution_m, 0.0);
        World::new(resolution_m, origin, width, height, &solid)
    }
}

/// The worlds of a folder (its files `world_*.json`), or of one file, by number.
///
/// # Errors
/// If a file cannot be read or is no world, or there is none, or one is there twice.
pub fn find_fields(folder: &Path) -> Result<Vec<Field>, FieldError> {
    let fail = |path: &Path, error| FieldError::File { path: path.to_owned(), error };
    let mut paths = Vec::new();
    if folder.is_file() {
        paths.push(folder.to_owned());
    } else {
        for entry in std::fs::read_dir(folder).map_err(|error| fail(folder, error))? {
            let path = entry.map_err(|error| fail(folder, error))?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if name.starts_with("world_") && name.ends_with(".json") {
                paths.push(path);
            }
        }
    }
    paths.sort();
    let mut fields: Vec<Field> = Vec::new();
    for path in paths {
        let text = std::fs::read_to_string(&path).map_err(|error| fail(&path, error))?;
        let field =
            Field::parse(&text).map_err(|why| FieldError::NotAField { path: path.clone(), why })?;
        if fields.iter().any(|other| other.number == field.number) {
            return Err(FieldError::Twice { path, number: field.number });
        }
        fields.push(field);
    }
    if fields.is_empty() {
        return Err(FieldError::None { path: folder.to_owned() });
    }
    fields.sort_by_key(|field| field.number);
    Ok(fields)
}
