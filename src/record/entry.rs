//! What a log holds, and how each piece is written.

use super::bytes::{Input, Output};
use super::container::Topic;
use super::header::Header;
use crate::autopilot::{BusHealth, BusState, Command, HostHealth};
use crate::fence::{Fence, Polygon};
use crate::frames::Point;
use crate::map::{Cell, CellIndex, CellRect, Grid};
use crate::time::Duration;
use crate::wire::can::{CanFrame, CanId};

/// One piece of a log.
#[derive(Clone, Debug, PartialEq)]
pub enum Entry {
    /// What begins every part of a log.
    Header(Box<Header>),
    /// The true map, of a simulated drive that needs it.
    Truth(Box<Grid>),
    /// A frame came in.
    Received(CanFrame),
    /// A frame went out.
    Sent(CanFrame),
    /// The core was told the time.
    Time,
    /// A wish.
    Command(Command),
    /// What the driver of the bus said.
    Bus(BusHealth),
    /// What the computer said about itself.
    Host(HostHealth),
    /// Another fence.
    Fence(Box<Fence>),
    /// Other parameters, all of them, as TOML.
    Params(String),
    /// A plan was asked for.
    PlanAsked {
        /// Number of the request.
        number: u32,
    },
    /// A planning step came back.
    PlanDone {
        /// Number of its request.
        number: u32,
        /// What it came to ([`super::plan_digest`]).
        digest: u64,
        /// Every reading of the clock during the step, where the clock had a say in it: time after
        /// the one before.
        readings: Vec<Duration>,
    },
    /// A planning step never came back.
    PlanLost {
        /// Number of its request.
        number: u32,
    },
    /// Pieces are missing here: whoever wrote them down did not keep up.
    Gap {
        /// How many.
        count: u64,
    },
    /// The log goes on in its next part.
    Continued,
    /// Something that happened, for reading (JSON).
    Event(String),
    /// What the core believed, for reading (JSON).
    State(String),
}

/// Why a piece cannot be read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum EntryError {
    /// It makes no sense.
    Nonsense(String),
    /// Its log has another version.
    Version(u32),
}

const HEADER: usize = 0;
const RECEIVED: usize = 1;
const SENT: usize = 2;
const INPUT: usize = 3;
const EVENT: usize = 4;
const STATE: usize = 5;

/// Every topic, in the order of the constants above.
pub const TOPICS: &[Topic] = &[
    Topic { name: "/apexd/header", encoding: "json", schema: "" },
    Topic { name: "/can/received", encoding: "apexd", schema: "" },
    Topic { name: "/can/sent", encoding: "apexd", schema: "" },
    Topic { name: "/core/input", encoding: "apexd", schema: "" },
    Topic {
        name: "/core/event",
        encoding: "json",
        schema: r#"{"type":"object","properties":{"event":{"type":"string"},"text":{"type":"string"}}}"#,
    },
    Topic {
        name: "/core/state",
        encoding: "json",
        schema: r#"{"type":"object","properties":{"mode":{"type":"string"},"x_m":{"type":"number"},"y_m":{"type":"number"},"heading_rad":{"type":"number"},"speed_mps":{"type":"number"}}}"#,
    },
];

/// What the first byte of a piece on `/core/input` says.
mod tag {
    pub const TIME: u8 = 0;
    pub const COMMAND: u8 = 1;
    pub const BUS: u8 = 2;
    pub const HOST: u8 = 3;
    pub const FENCE: u8 = 4;
    pub const PARAMS: u8 = 5;
    pub const PLAN_ASKED: u8 = 6;
    pub const PLAN_DONE: u8 = 7;
    pub const PLAN_LOST: u8 = 8;
    pub const GAP: u8 = 9;
    pub const CONTINUED: u8 = 10;
    pub const TRUTH: u8 = 11;
}

/// Bits of a frame's first four bytes besides the identifier (as SocketCAN has them, and one more).
const EXTENDED: u32 = 1 << 31;
const FD: u32 = 1 << 30;

