//! The scan as `OBSTACLE_DISTANCE` has it: the nearest surface in each of 72 sectors.

use crate::scan::Scan;
use crate::wire::mavlink::common::{MavDistanceSensor, MavFrame, OBSTACLE_DISTANCE_DATA};

const SECTORS: usize = 72;
const SECTOR_DEG: f64 = 360.0 / SECTORS as f64;
/// Nothing is known of a sector.
const UNKNOWN: u16 = u16::MAX;
/// Beams say nothing about what is nearer than this, centimetres.
const MIN_CM: u16 = 2;

/// The nearest surface in each sector, clockwise from the car's nose; each sector lies around its
/// direction.
pub fn distances(scan: &Scan) -> OBSTACLE_DISTANCE_DATA {
    let max_cm = (scan.range_max_m * 100.0).round().clamp(1.0, f64::from(UNKNOWN - 2)) as u16;
    let mut distances = [UNKNOWN; SECTORS];
    for (index, range_m) in scan.ranges_m.iter().enumerate() {
        let range_m = f64::from(*range_m);
        if range_m.is_nan() {
            continue;
        }
        let cm = if range_m >= scan.range_max_m {
            max_cm + 1
        } else {
            ((range_m * 100.0).floor().max(0.0) as u16).min(max_cm)
        };
        let clockwise_deg = -scan.angle_rad(index).to_degrees();
        let sector = (clockwise_deg / SECTOR_DEG).round().rem_euclid(SECTORS as f64) as usize;
        let nearest = &mut distances[sector % SECTORS];
        *nearest = (*nearest).min(cm);
    }
    OBSTACLE_DISTANCE_DATA {
        time_usec: scan.stamp.as_nanos() / 1000,
        distances,
        min_distance: MIN_CM,
        max_distance: max_cm,
        sensor_type: MavDistanceSensor::MAV_DISTANCE_SENSOR_LASER,
        increment: SECTOR_DEG as u8,
        increment_f: SECTOR_DEG as f32,
        angle_offset: 0.0,
        frame: MavFrame::MAV_FRAME_BODY_FRD,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::Instant;

    fn scan(ranges_m: Vec<f32>) -> Scan {
        let step = std::f64::consts::TAU / ranges_m.len() as f64;
        Scan {
            stamp: Instant::from_nanos(5_000),
            sequence: 0,
            angle_first_rad: 0.0,
            angle_step_rad: step,
            range_max_m: 10.0,
            ranges_m,
        }
    }

    #[test]
    fn what_stands_on_the_left_is_in_a_sector_on_the_left() {
        let mut ranges = vec![f32::INFINITY; 360];
        ranges[90] = 2.345;
        ranges[91] = 2.0;
        ranges[180] = f32::NAN;
        ranges[0] = 10.0;
        let message = distances(&scan(ranges));
        // Counter-clockwise 90 degrees is clockwise 270 degrees.
        assert_eq!(message.distances[54], 200);
        assert_eq!(message.distances[18], 1001);
        assert_eq!(message.distances[0], 1001);
        assert_eq!(message.max_distance, 1000);
        assert_eq!(message.time_usec, 5);
    }

    #[test]
    fn a_sector_without_a_beam_is_unknown() {
        let message = distances(&scan(vec![1.0, f32::NAN]));
        assert_eq!(message.distances[0], 100);
        assert!(message.distances[1..].iter().all(|cm| *cm == u16::MAX));
    }
}
