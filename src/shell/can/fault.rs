//! What goes wrong on the bus, as the driver reports it in error frames.

use socketcan::errors::{ControllerProblems, ErrorCause};
use socketcan::{CanError, CanErrorFrame};

use crate::autopilot::BusState;
use crate::time::Instant;

/// A kind of error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum ErrorClass {
    /// The driver gave up sending.
    TransmitTimeout,
    /// Arbitration was lost.
    LostArbitration,
    /// The controller's queues overflowed or its error counters crossed a limit.
    Controller,
    /// A bit, form, stuff or CRC error.
    Protocol,
    /// The transceiver reports a broken line.
    Transceiver,
    /// Nobody acknowledged a frame.
    NoAcknowledge,
    /// The controller went off the bus.
    BusOff,
    /// An error on the bus.
    BusError,
    /// The controller was started again.
    Restarted,
    /// The interface went down.
    InterfaceDown,
    /// What the driver says is not known here.
    Unknown,
}

impl ErrorClass {
    /// All of them, in order of their numbers.
    pub const ALL: [Self; 11] = [
        Self::TransmitTimeout,
        Self::LostArbitration,
        Self::Controller,
        Self::Protocol,
        Self::Transceiver,
        Self::NoAcknowledge,
        Self::BusOff,
        Self::BusError,
        Self::Restarted,
        Self::InterfaceDown,
        Self::Unknown,
    ];

    /// Its name in statistics.
    pub const fn name(self) -> &'static str {
        match self {
            Self::TransmitTimeout => "transmit_timeout",
            Self::LostArbitration => "lost_arbitration",
            Self::Controller => "controller",
            Self::Protocol => "protocol",
            Self::Transceiver => "transceiver",
            Self::NoAcknowledge => "no_acknowledge",
            Self::BusOff => "bus_off",
            Self::BusError => "bus_error",
            Self::Restarted => "restarted",
            Self::InterfaceDown => "interface_down",
            Self::Unknown => "unknown",
        }
    }
}

/// Some classes of errors.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ErrorClasses(u16);

impl ErrorClasses {
    /// With one more.
    pub const fn with(self, class: ErrorClass) -> Self {
        Self(self.0 | 1 << class as u8)
    }

    /// Whether one is among them.
    pub const fn contains(self, class: ErrorClass) -> bool {
        self.0 & 1 << class as u8 != 0
    }

    /// Each of them.
    pub fn iter(self) -> impl Iterator<Item = ErrorClass> {
        ErrorClass::ALL.into_iter().filter(move |class| self.contains(*class))
    }
}

/// One error report.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BusFault {
    /// When.
    pub at: Instant,
    /// What.
    pub classes: ErrorClasses,
    /// The state that the controller is in from now on, if the report says so.
    pub state: Option<BusState>,
    /// Error counters of sending and receiving, if the driver gives them.
    pub counters: Option<[u8; 2]>,
}

impl BusFault {
    /// The interface went down.
    pub const fn interface_down(at: Instant) -> Self {
        Self {
            at,
            classes: ErrorClasses(0).with(ErrorClass::InterfaceDown),
            state: Some(BusState::Off),
            counters: None,
        }
    }

    /// Reads an error frame: its identifier and data (`linux/can/error.h`).
    pub fn decode(at: Instant, id: u32, data: &[u8]) -> Self {
        let mut fault = Self { at, classes: ErrorClasses::default(), state: None, counters: None };
        let Ok(frame) = CanErrorFrame::new_error(id, data) else {
            fault.classes = fault.classes.with(ErrorClass::Unknown);
            return fault;
        };
        for cause in CanError::from(frame).causes() {
            fault.note(cause);
        }
        // The counters are the state, where the driver names none.
        if let (None, Some(counters)) = (fault.state, fault.counters) {
            let passive = counters.iter().any(|counter| *counter >= PASSIVE_FROM);
            fault.state = Some(if passive { BusState::Passive } else { BusState::Active });
        }
        fault
    }

    fn note(&mut self, cause: &ErrorCause) {
        let class = match cause {
            ErrorCause::TransmitTimeout => ErrorClass::TransmitTimeout,
            ErrorCause::LostArbitration(_) => ErrorClass::LostArbitration,
            ErrorCause::Controller(problems) => {
                self.enter(controller_state(*problems));
                ErrorClass::Controller
            }
            ErrorCause::Protocol { .. } => ErrorClass::Protocol,
            ErrorCause::Transceiver { .. } => ErrorClass::Transceiver,
            ErrorCause::NoAck => ErrorClass::NoAcknowledge,
            ErrorCause::BusOff => {
                self.enter(Some(BusState::Off));
                ErrorClass::BusOff
            }
            ErrorCause::BusError => ErrorClass::BusError,
            ErrorCause::Restarted => {
                self.enter(Some(BusState::Active));
                ErrorClass::Restarted
            }
            ErrorCause::Counters { tx, rx } => {
                // No error of its own: figures that come with one.
                self.counters = Some([*tx, *rx]);
                return;
            }
            _ => ErrorClass::Unknown,
        };
        self.classes = self.classes.with(class);
    }

