//! Items of missions and fences: what they mean, which are refused, and the text they are kept as.

use std::fmt::Write;

use super::places;
use super::wanted::{Denial, Wanted};
use crate::fence::{Fence, Polygon, circle};
use crate::frames::Point;
use crate::wire::mavlink::common::{
    MISSION_ITEM_DATA, MISSION_ITEM_INT_DATA, MavCmd, MavFrame, MavMissionResult as Code,
    MavMissionType, MavResult,
};
use crate::wire::mavlink::{MavlinkVersion, MessageData, Origin};

/// Longest wait at a goal, seconds.
const WAIT_MAX_S: f32 = 3600.0;
/// Slowest speed that can be asked for, m/s.
const SPEED_MIN_MPS: f32 = 0.1;
/// Most repetitions of a jump.
const REPEATS_MAX: f32 = 32767.0;
/// Largest circle of a fence, metres.
const RADIUS_MAX_M: f32 = 1000.0;
/// First line of a kept list, as ground stations write theirs.
const TITLE: &str = "QGC WPL 110";

/// Which list an item belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// Goals.
    Mission,
    /// Places to stay in and out of.
    Fence,
}

impl Kind {
    /// The kind of a list that this vehicle has.
    pub const fn of(kind: MavMissionType) -> Option<Self> {
        match kind {
            MavMissionType::MAV_MISSION_TYPE_MISSION => Some(Self::Mission),
            MavMissionType::MAV_MISSION_TYPE_FENCE => Some(Self::Fence),
            _ => None,
        }
    }

    /// Its number in messages.
    pub const fn number(self) -> MavMissionType {
        match self {
            Self::Mission => MavMissionType::MAV_MISSION_TYPE_MISSION,
            Self::Fence => MavMissionType::MAV_MISSION_TYPE_FENCE,
        }
    }

    /// What people call it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Mission => "Mission",
            Self::Fence => "Fence",
        }
    }
}

/// Why an item, or a list, is not taken.
#[derive(Clone, Debug, PartialEq)]
pub struct Fault {
    /// What the acknowledgement says.
    pub code: Code,
    /// Why, for a person.
    pub reason: String,
}

impl Fault {
    /// A fault with its reason.
    pub fn new(code: Code, reason: impl Into<String>) -> Self {
        Self { code, reason: reason.into() }
    }
}

/// One item, as it came.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Item {
    /// What to do.
    pub command: MavCmd,
    /// What the place is given in.
    pub frame: MavFrame,
    /// Its first four numbers.
    pub params: [f32; 4],
    /// The place: degrees times ten million, or metres times ten thousand.
    pub x: i32,
    /// See `x`.
    pub y: i32,
    /// Height, metres.
    pub z: f32,
    /// Whether to go on with the next one by itself.
    pub goes_on: bool,
}

impl Item {
    /// From the message with integers.
    pub const fn of_int(data: &MISSION_ITEM_INT_DATA) -> Self {
        Self {
            command: data.command,
            frame: data.frame,
            params: [data.param1, data.param2, data.param3, data.param4],
            x: data.x,
            y: data.y,
            z: data.z,
            goes_on: data.autocontinue != 0,
        }
    }

    /// From the old message; `None` if its place is no number.
    pub fn of_float(data: &MISSION_ITEM_DATA) -> Option<Self> {
        let scale = if is_local(data.frame) { 1e4 } else { 1e7 };
        let whole = |v: f32| {
            let scaled = (f64::from(v) * scale).round();
            (scaled.abs() < f64::from(i32::MAX)).then_some(scaled as i32)
        };
        Some(Self {
            command: data.command,
            frame: data.frame,
            params: [data.param1, data.param2, data.param3, data.param4],
            x: whole(data.x)?,
            y: whole(data.y)?,
            z: data.z,
            goes_on: data.autocontinue != 0,
        })
    }

    /// As a message, without its addressee.
    pub const fn message(&self, seq: u16, kind: Kind, current: bool) -> MISSION_ITEM_INT_DATA {
        let [param1, param2, param3, param4] = self.params;
        MISSION_ITEM_INT_DATA {
            param1,
            param2,
            param3,
            param4,
            x: self.x,
            y: self.y,
            z: self.z,
            seq,
            command: self.command,
            target_system: 0,
            target_component: 0,
            frame: self.frame,
            current: current as u8,
            autocontinue: self.goes_on as u8,
            mission_type: kind.number(),
        }
    }

