//! Where a field has Kubernetes' name it means what it means there: tables of what Kubernetes documents against what the
//! API crate decides. Where muster means something else, its row says why.
//!
//! The other tables: `controller/core/tests/kubernetes.rs` (placement, deadlines, deletion), `agent/core/tests/kubernetes.rs`
//! (restarts, back-off, grace) and `agent/core/src/probe/tests.rs` (thresholds of probes).

mod table;

use muster_api::kind::node::{Taint, TaintEffect};
use muster_api::kind::task::{DEFAULT_GRACE_SECONDS, Toleration};
use muster_api::kind::{admit, admit_change, find};
use muster_api::quantity::{Bytes, MilliCpu};
use muster_api::selector::{FieldSelector, LabelSelector, Labels};
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use table::{Differs, Row, Same, hold};

fn read<T: DeserializeOwned>(yaml: &str) -> Option<T> {
    serde_saphyr::from_str(yaml).ok()
}

/// What is wrong with a task of this spec, as admission says it, the paths alone.
fn refused(spec: &Value) -> Vec<String> {
    match admit(&task(spec)) {
        Ok(_) => Vec::new(),
        Err(violations) => violations.iter().map(|v| v.path.clone()).collect(),
    }
}

fn task(spec: &Value) -> Value {
    let mut task = json!({
        "apiVersion": muster_api::API_VERSION, "kind": "Task", "metadata": {"name": "t"},
        "spec": {"run": {"process": {"command": ["true"]}}},
    });
    for (field, value) in spec.as_object().expect("members") {
        task["spec"][field] = value.clone();
    }
    task
}

fn labels(pairs: &[(&str, &str)]) -> Labels {
    pairs.iter().map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect()
}

/// Whether a selector selects an object with the labels `app=cam, tier=back`, and one without labels.
type Selects = (bool, bool);

const BOTH: Selects = (true, true);
const LABELLED: Selects = (true, false);
const BARE: Selects = (false, true);
const NEITHER: Selects = (false, false);

fn selects(selector: &LabelSelector) -> Selects {
    let labelled = labels(&[("app", "cam"), ("tier", "back")]);
    (selector.matches(&labelled), selector.matches(&Labels::new()))
}

#[test]
fn selectors_in_manifests() {
    let rows: &[Row<&str, Option<Selects>>] = &[
        // An empty selector selects everything.
        ("{}", Some(BOTH), Same),
        ("{matchLabels: {}, matchExpressions: []}", Some(BOTH), Same),
        ("{matchLabels: {app: cam}}", Some(LABELLED), Same),
        ("{matchLabels: {app: arm}}", Some(NEITHER), Same),
        ("{matchLabels: {app: cam, tier: front}}", Some(NEITHER), Same),
        // The empty value is a value: a label that is not there does not have it.
        ("{matchLabels: {gpu: ''}}", Some(NEITHER), Same),
        // Parts are "and"; values of one part are "or".
        (
            "{matchLabels: {app: cam}, matchExpressions: [{key: tier, operator: Exists}]}",
            Some(LABELLED),
            Same,
        ),
        (
            "{matchLabels: {app: cam}, matchExpressions: [{key: gpu, operator: Exists}]}",
            Some(NEITHER),
            Same,
        ),
        (
            "{matchExpressions: [{key: app, operator: In, values: [arm, cam]}]}",
            Some(LABELLED),
            Same,
        ),
        ("{matchExpressions: [{key: app, operator: In, values: [arm]}]}", Some(NEITHER), Same),
        // NotIn and DoesNotExist select what does not have the label.
        ("{matchExpressions: [{key: app, operator: NotIn, values: [cam, arm]}]}", Some(BARE), Same),
        ("{matchExpressions: [{key: app, operator: NotIn, values: [arm]}]}", Some(BOTH), Same),
        ("{matchExpressions: [{key: gpu, operator: NotIn, values: [a]}]}", Some(BOTH), Same),
        ("{matchExpressions: [{key: app, operator: Exists}]}", Some(LABELLED), Same),
        ("{matchExpressions: [{key: app, operator: DoesNotExist}]}", Some(BARE), Same),
        // Names are case-sensitive, those of operators too.
        ("{matchLabels: {App: cam}}", Some(NEITHER), Same),
        ("{matchExpressions: [{key: app, operator: exists}]}", None, Same),
        // What Kubernetes' admission refuses.
        ("{matchExpressions: [{key: app, operator: In}]}", None, Same),
        ("{matchExpressions: [{key: app, operator: In, values: []}]}", None, Same),
        ("{matchExpressions: [{key: app, operator: Exists, values: [a]}]}", None, Same),
        ("{matchExpressions: [{key: -app, operator: Exists}]}", None, Same),
        ("{matchExpressions: [{key: app, operator: In, values: [a b]}]}", None, Same),
        ("{matchLabels: {a/b/c: d}}", None, Same),
        ("{matchLabels: {app: -d}}", None, Same),
        // Kubernetes has Gt and Lt for nodes alone (nodeAffinity), which is what selects a node there.
        (
            "{matchExpressions: [{key: cores, operator: Gt, values: ['4']}]}",
            Some(NEITHER),
            Differs(
                None,
                "a number of a robot is a field with a unit: minBattery, resources, within",
            ),
        ),
    ];
    hold(rows, |yaml| {
        let selector: LabelSelector = read(yaml)?;
        let mut violations = muster_api::validate::Violations::new();
        selector.validate("spec", &mut violations);
        violations.iter().next().is_none().then(|| selects(&selector))
    });
}

