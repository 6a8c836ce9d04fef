//! What the agent is told: flags and `agent.yaml`, the same fields; a flag wins. What neither says
//! of the node is as it was declared last (see `declared`).

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use clap::ValueEnum;
use muster_api::kind::node::NodeKind;
use muster_api::name::{FunctionName, NodeName};
use muster_api::pose::DEFAULT_MAP;
use muster_api::quantity::{Bytes, MilliCpu};
use muster_api::resource::parse_function_list;
use muster_failpoint::Failpoint;
use serde::Deserialize;

use crate::declared::Declared;
use crate::durable::{self, FileError, Keep};
use crate::executor::direct::Where;
use crate::gate::settings::Settings as GateSettings;
use crate::gauge::battery::BatterySource;
use crate::position::PositionSource;
use crate::position::settings::{PoseArgs, PoseSettings};
use crate::runtime::process::attempt::LogBounds;
use crate::sensor;
use crate::sensor::settings::Source;
use crate::sim;
use crate::sim::settings::Settings as SimSettings;

/// Where the Docker Engine listens when nobody says otherwise.
const DOCKER_SOCKET: &str = "/var/run/docker.sock";

/// What a node is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// It has a pose, and sensors or actuators.
    Robot,
    /// Computation only.
    Cloud,
}

impl From<Kind> for NodeKind {
    fn from(kind: Kind) -> Self {
        match kind {
            Kind::Robot => NodeKind::Robot,
            Kind::Cloud => NodeKind::Cloud,
        }
    }
}

/// Flags of `muster-agent` and of `muster agent`. What a node declares of itself (labels, sensors,
/// actuators, map, position, cpu, memory, speed, battery) is remembered in its data directory.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct Args {
    /// The controller, https://HOST:PORT; an agent that joined before knows it
    #[arg(long, value_name = "URL")]
    pub join: Option<String>,
    /// Join token; an agent that joined before needs none
    #[arg(long, value_name = "TOKEN", env = "MUSTER_TOKEN", hide_env_values = true)]
    pub token: Option<String>,
    /// This node's name
    #[arg(long, value_name = "NAME")]
    pub name: Option<String>,
    /// What this node is
    #[arg(long, value_enum)]
    pub kind: Option<Kind>,
    /// The same settings from a file; flags win
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Where the agent keeps its identity and its tasks
    #[arg(long, value_name = "DIR")]
    pub data_dir: Option<PathBuf>,
    /// A label of the node, may be repeated; without any, the labels given last stay
    #[arg(long = "label", value_name = "KEY=VALUE")]
    pub labels: Vec<String>,
    /// Sensor functions, kinect:ImageGen;kinect:LaserGen [default: as given last]
    #[arg(long, value_name = "LIST")]
    pub sr_res: Option<String>,
    /// Actuator functions, base:Drive [default: as given last]
    #[arg(long, value_name = "LIST")]
    pub ar_res: Option<String>,
    /// The map that positions are in [default: as given last, else map]
    #[arg(long, value_name = "NAME")]
    pub map: Option<String>,
    /// Where the robot is: `static:X,Y[,YAW]`, `file:PATH` with a line `X Y [YAW]` that the robot keeps up to date,
    /// `ros1:TOPIC` of type Odometry, PoseWithCovarianceStamped, PoseStamped or TFMessage, or `sim:WORLD`, a file with
    /// the world of a robot that is simulated [default: as given last]
    #[arg(long, value_name = "SOURCE", allow_hyphen_values = true)]
    pub position: Option<String>,
    #[command(flatten)]
    pub(crate) pose: PoseArgs,
    /// Offer at most this much cpu [default: as given last, else all]
    #[arg(long, value_name = "CPU")]
    pub cpu: Option<String>,
    /// Offer at most this much memory [default: as given last, else all]
    #[arg(long, value_name = "BYTES")]
    pub memory: Option<String>,
    /// Usual speed of the robot, m/s [default: as given last]
    #[arg(long, value_name = "M/S")]
    pub speed: Option<f64>,
    /// The robot's battery: `sysfs:NAME` as in /sys/class/power_supply, or `file:PATH` with a line
    /// `PERCENT [charging]` that the robot keeps up to date, or `sim` [default: as given last; a simulated robot's own]
    #[arg(long, value_name = "SOURCE")]
    pub battery: Option<String>,
    /// Run tasks with quotas even where the kernel cannot hold them to their quotas
    #[arg(long)]
    pub unenforced_quotas: bool,
    /// How large one file of a task's output may become [default: 10Mi]
    #[arg(long, value_name = "BYTES")]
    pub log_max_size: Option<String>,
    /// How many files of a task's output are kept [default: 5]
    #[arg(long, value_name = "COUNT")]
    pub log_max_files: Option<u32>,
    /// The Docker Engine's socket, or none [default: /var/run/docker.sock]
    #[arg(long, value_name = "PATH")]
    pub docker_socket: Option<String>,
    /// Where frameworks may exchange messages with executors without the controller: `ADDR[:PORT]`, or none, once there is
    /// an executor [default: a free port of the address by which the controller is reached]
    #[arg(long, value_name = "ADDR[:PORT]")]
    pub messages: Option<String>,
}

