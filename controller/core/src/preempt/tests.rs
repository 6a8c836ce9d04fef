use muster_api::kind::node::NodeKind;
use muster_api::kind::task::TaskSpec;
use muster_api::quantity::{Bytes, MilliCpu};
use proptest::prelude::*;
use serde_json::json;

use super::*;
use crate::fixtures::{name, node};
use crate::ledger::Standing;
use crate::schedule::{Bind, schedule};

fn demand(uid: &str, priority: i32, cpu: u64, drives: bool) -> Demand {
    let actuators: &[&str] = if drives { &["base:Drive"] } else { &[] };
    let spec = json!({
        "priority": priority,
        "placement": {"on": "Robot"},
        "resources": {"cpu": format!("{cpu}m"), "actuators": actuators},
        "run": {"process": {"command": ["true"]}},
    });
    let spec: TaskSpec = serde_json::from_value(spec).expect("a spec");
    let title = format!("default/{uid}").into();
    Demand {
        uid: TaskUid::new(uid),
        title,
        spec: Arc::new(spec),
        since: 0,
        avoid: Arc::default(),
        framework: None,
    }
}

fn cluster(robots: &[(&str, u64)]) -> Cluster {
    let mut cluster = Cluster::new();
    for (robot, cpu) in robots {
        cluster.upsert_node(&name(robot), &node(NodeKind::Robot, *cpu, Some((0.0, 0.0))));
    }
    cluster
}

fn bound(cluster: &mut Cluster, demand: Demand) -> Bind {
    let mut plan = schedule(cluster, &mut [demand]);
    assert_eq!((plan.binds.len(), plan.preemptions.len()), (1, 0));
    plan.binds.remove(0)
}

fn victims_of(preemption: &Preemption) -> Vec<&str> {
    preemption.victims.iter().map(|v| v.uid.as_str()).collect()
}

#[test]
fn a_lease_passes_on_when_its_holder_is_gone_and_not_before() {
    let mut cluster = cluster(&[("r1", 1000)]);
    bound(&mut cluster, demand("old", 0, 100, true));
    let urgent = || demand("urgent", 5, 100, true);
    let plan = schedule(&mut cluster, &mut [urgent()]);
    assert_eq!(plan.binds, []);
    assert_eq!(victims_of(&plan.preemptions[0]), ["old"]);
    assert_eq!(
        (plan.waits[0].why[0].reason.as_str(), plan.waits[0].why[0].node.as_str()),
        ("Preempting", "r1")
    );
    assert!(plan.waits[0].why[0].message.contains("default/old"), "{:?}", plan.waits);
    // Another pass, while it ends: nobody more, and nothing for those who came later.
    let plan = schedule(&mut cluster, &mut [urgent(), demand("later", 5, 100, true)]);
    assert_eq!(plan.binds, []);
    assert_eq!(plan.preemptions.len(), 1, "the later one of the same priority waits: {plan:?}");
    assert_eq!(victims_of(&plan.preemptions[0]), [""; 0]);
    cluster.release(&TaskUid::new("old"));
    let plan = schedule(&mut cluster, &mut [demand("later", 5, 100, true)]);
    assert_eq!(plan.binds, [], "kept for the urgent one");
    assert_eq!(plan.waits[0].why[0].reason, "KeptForAnother");
    let bind = bound(&mut cluster, urgent());
    assert_eq!(bind.leases.len(), 1);
}

#[test]
fn what_is_freed_bit_by_bit_is_kept() {
    let mut cluster = cluster(&[("r1", 1000)]);
    for uid in ["a", "b"] {
        bound(&mut cluster, demand(uid, 0, 500, false));
    }
    let plan = schedule(&mut cluster, &mut [demand("big", 1, 1000, false)]);
    assert_eq!(victims_of(&plan.preemptions[0]), ["a", "b"]);
    cluster.release(&TaskUid::new("a"));
    let plan = schedule(&mut cluster, &mut [demand("small", 0, 100, false)]);
    assert_eq!(plan.binds, []);
    cluster.release(&TaskUid::new("b"));
    bound(&mut cluster, demand("big", 1, 1000, false));
    assert_eq!(cluster.nomination(&TaskUid::new("big")), None);
}