    /// Its place in the map frame.
    ///
    /// # Errors
    /// If it has none, or one in a frame that is not understood here.
    pub fn place(&self, origin: Option<&Origin>) -> Result<Point, Fault> {
        let [a, b, c, d] = self.params;
        let wanted = Wanted {
            command: self.command,
            params: [a, b, c, d, f32::NAN, f32::NAN, self.z],
            place: Some((self.frame, self.x, self.y)),
            confirmation: 0,
        };
        let fault = |denial: Denial| {
            let code = match denial.result {
                MavResult::MAV_RESULT_DENIED => Code::MAV_MISSION_INVALID_PARAM5_X,
                // No such frame, or none as long as nobody says where the map lies.
                _ => Code::MAV_MISSION_UNSUPPORTED_FRAME,
            };
            Fault::new(code, denial.reason)
        };
        let place = places::of_command(&wanted, origin).map_err(fault)?;
        place.ok_or_else(|| Fault::new(Code::MAV_MISSION_INVALID_PARAM5_X, "it has no position"))
    }

    /// Whether it can be part of a list of `count`.
    ///
    /// # Errors
    /// Why not.
    pub fn check(
        &self,
        kind: Kind,
        count: u16,
        speed_max_mps: f64,
        origin: Option<&Origin>,
    ) -> Result<(), Fault> {
        let codes = [
            Code::MAV_MISSION_INVALID_PARAM1,
            Code::MAV_MISSION_INVALID_PARAM2,
            Code::MAV_MISSION_INVALID_PARAM3,
            Code::MAV_MISSION_INVALID_PARAM4,
            Code::MAV_MISSION_INVALID_PARAM7,
        ];
        let [a, b, c, d] = self.params;
        if let Some(at) = [a, b, c, d, self.z].iter().position(|number| number.is_infinite()) {
            return Err(Fault::new(codes[at], "it holds an infinite number"));
        }
        let invalid = |number: usize, reason: String| Err(Fault::new(codes[number - 1], reason));
        match (kind, self.command) {
            (Kind::Mission, MavCmd::MAV_CMD_NAV_WAYPOINT) => {
                if !a.is_nan() && !(0.0..=WAIT_MAX_S).contains(&a) {
                    return invalid(1, format!("a wait of {a} s, allowed is 0 to {WAIT_MAX_S}"));
                }
                self.place(origin).map(drop)
            }
            (Kind::Mission, MavCmd::MAV_CMD_DO_CHANGE_SPEED) => {
                if a != 0.0 && a != 1.0 {
                    return invalid(1, "a car only has a speed over ground".into());
                }
                let inside = (SPEED_MIN_MPS..=speed_max_mps as f32 + 1e-6).contains(&b);
                if !inside && b != -1.0 && b != -2.0 {
                    return invalid(
                        2,
                        format!(
                            "a speed of {b} m/s, allowed is {SPEED_MIN_MPS} to {speed_max_mps}"
                        ),
                    );
                }
                Ok(())
            }
            (Kind::Mission, MavCmd::MAV_CMD_DO_JUMP) => {
                if a.fract() != 0.0 || !(0.0..f32::from(count)).contains(&a) {
                    return invalid(1, format!("a jump to item {a} of {count}"));
                }
                if b.fract() != 0.0 || !(-1.0..=REPEATS_MAX).contains(&b) {
                    return invalid(2, format!("{b} repetitions"));
                }
                Ok(())
            }
            (
                Kind::Fence,
                MavCmd::MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
                | MavCmd::MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION,
            ) => {
                if a.fract() != 0.0 || !(3.0..=f32::from(count)).contains(&a) {
                    return invalid(1, format!("a polygon of {a} corners in a list of {count}"));
                }
                self.place(origin).map(drop)
            }
            (
                Kind::Fence,
                MavCmd::MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION
                | MavCmd::MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION,
            ) => {
                if !(a > 0.0 && a <= RADIUS_MAX_M) {
                    return invalid(1, format!("a radius of {a} m, allowed is to {RADIUS_MAX_M}"));
                }
                self.place(origin).map(drop)
            }
            (_, command) => {
                let name = format!("{command:?}");
                let name = name.trim_start_matches("MAV_CMD_");
                let reason = format!("{name} is not done here");
                Err(Fault::new(Code::MAV_MISSION_UNSUPPORTED, reason))
            }
        }
    }
}

