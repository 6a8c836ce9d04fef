//! How a robot's drivers and its emergency stops are reached: `gate` of `agent.yaml`, and the same as the gate reads it.
//!
//! ```yaml
//! gate:
//!   drivers:
//!     - actuators: ["base:Drive"]
//!       exec: [/usr/lib/robot/base-driver]     # or unix: /run/robot/base.sock; or sim: Base, with nothing beside
//!       stop: '{"linear": 0, "angular": 0}'
//!     - actuators: ["arm:Move"]                # a topic of ROS 1, which the gate publishes; commands are JSON
//!       ros1: {topic: /arm/command, type: std_msgs/Float64, node: /arm_driver}
//!       stop: {data: 0}                        # of a Twist known: it stands
//!   ladder: [{after: 100ms, action: Log}, {after: 200ms, action: Stop}, {after: 30s, action: Release}]
//!   agentGrace: 0s
//!   estop:
//!     - {name: button, gpio: /sys/class/gpio/gpio17/value, activeLow: true}
//!     - {name: fence, file: /run/robot/estop}
//! ```

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use muster_agent_core::gate::{self, Action, Step, Tier};
use muster_api::duration::Span;
use muster_api::name::FunctionName;
use muster_ros1::env::{DEFAULT_MASTER, Environment};
use muster_ros1::layout::Layout;
use muster_ros1::message;
use muster_ros1::name::{NameError, Resolver};
use serde::{Deserialize, Deserializer, Serialize};

use crate::driver::chain;
use crate::position::settings::PoseSettings;
use crate::sim;

/// The file, in the gate's directory.
pub(super) const FILE: &str = "settings.json";

/// What stands before the robot's drivers.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub(crate) struct Settings {
    /// The drivers of the robot's actuators.
    pub(crate) drivers: Vec<Driver>,
    /// What follows when whoever drives is silent; absent: stop after 200 ms.
    ladder: Option<Vec<Rung>>,
    /// How long the robot may go on when the agent is gone.
    agent_grace: Span,
    /// What stops the robot on the robot.
    pub(crate) estop: Vec<Hook>,
}

/// All that a gate is set up with.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Setup {
    pub(super) settings: Settings,
    pub(super) ros: Ros,
}

/// Where the robot's ROS is; nothing, when no driver is a topic.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Ros {
    pub(super) master: String,
    pub(super) host: Option<String>,
    pub(super) namespace: Option<String>,
    /// This node of muster's.
    pub(super) robot: String,
}

/// One step of the ladder.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Rung {
    after: Span,
    action: Action,
}

/// A driver: the program that moves something.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub(crate) struct Driver {
    /// What it moves.
    pub(crate) actuators: BTreeSet<FunctionName>,
    /// A program that the gate starts; it reads commands from its standard input, and ends with it.
    #[serde(default)]
    pub(super) exec: Vec<String>,
    /// A Unix socket on which it listens.
    #[serde(default)]
    pub(super) unix: Option<PathBuf>,
    /// The simulated robot's base.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    sim: Option<Simulated>,
    /// A topic of ROS 1 that it subscribes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) ros1: Option<Topic>,
    /// How commands are kept apart.
    #[serde(default)]
    pub(super) framing: Framing,
    /// What becomes of a command for an actuator while another one for it waits until the driver has read.
    #[serde(default)]
    pub(super) waiting: Waiting,
    /// The command that stops what it moves; the simulator's and a Twist's are known.
    #[serde(default, deserialize_with = "command")]
    pub(super) stop: String,
    /// The command to stay as it is; absent: the stop command.
    #[serde(default, deserialize_with = "maybe_command")]
    pub(super) hold: Option<String>,
    /// The command that cuts the power; absent: the driver is ended, or its socket closed, or its topic not published.
    #[serde(default, deserialize_with = "maybe_command")]
    pub(super) cut: Option<String>,
}

