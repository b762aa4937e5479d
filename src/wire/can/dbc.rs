//! The CAN database as text (`params/car.dbc`) and as the tables of `docs/can-interface.md`.

use std::fmt::Write as _;

use super::database::{Message, Sender, messages, protection};
use super::frame::Layout;
use super::signal::{Multiplex, Signal};

const HEADER: &str = "\
VERSION \"1\"

NS_ :
\tCM_
\tBA_DEF_
\tBA_
\tVAL_
\tBA_DEF_DEF_
\tSG_MUL_VAL_

BS_:

BU_: Car Daemon

";

/// Names of a row's signals: the bare name, or with a two-digit number.
fn names(signal: &Signal) -> impl Iterator<Item = (u16, String)> + '_ {
    (0..signal.count).map(|i| {
        let name = match signal.count {
            1 => signal.name.to_owned(),
            _ => format!("{}{i:02}", signal.name),
        };
        (signal.start + i * signal.stride, name)
    })
}

fn all_signals(message: &Message) -> Vec<Signal> {
    protection(message.layout).into_iter().chain(message.signals.iter().copied()).collect()
}

/// The number as a database and a table write it: without the dust of binary fractions.
fn number(value: f64) -> String {
    let text = format!("{value:.10}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}

fn limits(signal: &Signal) -> (String, String) {
    (number(signal.physical(signal.raw_min())), number(signal.physical(signal.raw_max())))
}

/// The text of `params/car.dbc`.
pub fn database_text() -> String {
    let mut text = HEADER.to_owned();
    // Writing to a string cannot fail.
    let mut line = |words: std::fmt::Arguments<'_>| {
        let _ = text.write_fmt(words);
        text.push('\n');
    };
    let messages = messages();
    for message in &messages {
        let (from, to) = match message.sender {
            Sender::Car => ("Car", "Daemon"),
            Sender::Daemon => ("Daemon", "Car"),
        };
        line(format_args!("BO_ {} {}: {} {from}", message.id, message.name, message.len));
        for signal in all_signals(message) {
            let multiplex = match signal.multiplex {
                Multiplex::Plain => String::new(),
                Multiplex::Selector => " M".to_owned(),
                Multiplex::On(first, _) => format!(" m{first}"),
            };
            let (min, max) = limits(&signal);
            for (start, name) in names(&signal) {
                line(format_args!(
                    " SG_ {name}{multiplex} : {start}|{}@1{} ({},{}) [{min}|{max}] \"{}\" {to}",
                    signal.bits,
                    if signal.signed { '-' } else { '+' },
                    number(signal.scale),
                    number(signal.offset),
                    signal.unit,
                ));
            }
        }
        line(format_args!(""));
    }
    line(format_args!(
        "CM_ \"The interface between the daemon and the car's controller. Written from the codec's own \
         description; docs/can-interface.md explains it. A car speaks either the CAN FD messages or \
         the ones whose names end in Classic.\";"
    ));
    for message in &messages {
        line(format_args!("CM_ BO_ {} \"{}\";", message.id, message.text));
        for signal in all_signals(message) {
            for (_, name) in names(&signal) {
                line(format_args!("CM_ SG_ {} {name} \"{}\";", message.id, signal.text));
            }
        }
    }
    line(format_args!(
        "BA_DEF_ \"BusType\" STRING ;\n\
         BA_DEF_ BO_ \"VFrameFormat\" ENUM \"StandardCAN\",\"ExtendedCAN\",\"reserved\",\"J1939PG\",\
         \"reserved\",\"reserved\",\"reserved\",\"reserved\",\"reserved\",\"reserved\",\"reserved\",\
         \"reserved\",\"reserved\",\"reserved\",\"StandardCAN_FD\",\"ExtendedCAN_FD\";\n\
         BA_DEF_ BO_ \"CANFD_BRS\" ENUM \"0\",\"1\";\n\
         BA_DEF_ BO_ \"GenMsgCycleTime\" INT 0 65535;\n\
         BA_DEF_ BO_ \"GenMsgSendType\" ENUM \"Cyclic\",\"Event\";\n\
         BA_DEF_ BO_ \"E2EProfile\" ENUM \"None\",\"P05\",\"P11A\";\n\
         BA_DEF_ BO_ \"E2EDataId\" INT 0 65535;\n\
         BA_DEF_DEF_ \"BusType\" \"CAN FD\";\n\
         BA_DEF_DEF_ \"VFrameFormat\" \"StandardCAN\";\n\
         BA_DEF_DEF_ \"CANFD_BRS\" \"0\";\n\
         BA_DEF_DEF_ \"GenMsgCycleTime\" 0;\n\
         BA_DEF_DEF_ \"GenMsgSendType\" \"Cyclic\";\n\
         BA_DEF_DEF_ \"E2EProfile\" \"None\";\n\
         BA_DEF_DEF_ \"E2EDataId\" 0;\n\
         BA_ \"BusType\" \"CAN FD\";"
    ));
    for message in &messages {
        let id = message.id;
        let fd = message.layout == Layout::Fd;
        line(format_args!("BA_ \"VFrameFormat\" BO_ {id} {};", if fd { 14 } else { 0 }));
        line(format_args!("BA_ \"CANFD_BRS\" BO_ {id} {};", u8::from(fd)));
        line(format_args!("BA_ \"GenMsgCycleTime\" BO_ {id} {};", message.cycle_ms));
        line(format_args!("BA_ \"GenMsgSendType\" BO_ {id} {};", u8::from(message.cycle_ms == 0)));
        line(format_args!("BA_ \"E2EProfile\" BO_ {id} {};", if fd { 1 } else { 2 }));
        line(format_args!("BA_ \"E2EDataId\" BO_ {id} {};", message.data_id));
    }
    for message in &messages {
        for signal in all_signals(message).iter().filter(|signal| !signal.values.is_empty()) {
            for (_, name) in names(signal) {
                let values: String =
                    signal.values.iter().map(|(raw, name)| format!(" {raw} \"{name}\"")).collect();
                line(format_args!("VAL_ {} {name}{values} ;", message.id));
            }
        }
    }
    // Signals that are there for more than one value of the selector.
    for message in &messages {
        let signals = all_signals(message);
        let selector = signals.iter().find(|signal| signal.multiplex == Multiplex::Selector);
        let ranges = signals.iter().any(|s| matches!(s.multiplex, Multiplex::On(a, b) if a != b));
        let (Some(selector), true) = (selector, ranges) else { continue };
        for signal in &signals {
            if let Multiplex::On(first, last) = signal.multiplex {
                for (_, name) in names(signal) {
                    line(format_args!(
                        "SG_MUL_VAL_ {} {name} {} {first}-{last};",
                        message.id, selector.name
                    ));
                }
            }
        }
    }
    text
}

/// One table a message, in Markdown.
pub fn frame_tables() -> String {
    let mut text = String::new();
    for message in messages() {
        let cycle = match message.cycle_ms {
            0 => "a stream".to_owned(),
            ms => format!("every {ms} ms"),
        };
        let format = match message.layout {
            Layout::Classic => "classic, profile 11",
            Layout::Fd => "CAN FD, profile 5",
        };
        let from = match message.sender {
            Sender::Car => "car",
            Sender::Daemon => "daemon",
        };
        let _ = writeln!(
            text,
            "#### `{:03X}` {}\n\n{}. From the {from}, {cycle}; {} bytes, {format}, Data ID `{:04X}`.\n\n\
             | bits | signal | when | scale | range | unit | meaning |\n\
             |---|---|---|---|---|---|---|",
            message.id, message.name, message.text, message.len, message.data_id,
        );
        for signal in all_signals(&message) {
            let when = match signal.multiplex {
                Multiplex::Plain => String::new(),
                Multiplex::Selector => "selector".to_owned(),
                Multiplex::On(a, b) if a == b => format!("Part {a}"),
                Multiplex::On(a, b) => format!("Part {a} to {b}"),
            };
            let last = signal.start + u16::from(signal.bits) - 1;
            let (bits, name) = match signal.count {
                1 if signal.bits == 1 => (last.to_string(), signal.name.to_owned()),
                1 => (format!("{} to {last}", signal.start), signal.name.to_owned()),
                n => (
                    format!("{} to {last}, then every {}", signal.start, signal.stride),
                    format!("{}00 to {:02}", signal.name, n - 1),
                ),
            };
            let values: Vec<String> =
                signal.values.iter().map(|(raw, name)| format!("{raw} = {name}")).collect();
            let (min, max) = limits(&signal);
            let _ = writeln!(
                text,
                "| {bits}{} | {name} | {when} | {} | {min} to {max} | {} | {}{}{} |",
                if signal.signed { ", signed" } else { "" },
                number(signal.scale),
                signal.unit,
                signal.text,
                if values.is_empty() { "" } else { ": " },
                values.join(", "),
            );
        }
        text.push('\n');
    }
    text
}
