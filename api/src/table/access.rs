//! Access: which role, where, for whom.

use crate::kind::access::{Access, SubjectKind};

use super::{Column, age};

pub(super) const COLUMNS: &[Column<Access>] = &[
    Column::new("ROLE", |access, _| access.spec.role.to_string().into()),
    Column::new("NAMESPACES", |access, _| match &access.spec.namespaces {
        Some(namespaces) => namespaces.join(",").into(),
        None => "(cluster)".into(),
    }),
    Column::new("SUBJECTS", |access, _| {
        let name = |subject: &crate::kind::access::Subject| match subject.kind {
            SubjectKind::User => subject.name.clone(),
            SubjectKind::Group => format!("group {}", subject.name),
        };
        access.spec.subjects.iter().map(name).collect::<Vec<_>>().join(", ").into()
    }),
    Column::new("AGE", |access, now| age(access.metadata.creation_timestamp.as_ref(), now)),
];
