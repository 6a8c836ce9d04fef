//! Namespace: core `v1`, as Kubernetes has it.

pub use k8s_openapi::api::core::v1::Namespace;

use super::{KindInfo, admit_core, any_change};

/// The namespace of objects that name none.
pub const DEFAULT: &str = "default";

pub(super) const INFO: KindInfo = KindInfo {
    group: "",
    version: "v1",
    kind: "Namespace",
    plural: "namespaces",
    singular: "namespace",
    short_names: &["ns"],
    namespaced: false,
    has_status: true,
    schema: |g| g.subschema_for::<Namespace>(),
    selectable: &["status.phase"],
    admit_body: admit_core::<Namespace>,
    admit_change: any_change,
};