/// `agent.yaml`.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
struct FileConfig {
    join: Option<String>,
    token: Option<String>,
    name: Option<String>,
    kind: Option<Kind>,
    data_dir: Option<PathBuf>,
    labels: Option<BTreeMap<String, String>>,
    sr_res: Option<String>,
    ar_res: Option<String>,
    map: Option<String>,
    position: Option<String>,
    pose: PoseArgs,
    cpu: Option<String>,
    memory: Option<String>,
    speed: Option<f64>,
    battery: Option<String>,
    unenforced_quotas: bool,
    log_max_size: Option<String>,
    log_max_files: Option<u32>,
    docker_socket: Option<String>,
    gate: GateSettings,
    sensors: Vec<Source>,
    messages: Option<String>,
}

/// Settings that make sense.
#[derive(Debug, Clone)]
pub struct Config {
    pub(crate) join: Option<String>,
    pub(crate) token: Option<String>,
    pub(crate) name: Option<NodeName>,
    pub(crate) kind: Option<Kind>,
    pub(crate) data_dir: PathBuf,
    pub(crate) labels: BTreeMap<String, String>,
    pub(crate) sensors: BTreeSet<FunctionName>,
    pub(crate) actuators: BTreeSet<FunctionName>,
    pub(crate) position: Option<PositionSource>,
    pub(crate) pose: PoseSettings,
    pub(crate) map: String,
    pub(crate) cpu: Option<MilliCpu>,
    pub(crate) memory: Option<Bytes>,
    pub(crate) speed: Option<f64>,
    pub(crate) battery: Option<BatterySource>,
    /// The world of a robot that is simulated.
    pub(crate) simulated: Option<SimSettings>,
    pub(crate) unenforced_quotas: bool,
    pub(crate) log: LogBounds,
    /// Absent: no Docker.
    pub(crate) docker_socket: Option<PathBuf>,
    /// The drivers of the actuators.
    pub(crate) gate: GateSettings,
    /// Where the sensors' functions come from.
    pub(crate) sources: Vec<Source>,
    pub(crate) messages: Where,
    /// To be kept for the next start.
    pub(crate) declared: Declared,
    /// The flags that nobody gave now, and that count as they were given last.
    pub(crate) remembered: Vec<&'static str>,
}

/// Why the settings make no sense.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file is not there, or cannot be read.
    #[error("failed to read {path}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// The file is not an agent's configuration.
    #[error("{path} is not a configuration of an agent: {reason}")]
    Yaml {
        /// The file.
        path: PathBuf,
        /// Line, column and reason.
        reason: String,
    },
    /// A setting has no meaning.
    #[error("{field}: {reason}")]
    Field {
        /// As the flag is called.
        field: &'static str,
        /// What is wrong, and what would be right.
        reason: String,
    },
    /// What was declared last cannot be read.
    #[error("what this node declared last cannot be read")]
    Declared(#[from] FileError),
}

