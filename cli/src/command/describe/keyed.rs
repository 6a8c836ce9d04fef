//! ConfigMaps with what they say; Secrets with what they have, by key and size only.

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::ObjectMeta;
use muster_api::kind::config_map::ConfigMap;
use muster_api::kind::secret::Secret;

use super::begin;
use crate::output::sheet::Sheet;
use crate::output::table::Table;

/// kubectl writes whole manifests here, with what a Secret is to hide.
const KUBECTL_APPLIED: &str = "kubectl.kubernetes.io/last-applied-configuration";
/// A longer value is told by its size.
const SHOWN: usize = 256;

pub(super) fn config_map(sheet: &mut Sheet, map: &ConfigMap, now: Timestamp) {
    begin(sheet, &without_manifest(&map.metadata), now);
    immutable(sheet, map.immutable);
    let mut table = Table::new(["KEY", "VALUE"]);
    for (key, value) in map.data.iter().flatten() {
        let short = value.len() <= SHOWN && !value.trim_end().contains('\n');
        let shown = if short { value.trim_end().to_owned() } else { bytes(value.len()) };
        table.push([key.clone(), shown]);
    }
    for (key, value) in map.binary_data.iter().flatten() {
        table.push([key.clone(), bytes(value.0.len())]);
    }
    sheet.table("Data", table);
}

pub(super) fn secret(sheet: &mut Sheet, secret: &Secret, now: Timestamp) {
    begin(sheet, &without_manifest(&secret.metadata), now);
    sheet.maybe("Type", secret.type_.clone());
    immutable(sheet, secret.immutable);
    let mut table = Table::new(["KEY", "SIZE"]);
    for (key, value) in secret.data.iter().flatten() {
        table.push([key.clone(), bytes(value.0.len())]);
    }
    sheet.table("Data", table);
}

fn without_manifest(metadata: &ObjectMeta) -> ObjectMeta {
    let mut metadata = metadata.clone();
    if let Some(notes) = &mut metadata.annotations {
        notes.remove(KUBECTL_APPLIED);
    }
    metadata
}

fn immutable(sheet: &mut Sheet, immutable: Option<bool>) {
    if immutable == Some(true) {
        sheet.field("Immutable", "yes");
    }
}

fn bytes(count: usize) -> String {
    if count == 1 { "1 byte".to_owned() } else { format!("{count} bytes") }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::fake::Fake;

    #[tokio::test]
    async fn a_secret_is_described_by_its_keys() {
        let fake = Fake::new();
        let object = json!({
            "apiVersion": "v1", "kind": "Secret", "type": "Opaque",
            "metadata": {"name": "s", "namespace": "default", "annotations": {
                "kubectl.kubernetes.io/last-applied-configuration": "hunter2", "kept": "note"}},
            "data": {"password": "aHVudGVyMg=="},
        });
        fake.put("secrets/default/s", object);
        let (_, text) = fake.run(&["describe", "secret", "s"]).await;
        assert!(text.contains("password") && text.contains("7 bytes"), "{text}");
        assert!(text.contains("note"), "{text}");
        assert!(!text.contains("hunter2") && !text.contains("aHVudGVyMg"), "{text}");
        let (_, text) = fake.run(&["get", "secrets"]).await;
        assert!(text.contains("Opaque") && !text.contains("aHVudGVyMg"), "{text}");
        let (_, text) = fake.run(&["get", "secret", "s", "-o", "yaml"]).await;
        assert!(text.contains("aHVudGVyMg"), "as kubectl shows it: {text}");
    }
}
