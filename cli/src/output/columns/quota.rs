//! Quotas: what a namespace may have.

use muster_api::kind::quota::Quota;

use super::{Column, age};
use crate::output::human;

pub(super) const COLUMNS: &[Column<Quota>] = &[
    Column::new("CPU", |quota, _| quota.spec.hard.cpu.map(human::cores).unwrap_or_default().into()),
    Column::new("MEMORY", |quota, _| {
        quota.spec.hard.memory.map(human::bytes).unwrap_or_default().into()
    }),
    Column::new("LEASES", |quota, _| {
        quota.spec.hard.leases.map(|n| n.to_string()).unwrap_or_default().into()
    }),
    Column::new("WEIGHT", |quota, _| quota.spec.weight.to_string().into()),
    Column::new("AGE", |quota, now| age(quota.metadata.creation_timestamp.as_ref(), now)),
    Column::wide("EXTENDED", |quota, _| {
        let all = quota.spec.hard.extended.iter().map(|(name, n)| format!("{name}={n}"));
        all.collect::<Vec<_>>().join(",").into()
    }),
];

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::output::columns::{Layout, table};
    use crate::output::style::Styles;

    #[test]
    fn what_is_not_limited_is_a_dash() {
        let info = muster_api::kind::find_by_word("quotas").expect("served");
        let quota = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Quota",
            "metadata": {"name": "default", "namespace": "lab"},
            "spec": {"hard": {"cpu": "1500m", "leases": 2, "extended": {"gpu": 1}}, "weight": 2},
        });
        let now = jiff::Timestamp::UNIX_EPOCH;
        let layout = Layout { wide: true, namespaces: true, kinds: false, now };
        assert_eq!(
            table(info, &[quota], layout).text(&Styles::default()),
            "NAMESPACE   NAME      CPU   MEMORY   LEASES   WEIGHT   AGE   EXTENDED\n\
             lab         default   1.5   -        2        2        -     gpu=1\n"
        );
    }
}
