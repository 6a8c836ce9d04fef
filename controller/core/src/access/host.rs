//! What of a task reaches past the task into its node, and who may have it so.
//!
//! A container with a network of its own sees what its image and muster give it. A process sees the node's files and
//! programs, as does a container that a directory of the node is mounted into; on the node's network it reaches whatever
//! listens to the node itself. Kubernetes forbids the same under its Pod Security Standard *Baseline* (hostPath, host
//! namespaces).

use std::fmt;

use muster_api::kind::access::Role;
use muster_api::kind::task::{Network, TaskSpec};

use super::Who;

/// Something of a node that a task reaches.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Reached {
    /// Everything that the process's user may: it runs beside muster's agent.
    Process,
    /// A directory or file.
    Path {
        /// Which of the container's mounts.
        mount: usize,
        /// On the node.
        path: String,
    },
    /// What listens on the node's own addresses.
    Network,
    /// Whatever ROS master the task names, and who publishes there: the agent asks for a topic's rate from where it is itself.
    Topic {
        /// Which of the probes.
        probe: &'static str,
    },
}

impl Reached {
    /// The field of the task's spec that says so.
    #[must_use]
    pub fn field(&self) -> String {
        match self {
            Self::Process => "run.process".to_owned(),
            Self::Path { mount, .. } => format!("run.container.mounts[{mount}].hostPath"),
            Self::Network => "run.container.network".to_owned(),
            Self::Topic { probe } => format!("{probe}.topic"),
        }
    }

    /// What does without it.
    #[must_use]
    pub const fn instead(&self) -> &'static str {
        match self {
            Self::Process => "run a container",
            Self::Path { .. } => "bring what it needs in the image, in a ConfigMap or in a Secret",
            Self::Network => "say `network: Bridge` or `network: None`",
            Self::Topic { .. } => "probe by `exec`, `http` or `tcp`",
        }
    }
}

impl fmt::Display for Reached {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Process => f.write_str("a process sees its node's files"),
            Self::Path { path, .. } => write!(f, "{path:?} is its node's"),
            Self::Network => f.write_str("is its node's own, also when nothing is said"),
            Self::Topic { .. } => f.write_str("is asked for from its node's network"),
        }
    }
}

/// What a task reaches of its node.
#[must_use]
pub fn reached(spec: &TaskSpec) -> Vec<Reached> {
    let (run, mut all) = (&spec.run, Vec::new());
    if run.process.is_some() {
        all.push(Reached::Process);
    }
    if let Some(container) = &run.container {
        let mounts = container.mounts.iter().enumerate();
        all.extend(mounts.map(|(mount, m)| Reached::Path { mount, path: m.host_path.clone() }));
        if container.network == Network::Host {
            all.push(Reached::Network);
        }
    }
    let probes =
        [("startup", &spec.startup), ("readiness", &spec.readiness), ("liveness", &spec.liveness)];
    let topics = probes.into_iter().filter(|(_, p)| p.as_ref().is_some_and(|p| p.topic.is_some()));
    all.extend(topics.map(|(probe, _)| Reached::Topic { probe }));
    all
}

/// Whether somebody's tasks in a namespace may reach into their nodes. Who runs the nodes has them anyway.
#[must_use]
pub fn allowed(who: &Who, namespace: &str) -> bool {
    match who {
        Who::Admin => true,
        Who::Node(_) | Who::Nobody => false,
        Who::User(held) => held.iter().any(|grant| match grant.namespace.as_deref() {
            None => grant.host_access || grant.role >= Role::Operator,
            Some(here) => grant.host_access && here == namespace,
        }),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::super::Grant;
    use super::*;

    fn reaches(run: serde_json::Value) -> Vec<String> {
        reaches_with(json!({ "run": run }))
    }

    fn reaches_with(spec: serde_json::Value) -> Vec<String> {
        let spec: TaskSpec = serde_json::from_value(spec).expect("a spec");
        reached(&spec).iter().map(Reached::field).collect()
    }

    #[test]
    fn what_is_the_nodes_is_named_by_its_field() {
        assert_eq!(
            reaches(json!({"process": {"command": ["true"], "user": "nobody"}})),
            ["run.process"]
        );
        let container = |network: Option<&str>, mounts: &[&str]| {
            let mounts: Vec<_> = mounts
                .iter()
                .map(|m| json!({"hostPath": m, "mountPath": "/x", "readOnly": true}))
                .collect();
            let mut container = json!({"image": "i", "mounts": mounts});
            if let Some(network) = network {
                container["network"] = network.into();
            }
            reaches(json!({"container": container}))
        };
        assert_eq!(container(None, &[]), ["run.container.network"], "the default is the node's");
        assert_eq!(container(Some("Bridge"), &[]), [""; 0]);
        assert_eq!(
            container(Some("None"), &["/a", "/b"]),
            ["run.container.mounts[0].hostPath", "run.container.mounts[1].hostPath"]
        );
        assert_eq!(
            reaches(json!({"executor": {"task": "e"}})),
            [""; 0],
            "it adds nothing to its executor"
        );
    }

    #[test]
    fn a_topic_is_asked_for_by_the_agent() {
        let run = json!({"container": {"image": "i", "network": "None"}});
        let topic = json!({"topic": {"name": "/scan", "minHz": 1.0}});
        let exec = json!({"exec": {"command": ["true"]}});
        assert_eq!(
            reaches_with(json!({"run": run, "readiness": topic, "liveness": exec})),
            ["readiness.topic"]
        );
    }

    #[test]
    fn it_is_given_or_goes_with_running_the_nodes() {
        let may = |role, namespace: Option<&str>, host_access| {
            let namespace = namespace.map(str::to_owned);
            allowed(&Who::User(vec![Grant { role, namespace, host_access }]), "lab")
        };
        for role in [Role::Framework, Role::Developer] {
            assert!(!may(role, None, false) && !may(role, Some("lab"), false), "{role}");
            assert!(may(role, None, true) && may(role, Some("lab"), true), "{role}");
            assert!(!may(role, Some("hall"), true), "{role}: elsewhere");
        }
        for role in [Role::Operator, Role::Admin] {
            assert!(may(role, None, false), "{role}");
            assert!(
                !may(role, Some("lab"), false),
                "{role}: of a namespace is nobody on the nodes"
            );
        }
        assert!(allowed(&Who::Admin, "lab"));
        assert!(!allowed(&Who::Nobody, "lab") && !allowed(&Who::Node("n".to_owned()), "lab"));
    }
}