/// `-l` and `labelSelector=`: apimachinery's `labels.Parse`.
#[test]
fn selectors_as_text() {
    let rows: &[Row<&str, Option<Selects>>] = &[
        ("", Some(BOTH), Same),
        ("  ", Some(BOTH), Same),
        ("app=cam", Some(LABELLED), Same),
        ("app==cam", Some(LABELLED), Same),
        (" app = cam ", Some(LABELLED), Same),
        ("app!=cam", Some(BARE), Same),
        ("app!=arm", Some(BOTH), Same),
        ("gpu!=a", Some(BOTH), Same),
        ("app", Some(LABELLED), Same),
        ("!app", Some(BARE), Same),
        ("! app", Some(BARE), Same),
        ("app in (cam,arm)", Some(LABELLED), Same),
        ("app in(cam)", Some(LABELLED), Same),
        ("app notin ( cam , arm )", Some(BARE), Same),
        ("gpu notin (a)", Some(BOTH), Same),
        ("app=cam,tier!=front,app in (x,cam),!gpu", Some(LABELLED), Same),
        ("app=cam,app=arm", Some(NEITHER), Same),
        // Nothing between is the empty value, which a missing label does not have.
        ("app=", Some(NEITHER), Same),
        ("app!=", Some(BOTH), Same),
        ("app in ()", Some(NEITHER), Same),
        ("app in (,cam)", Some(LABELLED), Same),
        // The words of the grammar are labels' keys as well.
        ("in", Some(NEITHER), Same),
        ("notin in (in)", Some(NEITHER), Same),
        ("example.dev/app!=cam", Some(BOTH), Same),
        // Mistakes.
        ("app=cam,", None, Same),
        (",app=cam", None, Same),
        ("app=cam,,tier=back", None, Same),
        (",", None, Same),
        ("!app=cam", None, Same),
        ("app=cam tier=back", None, Same),
        ("app===cam", None, Same),
        ("app in cam", None, Same),
        ("app in (cam", None, Same),
        ("app IN (cam)", None, Same),
        ("app within (cam)", None, Same),
        ("=cam", None, Same),
        ("!", None, Same),
        ("app=-cam", None, Same),
        ("a/b/c=d", None, Same),
        (
            "app>4",
            Some(NEITHER),
            Differs(None, "labels are not compared as numbers; what has a number has a field"),
        ),
    ];
    hold(rows, |text| LabelSelector::parse(text).ok().as_ref().map(selects));
}

/// `--field-selector`: apimachinery's `fields.ParseSelector`.
#[test]
fn field_selectors_as_text() {
    let object = json!({"metadata": {"name": "t"}, "status": {"phase": "Running"}});
    let rows: &[Row<&str, Option<bool>>] = &[
        ("", Some(true), Same),
        ("status.phase=Running", Some(true), Same),
        ("status.phase==Running", Some(true), Same),
        ("status.phase!=Running", Some(false), Same),
        ("metadata.name=t,status.phase!=Pending", Some(true), Same),
        // A field that is not there is the empty text.
        ("status.node=", Some(true), Same),
        ("status.node!=r1", Some(true), Same),
        // Unlike in a label selector, empty parts are skipped.
        ("metadata.name=t,", Some(true), Same),
        // There is no existence and there are no sets.
        ("status.phase", None, Same),
    ];
    hold(rows, |text| Some(FieldSelector::parse(text).ok()?.matches(&object)));
}