fn field(field: &'static str) -> impl Fn(&dyn std::error::Error) -> ConfigError {
    move |error| ConfigError::Field { field, reason: crate::driver::chain(error) }
}

impl Args {
    /// Flags and file together, checked.
    ///
    /// # Errors
    ///
    /// Names the file with line and column, or the flag.
    pub fn resolve(self) -> Result<Config, ConfigError> {
        let file = match &self.config {
            Some(path) => read(path)?,
            None => FileConfig::default(),
        };
        let data_dir = absolute(self.data_dir.or(file.data_dir).unwrap_or_else(default_data_dir));
        let mut pose = self.pose;
        pose.fill(file.pose);
        let mut declared = Declared {
            labels: labels(file.labels, &self.labels)?,
            sr_res: self.sr_res.or(file.sr_res),
            ar_res: self.ar_res.or(file.ar_res),
            map: self.map.or(file.map),
            position: match self.position {
                Some(text) => Some(whole(text, None)),
                None => file.position.map(|text| whole(text, self.config.as_deref())),
            },
            pose,
            cpu: self.cpu.or(file.cpu),
            memory: self.memory.or(file.memory),
            speed: self.speed.or(file.speed),
            battery: self.battery.or(file.battery),
        };
        let remembered = declared.remember(Declared::last(&data_dir)?);
        let functions = |name, text: &Option<String>| {
            parse_function_list(text.as_deref().unwrap_or_default()).map_err(|e| field(name)(&e))
        };
        let kind = self.kind.or(file.kind);
        let actuators = functions("--ar-res", &declared.ar_res)?;
        let sensors = functions("--sr-res", &declared.sr_res)?;
        if kind == Some(Kind::Cloud) && !(actuators.is_empty() && sensors.is_empty()) {
            let reason =
                "a cloud node has no sensors and no actuators; use --kind robot".to_owned();
            return Err(ConfigError::Field { field: "--kind", reason });
        }
        let of_file = |field, error: &dyn std::error::Error| {
            let reason = match &self.config {
                Some(path) => format!("{} ({})", crate::driver::chain(error), path.display()),
                None => crate::driver::chain(error),
            };
            ConfigError::Field { field, reason }
        };
        let position = parsed("--position", &declared.position)?;
        let simulated = match &position {
            Some(PositionSource::Sim(world)) => {
                Some(SimSettings::read(world).map_err(|e| field("--position")(&e))?)
            }
            _ => None,
        };
        let simulator = simulated.as_ref().map(|_| data_dir.join(sim::DIR));
        let gate_error = |error| of_file("gate", &error);
        file.gate.check(&actuators).map_err(gate_error)?;
        let gate = file.gate.simulate(simulator.as_deref()).map_err(gate_error)?;
        sensor::settings::check(&file.sensors, &sensors, simulated.is_some())
            .map_err(|e| of_file("sensors", &e))?;
        let battery = battery(&declared.battery, simulated.as_ref())?;
        let name = self.name.or(file.name);
        let socket = self.docker_socket.or(file.docker_socket);
        Ok(Config {
            join: self.join.or(file.join),
            token: self.token.or(file.token),
            name: name.map(NodeName::new).transpose().map_err(|e| field("--name")(&e))?,
            kind,
            data_dir,
            labels: declared.labels.clone().unwrap_or_default(),
            sensors,
            actuators,
            position,
            pose: declared
                .pose
                .resolve()
                .map_err(|(field, reason)| ConfigError::Field { field, reason })?,
            map: declared.map.clone().unwrap_or_else(|| DEFAULT_MAP.to_owned()),
            cpu: parsed("--cpu", &declared.cpu)?,
            memory: parsed("--memory", &declared.memory)?,
            speed: speed(declared.speed)?.or_else(|| simulated.as_ref().map(SimSettings::speed)),
            battery,
            simulated,
            unenforced_quotas: self.unenforced_quotas || file.unenforced_quotas,
            log: log_bounds(
                self.log_max_size.or(file.log_max_size),
                self.log_max_files.or(file.log_max_files),
            )?,
            docker_socket: match socket.as_deref() {
                Some("none") => None,
                Some(path) => Some(PathBuf::from(path)),
                None => Some(PathBuf::from(DOCKER_SOCKET)),
            },
            gate,
            sources: file.sensors,
            messages: parsed("--messages", &self.messages.or(file.messages))?.unwrap_or_default(),
            declared,
            remembered,
        })
    }
}