fn is_local(frame: MavFrame) -> bool {
    matches!(frame, MavFrame::MAV_FRAME_LOCAL_NED | MavFrame::MAV_FRAME_LOCAL_ENU)
}

/// The fence that a list of checked items describes.
///
/// # Errors
/// If polygons are not whole; with the number of the item.
pub fn fence_of(items: &[Item], origin: Option<&Origin>) -> Result<Fence, (usize, Fault)> {
    let mut fence = Fence::default();
    let mut groups: Vec<(u32, Vec<Polygon>)> = Vec::new();
    let mut enclose = |group: f32, polygon: Polygon| {
        let group = if group.is_nan() { 0 } else { group as u32 };
        match groups.iter_mut().find(|(number, _)| *number == group) {
            Some((_, polygons)) => polygons.push(polygon),
            None => groups.push((group, vec![polygon])),
        }
    };
    let mut at = 0;
    while let Some(item) = items.get(at) {
        let place = |i: usize| items[i].place(origin).map_err(|fault| (i, fault));
        let [size, group, ..] = item.params;
        match item.command {
            MavCmd::MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION => {
                enclose(group, circle(place(at)?, f64::from(size), false));
                at += 1;
            }
            MavCmd::MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION => {
                fence.outside.push(circle(place(at)?, f64::from(size), true));
                at += 1;
            }
            command => {
                let end = at + size as usize;
                let same = |other: &Item| other.command == command && other.params[0] == size;
                if end > items.len() || !items[at..end].iter().all(same) {
                    let reason = format!("its polygon does not have {size} corners");
                    return Err((at, Fault::new(Code::MAV_MISSION_INVALID_PARAM1, reason)));
                }
                let polygon = (at..end).map(place).collect::<Result<Polygon, _>>()?;
                if command == MavCmd::MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION {
                    enclose(group, polygon);
                } else {
                    fence.outside.push(polygon);
                }
                at = end;
            }
        }
    }
    fence.inside = groups.into_iter().map(|(_, polygons)| polygons).collect();
    Ok(fence)
}

/// A number that changes with the list; zero for an empty one.
pub fn opaque_id(items: &[Item]) -> u32 {
    const CRC: crc::Crc<u32> = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC);
    if items.is_empty() { 0 } else { CRC.checksum(text_of(items).as_bytes()).max(1) }
}

/// A list as ground stations write theirs into files.
pub fn text_of(items: &[Item]) -> String {
    let mut out = format!("{TITLE}\n");
    for (seq, item) in items.iter().enumerate() {
        let (scale, digits) = if is_local(item.frame) { (1e4, 4) } else { (1e7, 7) };
        let [x, y] = [item.x, item.y].map(|v| f64::from(v) / scale);
        let [a, b, c, d] = item.params;
        let (frame, command) = (item.frame as u8, item.command as u16);
        let goes_on = u8::from(item.goes_on);
        let _ = writeln!(
            out,
            "{seq}\t0\t{frame}\t{command}\t{a}\t{b}\t{c}\t{d}\t{x:.digits$}\t{y:.digits$}\t{}\t{goes_on}",
            item.z
        );
    }
    out
}

/// Reads what [`text_of`] wrote; `None` if it is anything else.
pub fn items_of(text: &str) -> Option<Vec<Item>> {
    let mut lines = text.lines();
    if lines.next()?.trim() != TITLE {
        return None;
    }
    lines.filter(|line| !line.trim().is_empty()).map(item_of).collect()
}

