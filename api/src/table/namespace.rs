//! Namespaces.

use crate::kind::namespace::Namespace;

use super::{Column, age};

pub(super) const COLUMNS: &[Column<Namespace>] = &[
    Column::new("STATUS", |namespace, _| {
        namespace.status.as_ref().and_then(|s| s.phase.clone()).unwrap_or_default().into()
    }),
    Column::new("AGE", |namespace, now| age(namespace.metadata.creation_timestamp.as_ref(), now)),
];