/// The file's labels and the flags' together; `None` when neither says anything of labels.
fn labels(
    file: Option<BTreeMap<String, String>>,
    flags: &[String],
) -> Result<Option<BTreeMap<String, String>>, ConfigError> {
    if file.is_none() && flags.is_empty() {
        return Ok(None);
    }
    let mut labels = file.unwrap_or_default();
    for label in flags {
        let (key, value) = label.split_once('=').ok_or_else(|| ConfigError::Field {
            field: "--label",
            reason: format!("{label:?} is not KEY=VALUE"),
        })?;
        labels.insert(key.to_owned(), value.to_owned());
    }
    Ok(Some(labels))
}

fn parsed<T>(flag: &'static str, text: &Option<String>) -> Result<Option<T>, ConfigError>
where
    T: FromStr<Err: std::error::Error + 'static>,
{
    text.as_deref().map(|text| text.parse().map_err(|e| field(flag)(&e))).transpose()
}

/// A simulated robot has its own battery, unless it is said otherwise.
fn battery(
    text: &Option<String>,
    simulated: Option<&SimSettings>,
) -> Result<Option<BatterySource>, ConfigError> {
    let simulates = simulated.is_some_and(SimSettings::has_battery);
    match parsed("--battery", text)? {
        Some(BatterySource::Sim) if !simulates => {
            let reason =
                "the robot is not simulated, or its world gives it no battery; leave it out";
            Err(ConfigError::Field { field: "--battery", reason: reason.to_owned() })
        }
        None if simulates => Ok(Some(BatterySource::Sim)),
        source => Ok(source),
    }
}

/// The world of `sim:` as a whole path: a file's is beside the file, a flag's in the working directory. It is remembered, and the
/// next start may be elsewhere.
fn whole(position: String, config: Option<&Path>) -> String {
    match position.strip_prefix("sim:") {
        Some(world) if !world.is_empty() => {
            let dir = config.and_then(Path::parent).unwrap_or_else(|| Path::new(""));
            format!("sim:{}", absolute(dir.join(world)).display())
        }
        _ => position,
    }
}

fn log_bounds(size: Option<String>, files: Option<u32>) -> Result<LogBounds, ConfigError> {
    let default = LogBounds::default();
    let bytes: Option<Bytes> = parsed("--log-max-size", &size)?;
    Ok(LogBounds {
        bytes: bytes.map_or(default.bytes, |bytes| bytes.0),
        files: files.unwrap_or(default.files).max(1),
    })
}

fn speed(speed: Option<f64>) -> Result<Option<f64>, ConfigError> {
    match speed {
        Some(speed) if !(speed.is_finite() && speed > 0.0) => Err(ConfigError::Field {
            field: "--speed",
            reason: format!("{speed} is not a speed in m/s above 0"),
        }),
        speed => Ok(speed),
    }
}

fn read(path: &Path) -> Result<FileConfig, ConfigError> {
    let text = std::fs::read_to_string(path)
        .map_err(|source| ConfigError::Read { path: path.to_owned(), source })?;
    serde_saphyr::from_str(&text)
        .map_err(|error| ConfigError::Yaml { path: path.to_owned(), reason: error.to_string() })
}

/// Shims leave the agent's working directory, so a path that depends on it would lead elsewhere.
fn absolute(path: PathBuf) -> PathBuf {
    // Fails only for an empty path, or without a working directory; opening the path says so then.
    std::path::absolute(&path).unwrap_or(path)
}

fn default_data_dir() -> PathBuf {
    if rustix::process::geteuid().is_root() {
        return PathBuf::from("/var/lib/muster/agent");
    }
    let home = std::env::var_os("HOME").map_or_else(std::env::temp_dir, PathBuf::from);
    home.join(".local/share/muster/agent")
}

/// Who this data directory belongs to; written once, at the first join.
#[derive(Debug, Clone, serde::Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Identity {
    /// Made with the directory: names this agent's groups and containers.
    pub(crate) id: String,
    pub(crate) node: Option<String>,
    pub(crate) kind: Option<Kind>,
    pub(crate) controller: Option<String>,
}