fn item_of(line: &str) -> Option<Item> {
    let fields: Vec<&str> = line.split('\t').collect();
    let [_, _, frame, command, a, b, c, d, x, y, z, goes_on] = fields[..] else { return None };
    let number = |text: &str| text.parse::<f32>().ok();
    let (frame, command): (u8, u16) = (frame.parse().ok()?, command.parse().ok()?);
    // The numbers become what they stand for as they do on the wire.
    let mut payload = [0; 38];
    payload[30..32].copy_from_slice(&command.to_le_bytes());
    payload[34] = frame;
    let parsed = MISSION_ITEM_INT_DATA::deser(MavlinkVersion::V2, &payload).ok()?;
    let scale = if is_local(parsed.frame) { 1e4 } else { 1e7 };
    let place = |text: &str| {
        let scaled = (text.parse::<f64>().ok()? * scale).round();
        (scaled.abs() <= f64::from(i32::MAX)).then_some(scaled as i32)
    };
    Some(Item {
        params: [number(a)?, number(b)?, number(c)?, number(d)?],
        x: place(x)?,
        y: place(y)?,
        z: number(z)?,
        goes_on: goes_on.trim() != "0",
        ..Item::of_int(&parsed)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::mavlink::Geodetic;

    fn local(command: MavCmd, params: [f32; 4], x: i32, y: i32) -> Item {
        let frame = MavFrame::MAV_FRAME_LOCAL_NED;
        Item { command, frame, params, x, y, z: 0.0, goes_on: true }
    }

    #[test]
    fn a_list_reads_back_as_it_was_kept() {
        let nan = f32::NAN;
        let items = [
            local(MavCmd::MAV_CMD_NAV_WAYPOINT, [0.5, 0.1, 1e-7, 2.0], 12_345, -1),
            Item {
                frame: MavFrame::MAV_FRAME_GLOBAL_INT,
                goes_on: false,
                ..local(MavCmd::MAV_CMD_NAV_WAYPOINT, [0.0; 4], 473_977_419, -1_225_000_001)
            },
            local(MavCmd::MAV_CMD_DO_JUMP, [0.0, -1.0, 0.0, 0.0], i32::MAX, i32::MIN + 1),
        ];
        assert_eq!(items_of(&text_of(&items)).unwrap(), items);
        let kept = items_of(&text_of(&[local(MavCmd::MAV_CMD_NAV_WAYPOINT, [nan; 4], 0, 0)]));
        assert!(kept.unwrap()[0].params.iter().all(|p| p.is_nan()));
        assert_eq!(items_of(""), None);
        assert_eq!(items_of("QGC WPL 110\n0\t0\t1\t65000\t0\t0\t0\t0\t0\t0\t0\t1\n"), None);
        assert_eq!(items_of("QGC WPL 110\nx\n"), None);
        assert_ne!(opaque_id(&items), opaque_id(&items[1..]));
        assert_eq!(opaque_id(&[]), 0);
    }

    #[test]
    fn positions_are_understood_in_local_and_global_frames_and_in_no_other() {
        let item = local(MavCmd::MAV_CMD_NAV_WAYPOINT, [0.0; 4], 20_000, 35_000);
        assert_eq!(item.place(None), Ok(Point::new(3.5, 2.0)), "north first");
        let east = Item { frame: MavFrame::MAV_FRAME_LOCAL_ENU, ..item };
        assert_eq!(east.place(None), Ok(Point::new(2.0, 3.5)));
        let place = Geodetic { latitude_deg: 47.0, longitude_deg: 8.0 };
        let origin = Origin { place, altitude_m: 0.0 };
        let [x, y] = origin.place_of(Point::new(30.0, -20.0)).as_e7();
        let global = Item { frame: MavFrame::MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, x, y, ..item };
        let found = global.place(Some(&origin)).unwrap();
        assert!((found - Point::new(30.0, -20.0)).norm() < 0.02, "{found}");
        for wrong in [global, Item { frame: MavFrame::MAV_FRAME_BODY_FRD, ..item }] {
            let fault = wrong.place(None).unwrap_err();
            assert_eq!(fault.code, Code::MAV_MISSION_UNSUPPORTED_FRAME);
        }
        let far = Item { x: i32::MAX - 1, ..item };
        assert_eq!(far.place(None).unwrap_err().code, Code::MAV_MISSION_INVALID_PARAM5_X);
    }

    #[test]
    fn what_a_car_cannot_do_is_refused_with_the_number_that_is_wrong() {
        let check = |kind, item: Item| item.check(kind, 5, 4.0, None).map_err(|fault| fault.code);
        let goal = |params| local(MavCmd::MAV_CMD_NAV_WAYPOINT, params, 0, 0);
        let (mission, fence) = (Kind::Mission, Kind::Fence);
        let nan = f32::NAN;
        assert_eq!(check(mission, goal([0.0, 0.0, nan, nan])), Ok(()));
        let one = Err(Code::MAV_MISSION_INVALID_PARAM1);
        let two = Err(Code::MAV_MISSION_INVALID_PARAM2);
        assert_eq!(check(mission, goal([-1.0, 0.0, 0.0, 0.0])), one);
        assert_eq!(check(mission, goal([f32::INFINITY, 0.0, 0.0, 0.0])), one);
        let code = check(mission, goal([0.0, 0.0, 0.0, f32::NEG_INFINITY]));
        assert_eq!(code, Err(Code::MAV_MISSION_INVALID_PARAM4));
        let speed = |a, b| local(MavCmd::MAV_CMD_DO_CHANGE_SPEED, [a, b, nan, nan], 0, 0);
        assert_eq!(check(mission, speed(1.0, 2.0)), Ok(()));
        assert_eq!(check(mission, speed(1.0, -2.0)), Ok(()));
        assert_eq!(check(mission, speed(1.0, 4.5)), two);
        assert_eq!(check(mission, speed(1.0, nan)), two);
        assert_eq!(check(mission, speed(2.0, 1.0)), one);
        assert_eq!(check(mission, speed(nan, 1.0)), one);
        let jump = |a, b| local(MavCmd::MAV_CMD_DO_JUMP, [a, b, 0.0, 0.0], 0, 0);
        assert_eq!(check(mission, jump(4.0, -1.0)), Ok(()));
        assert_eq!(check(mission, jump(5.0, 1.0)), one);
        assert_eq!(check(mission, jump(0.5, 1.0)), one);
        assert_eq!(check(mission, jump(nan, 1.0)), one);
        assert_eq!(check(mission, jump(0.0, -2.0)), two);
        let takeoff = local(MavCmd::MAV_CMD_NAV_TAKEOFF, [0.0; 4], 0, 0);
        assert_eq!(check(mission, takeoff), Err(Code::MAV_MISSION_UNSUPPORTED));
        assert_eq!(check(fence, goal([0.0; 4])), Err(Code::MAV_MISSION_UNSUPPORTED));
        let corner =
            |n| local(MavCmd::MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION, [n, 0.0, 0.0, 0.0], 0, 0);
        assert_eq!(check(fence, corner(3.0)), Ok(()));
        assert_eq!(check(fence, corner(2.0)), one);
        assert_eq!(check(fence, corner(6.0)), one);
        assert_eq!(check(fence, corner(nan)), one);
        let round = local(MavCmd::MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION, [nan, 0.0, 0.0, 0.0], 0, 0);
        assert_eq!(check(fence, round), one);
    }

    #[test]
    fn corners_make_polygons_and_half_ones_are_refused() {
        let exclusion = MavCmd::MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION;
        let inclusion = MavCmd::MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION;
        let corner = |command, x, y| local(command, [3.0, 0.0, 0.0, 0.0], x, y);
        let items = [
            corner(exclusion, 0, 0),
            corner(exclusion, 10_000, 0),
            corner(exclusion, 0, 10_000),
            corner(inclusion, -90_000, -90_000),
            corner(inclusion, 90_000, -90_000),
            corner(inclusion, 0, 90_000),
        ];
        let fence = fence_of(&items, None).unwrap();
        assert_eq!((fence.inside.len(), fence.outside.len()), (1, 1));
        assert!(!fence.allows(Point::new(0.2, 0.2)));
        assert!(fence.allows(Point::new(-0.2, -0.2)));
        assert!(!fence.allows(Point::new(20.0, 0.0)));
        assert_eq!(fence_of(&items[..2], None).unwrap_err().0, 0);
        assert_eq!(fence_of(&items[1..], None).unwrap_err().0, 0);
        assert_eq!(fence_of(&items[..5], None).unwrap_err().0, 3);
        assert!(fence_of(&[], None).unwrap().is_empty());
    }
}