/// `v1.Toleration.ToleratesTaint`, for what admission lets in.
#[test]
fn tolerations_and_taints() {
    use TaintEffect::{NoSchedule, PreferNoSchedule};
    let rows: &[Row<(&str, TaintEffect), Option<bool>>] = &[
        // The taint is battery=low; without an operator: Equal; without an effect: every effect.
        (
            ("{key: battery, operator: Equal, value: low, effect: NoSchedule}", NoSchedule),
            Some(true),
            Same,
        ),
        (("{key: battery, value: low}", NoSchedule), Some(true), Same),
        (("{key: battery, value: low}", PreferNoSchedule), Some(true), Same),
        (("{key: battery, value: full}", NoSchedule), Some(false), Same),
        (("{key: battery}", NoSchedule), Some(false), Same),
        (("{key: other, value: low}", NoSchedule), Some(false), Same),
        (("{key: battery, value: low, effect: PreferNoSchedule}", NoSchedule), Some(false), Same),
        (("{key: battery, value: low, effect: NoSchedule}", PreferNoSchedule), Some(false), Same),
        (("{key: battery, operator: Exists}", NoSchedule), Some(true), Same),
        (("{key: other, operator: Exists}", NoSchedule), Some(false), Same),
        (
            ("{key: battery, operator: Exists, effect: PreferNoSchedule}", NoSchedule),
            Some(false),
            Same,
        ),
        // No key and Exists: every key, of the effect or of all.
        (("{operator: Exists}", NoSchedule), Some(true), Same),
        (("{operator: Exists}", PreferNoSchedule), Some(true), Same),
        (("{operator: Exists, effect: NoSchedule}", NoSchedule), Some(true), Same),
        (("{operator: Exists, effect: NoSchedule}", PreferNoSchedule), Some(false), Same),
        // What admission refuses.
        (("{operator: Equal}", NoSchedule), None, Same),
        (("{value: low}", NoSchedule), None, Same),
        (("{key: battery, operator: Exists, value: low}", NoSchedule), None, Same),
        (("{key: battery, operator: Like, value: low}", NoSchedule), None, Same),
        (("{key: battery, value: low, effect: NoRun}", NoSchedule), None, Same),
        (
            ("{key: battery, value: low, effect: NoExecute}", NoSchedule),
            Some(false),
            Differs(
                None,
                "there is no NoExecute: `muster drain` and maintenance windows end what runs, and say so before",
            ),
        ),
        (
            ("{key: battery, operator: Exists, tolerationSeconds: 60}", NoSchedule),
            None, // Kubernetes: only with the effect NoExecute.
            Same,
        ),
    ];
    hold(rows, |(yaml, effect)| {
        let toleration: Toleration = read(yaml)?;
        let spec = json!({"placement": {"tolerations": [toleration]}});
        let taint = Taint { key: "battery".to_owned(), value: "low".to_owned(), effect };
        refused(&spec).is_empty().then(|| toleration.tolerates(&taint))
    });
}

/// `resource.Quantity` as millicores, rounded up (`MilliValue`).
#[test]
fn quantities_of_cpu() {
    const SIGN: &str = "an amount has no sign";
    const UNIT: &str = "cores and millicores are the units of cpu; another one is a slip";
    let rows: &[Row<&str, Option<u64>>] = &[
        ("100m", Some(100), Same),
        ("1", Some(1_000), Same),
        ("1.5", Some(1_500), Same),
        ("0.1", Some(100), Same),
        (".5", Some(500), Same),
        ("1.", Some(1_000), Same),
        ("16.1", Some(16_100), Same),
        ("1e3", Some(1_000_000), Same),
        ("1E1", Some(10_000), Same),
        ("5e-1", Some(500), Same),
        ("0", Some(0), Same),
        // Finer than a millicore: rounded up.
        ("0.0001", Some(1), Same),
        ("0.5m", Some(1), Same),
        ("1.0001", Some(1_001), Same),
        ("", None, Same),
        ("2core", None, Same),
        ("1 m", None, Same),
        ("1e3m", None, Same),
        ("0x10", None, Same),
        ("-1", Some(0), Differs(None, "refused when it is read, not by a rule of each field")),
        ("+1", Some(1_000), Differs(None, SIGN)),
        (" 1 ", None, Differs(Some(1_000), "space around an amount has no other meaning")),
        ("1k", Some(1_000_000), Differs(None, UNIT)),
        ("1Ki", Some(1_024_000), Differs(None, UNIT)),
        ("1u", Some(1), Differs(None, UNIT)),
    ];
    // Kubernetes reads a negative amount, and the validation of resources refuses it.
    hold(rows, |text| text.parse::<MilliCpu>().ok().map(|cpu| cpu.0));
}

