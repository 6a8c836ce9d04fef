//! Who is there, what runs, and what the paper measured.

use serde_json::Value;

use muster_api::manifest;

/// A node of the demo.
#[derive(Debug)]
pub(super) struct NodePlan {
    pub(super) name: &'static str,
    pub(super) kind: &'static str,
    /// What it offers. The robot's one core is the unit of everything here: its CR.
    pub(super) cpu: &'static str,
    pub(super) memory: &'static str,
    pub(super) flags: &'static [&'static str],
}

const SENSORS: &str = "kinect:ImageGen;kinect:LaserGen";

/// The robot that is shared, by being nearest to the place of the work.
pub(super) const ROBOT: &str = "turtlebot-1";
/// Where training should go.
pub(super) const CLOUD: &str = "cloud-1";

/// Two robots within reach of the place of the work, (3, 4), and a server.
pub(super) const NODES: [NodePlan; 3] = [
    NodePlan {
        name: ROBOT,
        kind: "robot",
        cpu: "1000m",
        memory: "1Gi",
        flags: &["--sr-res", SENSORS, "--ar-res", "base:Drive", "--position", "static:1,2"],
    },
    NodePlan {
        name: "turtlebot-2",
        kind: "robot",
        cpu: "1000m",
        memory: "1Gi",
        flags: &["--sr-res", SENSORS, "--ar-res", "base:Drive", "--position", "static:11,10"],
    },
    NodePlan { name: CLOUD, kind: "cloud", cpu: "500m", memory: "1Gi", flags: &[] },
];

/// A workload of the paper: its manifest, its class, and its share of the robot's CPU alone (Fig. 2), %.
#[derive(Debug)]
pub(super) struct Workload {
    pub(super) name: &'static str,
    pub(super) class: &'static str,
    pub(super) paper_percent: f64,
    manifest: &'static str,
}

/// The three of Fig. 2 and 5, in the order in which Fig. 5 starts them.
pub(super) const WORKLOADS: [Workload; 3] = [
    Workload {
        name: "gmapping",
        class: "AR-CR-SR",
        paper_percent: 15.3,
        manifest: include_str!("../../../manifests/examples/avalon/gmapping.yaml"),
    },
    Workload {
        name: "monitoring",
        class: "SR",
        paper_percent: 13.1,
        manifest: include_str!("../../../manifests/examples/avalon/monitoring.yaml"),
    },
    Workload {
        name: "recognition",
        class: "CR-SR",
        paper_percent: 51.7,
        manifest: include_str!("../../../manifests/examples/avalon/recognition.yaml"),
    },
];

/// CPU of the robot with two and with three workloads (Fig. 5), %.
pub(super) const PAPER_TWO: f64 = 69.66;
pub(super) const PAPER_THREE: f64 = 98.38;

const TRAINING: &str = include_str!("../../../manifests/examples/avalon/training.yaml");
const SECOND_DRIVER: &str = include_str!("../../../manifests/examples/avalon/second-driver.yaml");

/// The only object of an embedded manifest.
fn object(text: &str) -> Value {
    let documents = manifest::parse("embedded", text).unwrap_or_default();
    // A test parses all of them.
    documents.into_iter().next().map(|document| document.object).unwrap_or_default()
}

fn named(mut object: Value, name: &str) -> Value {
    object["metadata"]["name"] = name.into();
    object
}

impl Workload {
    /// The task, to run beside others.
    pub(super) fn task(&self) -> Value {
        object(self.manifest)
    }

    /// The same task under another name, to run alone.
    pub(super) fn alone(&self) -> Value {
        named(self.task(), &format!("{}-alone", self.name))
    }
}

/// What recognition's framework keeps in the cloud. It takes all the cpu that its quota leaves it; where
/// nothing holds it to one it must hold itself, or it would take the robots' cpu on this same machine.
pub(super) fn training(quotas_are_enforced: bool) -> Value {
    let mut task = object(TRAINING);
    if let Some(args) = task.pointer_mut("/spec/run/process/args").and_then(Value::as_array_mut)
        && !quotas_are_enforced
    {
        args.extend(["--load".into(), "0.3".into()]);
    }
    task
}

/// What must wait for the lease.
pub(super) fn second_driver() -> Value {
    object(SECOND_DRIVER)
}

/// One more user of the camera, `monitoring-2` and so on. It reserves what it uses, so that the ledger can
/// tell when the robot is full, and may go to the nearest robot only.
pub(super) fn more_monitoring(number: usize) -> Value {
    let mut task = named(WORKLOADS[1].task(), &format!("monitoring-{number}"));
    task["spec"]["resources"]["cpu"] = "150m".into();
    task["spec"]["resources"]["memory"] = "64Mi".into();
    task["spec"]["placement"]["within"] = 5.into();
    task
}

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    use muster_api::kind::task::Task;

    use super::*;

    fn read(object: Value) -> Task {
        let admitted = muster_api::kind::admit(&object).expect("an embedded manifest is good");
        serde_json::from_value(admitted).expect("a task")
    }

    #[test]
    fn the_tasks_are_what_the_paper_calls_them() {
        for workload in &WORKLOADS {
            let task = read(workload.task());
            assert_eq!(task.metadata.name.as_deref(), Some(workload.name));
            assert_eq!(task.spec.resources.class(), workload.class);
            let args = task.spec.run.process.expect("a process").args;
            let load = (workload.paper_percent / 100.0).to_string();
            assert!(args.windows(2).any(|w| w == ["--load", load.as_str()]), "{args:?}");
        }
        assert_eq!(read(training(true)).spec.resources.class(), "CR");
        let args = read(training(false)).spec.run.process.expect("a process").args;
        assert!(args.ends_with(&["--load".to_owned(), "0.3".to_owned()]), "{args:?}");
        assert_eq!(read(second_driver()).spec.resources.class(), "AR-CR");
        assert_eq!(read(more_monitoring(2)).metadata.name.as_deref(), Some("monitoring-2"));
    }

    #[test]
    fn reservations_of_the_three_and_one_more_fill_the_robot() {
        let tasks = WORKLOADS.iter().map(Workload::task).chain([more_monitoring(2)]);
        let reserved: u64 = tasks.map(|t| read(t).spec.resources.reserved().cpu.0).sum();
        assert_eq!(reserved, 1000);
    }

    fn examples(dir: &Path, found: &mut Vec<PathBuf>) {
        for entry in std::fs::read_dir(dir).expect("the examples") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                examples(&path, found);
            } else if path.extension().is_some_and(|e| e == "yaml") {
                found.push(path);
            }
        }
    }

    #[test]
    fn every_example_is_admitted() {
        let mut found = Vec::new();
        examples(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../manifests/examples"), &mut found);
        assert!(found.len() >= 9, "{found:?}");
        for path in found {
            let text = std::fs::read_to_string(&path).expect("readable");
            let documents = manifest::parse(&path.display().to_string(), &text);
            let documents = documents.unwrap_or_else(|error| panic!("{error}"));
            assert!(!documents.is_empty(), "{}", path.display());
            for document in documents {
                if let Err(error) = document.admit() {
                    panic!("{error}");
                }
            }
        }
    }
}
