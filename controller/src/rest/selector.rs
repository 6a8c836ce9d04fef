//! Label and field selectors of a request.

use muster_api::kind::node::NodeKind;
use muster_api::selector::{FieldRequirement, FieldSelector, LabelSelector, field_text};
use muster_controller_core::project;
use serde::Deserialize;

use super::failure::Failure;
use super::query::Query;
use super::registry::{Entry, View};
use crate::store::Stored;

/// Events are about our own kinds: who asks for those of a Pod or of a core Node means what it is a view of.
fn of_ours(entry: &Entry, mut fields: FieldSelector) -> FieldSelector {
    let (kind, version) = ("involvedObject.kind", "involvedObject.apiVersion");
    let of_view = |requirement: &FieldRequirement| {
        requirement.path == kind
            && requirement.equal
            && matches!(requirement.value.as_str(), "Pod" | "Node")
    };
    if entry.info.kind != "Event" || !fields.0.iter().any(of_view) {
        return fields;
    }
    for requirement in &mut fields.0 {
        let ours = match (requirement.path.as_str(), requirement.value.as_str()) {
            (path, "Pod") if path == kind => "Task",
            (path, "v1") if path == version => muster_api::API_VERSION,
            _ => continue,
        };
        ours.clone_into(&mut requirement.value);
    }
    fields
}

/// Where a field stands that is asked for by another path: what a task's node is, is decided and not asked for, and who
/// knows Pods looks for it in the spec.
fn place<'a>(entry: &Entry, path: &'a str) -> &'a str {
    match (entry.info.kind, path) {
        ("Task", "spec.node") => "status.node",
        _ => path,
    }
}

/// The part of a Node that says what it is.
#[derive(Deserialize)]
struct OfKind {
    spec: Kind,
}

#[derive(Deserialize)]
struct Kind {
    kind: NodeKind,
}

/// A requirement on one of the fields that a kind can be selected by.
#[derive(Debug, Clone)]
struct Field {
    /// Which of `KindInfo::selectable`.
    index: usize,
    equal: bool,
    value: String,
}

/// What of a collection is asked for.
#[derive(Debug, Clone)]
pub(super) struct Selection {
    entry: &'static Entry,
    namespace: Option<String>,
    labels: LabelSelector,
    /// Requirements on name and namespace, which need no look into the object.
    place: FieldSelector,
    fields: Vec<Field>,
}

impl Selection {
    pub(super) fn read(
        entry: &'static Entry,
        namespace: Option<&str>,
        query: &Query,
    ) -> Result<Self, Failure> {
        let bad = |name: &str, error: &dyn std::fmt::Display| {
            Failure::bad_request(format!("{name}: {error}"))
        };
        let labels = LabelSelector::parse(query.text("labelSelector").unwrap_or_default())
            .map_err(|error| bad("labelSelector", &error))?;
        let fields = FieldSelector::parse(query.text("fieldSelector").unwrap_or_default())
            .map_err(|error| bad("fieldSelector", &error))?;
        let fields = of_ours(entry, fields);
        let (place, fields): (Vec<_>, Vec<_>) = fields.0.into_iter().partition(|requirement| {
            matches!(requirement.path.as_str(), "metadata.name" | "metadata.namespace")
        });
        let field = |FieldRequirement { path, equal, value }: FieldRequirement| match entry
            .info
            .selectable
            .iter()
            .position(|known| *known == path)
        {
            Some(index) => Ok(Field { index, equal, value }),
            None => {
                let known = entry.info.selectable.join(", ");
                Err(Failure::bad_request(format!(
                    "fieldSelector: {path:?} cannot be selected by; try metadata.name, metadata.namespace, {known}"
                )))
            }
        };
        let fields = fields.into_iter().map(field).collect::<Result<_, _>>()?;
        let namespace = namespace.map(str::to_owned);
        Ok(Self { entry, namespace, labels, place: FieldSelector(place), fields })
    }

    /// Whether everything in the namespace is asked for.
    pub(super) fn is_everything(&self) -> bool {
        self.labels.is_empty() && self.fields.is_empty() && self.place.0.is_empty()
    }

    pub(super) fn matches(&self, stored: &Stored) -> bool {
        let key = &stored.key;
        if self.namespace.as_deref().is_some_and(|wanted| key.namespace() != Some(wanted)) {
            return false;
        }
        let placed = self.place.0.iter().all(|requirement| {
            let is = match requirement.path.as_str() {
                "metadata.name" => &*key.name,
                _ => key.namespace().unwrap_or_default(),
            };
            (is == requirement.value) == requirement.equal
        });
        placed && self.labels_match(stored) && self.fields_match(stored)
    }

    fn labels_match(&self, stored: &Stored) -> bool {
        if self.labels.is_empty() {
            return true;
        }
        if self.entry.view != View::Node {
            return self.labels.matches(stored.labels());
        }
        // The view of a node adds labels that are not stored.
        self.labels.matches(stored.labels_shown(|labels| match stored.parse::<OfKind>() {
            Ok(node) => project::node::labels(labels, node.spec.kind, &stored.key.name),
            Err(_) => labels.clone(),
        }))
    }

    fn fields_match(&self, stored: &Stored) -> bool {
        if self.fields.is_empty() {
            return true;
        }
        let entry = self.entry;
        // Read once for all who ask: a thousand watchers may.
        let values = stored.fields(usize::from(entry.view != View::Stored), || {
            let object = entry.value(stored);
            let paths = entry.info.selectable.iter();
            paths.map(|path| field_text(&object, place(entry, path))).collect()
        });
        self.fields.iter().all(|field| (*values[field.index] == *field.value) == field.equal)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_of_a_view_are_those_of_what_it_shows() {
        let read = |text: &str| {
            let events = crate::rest::registry::find("", "events").unwrap();
            let fields = of_ours(events, FieldSelector::parse(text).unwrap());
            fields.0.into_iter().map(|requirement| requirement.value).collect::<Vec<_>>()
        };
        let ours = muster_api::API_VERSION;
        let of = |kind: &str| {
            read(&format!(
                "involvedObject.kind={kind},involvedObject.apiVersion=v1,involvedObject.name=x"
            ))
        };
        assert_eq!(of("Pod"), ["Task", ours, "x"]);
        assert_eq!(of("Node"), ["Node", ours, "x"]);
        assert_eq!(of("ConfigMap"), ["ConfigMap", "v1", "x"]);
        assert_eq!(read("involvedObject.kind!=Pod"), ["Pod"]);
    }
}
