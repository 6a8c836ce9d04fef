//! Where the functions of a robot's sensors come from: `sensors` of `agent.yaml`.
//!
//! ```yaml
//! sensors:
//!   - {function: "kinect:ImageGen", ros1: /camera/image_raw}
//!   - function: "kinect:LaserGen"
//!     exec: [/usr/lib/robot/laser]       # its standard output
//!     framing: Length                    # Lines, Length, or Fixed with a size
//!     silence: 2s                        # begun anew when nothing comes for so long
//!   - {function: "gps:Fix", device: /dev/ttyUSB0, framing: Lines}
//!   - {function: "kinect:DepthGen", sim: Camera}   # of the simulated robot: Laser or Camera
//!   - {function: "cam:Recorded", device: /data/cam.raw, framing: Fixed, size: 900Ki, maxHz: 30}
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use muster_api::duration::Span;
use muster_api::name::FunctionName;
use muster_api::quantity::Bytes;
use serde::Deserialize;

/// Memory for a source's frames, when nobody says otherwise.
const MEMORY: Bytes = Bytes(64 << 20);

/// A frame may take this part of it: one is read, one is the newest, and readers have others.
const LONGEST: u64 = 4;

/// One function of a sensor, and where it comes from. Exactly one of `ros1`, `device`, `exec` and `sim`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub(crate) struct Source {
    /// What tasks ask for.
    pub(crate) function: FunctionName,
    /// A topic of ROS 1, of any type; a frame is a serialised message.
    #[serde(default)]
    pub(super) ros1: Option<String>,
    /// A device node, a FIFO or a file. A terminal is read as it is set up (`stty`).
    #[serde(default)]
    pub(super) device: Option<PathBuf>,
    /// A program, by its standard output. It ends with the agent.
    #[serde(default)]
    pub(super) exec: Vec<String>,
    /// The simulated robot's.
    #[serde(default)]
    pub(super) sim: Option<Simulated>,
    /// How frames of a device or a program are kept apart.
    #[serde(default)]
    framing: Option<Framing>,
    /// The bytes of a frame of `Fixed`.
    #[serde(default)]
    size: Option<Bytes>,
    /// Frames a second that are taken at most; absent: as many as come.
    #[serde(default)]
    pub(super) max_hz: Option<f64>,
    /// A source that says nothing for so long has failed; absent: it may be silent.
    #[serde(default)]
    pub(super) silence: Option<Span>,
    /// Memory for its frames at most. Readers that keep old ones lose them when it is used up.
    #[serde(default = "memory")]
    pub(super) memory: Bytes,
}

fn memory() -> Bytes {
    MEMORY
}

/// A sensor of the simulated robot; a frame is a message of `muster.ros.v1`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub(super) enum Simulated {
    /// A LaserScan.
    Laser,
    /// An Image.
    Camera,
}

/// How frames are kept apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
enum Framing {
    /// Each is a line, without its newline.
    Lines,
    /// A big-endian 32-bit length before each.
    Length,
    /// All have one size.
    Fixed,
}

/// The same with its size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Cut {
    Lines,
    Length,
    Fixed(usize),
}

/// Why settings make no sense.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SettingsError {
    #[error("sensors[{0}]: give exactly one of ros1, device, exec and sim")]
    Way(usize),
    #[error("sensors[{0}].sim: this robot is not simulated; its position would be sim:world.yaml")]
    NotSimulated(usize),
    #[error(
        "sensors[{at}].function: {function} is not among the node's sensors; add it to --sr-res"
    )]
    NotDeclared { at: usize, function: FunctionName },
    #[error(
        "sensors[{at}].function: {function} would be found at {path}, as {other}; rename one of them"
    )]
    Twice { at: usize, function: FunctionName, other: Box<FunctionName>, path: String },
    #[error(
        "sensors[{0}].framing: say how frames are kept apart: Lines, Length, or Fixed with a size"
    )]
    NoFraming(usize),
    #[error(
        "sensors[{0}].framing: a topic's and a simulator's messages are frames by themselves; leave it out"
    )]
    Framed(usize),
    #[error(
        "sensors[{0}].size: `framing: Fixed` needs a size above 0, and no other framing has one"
    )]
    Size(usize),
    #[error(
        "sensors[{at}].memory: {memory} is too little for a frame of {size}; give it {least} at least"
    )]
    Memory { at: usize, memory: Bytes, size: Bytes, least: Bytes },
    #[error("sensors[{at}].maxHz: {hz} is not a rate above 0")]
    Rate { at: usize, hz: f64 },
    #[error("sensors[{at}].ros1")]
    Topic {
        at: usize,
        #[source]
        source: muster_ros1::name::NameError,
    },
}

