//! The course of events: each workload alone (Fig. 2), then two, then three together (Fig. 5), with a task
//! for the cloud and one that must wait, then as many more users of the camera as the robot takes.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use muster_api::condition::{ConditionStatus, QUOTAS_ENFORCED};
use muster_api::kind::lease::{DEFAULT_GROUP, LeaseSpec};
use muster_api::kind::node::Node;
use muster_api::kind::task::Task;
use muster_api::phase::TaskPhase;
use serde_json::Value;

use super::api::Api;
use super::check::{self, Seen};
use super::figures::{Held, Report, Row, percent, totals};
use super::house::House;
use super::measure::{Found, Measured, lines, measure};
use super::print::{BUSY, Out};
use super::scenario::{self, NODES, ROBOT, WORKLOADS};
use super::{Args, DemoError, verdict};
use crate::error::CliError;

/// An agent joins and a task starts within a second on a machine that is not busy.
const LIMIT: Duration = Duration::from_secs(30);
/// After its calibration a workload's rate still settles for a few of its windows of a second.
const SETTLE: Duration = Duration::from_secs(3);
/// How often at most something is measured while others use the machine; the measurement that they disturbed least counts.
const MEASUREMENTS: usize = 3;
/// No robot has more cores than this many users of a camera need.
const MOST_USERS: usize = 8;

/// The demo while it runs.
struct Play<'a, 'u> {
    house: &'a mut House,
    out: &'a mut Out<'u>,
    api: Api,
    window: Duration,
    rows: BTreeMap<String, Row>,
    /// Rows in the order in which tasks came.
    order: Vec<String>,
    seen: Seen,
    robot_millis: u64,
    /// Most cores that others of this machine used during a measurement.
    others: f64,
}

/// What is measured, as a field of a row.
type Slot = fn(&mut Row) -> &mut Option<Measured>;

/// Plays it. Returns the exit code.
pub(super) async fn play(
    args: &Args,
    house: &mut House,
    out: &mut Out<'_>,
) -> Result<u8, CliError> {
    let begin = Instant::now();
    out.doing("starting a controller, two robots and a cloud server");
    let api = house.start_controller().await?;
    let token = api.token().await?;
    for plan in &NODES {
        house.start_agent(plan, api.server(), &token)?;
    }
    let mut play = Play {
        house,
        out,
        api,
        window: Duration::from_secs(args.measure),
        rows: BTreeMap::new(),
        order: Vec::new(),
        seen: Seen::default(),
        robot_millis: 0,
        others: 0.0,
    };
    let quotas = play.nodes_join().await?;
    play.alone().await?;
    play.two().await?;
    play.three(quotas.is_some()).await?;
    play.more().await?;
    play.look_at_the_books().await?;
    let mut report = play.report(quotas);
    report.seconds = begin.elapsed().as_secs_f64();
    let seen = std::mem::take(&mut play.seen);
    report.checks = check::all(&report, &seen);
    play.out.report(&report)?;
    if !args.once {
        play.stay().await?;
    }
    Ok(verdict(&report.checks))
}

impl Play<'_, '_> {
    /// Waits for all nodes. Returns how quotas are enforced, if they are.
    async fn nodes_join(&mut self) -> Result<Option<String>, CliError> {
        let mut nodes = Vec::new();
        for plan in &NODES {
            let api = self.api.clone();
            let ready = async || {
                let node = api.node(plan.name).await?;
                Ok(node.filter(|n| n.status.as_ref().is_some_and(|s| s.is_ready())))
            };
            let what = format!("node {} to be ready", plan.name);
            nodes.push(self.house.wait(&what, LIMIT, ready).await?);
        }
        let status = nodes[0].status.clone().unwrap_or_default();
        self.robot_millis = status.allocatable.cpu.0;
        let quotas = enforcement(&nodes[0]);
        self.out.first_line(&quotas)?;
        for node in &nodes {
            self.out.node(node)?;
        }
        Ok(quotas.ok())
    }