/// A topic of ROS 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub(super) struct Topic {
    /// Its name; one without a slash is in `--ros-namespace`.
    pub(super) topic: String,
    /// `geometry_msgs/Twist`.
    #[serde(rename = "type")]
    pub(super) kind: String,
    /// The driver's name in ROS; absent: whoever subscribes the topic is taken for it.
    #[serde(default)]
    pub(super) node: Option<String>,
}

impl Topic {
    /// Of its messages; none: the type is not known.
    pub(super) fn layout(&self) -> Option<Layout> {
        message::find(&self.kind).map(Layout::of)
    }

    /// The message of nothing, where that is known to be a stop: no velocity.
    fn stop(&self) -> Option<&'static str> {
        matches!(&*self.kind, "geometry_msgs/Twist" | "geometry_msgs/TwistStamped").then_some("{}")
    }
}

/// A text; or a mapping, which is JSON.
fn command<'de, D: Deserializer<'de>>(from: D) -> Result<String, D::Error> {
    serde_json::Value::deserialize(from).map(|value| match value {
        serde_json::Value::String(text) => text,
        serde_json::Value::Null => String::new(),
        other => other.to_string(),
    })
}

fn maybe_command<'de, D: Deserializer<'de>>(from: D) -> Result<Option<String>, D::Error> {
    command(from).map(|text| Some(text).filter(|text| !text.is_empty()))
}

/// A driver of the simulated robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
enum Simulated {
    /// Velocities, `{"linear": m/s, "angular": rad/s}`.
    Base,
}

/// What becomes of a command while another one waits.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Waiting {
    /// It takes the other one's place: for velocities and positions, of which only the newest counts.
    #[default]
    Newest,
    /// It is answered NO_DRIVER: for a driver of which each command counts.
    Each,
}

/// How commands are kept apart.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Framing {
    /// A newline after each; none may hold one.
    #[default]
    Lines,
    /// A big-endian 32-bit length before each.
    Length,
}

/// Something on the robot that stops it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub(crate) struct Hook {
    /// As it is called in the node's status.
    pub(super) name: String,
    /// A file with one word, none, settle or cut. One that is not there demands nothing; one that cannot be read, or says something
    /// else, demands that the robot settles.
    #[serde(default)]
    pub(super) file: Option<PathBuf>,
    /// The value file of a pin (`/sys/class/gpio/gpioN/value`). One that cannot be read counts as pressed.
    #[serde(default)]
    pub(super) gpio: Option<PathBuf>,
    /// The pin is pressed at 0: a cut wire stops the robot.
    #[serde(default)]
    pub(super) active_low: bool,
    /// What the pin demands.
    #[serde(default = "cut")]
    pub(super) tier: Tier,
}

fn cut() -> Tier {
    Tier::Cut
}

