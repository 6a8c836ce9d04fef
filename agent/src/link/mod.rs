//! The link to the controller.
//!
//! | module | holds |
//! |---|---|
//! | [`token`] | join tokens |
//! | [`tls`] | whom the agent believes, and who it says it is |
//! | [`join`] | from a token to a certificate, once |
//! | [`renewal`] | a certificate that nears its end against a new one |
//! | [`dial`] | connections to the controller |
//! | [`messages`] | messages of executors, on a connection of their own |
//! | [`orders`] | emergency stops, on a connection of their own |
//! | [`session`] | one stream per life of the agent, made again whenever it breaks |
//! | [`report`] | reports in their wire form |
//! | [`stream_logs`] | a task's output, on request |

pub(crate) mod dial;
pub(crate) mod join;
pub(crate) mod messages;
pub(crate) mod orders;
pub(crate) mod renewal;
pub(crate) mod report;
pub(crate) mod session;
pub(crate) mod stream_logs;
pub(crate) mod tls;
pub(crate) mod token;

use std::fmt;
use std::str::FromStr;

use http::Uri;

/// Where the controller is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Address {
    pub(crate) host: String,
    pub(crate) port: u16,
}

/// Why a text is no address of a controller.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is not the address of a controller; write https://HOST:PORT")]
pub struct AddressError(String);

impl FromStr for Address {
    type Err = AddressError;

    fn from_str(text: &str) -> Result<Self, AddressError> {
        let bad = || AddressError(text.to_owned());
        let uri: Uri = text.parse().map_err(|_| bad())?;
        match (uri.scheme_str(), uri.host(), uri.port_u16(), uri.path()) {
            (Some("https"), Some(host), port, "" | "/") => {
                let host = host.trim_start_matches('[').trim_end_matches(']').to_owned();
                // The port that the controller listens on when nobody says otherwise.
                Ok(Address { host, port: port.unwrap_or(7443) })
            }
            _ => Err(bad()),
        }
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.host.contains(':') {
            write!(f, "[{}]:{}", self.host, self.port)
        } else {
            write!(f, "{}:{}", self.host, self.port)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses() {
        let address: Address = "https://10.0.0.1:7443".parse().unwrap();
        assert_eq!(address.to_string(), "10.0.0.1:7443");
        assert_eq!("https://[::1]:1/".parse::<Address>().unwrap().to_string(), "[::1]:1");
        assert_eq!("https://host".parse::<Address>().unwrap().port, 7443);
        for bad in ["host:1", "http://host:1", "https://host:1/x", ""] {
            assert!(bad.parse::<Address>().is_err(), "{bad}");
        }
    }
}
