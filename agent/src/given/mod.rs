//! What a task is given of ConfigMaps and Secrets: kept for its next attempt, handed over at its start.
//!
//! | module | holds |
//! |---|---|
//! | [`vault`] | the values at rest: sealed, beside the task's record |
//! | [`files`] | the values as files, for as long as an attempt may live |
//!
//! Variables never touch a disk in the clear: a process gets them from its shim, which reads them from a memfd, and a
//! container from its engine.

pub(crate) mod files;
pub(crate) mod vault;

use std::sync::Arc;

use muster_agent_core::workload::Failure;
use muster_api::kind::task::TaskSpec;
use muster_api::wire::agent::v1 as proto;

/// Whole, as the controller sent it; none: the task names nothing. Its `Debug` shows no value.
pub(crate) type Given = Option<Arc<proto::Config>>;

/// What is kept when the controller sends `new`: when something is not there any more, what was given before.
pub(crate) fn renew(old: &Given, new: Given) -> Given {
    match (old, &new) {
        (Some(old), Some(new)) if new.unresolved.is_some() && old.unresolved.is_none() => {
            Some(Arc::clone(old))
        }
        _ => new,
    }
}

/// Whether an attempt can be started with it.
pub(crate) fn check(spec: &TaskSpec, given: &Given) -> Result<(), Failure> {
    let refused = |reason: &str, message: &str| {
        Err(Failure { reason: reason.to_owned(), message: message.to_owned(), retry: true })
    };
    match given {
        None if spec.references().is_empty() => Ok(()),
        None => refused(
            "ConfigMissing",
            "the values of its ConfigMaps and Secrets are not on this node; the controller sends them",
        ),
        Some(given) => match &given.unresolved {
            Some(proto::Unresolved { reason, message }) => refused(reason, message),
            None => Ok(()),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn given(value: &str, unresolved: bool) -> Given {
        let variable = proto::Variable { name: "A".to_owned(), value: value.to_owned() };
        Some(Arc::new(proto::Config {
            variables: vec![variable],
            files: Vec::new(),
            unresolved: unresolved.then(|| proto::Unresolved {
                reason: "SecretNotFound".to_owned(),
                message: "gone".to_owned(),
            }),
        }))
    }

    #[test]
    fn the_newest_values_are_kept_and_a_loss_takes_none_away() {
        let (old, new, lost) = (given("1", false), given("2", false), given("", true));
        assert_eq!(renew(&old, new.clone()), new);
        assert_eq!(renew(&old, lost.clone()), old);
        assert_eq!(renew(&None, lost.clone()), lost);
        assert_eq!(renew(&lost, new.clone()), new);
        assert_eq!(renew(&old, None), None);
    }

    #[test]
    fn nothing_starts_without_its_values() {
        let json =
            br#"{"run":{"process":{"command":["x"],"envFrom":[{"secretRef":{"name":"s"}}]}}}"#;
        let spec = muster_api::wire::agent_session::spec_from_wire(json).unwrap();
        assert_eq!(check(&spec, &None).unwrap_err().reason, "ConfigMissing");
        assert_eq!(check(&spec, &given("", true)).unwrap_err().reason, "SecretNotFound");
        check(&spec, &given("1", false)).unwrap();
        check(&crate::spec::nothing(), &None).unwrap();
    }
}