/// Two that ask the same, of which the later one is nominated: that the earlier one waits says nothing of it.
#[test]
fn a_nominated_task_is_looked_at_for_itself() {
    let mut cluster = cluster(&[("r1", 1000)]);
    bound(&mut cluster, demand("old", 0, 100, true));
    let second = || Demand { since: 2, ..demand("second", 5, 100, true) };
    let first = || Demand { since: 1, ..demand("first", 5, 100, true) };
    let plan = schedule(&mut cluster, &mut [second()]);
    assert_eq!(plan.preemptions.len(), 1);
    let plan = schedule(&mut cluster, &mut [first(), second()]);
    assert_eq!(plan.preemptions.len(), 1, "{plan:?}");
    assert_eq!(plan.preemptions[0].uid, TaskUid::new("second"));
    cluster.release(&TaskUid::new("old"));
    let plan = schedule(&mut cluster, &mut [first(), second()]);
    assert_eq!(plan.binds.len(), 1);
    assert_eq!(plan.binds[0].uid, TaskUid::new("second"));
}

#[test]
fn what_is_kept_follows_the_priority_of_its_task() {
    let mut cluster = cluster(&[("r1", 1000)]);
    for uid in ["a", "b"] {
        bound(&mut cluster, demand(uid, 0, 500, false));
    }
    assert_eq!(schedule(&mut cluster, &mut [demand("big", 9, 1000, false)]).preemptions.len(), 1);
    cluster.release(&TaskUid::new("a"));
    // Its owner thinks better of it.
    let mut both = [demand("big", 1, 1000, false), demand("small", 5, 400, false)];
    assert_eq!(schedule(&mut cluster, &mut both).binds, [], "kept with priority 9 in this pass");
    let plan = schedule(&mut cluster, &mut both);
    assert_eq!(plan.binds.len(), 1);
    assert_eq!(plan.binds[0].uid, TaskUid::new("small"));
}

#[test]
fn nobody_is_ended_for_room_that_the_quota_does_not_allow() {
    let mut cluster = cluster(&[("r1", 1000), ("r2", 1000)]);
    for uid in ["a", "b"] {
        bound(&mut cluster, demand(uid, 0, 100, true));
    }
    let quota = serde_json::from_value(json!({"hard": {"leases": 3}})).expect("a quota");
    cluster.set_quota("default", Some(quota));
    let plan = schedule(&mut cluster, &mut [demand("x", 5, 100, true), demand("y", 5, 100, true)]);
    assert_eq!(plan.preemptions.len(), 1, "{plan:?}");
    assert!(plan.waits.iter().any(|w| w.why[0].reason == "QuotaExceeded"), "{plan:?}");
}

#[test]
fn work_does_not_end_its_own_executor() {
    let mut cluster = cluster(&[("r1", 1000)]);
    bound(&mut cluster, demand("executor", 0, 800, false));
    let mut work = demand("work", 5, 500, false);
    let spec = Arc::make_mut(&mut work.spec);
    spec.run = serde_json::from_value(json!({"executor": {"task": "executor"}})).expect("a run");
    let plan = schedule(&mut cluster, &mut [work]);
    assert_eq!((plan.binds.len(), plan.preemptions), (0, vec![]));
}

#[test]
fn who_may_not_preempt_waits_and_equals_are_spared() {
    let mut cluster = cluster(&[("r1", 1000)]);
    bound(&mut cluster, demand("a", 3, 800, false));
    let plan = schedule(&mut cluster, &mut [demand("equal", 3, 500, false)]);
    assert_eq!(plan.preemptions, []);
    let mut never = demand("never", 9, 500, false);
    Arc::make_mut(&mut never.spec).preemption = task::Preemption::Never;
    let plan = schedule(&mut cluster, &mut [never]);
    assert_eq!((plan.preemptions, plan.waits.len()), (vec![], 1));
    // And nobody is ended where that would not help.
    let plan = schedule(&mut cluster, &mut [demand("giant", 9, 1500, false)]);
    assert_eq!(plan.preemptions, []);
}

