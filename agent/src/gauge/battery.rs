//! The charge of the robot's battery. A source is named by a scheme:
//!
//! | source | reads |
//! |---|---|
//! | `sysfs:NAME` | the kernel's driver, `/sys/class/power_supply/NAME/{capacity,status}` |
//! | `sim` | the simulator, where the robot is one (`position: sim:…`); the default there |
//! | `file:PATH` | a line `PERCENT` or `PERCENT charging` that some program of the robot's keeps up to date |
//!
//! A source that cannot be read for half a minute, or says something else, tells nothing: the controller then takes the
//! robot for one without a battery, and the agent's log says why.

use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Duration;

use muster_api::kind::node::upkeep::Battery;

use tokio::sync::watch;

use super::Gauge;
use crate::sim::keeper::Simulator;
use crate::sim::robot::Said;

/// A battery loses a percent in minutes.
const EVERY: Duration = Duration::from_secs(2);
/// A charge that could not be read this often in a row is not known any more: half a minute.
const MISSES: u32 = 15;

/// Where the charge is read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum BatterySource {
    /// A directory of the kernel's.
    Sysfs(PathBuf),
    /// Some program of the robot's keeps it in a file.
    File(PathBuf),
    /// The simulator's.
    Sim,
}

/// Why a text names no source.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum BatterySourceError {
    #[error("{0:?} names no battery; write sysfs:BAT0, file:/run/robot/battery or sim")]
    Scheme(String),
    #[error("{0:?} is no name in /sys/class/power_supply; write sysfs:BAT0")]
    Name(String),
    #[error("file:{0} is no absolute path; write file:/run/robot/battery")]
    File(String),
}

impl FromStr for BatterySource {
    type Err = BatterySourceError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text.split_once(':') {
            Some(("sysfs", name)) if name.is_empty() || name.contains(['/', '.']) => {
                Err(BatterySourceError::Name(name.to_owned()))
            }
            Some(("sysfs", name)) => {
                Ok(BatterySource::Sysfs(Path::new("/sys/class/power_supply").join(name)))
            }
            Some(("file", path)) if path.starts_with('/') => Ok(BatterySource::File(path.into())),
            Some(("file", path)) => Err(BatterySourceError::File(path.to_owned())),
            None if text == "sim" => Ok(BatterySource::Sim),
            _ => Err(BatterySourceError::Scheme(text.to_owned())),
        }
    }
}

impl BatterySource {
    /// Starts to read it. None: it is a simulator's, and there is none.
    pub(crate) fn open(&self, simulator: Option<&Simulator>) -> Option<BatteryGauge> {
        if *self == BatterySource::Sim {
            return Some(BatteryGauge::Simulated(simulator?.said()));
        }
        let source = self.clone();
        let read = move |last: Reading| last.then(source.read());
        Some(BatteryGauge::Read(Gauge::open(EVERY, Reading::default(), read)))
    }

    fn read(&self) -> Result<Battery, String> {
        let text = |path: &Path| {
            std::fs::read_to_string(path).map_err(|error| format!("{}: {error}", path.display()))
        };
        match self {
            BatterySource::Sysfs(dir) => {
                let (capacity, status) = (text(&dir.join("capacity"))?, text(&dir.join("status"))?);
                Ok(Battery { percent: percent(&capacity)?, charging: status.trim() == "Charging" })
            }
            BatterySource::File(path) => parse(&text(path)?),
            BatterySource::Sim => Err("there is no simulator".to_owned()),
        }
    }
}

/// What is known of the charge.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Reading {
    charge: Option<Battery>,
    /// How often in a row it could not be read.
    missed: u32,
}

impl Reading {
    /// The last charge counts on for a while: a file that is being written is empty for a moment, and a robot with 3 % is
    /// not one without a battery.
    fn then(self, read: Result<Battery, String>) -> Reading {
        match read {
            Ok(charge) => Reading { charge: Some(charge), missed: 0 },
            Err(why) => {
                let missed = self.missed.saturating_add(1);
                if missed == MISSES {
                    tracing::warn!(why, "the robot's battery is not known");
                }
                Reading { charge: self.charge.filter(|_| missed < MISSES), missed }
            }
        }
    }
}