/// `resource.Quantity` as bytes, rounded up (`Value`).
#[test]
fn quantities_of_bytes() {
    let rows: &[Row<&str, Option<u64>>] = &[
        ("512", Some(512), Same),
        // Kilo is small and 1000, kibi is 1024.
        ("1k", Some(1_000), Same),
        ("1Ki", Some(1_024), Same),
        ("1M", Some(1_000_000), Same),
        ("1Mi", Some(1 << 20), Same),
        ("1G", Some(1_000_000_000), Same),
        ("1Gi", Some(1 << 30), Same),
        ("1T", Some(1_000_000_000_000), Same),
        ("1Ti", Some(1 << 40), Same),
        ("1P", Some(1_000_000_000_000_000), Same),
        ("1Pi", Some(1 << 50), Same),
        ("1E", Some(1_000_000_000_000_000_000), Same),
        ("1Ei", Some(1 << 60), Same),
        ("1.5Gi", Some(1_610_612_736), Same),
        ("8.1k", Some(8_100), Same),
        ("1.G", Some(1_000_000_000), Same),
        ("1e3", Some(1_000), Same),
        ("1E3", Some(1_000), Same),
        ("1.3E+6", Some(1_300_000), Same),
        ("0.5", Some(1), Same),
        ("100.035Ki", Some(102_436), Same),
        ("1K", None, Same),
        ("1ki", None, Same),
        ("1KB", None, Same),
        ("1e3Ki", None, Same),
        ("0.1mi", None, Same),
        ("1e", None, Same),
        ("128m", Some(1), Differs(None, "nobody means a thousandth of a byte; 128Mi is offered")),
        (
            "99999999999P",
            Some(i64::MAX as u64),
            Differs(None, "more than can be is a slip, not the most there is"),
        ),
    ];
    hold(rows, |text| text.parse::<Bytes>().ok().map(|bytes| bytes.0));
}

/// The canonical form.
#[test]
fn quantities_as_they_are_shown() {
    const ONE_FORM: &str =
        "one amount, one form, whatever it was written as: nodes and tasks are compared by eye";
    let cpu: &[Row<&str, &str>] =
        &[("0.5", "500m", Same), ("1.5", "1500m", Same), ("2000m", "2", Same)];
    hold(cpu, |text| shown(text.parse::<MilliCpu>().expect(text)));
    let bytes: &[Row<&str, &str>] = &[
        ("1024Ki", "1Mi", Same),
        ("1.5Gi", "1536Mi", Same),
        ("1000", "1k", Differs("1000", ONE_FORM)),
        ("1024k", "1024k", Differs("1000Ki", ONE_FORM)),
    ];
    hold(bytes, |text| shown(text.parse::<Bytes>().expect(text)));
}

/// The text of an amount, for as long as the test runs.
fn shown(amount: impl ToString) -> &'static str {
    amount.to_string().leak()
}

/// What a task gets that says nothing.
#[test]
fn defaults() {
    let admitted = admit(&task(&json!({}))).expect("good");
    let rows: &[Row<&str, Option<i64>>] = &[
        ("/spec/priority", Some(0), Same),
        ("/spec/activeDeadlineSeconds", None, Same),
        ("/spec/ttlSecondsAfterFinished", None, Same),
        (
            "/spec/gracePeriodSeconds",
            Some(30),
            Differs(Some(i64::from(DEFAULT_GRACE_SECONDS)), "a robot's operator waits for it"),
        ),
    ];
    hold(rows, |path| admitted.pointer(path).and_then(Value::as_i64));
    // Kubernetes: Always for a Pod, and a Job must say. A task is one run of one program; a TaskSet's are Always.
    assert_eq!(admitted["spec"]["restartPolicy"], "Never");
}