#[test]
fn a_task_that_fits_elsewhere_meanwhile_goes_there() {
    let mut cluster = cluster(&[("r1", 1000)]);
    bound(&mut cluster, demand("a", 0, 800, false));
    let plan = schedule(&mut cluster, &mut [demand("urgent", 1, 500, false)]);
    assert_eq!(plan.preemptions.len(), 1);
    cluster.upsert_node(&name("r2"), &node(NodeKind::Robot, 1000, Some((9.0, 0.0))));
    assert_eq!(bound(&mut cluster, demand("urgent", 1, 500, false)).node, name("r2"));
    assert_eq!(cluster.nomination(&TaskUid::new("urgent")), None);
    cluster.release(&TaskUid::new("a"));
    bound(&mut cluster, demand("small", 0, 900, false));
}

/// One that holds something of a node.
#[derive(Debug, Clone)]
struct Holder {
    cpu: u64,
    memory: u64,
    priority: i32,
    stopping: bool,
    /// It is work for this one's executor.
    work_of: Option<usize>,
}

fn holder() -> impl Strategy<Value = Holder> {
    (
        0..5_u64,
        0..4_u64,
        0..4_i32,
        0..6_u8,
        prop_oneof![4 => Just(None), 1 => (0..6_usize).prop_map(Some)],
    )
        .prop_map(|(cpu, memory, priority, stopping, work_of)| Holder {
            cpu: cpu * 100,
            memory: memory << 20,
            priority,
            stopping: stopping == 0,
            work_of,
        })
}

fn uid(n: usize) -> TaskUid {
    TaskUid::new(format!("t{n}"))
}

/// Books the holders as they are; the first one that is nobody's work drives, if `driven`.
fn crowded(holders: &[Holder], driven: bool) -> Cluster {
    let mut cluster = Cluster::new();
    let mut robot = node(NodeKind::Robot, 1000, Some((0.0, 0.0)));
    robot.status.as_mut().expect("a status").allocatable =
        Compute::new(MilliCpu(1000), Bytes(10 << 20));
    cluster.upsert_node(&name("r1"), &robot);
    for (n, holder) in holders.iter().enumerate() {
        let executor = holder.work_of.filter(|e| *e < n && holders[*e].work_of.is_none());
        let reservation = Reservation {
            title: format!("default/t{n}").into(),
            compute: Compute::new(MilliCpu(holder.cpu), Bytes(holder.memory)),
            standing: Standing {
                priority: holder.priority,
                stopping: holder.stopping,
                executor: executor.map(|e| format!("default/t{e}").into()),
            },
            ..Reservation::default()
        };
        cluster.book(&uid(n), &name("r1"), reservation);
    }
    if driven && !holders.is_empty() {
        cluster.set_lease(&name("r1"), "body", muster_api::id::Epoch(1), Some(uid(0)));
    }
    cluster
}

