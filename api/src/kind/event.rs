//! Event: core `v1`, as Kubernetes has it; `describe` shows them under their object.

pub use k8s_openapi::api::core::v1::Event;

use super::{KindInfo, admit_core, any_change};

pub(super) const INFO: KindInfo = KindInfo {
    group: "",
    version: "v1",
    kind: "Event",
    plural: "events",
    singular: "event",
    short_names: &["ev"],
    namespaced: true,
    has_status: false,
    schema: |g| g.subschema_for::<Event>(),
    selectable: &[
        "involvedObject.apiVersion",
        "involvedObject.kind",
        "involvedObject.name",
        "involvedObject.namespace",
        "involvedObject.uid",
        "reason",
        "reportingComponent",
        "type",
    ],
    admit_body: admit_core::<Event>,
    admit_change: any_change,
};