    /// Of several states in one report the worst counts.
    fn enter(&mut self, state: Option<BusState>) {
        let rank = |state: Option<BusState>| state.map(|state| state as u8);
        if rank(state) > rank(self.state) {
            self.state = state;
        }
    }
}

/// An error counter from which on a controller is passive.
const PASSIVE_FROM: u8 = 128;

fn controller_state(problems: ControllerProblems) -> Option<BusState> {
    let passive = ControllerProblems::RX_PASSIVE | ControllerProblems::TX_PASSIVE;
    let warning = ControllerProblems::RX_WARNING | ControllerProblems::TX_WARNING;
    if problems.intersects(passive) {
        Some(BusState::Passive)
    } else if problems.intersects(warning | ControllerProblems::ACTIVE) {
        Some(BusState::Active)
    } else {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // Classes and bits of `linux/can/error.h`.
    const TX_TIMEOUT: u32 = 0x001;
    const CRTL: u32 = 0x004;
    const PROT: u32 = 0x008;
    const ACK: u32 = 0x020;
    const BUSOFF: u32 = 0x040;
    const BUSERROR: u32 = 0x080;
    const RESTARTED: u32 = 0x100;
    const CNT: u32 = 0x200;

    fn decode(id: u32, data: [u8; 8]) -> (Vec<ErrorClass>, Option<BusState>, Option<[u8; 2]>) {
        let fault = BusFault::decode(Instant::ZERO, id, &data);
        (fault.classes.iter().collect(), fault.state, fault.counters)
    }

    #[test]
    fn each_class_is_found_alone_and_in_company() {
        use ErrorClass::*;
        let single = [
            (0x001, TransmitTimeout),
            (0x002, LostArbitration),
            (0x008, Protocol),
            (0x010, Transceiver),
            (0x020, NoAcknowledge),
            (0x080, BusError),
        ];
        for (id, class) in single {
            assert_eq!(decode(id, [0; 8]), (vec![class], None, None), "{id:#x}");
        }
        let (classes, ..) = decode(TX_TIMEOUT | PROT | ACK | BUSERROR, [0; 8]);
        assert_eq!(classes, [TransmitTimeout, Protocol, NoAcknowledge, BusError]);
    }

    #[test]
    fn the_state_of_the_controller_follows_its_reports() {
        use BusState::*;
        let controller = |bits: u8| decode(CRTL, [0, bits, 0, 0, 0, 0, 0, 0]).1;
        for (bits, state) in [
            (0x01, None), // receive overflow says nothing about the state
            (0x02, None),
            (0x04, Some(Active)),
            (0x0C, Some(Active)),
            (0x10, Some(Passive)),
            (0x20, Some(Passive)),
            (0x30, Some(Passive)),
            (0x40, Some(Active)),
            (0x24, Some(Passive)),
        ] {
            assert_eq!(controller(bits), state, "{bits:#x}");
        }
        assert_eq!(decode(BUSOFF, [0; 8]).1, Some(Off));
        assert_eq!(decode(BUSOFF | CRTL, [0, 0x20, 0, 0, 0, 0, 0, 0]).1, Some(Off));
        assert_eq!(decode(RESTARTED, [0; 8]), (vec![ErrorClass::Restarted], Some(Active), None));
    }

    #[test]
    fn counters_are_figures_and_tell_the_state_where_nothing_else_does() {
        let (classes, state, counters) = decode(CNT | PROT, [0, 0, 0, 0, 0, 0, 130, 3]);
        assert_eq!((classes, state), (vec![ErrorClass::Protocol], Some(BusState::Passive)));
        assert_eq!(counters, Some([130, 3]));
        assert_eq!(decode(CNT | PROT, [0, 0, 0, 0, 0, 0, 127, 3]).1, Some(BusState::Active));
        let off = decode(CNT | BUSOFF, [0, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(off, (vec![ErrorClass::BusOff], Some(BusState::Off), Some([0, 0])));
    }

    #[test]
    fn no_report_is_too_strange() {
        for id in (0..0x800).chain([0x1000_0000, 0x1FFF_FFFF]) {
            for byte in [0, 1, 0x55, 0xFF] {
                let fault = BusFault::decode(Instant::ZERO, id, &[byte; 8]);
                let count_only = id & 0x1FFF_FFFF == CNT;
                assert!(id == 0 || count_only || fault.classes.iter().count() > 0, "{id:#x}");
            }
        }
        let long = BusFault::decode(Instant::ZERO, 1, &[0; 64]);
        assert!(long.classes.contains(ErrorClass::Unknown));
    }

    #[test]
    fn every_class_has_its_own_bit_and_name() {
        for (i, class) in ErrorClass::ALL.into_iter().enumerate() {
            assert_eq!(class as usize, i);
            assert_eq!(ErrorClasses::default().with(class).iter().collect::<Vec<_>>(), [class]);
        }
        let names: std::collections::BTreeSet<_> =
            ErrorClass::ALL.iter().map(|class| class.name()).collect();
        assert_eq!(names.len(), ErrorClass::ALL.len());
    }
}