impl Entry {
    /// Its topic, by place in [`TOPICS`]; its bytes are appended to `out`.
    pub fn encode(&self, out: &mut Vec<u8>) -> usize {
        match self {
            Self::Header(header) => {
                header.encode(out);
                return HEADER;
            }
            Self::Received(frame) => {
                put_frame(out, frame);
                return RECEIVED;
            }
            Self::Sent(frame) => {
                put_frame(out, frame);
                return SENT;
            }
            Self::Event(json) => {
                out.extend_from_slice(json.as_bytes());
                return EVENT;
            }
            Self::State(json) => {
                out.extend_from_slice(json.as_bytes());
                return STATE;
            }
            Self::Time => out.push(tag::TIME),
            Self::Command(command) => {
                out.push(tag::COMMAND);
                put_command(out, command);
            }
            Self::Bus(health) => {
                out.push(tag::BUS);
                out.push(match health.state {
                    BusState::Active => 0,
                    BusState::Passive => 1,
                    BusState::Off => 2,
                });
                out.put_varint(health.error_frames);
                out.put_varint(health.frames_unsent);
            }
            Self::Host(health) => {
                out.push(tag::HOST);
                out.push(u8::from(health.disk_full));
                out.push(u8::from(health.predictor_missing));
            }
            Self::Fence(fence) => {
                out.push(tag::FENCE);
                put_fence(out, fence);
            }
            Self::Params(text) => {
                out.push(tag::PARAMS);
                out.put_text(text);
            }
            Self::PlanAsked { number } => {
                out.push(tag::PLAN_ASKED);
                out.put_u32(*number);
            }
            Self::PlanDone { number, digest, readings } => {
                out.push(tag::PLAN_DONE);
                out.put_u32(*number);
                out.put_u64(*digest);
                out.put_u32(u32::try_from(readings.len()).expect("a step takes a while"));
                for reading in readings {
                    out.put_varint(u64::try_from(reading.as_nanos()).unwrap_or(u64::MAX));
                }
            }
            Self::PlanLost { number } => {
                out.push(tag::PLAN_LOST);
                out.put_u32(*number);
            }
            Self::Gap { count } => {
                out.push(tag::GAP);
                out.put_u64(*count);
            }
            Self::Continued => out.push(tag::CONTINUED),
            Self::Truth(grid) => {
                out.push(tag::TRUTH);
                put_grid(out, grid);
            }
        }
        INPUT
    }

    /// The piece that was written on a topic; `Ok(None)` if the topic is none of ours.
    ///
    /// # Errors
    /// Says what does not fit.
    pub fn decode(topic: &str, data: &[u8]) -> Result<Option<Self>, EntryError> {
        let Some(place) = TOPICS.iter().position(|known| known.name == topic) else {
            return Ok(None);
        };
        let mut input = Input::new(data);
        let entry = match place {
            HEADER => return Header::decode(data).map(|header| Some(Self::Header(header.into()))),
            RECEIVED => get_frame(&mut input).map(Self::Received),
            SENT => get_frame(&mut input).map(Self::Sent),
            INPUT => get_input(&mut input),
            _ => {
                let text = std::str::from_utf8(data)
                    .map_err(|_| EntryError::Nonsense(format!("{topic} is no text")))?
                    .to_owned();
                let event = place == EVENT;
                return Ok(Some(if event { Self::Event(text) } else { Self::State(text) }));
            }
        };
        match entry {
            Some(entry) if input.is_empty() => Ok(Some(entry)),
            _ => Err(EntryError::Nonsense(format!("a piece on {topic} that makes no sense"))),
        }
    }
}

fn put_frame(out: &mut Vec<u8>, frame: &CanFrame) {
    let extended = if frame.id.is_extended() { EXTENDED } else { 0 };
    let fd = if frame.fd { FD } else { 0 };
    out.put_u32(frame.id.raw() | extended | fd);
    out.extend_from_slice(frame.data());
}

fn get_frame(input: &mut Input<'_>) -> Option<CanFrame> {
    let word = input.u32()?;
    let raw = word & !(EXTENDED | FD);
    let id = if word & EXTENDED != 0 {
        CanId::extended(raw)
    } else {
        CanId::standard(u16::try_from(raw).ok()?)
    };
    let data = input.take(input.len())?;
    CanFrame::new(id, word & FD != 0, data).filter(|frame| frame.id.raw() == raw)
}

fn put_point(out: &mut Vec<u8>, point: Point) {
    out.put_f64(point.x);
    out.put_f64(point.y);
}

fn get_point(input: &mut Input<'_>) -> Option<Point> {
    Some(Point::new(input.f64()?, input.f64()?))
}

fn put_command(out: &mut Vec<u8>, command: &Command) {
    match command {
        Command::Arm => out.push(0),
        Command::Disarm => out.push(1),
        Command::Goto(point) => {
            out.push(2);
            put_point(out, *point);
        }
        Command::Pause => out.push(3),
        Command::Continue => out.push(4),
        Command::Return(point) => {
            out.push(5);
            put_point(out, *point);
        }
        Command::SpeedLimit(limit) => {
            out.push(6);
            out.push(u8::from(limit.is_some()));
            out.put_f64(limit.unwrap_or_default());
        }
        Command::StationLost(lost) => {
            out.push(7);
            out.push(u8::from(*lost));
        }
        Command::Terminate => out.push(8),
    }
}

fn get_command(input: &mut Input<'_>) -> Option<Command> {
    Some(match input.u8()? {
        0 => Command::Arm,
        1 => Command::Disarm,
        2 => Command::Goto(get_point(input)?),
        3 => Command::Pause,
        4 => Command::Continue,
        5 => Command::Return(get_point(input)?),
        6 => {
            let given = input.bool()?;
            let limit = input.f64()?;
            Command::SpeedLimit(given.then_some(limit))
        }
        7 => Command::StationLost(input.bool()?),
        8 => Command::Terminate,
        _ => return None,
    })
}

fn put_count(out: &mut Vec<u8>, count: usize) {
    out.put_u32(u32::try_from(count).expect("a fence has few corners"));
}

