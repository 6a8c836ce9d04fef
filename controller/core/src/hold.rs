//! Why a task is not considered for a place at all, whatever the nodes are like: something that it is to find when it
//! starts is not there.
//!
//! A hold is said of the whole cluster: [`Hold::refusal`] names no node. The scheduler passes over a task that is held
//! and writes its holds as its reasons; a framework's launch is refused with them.

use std::fmt;

use jiff::Timestamp;
use muster_api::kind::task::NodeRefusal;
use muster_api::kind::task::config::Source;

/// One reason.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Hold {
    /// The task names a ConfigMap or a Secret that is not there.
    ObjectNotFound {
        /// Which kind.
        source: Source,
        /// Its name, in the task's namespace.
        name: String,
    },
    /// It is there and has not the key.
    KeyNotFound {
        /// Which kind.
        source: Source,
        /// Its name.
        name: String,
        /// The key.
        key: String,
    },
    /// A variable must be text without a zero byte, and the value is not.
    NotText {
        /// Which kind.
        source: Source,
        /// Its name.
        name: String,
        /// The key.
        key: String,
    },
    /// The task waits for another one that is not there.
    DependencyNotFound {
        /// Its name, in the task's namespace.
        task: String,
    },
    /// The task waits for another one that has not come far enough.
    DependencyNotMet {
        /// Its name.
        task: String,
        /// What is missing, a clause whose subject is that task.
        why: String,
    },
    /// The task has failed on another node, and waits before the next one is tried.
    BackOff {
        /// Until then.
        until: Timestamp,
        /// Where it failed last.
        node: String,
        /// How, a clause.
        end: String,
        /// How many attempts have failed.
        used: u32,
        /// How many may.
        most: u32,
    },
    /// All that the task wants together is more than one message to its node takes.
    TooLarge {
        /// Bytes.
        bytes: usize,
        /// Most allowed.
        most: usize,
    },
}

impl Hold {
    /// The reason as one word, for programs.
    #[must_use]
    pub fn reason(&self) -> &'static str {
        use Source::{ConfigMap, Secret};
        match self {
            Hold::ObjectNotFound { source: ConfigMap, .. } => "ConfigMapNotFound",
            Hold::ObjectNotFound { source: Secret, .. } => "SecretNotFound",
            Hold::KeyNotFound { source: ConfigMap, .. } => "ConfigMapKeyNotFound",
            Hold::KeyNotFound { source: Secret, .. } => "SecretKeyNotFound",
            Hold::NotText { source: ConfigMap, .. } => "ConfigMapValueNotText",
            Hold::NotText { source: Secret, .. } => "SecretValueNotText",
            Hold::DependencyNotFound { .. } => "DependencyNotFound",
            Hold::DependencyNotMet { .. } => "DependencyNotMet",
            Hold::BackOff { .. } => "BackOff",
            Hold::TooLarge { .. } => "ConfigTooLarge",
        }
    }

    /// The field of the task that it is about.
    #[must_use]
    pub fn field(&self) -> &'static str {
        match self {
            Hold::DependencyNotFound { .. } | Hold::DependencyNotMet { .. } => "spec.dependsOn",
            Hold::BackOff { .. } => "spec.reschedule",
            Hold::ObjectNotFound { .. }
            | Hold::KeyNotFound { .. }
            | Hold::NotText { .. }
            | Hold::TooLarge { .. } => "spec.run",
        }
    }

    /// The hold as a task's status carries it.
    #[must_use]
    pub fn refusal(&self) -> NodeRefusal {
        NodeRefusal {
            node: String::new(),
            reason: self.reason().to_owned(),
            message: self.to_string(),
        }
    }
}

fn kind(source: Source) -> &'static str {
    match source {
        Source::ConfigMap => "ConfigMap",
        Source::Secret => "Secret",
    }
}

impl fmt::Display for Hold {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Hold::ObjectNotFound { source, name } => {
                write!(f, "there is no {} {name}; waits until it is created", kind(*source))
            }
            Hold::KeyNotFound { source, name, key } => {
                write!(f, "the {} {name} has no key {key:?}; waits until it has", kind(*source))
            }
            Hold::NotText { source, name, key } => write!(
                f,
                "the value of {key:?} in the {} {name} is not text, and a variable must be; use it as a file",
                kind(*source)
            ),
            Hold::DependencyNotFound { task } => {
                write!(f, "waits for task {task}, which is not there; waits until it is created")
            }
            Hold::DependencyNotMet { task, why } => {
                write!(f, "waits for task {task}, which {why}")
            }
            Hold::BackOff { until, node, end, used, most } => write!(
                f,
                "failed on {node} ({end}); is tried again at {until:.0}, attempt {} of {most}",
                used.saturating_add(1)
            ),
            Hold::TooLarge { bytes, most } => write!(
                f,
                "its ConfigMaps and Secrets come to {bytes} bytes, at most {most} are sent to a node"
            ),
        }
    }
}
