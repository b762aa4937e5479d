//! North-east-down and forward-right-down, and places on the earth.
//!
//! The map frame is east-north-up; its origin lies at a configured place on the earth.

use crate::frames::{Point, wrap_angle};

/// Semi-major axis of WGS 84, metres.
const WGS84_A_M: f64 = 6_378_137.0;
/// First eccentricity of WGS 84, squared.
const WGS84_E2: f64 = 6.694_379_990_141_316_5e-3;
/// MAVLink's degrees of latitude and longitude come as integers this many times as large.
const E7: f64 = 1e7;

/// North and east of a point of the map frame, metres.
pub fn ned_of(point: Point) -> [f64; 2] {
    [point.y, point.x]
}

/// The point of the map frame that lies so far north and east, metres.
pub fn point_of_ned(north_m: f64, east_m: f64) -> Point {
    Point::new(east_m, north_m)
}

/// Yaw (clockwise from north) of a heading of the map frame, radians.
pub fn yaw_of(heading_rad: f64) -> f64 {
    wrap_angle(std::f64::consts::FRAC_PI_2 - heading_rad)
}

/// Heading of the map frame of a yaw (clockwise from north), radians.
pub fn map_heading(yaw_rad: f64) -> f64 {
    yaw_of(yaw_rad)
}

/// A place on the earth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Geodetic {
    /// Degrees, north positive.
    pub latitude_deg: f64,
    /// Degrees, east positive.
    pub longitude_deg: f64,
}

impl Geodetic {
    /// Degrees times ten million, as messages have them.
    pub fn as_e7(self) -> [i32; 2] {
        [self.latitude_deg, self.longitude_deg].map(|degrees| (degrees * E7).round() as i32)
    }

    /// From degrees times ten million; `None` if it is no place on the earth.
    pub fn from_e7(latitude: i32, longitude: i32) -> Option<Self> {
        Self::checked(f64::from(latitude) / E7, f64::from(longitude) / E7)
    }

    /// From degrees; `None` if it is no place on the earth, or nearer to a pole than a map can lie.
    pub fn checked(latitude_deg: f64, longitude_deg: f64) -> Option<Self> {
        let on_earth = latitude_deg.abs() <= 89.9 && longitude_deg.abs() <= 180.0;
        on_earth.then_some(Self { latitude_deg, longitude_deg })
    }
}

/// Where the map's origin lies on the earth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Origin {
    /// The place.
    pub place: Geodetic,
    /// Height above the mean sea level, metres.
    pub altitude_m: f64,
}

impl Origin {
    /// Metres of one degree northwards and eastwards there.
    fn metres_per_degree(&self) -> [f64; 2] {
        let latitude = self.place.latitude_deg.to_radians();
        let w2 = 1.0 - WGS84_E2 * latitude.sin().powi(2);
        let meridian_m = WGS84_A_M * (1.0 - WGS84_E2) / w2.powf(1.5);
        let normal_m = WGS84_A_M / w2.sqrt();
        [meridian_m.to_radians(), normal_m.to_radians() * latitude.cos()]
    }

    /// The place of a point of the map frame, on the plane that touches the earth at the origin.
    pub fn place_of(&self, point: Point) -> Geodetic {
        let [north, east] = self.metres_per_degree();
        Geodetic {
            latitude_deg: self.place.latitude_deg + point.y / north,
            longitude_deg: wrap_degrees(self.place.longitude_deg + point.x / east),
        }
    }

    /// The point of the map frame at a place.
    pub fn point_of(&self, place: Geodetic) -> Point {
        let [north, east] = self.metres_per_degree();
        Point::new(
            wrap_degrees(place.longitude_deg - self.place.longitude_deg) * east,
            (place.latitude_deg - self.place.latitude_deg) * north,
        )
    }
}

fn wrap_degrees(degrees: f64) -> f64 {
    wrap_angle(degrees.to_radians()).to_degrees()
}
