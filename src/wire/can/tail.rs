//! Braking tails to frames and back.

use crate::command::{BrakingTail, TailSample};
use crate::time::Instant;

use super::assembly::{ClassicAssembly, expired, payload_frame, split_classic};
use super::fields::{SAMPLES_CLASSIC, SAMPLES_FD, TAIL_CLASSIC, TAIL_FD};
use super::frame::{CanFrame, DATA_MAX, Layout};
use super::receiver::Fault;
use super::signal::Signal;
use super::{SAMPLES_MAX, WireError};

/// A whole tail; anchors are still wrapped.
#[derive(Clone, Debug, Default)]
pub(super) struct RawTail {
    pub(super) plan: u16,
    pub(super) anchor_travelled: u32,
    pub(super) anchor_turned: i32,
    pub(super) anchor_offset_m: f64,
    pub(super) spacing_m: f64,
    pub(super) samples: Vec<TailSample>,
}

/// Raw speed of a sample, rounded down: more than the tail allows is never sent. The slack keeps
/// speeds that are whole counts.
fn speed_to_raw(signal: &Signal, speed_mps: f64) -> Result<i64, WireError> {
    let counts = (speed_mps / signal.scale + 1e-6).floor();
    if counts >= 0.0 && counts <= signal.raw_max() as f64 {
        Ok(counts as i64)
    } else {
        Err(WireError::OutOfRange { signal: signal.name, value: speed_mps })
    }
}

fn put_sample(
    signals: (&Signal, &Signal),
    data: &mut [u8; DATA_MAX],
    index: usize,
    sample: &TailSample,
) -> Result<(), WireError> {
    let (curvature, speed) = signals;
    curvature.put_at(data, index as u16, curvature.quantise(sample.curvature_pm)?);
    speed.put_at(data, index as u16, speed_to_raw(speed, sample.speed_mps)?);
    Ok(())
}

fn get_sample(signals: (&Signal, &Signal), data: &[u8; DATA_MAX], index: usize) -> TailSample {
    let (curvature, speed) = signals;
    TailSample {
        curvature_pm: curvature.physical(curvature.get_at(data, index as u16)),
        speed_mps: speed.physical(speed.get_at(data, index as u16)),
    }
}

/// Writes a tail's frame data, in order, without protection. Nothing is emitted on an error.
pub(super) fn encode(
    layout: Layout,
    tail: &BrakingTail,
    bytes: &mut Vec<u8>,
    mut emit: impl FnMut([u8; DATA_MAX]),
) -> Result<(), WireError> {
    let samples = &tail.samples;
    let Some(last) = samples.last().filter(|_| samples.len() <= SAMPLES_MAX) else {
        return Err(WireError::WrongCount { count: samples.len(), max: SAMPLES_MAX });
    };
    if last.speed_mps != 0.0 {
        return Err(WireError::TailWithoutRest { speed_mps: last.speed_mps });
    }
    let plan = i64::from(tail.plan);
    let count = samples.len() as i64 - 1;
    let spacing = TAIL_FD.spacing.quantise(tail.spacing_m)?;
    if spacing == 0 {
        return Err(WireError::OutOfRange { signal: "Spacing", value: tail.spacing_m });
    }
    let travelled = TAIL_FD.anchor_travelled.wrap(tail.anchor_travelled_m)?;
    let turned = TAIL_FD.anchor_turned.wrap(tail.anchor_turned_rad)?;
    match layout {
        Layout::Fd => {
            let s = &TAIL_FD;
            let mut frames = vec![[0; DATA_MAX]; 1 + samples.len().div_ceil(SAMPLES_FD)];
            s.plan.put(&mut frames[0], plan);
            s.count.put(&mut frames[0], count);
            s.anchor_travelled.put(&mut frames[0], travelled);
            s.anchor_turned.put(&mut frames[0], turned);
            s.spacing.put(&mut frames[0], spacing);
            let offset = s.anchor_offset.quantise(tail.anchor_offset_m)?;
            s.anchor_offset.put(&mut frames[0], offset);
            for (i, block) in samples.chunks(SAMPLES_FD).enumerate() {
                let data = &mut frames[i + 1];
                let first = i * SAMPLES_FD;
                s.part.put(data, 1);
                s.last.put(data, i64::from(first + block.len() == samples.len()));
                s.plan.put(data, plan);
                s.first_sample.put(data, first as i64);
                for (j, sample) in block.iter().enumerate() {
                    put_sample((&s.curvature, &s.speed), data, j, sample)?;
                }
            }
            frames.into_iter().for_each(emit);
        }
        Layout::Classic => {
            let s = &TAIL_CLASSIC;
            let mut heads = [[0; DATA_MAX]; 2];
            s.anchor_travelled.put(&mut heads[0], travelled);
            s.plan.put(&mut heads[0], plan);
            s.anchor_turned.put(&mut heads[1], turned);
            s.spacing.put(&mut heads[1], spacing);
            let mut blocks = Vec::with_capacity(samples.len().div_ceil(SAMPLES_CLASSIC));
            for block in samples.chunks(SAMPLES_CLASSIC) {
                let mut data = [0; DATA_MAX];
                for (j, sample) in block.iter().enumerate() {
                    put_sample((&s.curvature, &s.speed), &mut data, j, sample)?;
                }
                blocks.push(data);
            }
            let mut end = [0; DATA_MAX];
            s.end_plan.put(&mut end, plan);
            s.end_count.put(&mut end, count);
            let offset = s.anchor_offset.quantise(tail.anchor_offset_m)?;
            s.anchor_offset.put(&mut end, offset);
            let seal = |data: &mut _, seal| s.seal.put(data, i64::from(seal));
            split_classic(&heads, blocks.into_iter(), end, seal, bytes, &mut emit);
        }
    }
    Ok(())
}