fn put_polygons(out: &mut Vec<u8>, polygons: &[Polygon]) {
    put_count(out, polygons.len());
    for polygon in polygons {
        put_count(out, polygon.len());
        polygon.iter().for_each(|corner| put_point(out, *corner));
    }
}

fn get_polygons(input: &mut Input<'_>) -> Option<Vec<Polygon>> {
    let count = input.count(4)?;
    (0..count)
        .map(|_| {
            let corners = input.count(16)?;
            (0..corners).map(|_| get_point(input)).collect()
        })
        .collect()
}

fn put_fence(out: &mut Vec<u8>, fence: &Fence) {
    put_count(out, fence.inside.len());
    fence.inside.iter().for_each(|group| put_polygons(out, group));
    put_polygons(out, &fence.outside);
}

fn get_fence(input: &mut Input<'_>) -> Option<Fence> {
    let groups = input.count(4)?;
    let inside = (0..groups).map(|_| get_polygons(input)).collect::<Option<_>>()?;
    Some(Fence { inside, outside: get_polygons(input)? })
}

/// Cells of a map at most, so that a damaged log takes no memory: as many as a content may be long.
const CELLS_MAX: i64 = 64 << 20;

/// Runs of equal cells, row by row.
fn put_grid(out: &mut Vec<u8>, grid: &Grid) {
    let CellRect { x0, y0, x1, y1 } = grid.bounds();
    out.put_f64(grid.resolution_m());
    [x0, y0, x1, y1].into_iter().for_each(|edge| out.put_i32(edge));
    for run in grid.cells().chunk_by(|a, b| a == b) {
        out.push(run[0] as u8);
        out.put_varint(run.len() as u64);
    }
}

fn get_grid(input: &mut Input<'_>) -> Option<Grid> {
    let resolution_m = input.f64().filter(|m| *m > 0.0 && m.is_finite())?;
    let rect = CellRect { x0: input.i32()?, y0: input.i32()?, x1: input.i32()?, y1: input.i32()? };
    let mut grid = Grid::new(resolution_m);
    let side = |from: i32, to: i32| i64::from(to) - i64::from(from);
    let (width, height) = (side(rect.x0, rect.x1), side(rect.y0, rect.y1));
    if width <= 0 || height <= 0 {
        return input.is_empty().then_some(grid);
    }
    let near = |edge: i32| edge.abs() < i32::MAX / 4;
    let edges = [rect.x0, rect.y0, rect.x1, rect.y1];
    if width > CELLS_MAX
        || height > CELLS_MAX
        || width * height > CELLS_MAX
        || !edges.into_iter().all(near)
    {
        return None;
    }
    grid.grow_to(rect);
    if grid.bounds() != rect {
        return None; // a grid's bounds are always of the kind that it makes itself
    }
    let mut place = 0i64;
    while place < width * height {
        let cell = match input.u8()? {
            0 => Cell::Unknown,
            1 => Cell::Free,
            2 => Cell::Occupied,
            _ => return None,
        };
        let run = i64::try_from(input.varint()?).ok()?;
        let end = place.checked_add(run).filter(|end| *end <= width * height && run > 0)?;
        if cell != Cell::Unknown {
            for at in place..end {
                let (ix, iy) = ((at % width) as i32, (at / width) as i32);
                grid.set(CellIndex::new(rect.x0 + ix, rect.y0 + iy), cell);
            }
        }
        place = end;
    }
    Some(grid)
}

fn get_input(input: &mut Input<'_>) -> Option<Entry> {
    Some(match input.u8()? {
        tag::TIME => Entry::Time,
        tag::COMMAND => Entry::Command(get_command(input)?),
        tag::BUS => {
            let state = match input.u8()? {
                0 => BusState::Active,
                1 => BusState::Passive,
                2 => BusState::Off,
                _ => return None,
            };
            let (error_frames, frames_unsent) = (input.varint()?, input.varint()?);
            Entry::Bus(BusHealth { state, error_frames, frames_unsent })
        }
        tag::HOST => {
            let (disk_full, predictor_missing) = (input.bool()?, input.bool()?);
            Entry::Host(HostHealth { disk_full, predictor_missing })
        }
        tag::FENCE => Entry::Fence(Box::new(get_fence(input)?)),
        tag::PARAMS => Entry::Params(input.text()?.to_owned()),
        tag::PLAN_ASKED => Entry::PlanAsked { number: input.u32()? },
        tag::PLAN_DONE => {
            let (number, digest) = (input.u32()?, input.u64()?);
            let count = input.count(1)?;
            let reading = |_| input.varint().map(Duration::from_nanos);
            Entry::PlanDone {
                number,
                digest,
                readings: (0..count).map(reading).collect::<Option<_>>()?,
            }
        }
        tag::PLAN_LOST => Entry::PlanLost { number: input.u32()? },
        tag::GAP => Entry::Gap { count: input.u64()? },
        tag::CONTINUED => Entry::Continued,
        tag::TRUTH => Entry::Truth(Box::new(get_grid(input)?)),
        _ => return None,
    })
}

#[cfg(test)]
#[path = "entry_tests.rs"]
pub(super) mod tests;