impl Identity {
    /// The directory's identity; a new one for a new directory.
    pub(crate) fn open(data_dir: &Path) -> Result<Identity, FileError> {
        let path = data_dir.join("agent.json");
        if let Some(identity) = durable::read_json(&path)? {
            return Ok(identity);
        }
        let id = uuid::Uuid::new_v4().simple().to_string();
        let identity =
            Identity { id: id[..12].to_owned(), node: None, kind: None, controller: None };
        identity.write(data_dir)?;
        Ok(identity)
    }

    pub(crate) fn write(&self, data_dir: &Path) -> Result<(), FileError> {
        durable::write_json(
            Failpoint::AgentIdentity,
            &data_dir.join("agent.json"),
            self,
            Keep::PowerCut,
        )
    }
}

impl serde::Serialize for Kind {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(match self {
            Kind::Robot => "robot",
            Kind::Cloud => "cloud",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(text: &str) -> (tempfile::TempDir, PathBuf) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("agent.yaml");
        std::fs::write(&path, text).unwrap();
        (dir, path)
    }

    /// Of a directory in which nothing was declared before.
    fn args() -> Args {
        Args { data_dir: Some(PathBuf::from("/no/such/directory")), ..Args::default() }
    }

    #[test]
    fn flags_win_over_the_file() {
        let (_dir, path) = file("name: a\nkind: robot\nsrRes: kinect:ImageGen\nlabels: {x: '1'}\n");
        let args = Args {
            config: Some(path),
            name: Some("b".to_owned()),
            labels: vec!["y=2".to_owned()],
            docker_socket: Some("none".to_owned()),
            ..args()
        };
        let config = args.resolve().unwrap();
        assert_eq!(config.name.unwrap().as_str(), "b");
        assert_eq!(config.sensors.len(), 1);
        assert_eq!(config.labels.len(), 2);
        assert_eq!(config.docker_socket, None);
        assert_eq!(config.map, "map");
    }

    #[test]
    fn the_lab_s_robot_is_simulated() {
        let lab = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../manifests/lab"));
        let config = Args { config: Some(lab.join("agent.yaml")), ..args() }.resolve().unwrap();
        assert_eq!(config.position, Some(PositionSource::Sim(lab.join("world.yaml"))));
        assert_eq!((config.speed, &config.battery), (Some(0.5), &Some(BatterySource::Sim)));
        let args = Args { battery: Some("sim".into()), ..args() };
        assert!(args.resolve().unwrap_err().to_string().starts_with("--battery"));
    }

    #[test]
    fn mistakes_in_the_file_have_a_place() {
        let (_dir, path) = file("name: a\nposition: static:1,2\nspede: 3\n");
        let error = Args { config: Some(path), ..args() }.resolve().unwrap_err();
        let text = error.to_string();
        assert!(text.contains("spede") && text.contains('3'), "{text}");
    }

    #[test]
    fn mistakes_in_flags_name_the_flag() {
        let bad = [
            (Args { position: Some("static:1".into()), ..args() }, "--position"),
            (Args { cpu: Some("many".into()), ..args() }, "--cpu"),
            (Args { ar_res: Some("base".into()), ..args() }, "--ar-res"),
            (Args { labels: vec!["x".into()], ..args() }, "--label"),
            (Args { speed: Some(-1.0), ..args() }, "--speed"),
            (Args { battery: Some("full".into()), ..args() }, "--battery"),
            (Args { messages: Some("here".into()), ..args() }, "--messages"),
            (Args { kind: Some(Kind::Cloud), ar_res: Some("b:D".into()), ..args() }, "--kind"),
        ];
        for (args, flag) in bad {
            let error = args.resolve().unwrap_err().to_string();
            assert!(error.starts_with(flag), "{error}");
        }
    }
}
