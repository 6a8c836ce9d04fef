//! What must hold for the demo to have shown anything. Pure.

use serde::Serialize;

use super::figures::{Report, Row, kept, percent};
use super::scenario::{CLOUD, ROBOT, WORKLOADS};

/// One thing that must hold.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(super) struct Check {
    pub(super) what: &'static str,
    /// None: it could not be looked at here.
    pub(super) passed: Option<bool>,
    /// What was found.
    pub(super) found: String,
}

/// What was seen beside the rows.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Seen {
    /// Who the lease's own object says holds it, and its epoch.
    pub(super) lease: Option<(String, u64)>,
    /// Epoch of the lease when gmapping ran alone.
    pub(super) epoch_alone: Option<u64>,
    /// Millicores reserved on the robot and allocatable there, as its status says.
    pub(super) used_millis: u64,
    pub(super) allocatable_millis: u64,
}

/// A share alone may be off the paper's by this much, percent of the robot's CR.
const SHARE_TOLERANCE: f64 = 2.0;
/// Part of a workload's own throughput that must be left when it shares the robot.
const THROUGHPUT_KEPT: f64 = 0.9;
/// Cores that a task may be measured above its quota: the kernel gives quotas out by slices of 5 ms in
/// periods of 100 ms, and the samples' times are not exact.
const QUOTA_TOLERANCE: f64 = 0.03;

/// Everything that must hold.
pub(super) fn all(report: &Report, seen: &Seen) -> Vec<Check> {
    vec![
        placement(report),
        classes(report),
        lease(report, seen),
        waits(report),
        ledger(seen),
        quotas(report),
        shares(report),
        throughput(report),
    ]
}

fn check(what: &'static str, passed: bool, found: String) -> Check {
    Check { what, passed: Some(passed), found }
}

fn placement(report: &Report) -> Check {
    let expected = |row: &Row| if row.task == "training" { CLOUD } else { ROBOT };
    let rows = report.rows.iter().filter(|row| row.is_of_the_paper() || row.task == "training");
    let (mut right, mut found) = (true, Vec::new());
    for row in rows {
        let node = row.node.as_deref().unwrap_or("nowhere");
        right &= node == expected(row) && row.phase == "Running";
        found.push(format!("{} on {node}", row.task));
    }
    check("placed by distance and class", right && found.len() == 4, found.join(", "))
}

fn classes(report: &Report) -> Check {
    let mut expected: Vec<(&str, &str)> = WORKLOADS.iter().map(|w| (w.name, w.class)).collect();
    expected.push(("training", "CR"));
    let class_of = |task: &str| {
        let row = report.rows.iter().find(|row| row.task == task);
        row.map_or("none", |row| row.class.as_str())
    };
    let right = expected.iter().all(|(task, class)| class_of(task) == *class);
    let found: Vec<String> =
        expected.iter().map(|(task, _)| format!("{task} {}", class_of(task))).collect();
    check("resource classes are the paper's", right, found.join(", "))
}

fn lease(report: &Report, seen: &Seen) -> Check {
    let holders: Vec<&Row> = report.rows.iter().filter(|row| row.lease.is_some()).collect();
    let own = holders.first().and_then(|row| row.lease.as_ref());
    let right = holders.len() == 1
        && holders[0].task == "gmapping"
        && own.map(|held| ("gmapping".to_owned(), held.epoch)) == seen.lease
        && own.is_some_and(|held| seen.epoch_alone.is_some_and(|before| held.epoch > before));
    let found = match (&seen.lease, own) {
        (Some((holder, epoch)), Some(held)) => {
            let before = seen.epoch_alone.map_or_else(|| "none".to_owned(), |e| e.to_string());
            format!("{} held by {holder}, epoch {epoch}; alone it was {before}", held.name)
        }
        _ => "nobody holds it".to_owned(),
    };
    check("one driver, and the epoch grew", right, found)
}

fn waits(report: &Report) -> Check {
    let row = report.rows.iter().find(|row| row.task == "second-driver");
    let reason = row.and_then(|row| row.waits.clone());
    let right = row.is_some_and(|row| row.phase == "Pending")
        && reason.as_ref().is_some_and(|(word, _)| word == "LeaseHeld");
    let found = match (row, reason) {
        (_, Some((word, sentence))) => format!("{word}: {sentence}"),
        (Some(row), None) => format!("it is {}", row.phase),
        (None, None) => "it was not submitted".to_owned(),
    };
    check("the second driver waits for the lease", right, found)
}

fn ledger(seen: &Seen) -> Check {
    let (used, allocatable) = (seen.used_millis, seen.allocatable_millis);
    let found = format!("{used}m of {allocatable}m reserved on {ROBOT}");
    check("no more is reserved than there is", used > 0 && used <= allocatable, found)
}