/// Says what makes no sense.
pub(crate) fn check(
    sources: &[Source],
    sensors: &BTreeSet<FunctionName>,
    simulated: bool,
) -> Result<(), SettingsError> {
    let mut places: BTreeMap<String, FunctionName> = BTreeMap::new();
    for (at, source) in sources.iter().enumerate() {
        source.check(at)?;
        if source.sim.is_some() && !simulated {
            return Err(SettingsError::NotSimulated(at));
        }
        let function = source.function.clone();
        if !sensors.contains(&function) {
            return Err(SettingsError::NotDeclared { at, function });
        }
        let path = function.path();
        if let Some(other) = places.insert(path.clone(), function.clone()) {
            return Err(SettingsError::Twice { at, function, other: Box::new(other), path });
        }
    }
    Ok(())
}

impl Source {
    fn check(&self, at: usize) -> Result<(), SettingsError> {
        let ways =
            [self.ros1.is_some(), self.device.is_some(), !self.exec.is_empty(), self.sim.is_some()];
        if ways.into_iter().filter(|given| *given).count() != 1 {
            return Err(SettingsError::Way(at));
        }
        if let Some(hz) = self.max_hz.filter(|hz| !(hz.is_finite() && *hz > 0.0)) {
            return Err(SettingsError::Rate { at, hz });
        }
        if let Some(topic) = &self.ros1 {
            let names = muster_ros1::name::Resolver::new("/", "agent", []);
            let named = names.and_then(|names| names.resolve(topic));
            named.map_err(|source| SettingsError::Topic { at, source })?;
        }
        match (self.ros1.is_some() || self.sim.is_some(), self.framing) {
            (true, Some(_)) => return Err(SettingsError::Framed(at)),
            (false, None) => return Err(SettingsError::NoFraming(at)),
            _ => {}
        }
        let size = self.size.unwrap_or(Bytes(0));
        if (self.framing == Some(Framing::Fixed)) != (size.0 > 0) {
            return Err(SettingsError::Size(at));
        }
        if size.0 > self.memory.0 / LONGEST {
            let least = Bytes(size.0.saturating_mul(LONGEST));
            return Err(SettingsError::Memory { at, memory: self.memory, size, least });
        }
        Ok(())
    }

    pub(super) fn cut(&self) -> Cut {
        match self.framing {
            None if self.sim.is_some() => Cut::Length,
            Some(Framing::Length) => Cut::Length,
            Some(Framing::Fixed) => {
                let size = self.size.map_or(0, |size| size.0);
                Cut::Fixed(usize::try_from(size).unwrap_or(usize::MAX))
            }
            Some(Framing::Lines) | None => Cut::Lines,
        }
    }

    /// Bytes of a frame at most.
    pub(super) fn longest(&self) -> usize {
        usize::try_from(self.memory.0 / LONGEST).unwrap_or(usize::MAX)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refusal(text: &str) -> String {
        let sources: Vec<Source> = serde_saphyr::from_str(text).unwrap();
        let sensors = ["k:I", "k:L", "a/b:C", "a_b:C"].map(|name| name.parse().unwrap());
        check(&sources, &BTreeSet::from(sensors), false).unwrap_err().to_string()
    }

    #[test]
    fn what_makes_no_sense_is_named() {
        let cases = [
            ("[{function: 'k:I'}]", "sensors[0]: give exactly one of"),
            ("[{function: 'k:I', ros1: /a, exec: [b]}]", "sensors[0]: give exactly one of"),
            ("[{function: 'k:I', sim: Laser}]", "sensors[0].sim: this robot is not"),
            ("[{function: 'k:I', sim: Laser, framing: Length}]", "sensors[0].framing"),
            ("[{function: 'x:Y', ros1: /a}]", "sensors[0].function: x:Y is not among"),
            ("[{function: 'k:I', ros1: /a}, {function: 'k:I', ros1: /a}]", "sensors[1].function"),
            ("[{function: 'a/b:C', ros1: /a}, {function: 'a_b:C', ros1: /b}]", "found at a_b/C"),
            ("[{function: 'k:I', ros1: '/a b'}]", "sensors[0].ros1"),
            ("[{function: 'k:I', ros1: /a, framing: Lines}]", "sensors[0].framing: a topic's"),
            ("[{function: 'k:I', device: /a}]", "sensors[0].framing: say how"),
            ("[{function: 'k:I', device: /a, framing: Fixed}]", "sensors[0].size"),
            ("[{function: 'k:I', device: /a, framing: Lines, size: 3Ki}]", "sensors[0].size"),
            (
                "[{function: 'k:I', device: /a, framing: Fixed, size: 1Mi, memory: 2Mi}]",
                "give it 4Mi at least",
            ),
            ("[{function: 'k:I', ros1: /a, maxHz: 0}]", "sensors[0].maxHz: 0 is not"),
        ];
        for (text, part) in cases {
            let refusal = refusal(text);
            assert!(refusal.contains(part), "{text}: {refusal}");
        }
    }
}