    /// Each workload alone on the robot, one after the other.
    async fn alone(&mut self) -> Result<(), CliError> {
        for workload in &WORKLOADS {
            let name = self.submit(&workload.alone()).await?;
            let task = self.running(&name).await?;
            let lease = task.status.as_ref().and_then(|s| s.lease.as_ref());
            if let Some(lease) = lease {
                self.seen.epoch_alone = Some(lease.epoch.0);
            }
            let what = format!("{} alone", workload.name);
            let found = self.measure(&[task], &what, self.window).await?;
            let measured = found.tasks.get(&name).copied().unwrap_or_default();
            self.end(&name).await?;
            self.out.measured(workload.name, "alone", &measured, self.robot_millis)?;
            let row = self.row(workload.name);
            row.alone = Some(measured);
        }
        Ok(())
    }

    /// The first 165 s of Fig. 5, in short; and somebody who wants the base, too.
    async fn two(&mut self) -> Result<(), CliError> {
        let tasks = self.start_all(&[WORKLOADS[0].task(), WORKLOADS[1].task()]).await?;
        self.submit(&scenario::second_driver()).await?;
        let found = self.measure(&tasks, "two together", self.short_window()).await?;
        self.note(found, "two", |row| &mut row.two)
    }

    /// Fig. 5 after 165 s.
    async fn three(&mut self, enforced: bool) -> Result<(), CliError> {
        let training = scenario::training(enforced);
        let mut tasks = self.start_all(&[WORKLOADS[2].task(), training]).await?;
        for workload in &WORKLOADS[..2] {
            tasks.extend(self.api.task(workload.name).await?);
        }
        let found = self.measure(&tasks, "three together", self.window).await?;
        self.note(found, "three", |row| &mut row.three)
    }

    /// The sensor is shared by any number: more users of it, until the ledger says that the robot is full.
    async fn more(&mut self) -> Result<(), CliError> {
        let mut placed = Vec::new();
        for number in 2..2 + MOST_USERS {
            let name = self.submit(&scenario::more_monitoring(number)).await?;
            let status = self.decided(&name).await?.status;
            if status.is_some_and(|s| s.phase == TaskPhase::Pending) {
                break;
            }
            placed.push(name);
        }
        let mut tasks = Vec::new();
        for name in &placed {
            tasks.push(self.running(name).await?);
        }
        for name in self.order.clone() {
            if self.rows.get(&name).is_some_and(|row| row.three.is_some()) {
                tasks.extend(self.api.task(&name).await?);
            }
        }
        let what = "more users of the camera";
        let found = self.measure(&tasks, what, self.short_window()).await?;
        self.note(found, "full", |row| &mut row.full)
    }

    /// For what the paper's ratios do not need.
    fn short_window(&self) -> Duration {
        self.window.mul_f64(0.7).max(Duration::from_secs(2))
    }

    /// Submits tasks, in order, and waits until all of them run and have calibrated themselves.
    async fn start_all(&mut self, tasks: &[Value]) -> Result<Vec<Task>, CliError> {
        let mut names = Vec::new();
        for task in tasks {
            names.push(self.submit(task).await?);
        }
        let mut running = Vec::new();
        for name in names {
            running.push(self.running(&name).await?);
        }
        Ok(running)
    }

    async fn submit(&mut self, task: &Value) -> Result<String, CliError> {
        let created = self.api.create(task).await?;
        let name = created.metadata.name.unwrap_or_default();
        if !name.ends_with("-alone") {
            self.row(&name);
        }
        Ok(name)
    }

    async fn running(&mut self, name: &str) -> Result<Task, CliError> {
        self.out.doing(&format!("{name} starts"));
        let api = self.api.clone();
        let ready = async || {
            let Some(task) = api.task(name).await? else { return Ok(None) };
            let status = task.status.clone().unwrap_or_default();
            if status.phase.is_terminal() {
                return Err(ended(name, &task, &api).await?);
            }
            let begun =
                status.phase == TaskPhase::Running && !lines(&api.log(name, 3).await?).is_empty();
            Ok(begun.then_some(task))
        };
        let what = format!("task {name} to run and to calibrate itself");
        self.house.wait(&what, LIMIT, ready).await
    }

