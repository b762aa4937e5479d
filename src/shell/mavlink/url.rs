//! Where links lead: `udpin:HOST:PORT` and the like.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

/// The host when none is named: nobody outside this computer.
const LOOPBACK: &str = "127.0.0.1";
/// Bits a second of a serial line when none are named.
const BAUD: u32 = 57_600;

/// A link.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LinkUrl {
    /// Waits for datagrams; whoever sends some is answered.
    UdpServer {
        /// Address to wait at.
        host: String,
        /// Port to wait at.
        port: u16,
    },
    /// Sends datagrams to one place.
    UdpClient {
        /// Where to.
        host: String,
        /// Where to.
        port: u16,
    },
    /// Waits for connections.
    TcpServer {
        /// Address to wait at.
        host: String,
        /// Port to wait at.
        port: u16,
    },
    /// Connects to one place, again and again.
    TcpClient {
        /// Where to.
        host: String,
        /// Where to.
        port: u16,
    },
    /// A serial line.
    Serial {
        /// The device.
        device: PathBuf,
        /// Bits a second.
        baud: u32,
    },
}

/// Why a text is no link.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{text:?} is no link: {why}; links are udpin:HOST:PORT, udpout:HOST:PORT, tcpin:HOST:PORT, \
     tcpout:HOST:PORT, serial:DEVICE:BAUD"
)]
pub struct UrlError {
    text: String,
    why: &'static str,
}

impl FromStr for LinkUrl {
    type Err = UrlError;

    fn from_str(text: &str) -> Result<Self, UrlError> {
        let fail = |why| UrlError { text: text.to_owned(), why };
        let (kind, rest) = text.trim().split_once(':').ok_or_else(|| fail("no kind before a :"))?;
        let rest = rest.strip_prefix("//").unwrap_or(rest);
        if kind == "serial" {
            let (device, baud) = match rest.rsplit_once(':') {
                Some((device, baud)) => (device, baud.parse().ok()),
                None => (rest, Some(BAUD)),
            };
            let baud = baud.filter(|baud| *baud > 0).ok_or_else(|| fail("no number of baud"))?;
            if device.is_empty() {
                return Err(fail("no device"));
            }
            return Ok(Self::Serial { device: device.into(), baud });
        }
        let (host, port) = rest.rsplit_once(':').unwrap_or(("", rest));
        let port: u16 = port.parse().map_err(|_| fail("the port must be 1 to 65535"))?;
        if port == 0 {
            return Err(fail("the port must be 1 to 65535"));
        }
        let bare = host.strip_prefix('[').and_then(|host| host.strip_suffix(']'));
        let host = bare.unwrap_or(host).to_owned();
        let server = |host: String| if host.is_empty() { LOOPBACK.to_owned() } else { host };
        match kind {
            "udpin" | "udp" => Ok(Self::UdpServer { host: server(host), port }),
            "tcpin" => Ok(Self::TcpServer { host: server(host), port }),
            "udpout" | "tcpout" | "tcp" if host.is_empty() => Err(fail("no host")),
            "udpout" => Ok(Self::UdpClient { host, port }),
            "tcpout" | "tcp" => Ok(Self::TcpClient { host, port }),
            _ => Err(fail("it is of no known kind")),
        }
    }
}

impl fmt::Display for LinkUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UdpServer { host, port } => write!(f, "udpin:{host}:{port}"),
            Self::UdpClient { host, port } => write!(f, "udpout:{host}:{port}"),
            Self::TcpServer { host, port } => write!(f, "tcpin:{host}:{port}"),
            Self::TcpClient { host, port } => write!(f, "tcpout:{host}:{port}"),
            Self::Serial { device, baud } => write!(f, "serial:{}:{baud}", device.display()),
        }
    }
}

/// The links of the parameter `mavlink.links`.
///
/// # Errors
/// If one of them is none.
pub fn parse_list(text: &str) -> Result<Vec<LinkUrl>, UrlError> {
    let items = text.split(',').map(str::trim).filter(|item| !item.is_empty());
    items.map(str::parse).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_are_read_in_every_form_and_written_in_one() {
        for (text, wanted) in [
            ("udpin:0.0.0.0:14550", "udpin:0.0.0.0:14550"),
            ("udpin://127.0.0.1:14540", "udpin:127.0.0.1:14540"),
            ("udpin:14550", "udpin:127.0.0.1:14550"),
            ("udpin::14550", "udpin:127.0.0.1:14550"),
            ("udpout:192.168.0.9:14550", "udpout:192.168.0.9:14550"),
            ("tcpin:[::1]:5760", "tcpin:::1:5760"),
            ("tcpout:laptop:5760", "tcpout:laptop:5760"),
            ("serial:/dev/ttyUSB0:921600", "serial:/dev/ttyUSB0:921600"),
            ("serial:/dev/ttyUSB0", "serial:/dev/ttyUSB0:57600"),
        ] {
            assert_eq!(text.parse::<LinkUrl>().unwrap().to_string(), wanted, "{text}");
        }
    }

    #[test]
    fn what_is_no_link_is_refused_with_the_forms_that_are() {
        for text in ["", "14550", "udpin:", "udpin:x:0", "udpin:x:99999", "udpout:14550", "can:0:1"]
            .into_iter()
            .chain(["serial:", "serial::9600", "serial:/dev/x:fast", "serial:/dev/x:0"])
        {
            let said = text.parse::<LinkUrl>().unwrap_err().to_string();
            assert!(said.contains("serial:DEVICE:BAUD"), "{said}");
        }
    }

    #[test]
    fn a_list_is_separated_by_commas() {
        assert_eq!(parse_list(" ").unwrap(), []);
        assert_eq!(parse_list("udpin:14550, tcpin:5760,").unwrap().len(), 2);
        assert!(parse_list("udpin:14550,nonsense").is_err());
    }
}
