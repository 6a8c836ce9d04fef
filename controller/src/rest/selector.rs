//! Label and field selectors of a request.

use muster_api::selector::{FieldSelector, LabelSelector, Labels};
use serde::Deserialize as _;

use super::failure::Failure;
use super::query::Query;
use super::registry::{Entry, View};
use crate::store::Stored;

/// What of a collection is asked for.
#[derive(Debug, Clone)]
pub(super) struct Selection {
    entry: &'static Entry,
    namespace: Option<String>,
    labels: LabelSelector,
    /// Requirements on name and namespace, which need no look into the object.
    place: FieldSelector,
    fields: FieldSelector,
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
        let (place, fields): (Vec<_>, Vec<_>) = fields.0.into_iter().partition(|requirement| {
            matches!(requirement.path.as_str(), "metadata.name" | "metadata.namespace")
        });
        for requirement in &fields {
            if !entry.info.selectable.contains(&requirement.path.as_str()) {
                let known = entry.info.selectable.join(", ");
                return Err(Failure::bad_request(format!(
                    "fieldSelector: {:?} cannot be selected by; try metadata.name, metadata.namespace, {known}",
                    requirement.path
                )));
            }
        }
        let namespace = namespace.map(str::to_owned);
        Ok(Self {
            entry,
            namespace,
            labels,
            place: FieldSelector(place),
            fields: FieldSelector(fields),
        })
    }

    /// Whether everything in the namespace is asked for.
    pub(super) fn is_everything(&self) -> bool {
        self.labels.is_empty() && self.fields.0.is_empty() && self.place.0.is_empty()
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
        // The view of a node adds labels that are not stored.
        if self.entry.view == View::Node {
            let object = self.entry.value(stored);
            let labels = Labels::deserialize(&object["metadata"]["labels"]);
            return self.labels.matches(&labels.unwrap_or_default());
        }
        self.labels.matches(stored.labels())
    }

    fn fields_match(&self, stored: &Stored) -> bool {
        self.fields.0.is_empty() || self.fields.matches(&self.entry.value(stored))
    }
}