    /// Waits until the scheduler has placed a task or said why not.
    async fn decided(&mut self, name: &str) -> Result<Task, CliError> {
        let api = self.api.clone();
        let decided = async || {
            let task = api.task(name).await?;
            Ok(task.filter(|t| {
                let status = t.status.as_ref();
                status.is_some_and(|s| s.phase != TaskPhase::Pending || !s.why.is_empty())
            }))
        };
        self.house.wait(&format!("a decision about task {name}"), LIMIT, decided).await
    }

    async fn end(&mut self, name: &str) -> Result<(), CliError> {
        self.api.delete(name).await?;
        let api = self.api.clone();
        let gone = async || Ok(api.task(name).await?.is_none().then_some(()));
        self.house.wait(&format!("task {name} to end"), LIMIT, gone).await
    }

    async fn measure(
        &mut self,
        tasks: &[Task],
        what: &str,
        window: Duration,
    ) -> Result<Found, CliError> {
        let ids: Vec<(String, String)> = tasks
            .iter()
            .filter_map(|t| Some((t.metadata.name.clone()?, t.metadata.uid.clone()?)))
            .collect();
        self.out.doing(&format!("{what}: settling"));
        tokio::time::sleep(SETTLE).await;
        let mut best = self.measure_once(&ids, what, window).await?;
        for _ in 1..MEASUREMENTS {
            if best.others <= BUSY {
                break;
            }
            self.out.disturbed(what, best.others)?;
            let again = self.measure_once(&ids, what, window).await?;
            if again.others < best.others {
                best = again;
            }
        }
        self.others = self.others.max(best.others);
        Ok(best)
    }

    async fn measure_once(
        &mut self,
        ids: &[(String, String)],
        what: &str,
        window: Duration,
    ) -> Result<Found, CliError> {
        let (out, robot) = (&mut *self.out, self.robot_millis);
        let seconds = window.as_secs();
        measure(&self.api, ids, window, |shares| {
            let sum: f64 = shares.values().sum();
            out.doing(&format!("{what}: measuring {seconds} s, {:.1} %", percent(sum, robot)));
        })
        .await
    }

    /// Puts what was measured into the rows.
    fn note(&mut self, found: Found, when: &str, slot: Slot) -> Result<(), CliError> {
        for name in self.order.clone() {
            let Some(measured) = found.tasks.get(&name) else { continue };
            self.out.measured(&name, when, measured, self.robot_millis)?;
            *slot(self.row(&name)) = Some(*measured);
        }
        Ok(())
    }

    fn row(&mut self, name: &str) -> &mut Row {
        if !self.rows.contains_key(name) {
            self.order.push(name.to_owned());
        }
        self.rows.entry(name.to_owned()).or_insert_with(|| Row {
            task: name.to_owned(),
            paper_percent: WORKLOADS.iter().find(|w| w.name == name).map(|w| w.paper_percent),
            ..Row::default()
        })
    }

    /// What the controller's own objects say of all this, while everything runs.
    async fn look_at_the_books(&mut self) -> Result<(), CliError> {
        self.decided("second-driver").await?;
        for name in self.order.clone() {
            if let Some(task) = self.api.task(&name).await? {
                describe(self.row(&name), &task);
            }
        }
        let lease = LeaseSpec::object_name(ROBOT, DEFAULT_GROUP);
        let status = self.api.lease(&lease).await?.and_then(|l| l.status);
        self.seen.lease = status.and_then(|s| Some((s.holder?.name, s.epoch.0)));
        let node = self.api.node(ROBOT).await?.and_then(|n| n.status).unwrap_or_default();
        self.seen.used_millis = node.used.cpu.0;
        self.seen.allocatable_millis = node.allocatable.cpu.0;
        Ok(())
    }

    fn report(&self, quotas: Option<String>) -> Report {
        let rows: Vec<Row> = self.order.iter().filter_map(|n| self.rows.get(n).cloned()).collect();
        let totals = totals(&rows, ROBOT, self.robot_millis);
        let (robot_millis, others) = (self.robot_millis, self.others);
        let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
        Report { quotas, robot_millis, rows, totals, others, cores, checks: vec![], seconds: 0.0 }
    }