/// Why settings make no sense.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SettingsError {
    #[error("drivers[{0}]: give exactly one of exec, unix, ros1 and sim")]
    Way(usize),
    #[error("drivers[{0}].stop: say the command that stops what it moves")]
    NoStopCommand(usize),
    #[error("drivers[{0}].{1}: the simulator's is known; leave it out")]
    Known(usize, &'static str),
    #[error("drivers[{0}].framing: messages of a topic are kept apart by ROS; leave it out")]
    Framed(usize),
    #[error("drivers[{0}].sim: this robot is not simulated; its position would be sim:world.yaml")]
    NotSimulated(usize),
    #[error("drivers[{0}].actuators: name what it moves, as in [\"base:Drive\"]")]
    NoActuators(usize),
    #[error(
        "drivers[{at}].actuators: {actuator} has a driver already; the gate needs one for each"
    )]
    Twice { at: usize, actuator: FunctionName },
    #[error(
        "drivers[{at}].actuators: {actuator} is not among the node's actuators; add it to --ar-res"
    )]
    NotDeclared { at: usize, actuator: FunctionName },
    #[error("drivers[{at}].{field}: a command with a newline needs `framing: Length`")]
    Newline { at: usize, field: &'static str },
    #[error("drivers[{at}].ros1.{field}")]
    Name {
        at: usize,
        field: &'static str,
        #[source]
        source: NameError,
    },
    #[error("drivers[{at}].ros1.type: {kind:?} is not known; known are {known}")]
    Type { at: usize, kind: String, known: String },
    #[error("drivers[{at}].{field}: {text} is no {kind}: {why}")]
    Message { at: usize, field: &'static str, text: String, kind: String, why: String },
    #[error("ladder: there is no Stop in it; a robot whose driver is silent would go on for ever")]
    NoStop,
    #[error("ladder[{0}]: Hold comes before Stop")]
    HoldAfterStop(usize),
    #[error("ladder[{0}]: Release comes after Stop; the robot would go on with nobody's right")]
    ReleaseBeforeStop(usize),
    #[error("estop[{0}]: give exactly one of file and gpio")]
    HookWay(usize),
    #[error("estop[{at}].name: {name:?} is taken, or empty; each needs a name of its own")]
    HookName { at: usize, name: String },
    #[error("estop[{0}].tier: Settle or Cut; a pin that demands nothing stops nothing")]
    HookTier(usize),
}

impl Settings {
    /// Nothing stands before the drivers.
    pub(crate) fn is_empty(&self) -> bool {
        self.drivers.is_empty()
    }

    /// Puts the socket of the simulator in `dir` in the place of the drivers that are simulated.
    pub(crate) fn simulate(mut self, dir: Option<&Path>) -> Result<Settings, SettingsError> {
        for (at, driver) in self.drivers.iter_mut().enumerate() {
            if driver.sim.take().is_some() {
                let dir = dir.ok_or(SettingsError::NotSimulated(at))?;
                driver.unix = Some(dir.join(sim::DRIVE));
                sim::STOP.clone_into(&mut driver.stop);
            }
        }
        Ok(self)
    }

    /// All that a gate of the robot `robot` needs.
    pub(crate) fn set_up(mut self, pose: &PoseSettings, robot: &str) -> Setup {
        let topics = self.drivers.iter_mut().filter_map(|driver| {
            let known = driver.ros1.as_ref()?.stop();
            Some((driver, known))
        });
        let mut any = false;
        for (driver, known) in topics {
            any = true;
            if let Some(known) = known.filter(|_| driver.stop.is_empty()) {
                known.clone_into(&mut driver.stop);
            }
        }
        let ros = if any { Ros::of(pose, robot) } else { Ros::default() };
        Setup { settings: self, ros }
    }

    /// Says what makes no sense.
    pub(crate) fn check(&self, actuators: &BTreeSet<FunctionName>) -> Result<(), SettingsError> {
        let mut driven = BTreeSet::new();
        for (at, driver) in self.drivers.iter().enumerate() {
            driver.check_way(at)?;
            if driver.actuators.is_empty() {
                return Err(SettingsError::NoActuators(at));
            }
            for actuator in &driver.actuators {
                let actuator = actuator.clone();
                if !actuators.contains(&actuator) {
                    return Err(SettingsError::NotDeclared { at, actuator });
                }
                if !driven.insert(actuator.clone()) {
                    return Err(SettingsError::Twice { at, actuator });
                }
            }
            driver.check_lines(at)?;
        }
        self.check_ladder()?;
        let mut names = BTreeSet::new();
        for (at, hook) in self.estop.iter().enumerate() {
            if hook.file.is_some() == hook.gpio.is_some() {
                return Err(SettingsError::HookWay(at));
            }
            if hook.name.is_empty() || !names.insert(&hook.name) {
                return Err(SettingsError::HookName { at, name: hook.name.clone() });
            }
            if hook.tier == Tier::None {
                return Err(SettingsError::HookTier(at));
            }
        }
        Ok(())
    }

    fn check_ladder(&self) -> Result<(), SettingsError> {
        let Some(rungs) = &self.ladder else { return Ok(()) };
        let stop =
            rungs.iter().filter(|rung| rung.action == Action::Stop).map(|rung| rung.after).min();
        let stop = stop.ok_or(SettingsError::NoStop)?;
        for (at, rung) in rungs.iter().enumerate() {
            match rung.action {
                Action::Release if rung.after < stop => {
                    return Err(SettingsError::ReleaseBeforeStop(at));
                }
                Action::Hold if rung.after >= stop => return Err(SettingsError::HoldAfterStop(at)),
                Action::Hold | Action::Log | Action::Stop | Action::Release => {}
            }
        }
        Ok(())
    }

    /// What the core decides by.
    pub(super) fn core(&self) -> gate::Settings {
        let millis = |span: Span| u64::try_from(span.as_duration().as_millis()).unwrap_or(u64::MAX);
        let step = |rung: &Rung| Step { after_ms: millis(rung.after), action: rung.action };
        gate::Settings {
            ladder: match &self.ladder {
                Some(rungs) => rungs.iter().map(step).collect(),
                None => gate::DEFAULT_LADDER.to_vec(),
            },
            agent_grace_ms: millis(self.agent_grace),
        }
    }
}

impl Setup {
    /// The drivers that are topics: the topic's global name, and an actuator that it moves.
    pub(crate) fn topics(&self) -> impl Iterator<Item = (String, String)> {
        let names = Resolver::new(self.ros.namespace.as_deref().unwrap_or("/"), "gate", []).ok();
        self.settings.drivers.iter().filter_map(move |driver| {
            let topic = names.as_ref()?.resolve(&driver.ros1.as_ref()?.topic).ok()?;
            Some((topic, driver.actuators.first()?.to_string()))
        })
    }
}

impl Ros {
    /// What is not said is the environment's, as ROS has it.
    fn of(pose: &PoseSettings, robot: &str) -> Ros {
        let environment = Environment::read();
        let master = pose.master.clone().or(environment.master);
        Ros {
            master: master.unwrap_or_else(|| DEFAULT_MASTER.to_owned()),
            host: pose.host.clone().or(environment.host),
            namespace: pose.namespace.clone().or(environment.namespace),
            robot: robot.to_owned(),
        }
    }
}

impl Driver {
    /// The commands that the gate gives by itself.
    fn own_commands(&self) -> impl Iterator<Item = (&'static str, &String)> {
        let all = [
            ("stop", Some(&self.stop).filter(|stop| !stop.is_empty())),
            ("hold", self.hold.as_ref()),
            ("cut", self.cut.as_ref()),
        ];
        all.into_iter().filter_map(|(field, text)| Some((field, text?)))
    }

    fn check_way(&self, at: usize) -> Result<(), SettingsError> {
        let ways =
            [!self.exec.is_empty(), self.unix.is_some(), self.sim.is_some(), self.ros1.is_some()];
        if ways.into_iter().filter(|given| *given).count() != 1 {
            return Err(SettingsError::Way(at));
        }
        let known = [
            ("stop", !self.stop.is_empty()),
            ("hold", self.hold.is_some()),
            ("cut", self.cut.is_some()),
            ("framing", self.framing != Framing::default()),
        ];
        match (self.sim, known.into_iter().find(|(_, given)| *given)) {
            (Some(_), Some((field, _))) => return Err(SettingsError::Known(at, field)),
            (Some(_), None) => return Ok(()),
            (None, _) => {}
        }
        let known = self.ros1.as_ref().and_then(Topic::stop);
        if self.stop.is_empty() && known.is_none() {
            return Err(SettingsError::NoStopCommand(at));
        }
        self.ros1.as_ref().map_or(Ok(()), |topic| self.check_topic(at, topic))
    }

    fn check_topic(&self, at: usize, topic: &Topic) -> Result<(), SettingsError> {
        if self.framing != Framing::default() {
            return Err(SettingsError::Framed(at));
        }
        let names = [("topic", Some(&topic.topic)), ("node", topic.node.as_ref())];
        for (field, name) in names.into_iter().filter_map(|(field, name)| Some((field, name?))) {
            let resolved = Resolver::new("/", "gate", []).and_then(|names| names.resolve(name));
            resolved.map_err(|source| SettingsError::Name { at, field, source })?;
        }
        let layout = topic.layout().ok_or_else(|| {
            let known: Vec<&str> = muster_ros1::ALL.iter().map(|known| known.name).collect();
            SettingsError::Type { at, kind: topic.kind.clone(), known: known.join(", ") }
        })?;
        for (field, text) in self.own_commands() {
            let json = serde_json::from_str(text).map_err(|error| error.to_string());
            let encoded = json.and_then(|json| layout.encode(&json).map_err(|e| chain(&e)));
            encoded.map_err(|why| {
                let (text, kind) = (text.clone(), topic.kind.clone());
                SettingsError::Message { at, field, text, kind, why }
            })?;
        }
        Ok(())
    }

    fn check_lines(&self, at: usize) -> Result<(), SettingsError> {
        let torn = |(_, text): &(_, &String)| text.contains('\n');
        match self.own_commands().find(torn) {
            Some((field, _)) if self.framing == Framing::Lines && self.ros1.is_none() => {
                Err(SettingsError::Newline { at, field })
            }
            _ => Ok(()),
        }
    }
}

impl Hook {
    /// What is looked at.
    pub(super) fn path(&self) -> &Path {
        self.file.as_deref().or(self.gpio.as_deref()).unwrap_or_else(|| Path::new(""))
    }

    /// What it demands, from what was read.
    pub(super) fn demands(&self, read: &std::io::Result<String>) -> Tier {
        match (self.file.is_some(), read) {
            (true, Ok(text)) => match text.trim().to_ascii_lowercase().as_str() {
                "none" => Tier::None,
                "cut" => Tier::Cut,
                _ => Tier::Settle,
            },
            (true, Err(error)) if error.kind() == std::io::ErrorKind::NotFound => Tier::None,
            (true, Err(_)) => Tier::Settle,
            (false, Ok(text)) if text.trim() == if self.active_low { "1" } else { "0" } => {
                Tier::None
            }
            (false, _) => self.tier,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(text: &str) -> Settings {
        serde_saphyr::from_str(text).unwrap()
    }

    fn refusal(text: &str) -> String {
        let actuators = ["base:Drive", "arm:Move"].map(|name| name.parse().unwrap());
        settings(text).check(&BTreeSet::from(actuators)).unwrap_err().to_string()
    }

    #[test]
    fn what_makes_no_sense_is_named() {
        let cases = [
            ("drivers: [{actuators: ['base:Drive'], stop: s}]", "drivers[0]: give exactly one"),
            ("drivers: [{actuators: ['base:Drive'], exec: [a]}]", "drivers[0].stop: say"),
            (
                "drivers: [{actuators: ['base:Drive'], sim: Base, stop: s}]",
                "drivers[0].stop: the sim",
            ),
            ("drivers: [{actuators: [], exec: [a], stop: s}]", "drivers[0].actuators: name what"),
            ("drivers: [{actuators: ['leg:Kick'], exec: [a], stop: s}]", "add it to --ar-res"),
            (
                "drivers: [{actuators: ['base:Drive'], exec: [a], stop: s}, {actuators: ['base:Drive'], unix: /a, stop: s}]",
                "drivers[1].actuators: base:Drive has a driver already",
            ),
            (
                "drivers: [{actuators: ['base:Drive'], exec: [a], stop: \"a\\nb\"}]",
                "drivers[0].stop",
            ),
            (
                "drivers: [{actuators: ['base:Drive'], ros1: {topic: '/a b', type: geometry_msgs/Twist}}]",
                "drivers[0].ros1.topic",
            ),
            (
                "drivers: [{actuators: ['base:Drive'], ros1: {topic: /a, type: std_msgs/Float64}}]",
                "drivers[0].stop: say",
            ),
            (
                "drivers: [{actuators: ['base:Drive'], ros1: {topic: /a, type: my_msgs/Go}, stop: {}}]",
                "\"my_msgs/Go\" is not known; known are geometry_msgs/Accel, ",
            ),
            (
                "drivers: [{actuators: ['base:Drive'], ros1: {topic: /a, type: std_msgs/Float64}, stop: {data: x}}]",
                "drivers[0].stop: {\"data\":\"x\"} is no std_msgs/Float64: data must be a number",
            ),
            (
                "drivers: [{actuators: ['base:Drive'], ros1: {topic: /a, type: geometry_msgs/Twist}, framing: Length}]",
                "drivers[0].framing: messages of a topic",
            ),
            ("ladder: []", "no Stop"),
            ("ladder: [{after: 1s, action: Stop}, {after: 2s, action: Hold}]", "ladder[1]: Hold"),
            (
                "ladder: [{after: 1s, action: Stop}, {after: 500ms, action: Release}]",
                "ladder[1]: Release",
            ),
            ("estop: [{name: a}]", "estop[0]: give exactly one"),
            ("estop: [{name: a, file: /a}, {name: a, gpio: /b}]", "estop[1].name: \"a\" is taken"),
            ("estop: [{name: a, gpio: /b, tier: None}]", "estop[0].tier"),
        ];
        for (text, part) in cases {
            let refusal = refusal(text);
            assert!(refusal.contains(part), "{text}: {refusal}");
        }
    }

    #[test]
    fn a_twist_of_nothing_is_a_stop() {
        let actuators = BTreeSet::from(["base:Drive".parse().unwrap()]);
        let drivers = |more: &str| {
            let topic = "ros1: {topic: cmd_vel, type: geometry_msgs/Twist}";
            let text = format!("drivers: [{{actuators: ['base:Drive'], {topic}{more}}}]");
            let settings = settings(&text);
            settings.check(&actuators).unwrap();
            let pose = crate::position::settings::PoseArgs {
                ros_master: Some("http://robot:11311".to_owned()),
                ..Default::default()
            };
            settings.set_up(&pose.resolve().unwrap(), "robot-1")
        };
        let setup = drivers("");
        assert_eq!(setup.settings.drivers[0].stop, "{}");
        assert_eq!(setup.ros.master, "http://robot:11311/");
        let setup = drivers(", stop: {linear: {x: 0.0}}, hold: '{}'");
        assert_eq!(setup.settings.drivers[0].stop, r#"{"linear":{"x":0.0}}"#);
        assert_eq!(setup.settings.drivers[0].hold.as_deref(), Some("{}"));
        let again = serde_json::to_string(&setup).unwrap();
        assert_eq!(serde_json::from_str::<Setup>(&again).unwrap(), setup);
    }

    #[test]
    fn what_cannot_be_read_stops_the_robot() {
        let gone = || Err(std::io::ErrorKind::NotFound.into());
        let io = || Err(std::io::ErrorKind::PermissionDenied.into());
        let text = |text: &str| Ok(text.to_owned());
        let all = settings(
            "estop: [{name: f, file: /f}, {name: g, gpio: /g}, {name: l, gpio: /l, activeLow: true}]",
        );
        let [file, pin, low] = all.estop.as_slice() else { panic!() };
        for (read, tier) in [
            (gone(), Tier::None),
            (io(), Tier::Settle),
            (text("none\n"), Tier::None),
            (text("Cut"), Tier::Cut),
            (text("settle"), Tier::Settle),
            (text("what"), Tier::Settle),
        ] {
            assert_eq!(file.demands(&read), tier, "{read:?}");
        }
        for (read, pressed, pressed_low) in [
            (text("0\n"), Tier::None, Tier::Cut),
            (text("1\n"), Tier::Cut, Tier::None),
            (gone(), Tier::Cut, Tier::Cut),
            (text(""), Tier::Cut, Tier::Cut),
        ] {
            assert_eq!(
                (pin.demands(&read), low.demands(&read)),
                (pressed, pressed_low),
                "{read:?}"
            );
        }
    }
}