fn quotas(report: &Report) -> Check {
    const WHAT: &str = "each is held to its quota";
    if report.quotas.is_none() {
        let found = "not looked at: quotas are not enforced here".to_owned();
        return Check { what: WHAT, passed: None, found };
    }
    let (mut right, mut found) = (true, Vec::new());
    for row in &report.rows {
        let Some(quota) = row.quota_millis else { continue };
        let measured = [&row.alone, &row.two, &row.three, &row.full].into_iter().flatten();
        let most = measured.filter_map(|m| m.cpu).reduce(f64::max);
        let Some(most) = most else { continue };
        right &= most <= quota as f64 / 1e3 + QUOTA_TOLERANCE;
        found.push(format!("{} {:.0}m of {quota}m", row.task, most * 1e3));
    }
    check(WHAT, right && !found.is_empty(), found.join(", "))
}

fn shares(report: &Report) -> Check {
    let (mut right, mut found) = (true, Vec::new());
    for row in report.rows.iter().filter(|row| row.is_of_the_paper()) {
        let share = row.alone.and_then(|m| m.cpu).map(|c| percent(c, report.robot_millis));
        let paper = row.paper_percent.unwrap_or_default();
        right &= share.is_some_and(|s| (s - paper).abs() <= SHARE_TOLERANCE);
        let share = share.map_or_else(|| "not measured".to_owned(), |s| format!("{s:.1} %"));
        found.push(format!("{} {share} (paper {paper} %)", row.task));
    }
    check("alone, each uses the paper's share ± 2 %", right && found.len() == 3, found.join(", "))
}

fn throughput(report: &Report) -> Check {
    let (mut right, mut found) = (true, Vec::new());
    for row in report.rows.iter().filter(|row| row.is_of_the_paper()) {
        let kept = kept(row.alone.as_ref(), row.three.as_ref());
        right &= kept.is_some_and(|k| k >= THROUGHPUT_KEPT);
        let kept =
            kept.map_or_else(|| "not measured".to_owned(), |k| format!("{:.0} %", k * 100.0));
        found.push(format!("{} {kept}", row.task));
    }
    let what = "together, each keeps 90 % of its own throughput";
    check(what, right && found.len() == 3, found.join(", "))
}

#[cfg(test)]
mod tests {
    use super::super::figures::tests::{measured, rows};
    use super::super::figures::{Held, totals};
    use super::*;

    fn good() -> (Report, Seen) {
        let mut rows = rows();
        rows[0].lease = Some(Held { name: "turtlebot-1.body".into(), epoch: 2 });
        rows[0].quota_millis = Some(250);
        rows.push(Row {
            task: "training".into(),
            class: "CR".into(),
            phase: "Running".into(),
            node: Some(CLOUD.into()),
            quota_millis: Some(300),
            three: Some(measured(0.301, 900.0)),
            ..Row::default()
        });
        rows.push(Row {
            task: "second-driver".into(),
            phase: "Pending".into(),
            waits: Some(("LeaseHeld".into(), "default/gmapping has it".into())),
            ..Row::default()
        });
        let totals = totals(&rows, ROBOT, 1000);
        let report = Report {
            quotas: Some("cgroup v1".into()),
            robot_millis: 1000,
            rows,
            totals,
            others: 0.0,
            cores: 2,
            checks: Vec::new(),
            seconds: 1.0,
        };
        let seen = Seen {
            lease: Some(("gmapping".into(), 2)),
            epoch_alone: Some(1),
            used_millis: 850,
            allocatable_millis: 1000,
        };
        (report, seen)
    }

    fn failed(report: &Report, seen: &Seen) -> Vec<&'static str> {
        all(report, seen).iter().filter(|c| c.passed != Some(true)).map(|c| c.what).collect()
    }

    #[test]
    fn a_good_run_passes() {
        let (report, seen) = good();
        assert_eq!(failed(&report, &seen), [""; 0]);
    }

    #[test]
    fn each_fault_is_found() {
        type Fault = fn(&mut Report, &mut Seen);
        let faults: [(Fault, &str); 9] = [
            (|r, _| r.rows[2].node = Some("turtlebot-2".into()), "placed by distance and class"),
            (|r, _| r.rows[1].class = "CR-SR".into(), "resource classes are the paper's"),
            (|_, s| s.lease = Some(("second-driver".into(), 3)), "one driver, and the epoch grew"),
            (|_, s| s.epoch_alone = Some(2), "one driver, and the epoch grew"),
            (|r, _| r.rows[4].waits = None, "the second driver waits for the lease"),
            (|_, s| s.used_millis = 1001, "no more is reserved than there is"),
            (|r, _| r.rows[3].three = Some(measured(0.4, 1.0)), "each is held to its quota"),
            (
                |r, _| r.rows[1].alone = Some(measured(0.16, 9.0)),
                "alone, each uses the paper's share ± 2 %",
            ),
            (
                |r, _| r.rows[1].three = Some(measured(0.131, 8.9)),
                "together, each keeps 90 % of its own throughput",
            ),
        ];
        for (fault, what) in faults {
            let (mut report, mut seen) = good();
            fault(&mut report, &mut seen);
            assert_eq!(failed(&report, &seen), [what]);
        }
    }

    #[test]
    fn quotas_that_nobody_enforces_are_not_looked_at() {
        let (mut report, seen) = good();
        report.quotas = None;
        let checks = all(&report, &seen);
        assert!(checks.iter().any(|c| c.passed.is_none()));
        assert!(checks.iter().all(|c| c.passed != Some(false)));
    }
}