    /// Until somebody ends it.
    async fn stay(&mut self) -> Result<(), CliError> {
        self.out.invite(&self.house.kubeconfig())?;
        loop {
            let mut tasks = Vec::new();
            for name in self.api.task_names().await? {
                tasks.extend(self.api.task(&name).await?);
            }
            let ids: Vec<(String, String)> = tasks
                .iter()
                .filter_map(|t| Some((t.metadata.name.clone()?, t.metadata.uid.clone()?)))
                .collect();
            let found = measure(&self.api, &ids, self.out.view_period(), |_| {}).await?;
            self.out.view(&tasks, &found.tasks)?;
        }
    }
}

/// Fills in what a task's object says.
fn describe(row: &mut Row, task: &Task) {
    let status = task.status.clone().unwrap_or_default();
    row.class = task.spec.resources.class();
    row.phase = status.phase.to_string();
    row.node = status.node;
    row.score = status.score;
    row.lease = status.lease.map(|lease| Held { name: lease.name, epoch: lease.epoch.0 });
    row.quota_millis = task.spec.resources.cpu.map(|cpu| cpu.0);
    // Of the robot that matters here; `muster why` tells of all.
    let refusal = status.why.iter().find(|why| why.node == ROBOT).or_else(|| status.why.first());
    row.waits = refusal
        .filter(|_| status.phase == TaskPhase::Pending)
        .map(|why| (why.reason.clone(), why.message.clone()));
}

/// How a node enforces quotas, or why it does not.
fn enforcement(node: &Node) -> Result<String, String> {
    let status = node.status.clone().unwrap_or_default();
    match status.condition(QUOTAS_ENFORCED) {
        Some(condition) if condition.status == ConditionStatus::True => {
            Ok(condition.reason.clone())
        }
        Some(condition) => Err(condition.message.clone()),
        None => Err("the node does not say".to_owned()),
    }
}

/// The error of a task that should run and has ended.
async fn ended(name: &str, task: &Task, api: &Api) -> Result<CliError, CliError> {
    let status = task.status.clone().unwrap_or_default();
    let log = api.log(name, 5).await?;
    let reason = format!("{} {}\n{log}", status.reason, status.message).trim().to_owned();
    Ok(DemoError::TaskEnded { name: name.to_owned(), reason }.into())
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_row_tells_of_the_robot_that_matters() {
        let task = json!({
            "apiVersion": muster_api::API_VERSION, "kind": "Task", "metadata": {"name": "t"},
            "spec": {"run": {"process": {"command": ["a"]}}, "resources": {"cpu": "50m"}},
            "status": {"phase": "Pending", "why": [
                {"node": "cloud-1", "reason": "WrongKind", "message": "a server"},
                {"node": ROBOT, "reason": "LeaseHeld", "message": "held"},
            ]},
        });
        let mut row = Row::default();
        describe(&mut row, &serde_json::from_value(task).expect("a task"));
        assert_eq!(row.waits, Some(("LeaseHeld".into(), "held".into())));
        assert_eq!((row.phase.as_str(), row.class.as_str()), ("Pending", "CR"));
        assert_eq!(row.quota_millis, Some(50));
    }

    #[test]
    fn a_node_says_how_quotas_are_enforced() {
        let node = |condition: Value| -> Node {
            serde_json::from_value(json!({
                "apiVersion": muster_api::API_VERSION, "kind": "Node", "metadata": {"name": "n"},
                "spec": {"kind": "Robot"}, "status": {"conditions": [condition]},
            }))
            .expect("a node")
        };
        let yes = node(json!({"type": QUOTAS_ENFORCED, "status": "True", "reason": "CgroupV2"}));
        assert_eq!(enforcement(&yes), Ok("CgroupV2".to_owned()));
        let no = node(json!({"type": QUOTAS_ENFORCED, "status": "False", "message": "not root"}));
        assert_eq!(enforcement(&no), Err("not root".to_owned()));
    }
}