/// What the rules say, by looking at every set of holders.
fn by_brute_force(
    holders: &[Holder],
    driven: bool,
    (priority, cpu, memory, drives): (i32, u64, u64, bool),
) -> Option<Harm> {
    let works = |e: usize| {
        let is = move |(n, h): &(usize, &Holder)| {
            h.work_of == Some(e) && e < *n && holders[e].work_of.is_none()
        };
        holders.iter().enumerate().filter(is).map(|(n, _)| n)
    };
    let mut best: Option<Harm> = None;
    for set in 0..1_u32 << holders.len() {
        let has = |n: usize| set >> n & 1 == 1;
        let allowed = (0..holders.len()).filter(|n| has(*n)).all(|n| {
            let closed = works(n).all(|w| has(w) || holders[w].stopping);
            holders[n].priority < priority && !holders[n].stopping && closed
        });
        let leaves = |n: usize| has(n) || holders[n].stopping;
        let stays = || (0..holders.len()).filter(|n| !leaves(*n)).map(|n| &holders[n]);
        let cpu_left = 1000_u64.saturating_sub(stays().map(|h| h.cpu).sum());
        let memory_left = (10_u64 << 20).saturating_sub(stays().map(|h| h.memory).sum());
        let lease = !(drives && driven && !holders.is_empty()) || leaves(0);
        if !allowed || cpu > cpu_left || memory > memory_left || !lease {
            continue;
        }
        let members: Vec<usize> = (0..holders.len()).filter(|n| has(*n)).collect();
        let mut priorities: Vec<i32> = members.iter().map(|n| holders[*n].priority).collect();
        priorities.sort_by_key(|p| Reverse(*p));
        let harm = Harm {
            highest: priorities.first().copied(),
            count: members.len(),
            priorities,
            ages: members.iter().map(|n| Reverse(*n as u64)).collect(),
        };
        if best.as_ref().is_none_or(|b| harm < *b) {
            best = Some(harm);
        }
    }
    best
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn victims_are_those_of_brute_force(
        holders in proptest::collection::vec(holder(), 0..8),
        driven in any::<bool>(),
        (priority, cpu, memory, drives) in (0..5_i32, 1..11_u64, 0..10_u64, any::<bool>()),
    ) {
        let (cpu, memory) = (cpu * 100, memory << 20);
        let mut cluster = crowded(&holders, driven);
        let mut demand = demand("new", priority, cpu, drives);
        Arc::make_mut(&mut demand.spec).resources.memory = Some(Bytes(memory));
        let refused = filter::refusal(cluster.sites(), cluster.at(0), &demand).is_some();
        let expected = refused.then(|| by_brute_force(&holders, driven, (priority, cpu, memory, drives))).flatten();
        let found = victims(cluster.sites(), cluster.at(0), &demand);
        let found_harm = found.as_ref().map(|v| harm(&cluster.at(0).ledger, v));
        prop_assert_eq!(&found_harm, &expected);
        // Carried out and ended, the task has its place.
        if let Some(victims) = found {
            let plan = schedule(&mut cluster, &mut [demand.clone()]);
            if cluster.least_priority().is_some_and(|least| least < priority) {
                prop_assert_eq!(plan.preemptions[0].victims.len(), victims.len());
            }
            for (n, _) in holders.iter().enumerate().filter(|(n, h)| h.stopping || victims.contains(&uid(*n))) {
                cluster.release(&uid(n));
                cluster.set_lease(&name("r1"), "body", muster_api::id::Epoch(1), (n != 0).then(|| uid(0)).filter(|_| driven && !victims.contains(&uid(0)) && !holders[0].stopping));
            }
            let plan = schedule(&mut cluster, &mut [demand]);
            prop_assert_eq!(plan.binds.len(), 1);
        }
    }

    /// With more than can be looked at: nobody is ended for nothing, and nobody who is as important.
    #[test]
    fn nobody_of_many_is_ended_for_nothing(
        holders in proptest::collection::vec((1..3_u64, 0..4_i32), 14..20),
        (priority, cpu) in (1..5_i32, 1..11_u64),
    ) {
        let holders: Vec<Holder> = holders.into_iter()
            .map(|(cpu, priority)| Holder { cpu: cpu * 25, memory: 0, priority, stopping: false, work_of: None }).collect();
        let cluster = crowded(&holders, false);
        let demand = demand("new", priority, cpu * 100, false);
        let Some(victims) = victims(cluster.sites(), cluster.at(0), &demand) else { return Ok(()) };
        let reservation = demand.reservation(cluster.at(0).facts.as_ref().expect("facts"));
        let need = Need { ledger: &cluster.at(0).ledger, reservation: &reservation, kept: Compute::default() };
        prop_assert!(need.is_met(&victims));
        for spared in &victims {
            let rest: Vec<TaskUid> = victims.iter().filter(|v| *v != spared).cloned().collect();
            prop_assert!(!need.is_met(&rest), "{spared} could be spared");
            let reservation = cluster.at(0).ledger.reservation(spared).expect("it is there");
            prop_assert!(reservation.standing.priority < priority);
        }
    }
}
