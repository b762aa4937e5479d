//! What the daemon wants of the bus.

use crate::shell::can::{CanLink, CanLinkError, LinkStatistics, Received, SendFault};
use crate::shell::clock::Clock;
use crate::wire::can::{CanFrame, CanParams, Sender};

/// The daemon's end of a CAN bus.
pub trait Link {
    /// The next frame, or word of a fault on the bus. Dropping the future loses nothing. After an
    /// error the link [is opened again](Self::reopen).
    async fn receive(&self) -> Result<Received, CanLinkError>;

    /// Hands a frame to the bus; never waits.
    fn try_send(&self, frame: &CanFrame) -> Result<(), SendFault>;

    /// Counts since it was opened first, and the state of the bus.
    fn statistics(&self) -> LinkStatistics;

    /// Tries to open it again.
    fn reopen(&mut self) -> Result<(), CanLinkError>;
}

/// SocketCAN.
pub struct SocketLink {
    link: CanLink,
    params: CanParams,
    clock: Clock,
    /// Counts of the links before this one.
    before: LinkStatistics,
}

impl SocketLink {
    /// Opens the interface that the parameters name. Within an async runtime only.
    pub fn open(params: &CanParams, clock: Clock) -> Result<Self, CanLinkError> {
        let link = CanLink::open(&params.interface, params.layout, Sender::Daemon, &clock)?;
        Ok(Self { link, params: params.clone(), clock, before: LinkStatistics::default() })
    }
}

impl Link for SocketLink {
    async fn receive(&self) -> Result<Received, CanLinkError> {
        self.link.receive().await
    }

    fn try_send(&self, frame: &CanFrame) -> Result<(), SendFault> {
        self.link.try_send(frame)
    }

    fn statistics(&self) -> LinkStatistics {
        sum(self.before, self.link.statistics())
    }

    fn reopen(&mut self) -> Result<(), CanLinkError> {
        let before = self.statistics();
        let Self { link, .. } = Self::open(&self.params, self.clock)?;
        (self.link, self.before) = (link, before);
        Ok(())
    }
}

/// Counts added up; the state is that of the newer link.
fn sum(before: LinkStatistics, now: LinkStatistics) -> LinkStatistics {
    let mut errors = now.errors;
    errors.iter_mut().zip(before.errors).for_each(|(sum, before)| *sum += before);
    LinkStatistics {
        received: before.received + now.received,
        sent: before.sent + now.sent,
        unsent: before.unsent + now.unsent,
        dropped: before.dropped + now.dropped,
        error_frames: before.error_frames + now.error_frames,
        errors,
        ..now
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shell::can::BusState;

    #[test]
    fn counts_outlive_the_link_that_made_them_and_states_do_not() {
        let before = LinkStatistics {
            received: 5,
            dropped: 2,
            errors: [1; 11],
            state: BusState::Off,
            ..LinkStatistics::default()
        };
        let now = LinkStatistics { received: 3, ..LinkStatistics::default() };
        let both = sum(before, now);
        assert_eq!((both.received, both.dropped, both.errors), (8, 2, [1; 11]));
        assert_eq!(both.state, BusState::Active);
    }
}
