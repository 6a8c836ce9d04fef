//! Somebody who applies, changes and deletes without a pause, and remembers what was acknowledged.
//!
//! A write that is answered with success is there from then on. One that is answered with an error, or not at all, may be there
//! or not, and stays so. Short tasks end by themselves, each with a code of its own: as often as it was started, with that code.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use k8s_openapi::api::core::v1::ConfigMap;
use kube::api::{ListParams, Patch, PatchParams, PostParams};
use kube::{Api, Client};
use muster_api::kind::task::Task;
use muster_api::phase::TaskPhase;
use muster_tests::dice::Dice;
use serde_json::json;
use tokio::task::JoinHandle;
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;

use crate::house::{DEADLINE, House, PATIENCE};
use crate::report::Report;

/// Between two writes.
const PAUSE: Duration = Duration::from_millis(40);
/// Between two looks at what has ended.
const LOOK: Duration = Duration::from_millis(500);
/// Short tasks that are there at once.
const CROWD: usize = 8;
/// ConfigMaps that are changed over and over.
const COUNTERS: usize = 4;
const LABEL: &str = "chaos=short";

/// What was asked for, and what was said to it.
#[derive(Debug, Default)]
struct Book {
    tasks: BTreeMap<String, Short>,
    counters: BTreeMap<usize, Counter>,
    wrote: Wrote,
    /// What must not be, and was seen between two checks.
    broken: Vec<String>,
}

/// A task that ends by itself.
#[derive(Debug, Default)]
struct Short {
    /// None: nobody has acknowledged it.
    uid: Option<String>,
    code: i32,
    /// Somebody asked that it should go, perhaps in vain.
    leaves: bool,
    /// That was acknowledged.
    gone: bool,
    /// It was seen to have ended as it should.
    ended: bool,
}

/// Numbers that were asked for, and the last that was acknowledged.
#[derive(Debug, Default, Clone, Copy)]
struct Counter {
    asked: u64,
    kept: u64,
}

/// How much there was.
#[derive(Debug, Default, Clone, Copy)]
pub(crate) struct Wrote {
    acknowledged: u64,
    refused: u64,
    ended: u64,
}

impl fmt::Display for Wrote {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Wrote { acknowledged, refused, ended } = self;
        write!(
            f,
            "{acknowledged} writes acknowledged, {refused} refused or not answered, {ended} tasks ran to their end"
        )
    }
}

/// The writer, and its book.
pub(crate) struct Writer {
    book: Arc<Mutex<Book>>,
    client: Client,
    starts: PathBuf,
    stop: CancellationToken,
    task: JoinHandle<()>,
}

impl Writer {
    pub(crate) async fn begin(house: &House) -> Writer {
        let (book, stop) = (Arc::new(Mutex::new(Book::default())), CancellationToken::new());
        let starts = house.witness.join("short");
        let pen = Pen { client: house.client.clone(), starts: starts.clone(), book: book.clone() };
        for n in 0..COUNTERS {
            pen.make_counter(n).await;
        }
        let stopped = stop.clone();
        let task = tokio::spawn(async move {
            tokio::select! {
                () = pen.write() => {}
                () = pen.read() => {}
                () = stopped.cancelled() => {}
            }
        });
        Writer { book, client: house.client.clone(), starts, stop, task }
    }