fn parse(line: &str) -> Result<Battery, String> {
    let words: Vec<&str> = line.split_whitespace().collect();
    match words.as_slice() {
        [charge] => Ok(Battery { percent: percent(charge)?, charging: false }),
        [charge, "charging"] => Ok(Battery { percent: percent(charge)?, charging: true }),
        _ => Err(format!("{:?} is not PERCENT or PERCENT charging", line.trim_end())),
    }
}

/// Rounded down: a battery has what it surely has.
fn percent(text: &str) -> Result<u8, String> {
    let text = text.trim();
    let number: Option<f64> = text.parse().ok().filter(|n| (0.0..=100.0).contains(n));
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 100")]
    number.map(|n| n as u8).ok_or_else(|| format!("{text:?} is not 0 to 100 percent"))
}

/// Tells the newest charge.
#[derive(Debug)]
pub(crate) enum BatteryGauge {
    /// Of a source that is read.
    Read(Gauge<Reading>),
    /// The simulator says it.
    Simulated(watch::Receiver<Option<Said>>),
}

impl BatteryGauge {
    pub(crate) fn charge(&self) -> Option<Battery> {
        match self {
            BatteryGauge::Read(gauge) => gauge.newest().charge,
            BatteryGauge::Simulated(said) => {
                let said = said.borrow();
                let said = said.as_ref()?;
                // Rounded down, as above.
                #[expect(
                    clippy::cast_possible_truncation,
                    clippy::cast_sign_loss,
                    reason = "0 to 100"
                )]
                Some(Battery { percent: said.percent? as u8, charging: said.charging })
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_source_is_named_by_its_scheme() {
        let sysfs = BatterySource::Sysfs("/sys/class/power_supply/BAT0".into());
        assert_eq!("sysfs:BAT0".parse(), Ok(sysfs));
        assert_eq!("file:/run/b".parse(), Ok(BatterySource::File("/run/b".into())));
        assert_eq!("sim".parse(), Ok(BatterySource::Sim));
        for bad in ["sysfs:", "sysfs:../../etc", "file:b", "BAT0", "ros9:/battery"] {
            assert!(bad.parse::<BatterySource>().is_err(), "{bad}");
        }
    }

    #[test]
    fn a_line_is_a_percentage_and_whether_it_charges() {
        assert_eq!(parse("83.9\n"), Ok(Battery { percent: 83, charging: false }));
        assert_eq!(parse("0 charging"), Ok(Battery { percent: 0, charging: true }));
        for bad in ["", "101", "-1", "NaN", "50 full", "50 charging now"] {
            assert!(parse(bad).is_err(), "{bad:?}");
        }
    }

    #[test]
    fn a_charge_counts_until_it_could_not_be_read_for_a_while() {
        let low = Battery { percent: 3, charging: false };
        let unreadable = || Err("empty".to_owned());
        let mut reading = Reading::default().then(Ok(low));
        for _ in 1..MISSES {
            reading = reading.then(unreadable());
            assert_eq!(reading.charge, Some(low));
        }
        assert_eq!(reading.clone().then(unreadable()).charge, None);
        let again = reading.then(Ok(low));
        assert_eq!(again, Reading { charge: Some(low), missed: 0 });
    }

    #[test]
    fn the_kernel_says_both_in_files() {
        let dir = tempfile::tempdir().unwrap();
        let source = BatterySource::Sysfs(dir.path().to_owned());
        let missing = source.read().unwrap_err();
        assert!(missing.contains("capacity"), "{missing}");
        std::fs::write(dir.path().join("capacity"), "42\n").unwrap();
        std::fs::write(dir.path().join("status"), "Charging\n").unwrap();
        assert_eq!(source.read(), Ok(Battery { percent: 42, charging: true }));
    }
}
