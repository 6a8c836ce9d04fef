//! Quotas: what a namespace has of what it may have.

use muster_api::kind::quota::{Limits, Quota, Used};

use super::{Column, age};
use crate::output::human;
use crate::output::table::Cell;

pub(super) const COLUMNS: &[Column<Quota>] = &[
    Column::new("CPU", |quota, _| {
        of(quota, |used| human::cores(used.cpu), |hard| hard.cpu.map(human::cores))
    }),
    Column::new("MEMORY", |quota, _| {
        of(quota, |used| human::bytes(used.memory), |hard| hard.memory.map(human::bytes))
    }),
    Column::new("LEASES", |quota, _| {
        of(quota, |used| used.leases.to_string(), |hard| hard.leases.map(|n| n.to_string()))
    }),
    Column::new("TASKS", |quota, _| {
        of(quota, |used| used.tasks.to_string(), |hard| hard.tasks.map(|n| n.to_string()))
    }),
    Column::new("WEIGHT", |quota, _| quota.spec.weight.to_string().into()),
    Column::new("AGE", |quota, now| age(quota.metadata.creation_timestamp.as_ref(), now)),
    Column::wide("EXTENDED", |quota, _| extended(quota).into()),
];

/// `used/hard`. What is not limited has a dash behind; what is not counted yet, one before.
fn of(
    quota: &Quota,
    used: impl Fn(&Used) -> String,
    hard: impl Fn(&Limits) -> Option<String>,
) -> Cell {
    let used = quota.status.as_ref().map(|status| used(&status.used));
    match (used, hard(&quota.spec.hard)) {
        (None, None) => String::new().into(),
        (used, hard) => {
            let or_dash = |text: Option<String>| text.unwrap_or_else(|| "-".to_owned());
            format!("{}/{}", or_dash(used), or_dash(hard)).into()
        }
    }
}

fn extended(quota: &Quota) -> String {
    let used = |name: &String| {
        let status = quota.status.as_ref()?;
        Some(status.used.extended.get(name).copied().unwrap_or_default().to_string())
    };
    let one = |(name, hard): (&String, &u64)| {
        format!("{name}={}/{hard}", used(name).unwrap_or_else(|| "-".to_owned()))
    };
    quota.spec.hard.extended.iter().map(one).collect::<Vec<_>>().join(",")
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use crate::output::columns::{Layout, table};
    use crate::output::style::Styles;

    fn text(status: &Value) -> String {
        let info = muster_api::kind::find_by_word("quotas").expect("served");
        let quota = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Quota",
            "metadata": {"name": "default", "namespace": "lab"},
            "spec": {"hard": {"cpu": "1500m", "leases": 2, "extended": {"gpu": 1}}, "weight": 2},
            "status": status,
        });
        let now = jiff::Timestamp::UNIX_EPOCH;
        let layout = Layout { wide: true, namespaces: true, kinds: false, now };
        table(info, &[quota], layout).text(&Styles::default())
    }

    #[test]
    fn what_is_used_stands_before_what_is_allowed() {
        let used = json!({"cpu": "500m", "memory": "64Mi", "leases": 1, "tasks": 3, "extended": {"gpu": 1}});
        assert_eq!(
            text(&json!({"used": used})),
            "NAMESPACE   NAME      CPU       MEMORY   LEASES   TASKS   WEIGHT   AGE   EXTENDED\n\
             lab         default   0.5/1.5   64Mi/-   1/2      3/-     2        -     gpu=1/1\n"
        );
    }

    #[test]
    fn what_is_not_limited_or_not_counted_is_a_dash() {
        assert_eq!(
            text(&Value::Null),
            "NAMESPACE   NAME      CPU     MEMORY   LEASES   TASKS   WEIGHT   AGE   EXTENDED\n\
             lab         default   -/1.5   -        -/2      -       2        -     gpu=-/1\n"
        );
    }
}