/// What of a spec admission refuses (true).
#[test]
fn limits_of_fields() {
    let rows: &[Row<&str, bool>] = &[
        ("{restartPolicy: Always}", false, Same),
        ("{restartPolicy: OnFailure}", false, Same),
        ("{restartPolicy: Never}", false, Same),
        ("{restartPolicy: always}", true, Same),
        ("{gracePeriodSeconds: 0}", false, Same),
        ("{gracePeriodSeconds: -1}", true, Same),
        (
            "{gracePeriodSeconds: 7200}",
            false,
            Differs(true, "a task that needs more than an hour to end blocks its robot"),
        ),
        ("{activeDeadlineSeconds: 1}", false, Same),
        // Of a Pod; a Job may have 0.
        ("{activeDeadlineSeconds: 0}", true, Same),
        ("{activeDeadlineSeconds: -1}", true, Same),
        ("{ttlSecondsAfterFinished: 0}", false, Same),
        ("{ttlSecondsAfterFinished: -1}", true, Same),
        ("{priority: -5}", false, Same),
        ("{resources: {cpu: '-1'}}", true, Same),
        ("{resources: {cpu: 100m, memory: 64Mi}}", false, Same),
        (
            "{resources: {cpu: 1m}}",
            false,
            Differs(
                true,
                "the kernel gives no quota finer than 1 ms in 100 ms, and cpu is a quota here",
            ),
        ),
        ("{resources: {memory: 1Mi}}", false, Differs(true, "no program starts in that")),
    ];
    hold(rows, |yaml| !refused(&read(yaml).expect(yaml)).is_empty());
}

/// Which fields of an object that exists may change (true), of those whose names are Kubernetes'.
#[test]
fn what_may_change() {
    let old = "{priority: 1, gracePeriodSeconds: 10, activeDeadlineSeconds: 60, ttlSecondsAfterFinished: 60, restartPolicy: Never}";
    const LATER: &str = "the controller keeps the time and needs nothing of the node for it";
    let rows: &[Row<&str, bool>] = &[
        // A Pod's.
        ("{restartPolicy: Always}", false, Same),
        ("{activeDeadlineSeconds: 30}", true, Same),
        ("{activeDeadlineSeconds: 90}", false, Differs(true, LATER)),
        ("{activeDeadlineSeconds: null}", false, Differs(true, LATER)),
        (
            "{priority: 2}",
            false,
            Differs(
                true,
                "there are no PriorityClasses to resolve; a waiting task may become urgent",
            ),
        ),
        ("{gracePeriodSeconds: 5}", false, Differs(true, LATER)),
        ("{placement: {tolerations: [{operator: Exists}]}}", true, Same),
        // A Job's.
        ("{ttlSecondsAfterFinished: 5}", true, Same),
        ("{ttlSecondsAfterFinished: null}", true, Same),
    ];
    let info = find(muster_api::API_VERSION, "Task").expect("a kind");
    let admitted = |yaml: &str| admit(&task(&read(yaml).expect(yaml))).expect("good");
    hold(rows, |yaml| {
        let mut spec: Value = read(old).expect("a spec");
        let change: Value = read(yaml).expect(yaml);
        for (field, value) in change.as_object().expect("members") {
            spec[field] = value.clone();
        }
        let new = admit(&task(&spec)).expect("good");
        admit_change(info, &admitted(old), &new).is_ok()
    });
}

/// Keys and values of labels (`validation.IsQualifiedName`, `IsValidLabelValue`): whether an object may have them.
#[test]
fn labels_of_objects() {
    let long = "a".repeat(64);
    let rows: &[Row<(&str, &str), bool>] = &[
        (("app", "cam"), true, Same),
        (("app", ""), true, Same),
        (("app.kubernetes.io/name", "Cam_1.2-a"), true, Same),
        (("App", "cam"), true, Same),
        (("app", &long[1..]), true, Same),
        (("app", &long), false, Same),
        ((&long, "cam"), false, Same),
        (("app", "a b"), false, Same),
        (("app", "-a"), false, Same),
        (("app", "a."), false, Same),
        (("", "a"), false, Same),
        (("example.dev/", "a"), false, Same),
        (("/app", "a"), false, Same),
        (("Example.dev/app", "a"), false, Same),
        (("a/b/c", "a"), false, Same),
    ];
    hold(rows, |(key, value)| {
        let mut object = task(&json!({}));
        object["metadata"]["labels"] = json!({key: value});
        admit(&object).is_ok()
    });
}