    /// Everything that was acknowledged is there, and nothing that was acknowledged to be gone.
    pub(crate) async fn check(&self, report: &mut Report) {
        // What is asked for while the list is on its way may be in it or not.
        let (mut there, mut away) = (Vec::new(), Vec::new());
        {
            let book = self.book.lock().expect("nobody panics with it");
            for (name, short) in &book.tasks {
                if let (Some(uid), false) = (&short.uid, short.leaves) {
                    there.push((name.clone(), uid.clone()));
                } else if short.gone {
                    away.push(name.clone());
                }
            }
        }
        let begun = Instant::now();
        loop {
            let found = list(&self.client).await;
            let lost: Vec<_> = {
                let book = self.book.lock().expect("nobody panics with it");
                let still = |name: &String| book.tasks.get(name).is_some_and(|s| !s.leaves);
                let missing = there.iter().filter(|(name, _)| still(name));
                let missing = missing.filter(|(name, uid)| {
                    found.get(name).is_none_or(|t| t.metadata.uid.as_ref() != Some(uid))
                });
                missing.map(|(name, _)| name.clone()).collect()
            };
            for name in lost {
                report.broken(format!("{name} was acknowledged, and is not there"));
                self.book.lock().expect("nobody panics with it").tasks.remove(&name);
            }
            look(&self.book, &self.starts, &found);
            let left = away.iter().find(|name| found.contains_key(*name));
            let Some(left) = left else { break };
            if begun.elapsed() > DEADLINE {
                report.broken(format!("{left} was deleted, and is there after {DEADLINE:?}"));
                break;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        let broken = {
            let mut book = self.book.lock().expect("nobody panics with it");
            for name in away {
                book.tasks.remove(&name);
            }
            std::mem::take(&mut book.broken)
        };
        broken.into_iter().for_each(|how| report.broken(how));
        self.check_counters(report).await;
    }

    async fn check_counters(&self, report: &mut Report) {
        let maps: Api<ConfigMap> = Api::namespaced(self.client.clone(), "default");
        for n in 0..COUNTERS {
            let kept = self.book.lock().expect("nobody panics with it").counters[&n].kept;
            let begun = Instant::now();
            let map = loop {
                let name = format!("counter-{n}");
                match tokio::time::timeout(PATIENCE, maps.get(&name)).await {
                    Ok(Ok(map)) => break map,
                    other => assert!(begun.elapsed() < DEADLINE, "no {name}: {other:?}"),
                }
            };
            let read = map.data.as_ref().and_then(|data| data.get("n")?.parse::<u64>().ok());
            let asked = self.book.lock().expect("nobody panics with it").counters[&n].asked;
            if read.is_none_or(|read| read < kept || read > asked) {
                report.broken(format!(
                    "counter-{n} is {read:?}; {kept} was acknowledged, {asked} asked for"
                ));
            }
        }
    }

    /// Writes no more, and waits until every short task has ended.
    pub(crate) async fn end(self, report: &mut Report) -> Wrote {
        self.stop.cancel();
        let begun = Instant::now();
        loop {
            self.check(report).await;
            let waits = |found: &BTreeMap<String, Task>| {
                found
                    .iter()
                    .find(|(_, task)| {
                        !task.status.as_ref().is_some_and(|status| status.phase.is_terminal())
                    })
                    .map(|(name, task)| format!("{name}: {:?}", task.status))
            };
            let Some(waits) = waits(&list(&self.client).await) else { break };
            if begun.elapsed() > DEADLINE {
                report.broken(format!("not ended {DEADLINE:?} after the last fault: {waits}"));
                break;
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        self.check(report).await;
        let _ = self.task.await;
        self.book.lock().expect("nobody panics with it").wrote
    }
}

/// All short tasks, as soon as the controller says.
async fn list(client: &Client) -> BTreeMap<String, Task> {
    let tasks: Api<Task> = Api::namespaced(client.clone(), "default");
    let (begun, wanted) = (Instant::now(), ListParams::default().labels(LABEL));
    loop {
        match tokio::time::timeout(PATIENCE, tasks.list(&wanted)).await {
            Ok(Ok(list)) => {
                let named = |task: Task| Some((task.metadata.name.clone()?, task));
                return list.items.into_iter().filter_map(named).collect();
            }
            other => assert!(begun.elapsed() < DEADLINE, "no list of tasks: {other:?}"),
        }
    }
}

/// Those that have ended did so as they were made to.
fn look(book: &Mutex<Book>, starts: &Path, found: &BTreeMap<String, Task>) {
    let starts = std::fs::read_to_string(starts).unwrap_or_default();
    let mut book = book.lock().expect("nobody panics with it");
    for (name, task) in found {
        let Some(short) = book.tasks.get_mut(name) else { continue };
        let ended = task.status.as_ref().filter(|status| status.phase.is_terminal());
        let Some(status) = ended.filter(|_| task.metadata.deletion_timestamp.is_none()) else {
            continue;
        };
        if std::mem::replace(&mut short.ended, true) {
            continue;
        }
        let code = short.code;
        book.wrote.ended += 1;
        let phase = if code == 0 { TaskPhase::Succeeded } else { TaskPhase::Failed };
        if (status.phase, status.exit_code) != (phase, Some(code)) {
            let told = (status.phase, status.exit_code, &status.reason, &status.message);
            book.broken.push(format!("{name} ends with {code}, and is told as {told:?}"));
        }
        let uid = task.metadata.uid.as_deref().unwrap_or_default();
        let times = starts.lines().filter(|line| line.split(' ').next() == Some(uid)).count();
        if times != 1 {
            book.broken.push(format!("{name} ({uid}) was started {times} times"));
        }
    }
}

/// What writes.
struct Pen {
    client: Client,
    starts: PathBuf,
    book: Arc<Mutex<Book>>,
}

impl Pen {
    async fn write(&self) {
        let mut dice = Dice::new(42);
        let mut ticks = tokio::time::interval(PAUSE);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        for number in 0_u64.. {
            ticks.tick().await;
            match dice.below(4) {
                0 => self.count(dice.below(COUNTERS)).await,
                1 => self.delete(&mut dice).await,
                _ => self.create(number, &mut dice).await,
            }
        }
    }

    /// Looks at what has ended; others can take its place then.
    async fn read(&self) {
        let mut ticks = tokio::time::interval(LOOK);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            look(&self.book, &self.starts, &list(&self.client).await);
        }
    }

    fn tally(&self, acknowledged: bool) {
        let mut book = self.book.lock().expect("nobody panics with it");
        let tally = &mut book.wrote;
        *if acknowledged { &mut tally.acknowledged } else { &mut tally.refused } += 1;
    }

    async fn make_counter(&self, n: usize) {
        let maps: Api<ConfigMap> = Api::namespaced(self.client.clone(), "default");
        let map = json!({"metadata": {"name": format!("counter-{n}")}, "data": {"n": "0"}});
        let map: ConfigMap = serde_json::from_value(map).expect("a ConfigMap");
        maps.create(&PostParams::default(), &map).await.expect("nothing is broken yet");
        self.book.lock().expect("nobody panics with it").counters.insert(n, Counter::default());
    }

    async fn count(&self, n: usize) {
        let maps: Api<ConfigMap> = Api::namespaced(self.client.clone(), "default");
        let next = {
            let mut book = self.book.lock().expect("nobody panics with it");
            let counter = book.counters.get_mut(&n).expect("it was made");
            counter.asked += 1;
            counter.asked
        };
        let patch = Patch::Merge(json!({"data": {"n": next.to_string()}}));
        let (name, params) = (format!("counter-{n}"), PatchParams::default());
        let asked = maps.patch(&name, &params, &patch);
        let kept = matches!(tokio::time::timeout(PATIENCE, asked).await, Ok(Ok(_)));
        if kept {
            let mut book = self.book.lock().expect("nobody panics with it");
            book.counters.get_mut(&n).expect("it was made").kept = next;
        }
        self.tally(kept);
    }

    async fn create(&self, number: u64, dice: &mut Dice) {
        let name = format!("short-{number}");
        let code =
            if dice.below(3) == 0 { i32::try_from(dice.below(90)).unwrap_or(0) + 1 } else { 0 };
        {
            let mut book = self.book.lock().expect("nobody panics with it");
            if book.tasks.values().filter(|short| !short.ended && !short.gone).count() >= CROWD {
                return;
            }
            book.tasks.insert(name.clone(), Short { code, ..Short::default() });
        }
        let nap = dice.below(1_500) as f64 / 1e3;
        let starts = self.starts.display();
        let script =
            format!("echo $MUSTER_UID $MUSTER_ATTEMPT >>{starts}; sleep {nap}; exit {code}");
        let node = *["robot-1", "robot-2", "cloud-1"].get(dice.below(3)).expect("of three");
        let task = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Task",
            "metadata": {"name": name, "labels": {"chaos": "short"}},
            "spec": {
                "placement": {"node": node}, "resources": {"cpu": "10m"}, "gracePeriodSeconds": 0,
                "onDisconnect": {"policy": "Keep"}, "restartPolicy": "Never",
                "run": {"process": {"command": ["sh", "-c", script]}},
            },
        });
        let task: Task = serde_json::from_value(task).expect("a task");
        let tasks: Api<Task> = Api::namespaced(self.client.clone(), "default");
        let params = PostParams::default();
        let made = tokio::time::timeout(PATIENCE, tasks.create(&params, &task)).await;
        let uid = made.ok().and_then(Result::ok).and_then(|task| task.metadata.uid);
        self.tally(uid.is_some());
        let mut book = self.book.lock().expect("nobody panics with it");
        book.tasks.get_mut(&name).expect("it was entered").uid = uid;
    }

    /// One that has ended, or one that has not.
    async fn delete(&self, dice: &mut Dice) {
        let name = {
            let mut book = self.book.lock().expect("nobody panics with it");
            let mut there: Vec<_> =
                book.tasks.iter_mut().filter(|(_, s)| s.uid.is_some() && !s.leaves).collect();
            // Most are left to run to their end.
            there.retain(|(_, short)| short.ended || dice.below(8) == 0);
            let at = dice.below(there.len());
            let Some((name, short)) = there.into_iter().nth(at) else { return };
            short.leaves = true;
            name.clone()
        };
        let tasks: Api<Task> = Api::namespaced(self.client.clone(), "default");
        let params = kube::api::DeleteParams::default();
        let asked = tokio::time::timeout(PATIENCE, tasks.delete(&name, &params)).await;
        let gone = matches!(asked, Ok(Ok(_)));
        self.tally(gone);
        let mut book = self.book.lock().expect("nobody panics with it");
        book.tasks.get_mut(&name).expect("it was entered").gone = gone;
    }
}