/// Puts tails together.
#[derive(Clone, Debug)]
pub(super) struct TailAssembly {
    classic: ClassicAssembly,
    begun: Option<Instant>,
    count: usize,
    tail: RawTail,
}

impl TailAssembly {
    pub(super) fn new() -> Self {
        Self {
            classic: ClassicAssembly::new(2, SAMPLES_MAX.div_ceil(SAMPLES_CLASSIC)),
            begun: None,
            count: 0,
            tail: RawTail::default(),
        }
    }

    /// Bytes that it holds on to.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        self.classic.capacity() + self.tail.samples.capacity() * size_of::<TailSample>()
    }

    fn give_up(&mut self) -> bool {
        self.tail.samples.clear();
        self.begun.take().is_some()
    }

    pub(super) fn take(
        &mut self,
        now: Instant,
        layout: Layout,
        lost: u8,
        frame: &CanFrame,
    ) -> Result<Option<RawTail>, Fault> {
        let done = match layout {
            Layout::Classic => self.take_classic(now, lost, frame)?,
            Layout::Fd => self.take_fd(now, lost, frame)?,
        };
        // A tail that does not end at rest, or a spacing of zero, is no tail to act on.
        match done {
            Some(tail)
                if tail.spacing_m > 0.0
                    && tail.samples.last().is_some_and(|sample| sample.speed_mps == 0.0) =>
            {
                Ok(Some(tail))
            }
            Some(_) => Err(Fault::BadValue),
            None => Ok(None),
        }
    }

    fn take_classic(
        &mut self,
        now: Instant,
        lost: u8,
        frame: &CanFrame,
    ) -> Result<Option<RawTail>, Fault> {
        let s = &TAIL_CLASSIC;
        let seal = |data: &_| s.seal.get(data) as u16;
        let Some(bytes) = self.classic.take(now, lost, frame, seal)? else {
            return Ok(None);
        };
        let [first, second] = [0, 1].map(|i| payload_frame(bytes, i));
        let end = frame.padded();
        let count = s.end_count.get(end) as usize + 1;
        if s.end_plan.get(end) != s.plan.get(&first)
            || bytes.len() / 6 - 2 != count.div_ceil(SAMPLES_CLASSIC)
        {
            return Err(Fault::Incomplete);
        }
        let samples = (0..count)
            .map(|i| {
                let block = payload_frame(bytes, 2 + i / SAMPLES_CLASSIC);
                get_sample((&s.curvature, &s.speed), &block, i % SAMPLES_CLASSIC)
            })
            .collect();
        Ok(Some(RawTail {
            plan: s.plan.get(&first) as u16,
            anchor_travelled: s.anchor_travelled.get(&first) as u32,
            anchor_turned: s.anchor_turned.get(&second) as i32,
            anchor_offset_m: s.anchor_offset.value(end),
            spacing_m: s.spacing.value(&second),
            samples,
        }))
    }

    fn take_fd(
        &mut self,
        now: Instant,
        lost: u8,
        frame: &CanFrame,
    ) -> Result<Option<RawTail>, Fault> {
        let s = &TAIL_FD;
        let data = frame.padded();
        let mut broken = false;
        if lost > 0 || self.begun.is_some_and(|begun| expired(begun, now)) {
            broken = self.give_up();
        }
        let last = s.last.get(data) != 0;
        let plan = s.plan.get(data) as u16;
        if s.part.get(data) == 0 {
            broken |= self.give_up();
            if last {
                return Err(Fault::BadValue);
            }
            self.count = s.count.get(data) as usize + 1;
            self.tail = RawTail {
                plan,
                anchor_travelled: s.anchor_travelled.get(data) as u32,
                anchor_turned: s.anchor_turned.get(data) as i32,
                anchor_offset_m: s.anchor_offset.value(data),
                spacing_m: s.spacing.value(data),
                samples: Vec::with_capacity(self.count),
            };
            self.begun = Some(now);
            return if broken { Err(Fault::Incomplete) } else { Ok(None) };
        }
        if self.begun.is_none() {
            return Err(if broken { Fault::Incomplete } else { Fault::Orphan });
        }
        let done = self.tail.samples.len();
        let here = (self.count - done).min(SAMPLES_FD);
        if plan != self.tail.plan
            || s.first_sample.get(data) != done as i64
            || last != (done + here == self.count)
        {
            self.give_up();
            return Err(Fault::Incomplete);
        }
        self.tail.samples.extend((0..here).map(|j| get_sample((&s.curvature, &s.speed), data, j)));
        if !last {
            return Ok(None);
        }
        self.begun = None;
        Ok(Some(std::mem::take(&mut self.tail)))
    }
}
