//! What the controller is told at start.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use muster_api::duration::Span;

/// Requests a second of one user where nobody says otherwise: what a controller on a small machine answers ten times over.
pub const REQUESTS_PER_SECOND: u32 = 500;

/// A certificate that counts for less could end before its holder has seen that it is to be renewed.
const SHORTEST_TTL: Duration = Duration::from_secs(60);

/// The flags of `muster-controller` and of `muster controller`.
#[derive(Debug, Clone, clap::Args)]
pub struct Args {
    /// Where the store and the certificates are kept [default: ~/.muster/controller]
    #[arg(long, value_name = "DIR", env = "MUSTER_DATA_DIR")]
    pub data_dir: Option<PathBuf>,
    /// The address of the one port for REST and agents
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:7443")]
    pub listen: SocketAddr,
    /// Where the admin's kubeconfig is written, whatever is there [default: ~/.muster/config, unless
    /// that is another cluster's]
    #[arg(long, value_name = "FILE")]
    pub kubeconfig: Option<PathBuf>,
    /// A name or address under which agents reach this controller; may be given several times
    #[arg(long, value_name = "HOST")]
    pub advertise: Vec<String>,
    /// The keys with which Secrets are sealed in the store, one a line, the newest first; made when it is missing and
    /// nothing was sealed yet [default: encryption.key in the data directory]
    #[arg(long, value_name = "FILE")]
    pub encryption_key: Option<PathBuf>,
    /// How long a certificate counts that this controller signs; all are renewed by themselves in time
    #[arg(long, value_name = "DURATION", default_value = "8760h", value_parser = certificate_ttl)]
    pub certificate_ttl: Span,
    /// Requests a second of one user, and twice as many at once; administrators and agents are not counted. 0: any number
    #[arg(long, value_name = "N", default_value_t = REQUESTS_PER_SECOND)]
    pub requests_per_second: u32,
}

/// What the controller needs to know to run.
#[derive(Debug, Clone)]
pub struct Config {
    /// Holds the store, the certificates and the lock. Created when it is missing.
    pub data_dir: PathBuf,
    /// Port 0 takes a free one.
    pub listen: SocketAddr,
    /// Where the admin's kubeconfig is written.
    pub kubeconfig: PathBuf,
    /// Somebody named that file: it is replaced, whatever it says.
    pub kubeconfig_asked: bool,
    /// Names and addresses for the certificate and for join commands, best first.
    pub advertise: Vec<String>,
    /// The keys of the Secrets; none: beside the store.
    pub encryption_key: Option<PathBuf>,
    /// How long a certificate counts; [`pki::TTL`](crate::pki::TTL) where nobody says otherwise.
    pub certificate_ttl: Duration,
    /// Requests a second of one user; 0: any number.
    pub requests_per_second: u32,
}

fn certificate_ttl(text: &str) -> Result<Span, String> {
    let ttl: Span = text
        .parse()
        .map_err(|error| format!("{error}; write a time with its unit, as in 8760h"))?;
    match ttl.as_duration() < SHORTEST_TTL {
        true => Err(format!("a certificate counts for {} s at least", SHORTEST_TTL.as_secs())),
        false => Ok(ttl),
    }
}

impl From<Args> for Config {
    fn from(args: Args) -> Self {
        let home = std::env::home_dir().unwrap_or_else(|| PathBuf::from("."));
        let own = home.join(".muster");
        Self {
            data_dir: args.data_dir.unwrap_or_else(|| own.join("controller")),
            listen: args.listen,
            kubeconfig_asked: args.kubeconfig.is_some(),
            kubeconfig: args.kubeconfig.unwrap_or_else(|| own.join("config")),
            advertise: args.advertise,
            encryption_key: args.encryption_key,
            certificate_ttl: args.certificate_ttl.as_duration(),
            requests_per_second: args.requests_per_second,
        }
    }
}

impl Config {
    /// The host that people and agents should dial for a controller bound to `address`.
    #[must_use]
    pub fn host(&self, address: SocketAddr) -> String {
        if let Some(first) = self.advertise.first() {
            return first.clone();
        }
        if address.ip().is_unspecified() {
            "127.0.0.1".to_owned()
        } else {
            address.ip().to_string()
        }
    }
}
