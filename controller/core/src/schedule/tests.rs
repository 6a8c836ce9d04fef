//! Placement rules one by one, and that fast choice agrees with a scan over every node.

use muster_api::condition::ConditionStatus;
use muster_api::kind::node::{Node, NodeStatus};
use muster_api::quantity::MilliCpu;
use proptest::prelude::*;
use serde_json::json;

use super::*;
use crate::fixtures::{name, node};

fn cluster(nodes: &[(&str, Node)]) -> Cluster {
    let mut cluster = Cluster::new();
    for (node_name, node) in nodes {
        cluster.upsert_node(&name(node_name), node);
    }
    cluster
}

fn demand(uid: &str, mut spec: serde_json::Value) -> Demand {
    spec["run"] = json!({"process": {"command": ["true"]}});
    Demand {
        uid: TaskUid::new(uid),
        title: format!("default/{uid}").into(),
        spec: Arc::new(serde_json::from_value(spec).expect("a spec")),
        since: 0,
        avoid: Arc::default(),
        framework: None,
    }
}

fn bound(plan: &Plan) -> Vec<(&str, &str)> {
    plan.binds.iter().map(|b| (b.uid.as_str(), b.node.as_str())).collect()
}

fn reasons(plan: &Plan) -> Vec<(&str, &str)> {
    plan.waits
        .iter()
        .flat_map(|w| w.why.iter())
        .map(|w| (w.node.as_str(), w.reason.as_str()))
        .collect()
}

use NodeKind::{Cloud, Robot};

#[test]
fn the_nearest_robot_inside_the_radius_is_taken_and_its_score_is_the_distance() {
    let mut cluster = cluster(&[
        ("far", node(Robot, 1000, Some((10.0, 0.0)))),
        ("near", node(Robot, 1000, Some((3.0, 4.0)))),
        ("cloud", node(Cloud, 9000, None)),
    ]);
    let spec = json!({"placement": {"at": {"x": 0.0, "y": 0.0}, "within": 5.0}, "resources": {"sensors": ["kinect:ImageGen"]}});
    let plan = schedule(&mut cluster, &mut [demand("t", spec)]);
    assert_eq!(bound(&plan), [("t", "near")]);
    assert_eq!(plan.binds[0].score, Some(5.0), "the rim is inside");
}

#[test]
fn a_live_pose_counts_until_the_node_is_gone_whatever_its_object_says() {
    let object = node(Robot, 1000, Some((50.0, 0.0)));
    let mut cluster = cluster(&[("robot", object.clone())]);
    let near = json!({"placement": {"at": {"x": 0.0, "y": 0.0}, "within": 5.0}, "resources": {"sensors": ["kinect:ImageGen"]}});
    let mut demands = [demand("t", near)];
    assert!(schedule_moved(&mut cluster, &mut demands).binds.is_empty(), "it is 50 m away");
    let pose = |x| node(Robot, 0, Some((x, 0.0))).status.and_then(|s| s.pose).expect("it has one");
    cluster.set_pose(&name("robot"), &pose(4.0));
    // The object changed for another reason, and its checkpoint is old.
    cluster.upsert_node(&name("robot"), &object);
    let plan = schedule_moved(&mut cluster, &mut demands);
    assert_eq!(plan.binds.iter().map(|b| b.score).collect::<Vec<_>>(), [Some(4.0)]);
    cluster.release(&TaskUid::new("t"));
    cluster.remove_node(&name("robot"));
    cluster.set_pose(&name("robot"), &pose(4.0));
    cluster.upsert_node(&name("robot"), &object);
    assert!(
        schedule_moved(&mut cluster, &mut demands).binds.is_empty(),
        "it joined anew, 50 m away"
    );
}

#[test]
fn a_robot_that_is_lost_is_more_than_a_move() {
    let mut cluster = cluster(&[("robot", node(Robot, 1000, Some((1.0, 0.0))))]);
    let mut pose = node(Robot, 0, Some((2.0, 0.0))).status.and_then(|s| s.pose).expect("one");
    drop(cluster.take_changes());
    cluster.set_pose(&name("robot"), &pose);
    let (changed, moved) = cluster.take_changes();
    assert_eq!((changed.len(), moved.len()), (0, 1));
    pose.localized = false;
    cluster.set_pose(&name("robot"), &pose);
    let (changed, moved) = cluster.take_changes();
    assert_eq!((changed.len(), moved.len()), (1, 1));
    assert_eq!(cluster.space().nearest("map", pose.position(), 9.0).count(), 0);
}

#[test]
fn a_compute_only_task_prefers_the_cloud_and_on_robot_keeps_it_away() {
    let nodes =
        [("robot", node(Robot, 1000, Some((0.0, 0.0)))), ("cloud", node(Cloud, 1000, None))];
    let at = json!({"at": {"x": 0.0, "y": 0.0}, "within": 1.0});
    let plan = schedule(
        &mut cluster(&nodes),
        &mut [demand("t", json!({"placement": at, "resources": {"cpu": 1}}))],
    );
    assert_eq!(bound(&plan), [("t", "cloud")]);
    assert_eq!(plan.binds[0].score, None);
    let plan = schedule(
        &mut cluster(&nodes),
        &mut [demand("t", json!({"placement": {"on": "Robot"}, "resources": {"cpu": 1}}))],
    );
    assert_eq!(bound(&plan), [("t", "robot")]);
    let mut big = [
        demand("a", json!({"resources": {"cpu": 1}})),
        demand("b", json!({"resources": {"cpu": 1}})),
    ];
    let plan = schedule(&mut cluster(&nodes), &mut big);
    assert_eq!(
        bound(&plan),
        [("a", "cloud"), ("b", "robot")],
        "the robot serves when the cloud is full"
    );
}

#[test]
fn a_robot_is_shared_by_ar_sr_and_cr_tasks_but_driven_by_one() {
    let mut cluster = cluster(&[("r", node(Robot, 1000, Some((0.0, 0.0))))]);
    let drive = json!({"resources": {"cpu": "300m", "actuators": ["base:Drive"], "sensors": ["kinect:LaserGen"]}});
    let grasp = json!({"resources": {"actuators": ["arm:Grasp"]}});
    let look = json!({"resources": {"sensors": ["kinect:ImageGen"]}});
    let mut all =
        [demand("a", drive), demand("b", look.clone()), demand("c", look), demand("d", grasp)];
    let plan = schedule(&mut cluster, &mut all);
    assert_eq!(bound(&plan), [("a", "r"), ("b", "r"), ("c", "r")]);
    assert_eq!(plan.binds[0].leases, [("body".to_owned(), Epoch(1))]);
    assert_eq!(reasons(&plan), [("r", "LeaseHeld")], "any AR takes all AR of the robot");
    assert!(plan.waits[0].why[0].message.contains("held by default/a"), "{:?}", plan.waits);

    cluster.release(&TaskUid::new("a"));
    let plan = schedule(&mut cluster, &mut all[3..]);
    assert_eq!(bound(&plan), [("d", "r")]);
    assert_eq!(plan.binds[0].leases, [("body".to_owned(), Epoch(2))]);
}

#[test]
fn priority_goes_first_then_who_waits_longest() {
    let mut cluster = cluster(&[("c", node(Cloud, 1000, None))]);
    let one = |uid: &str, priority: i32, since| Demand {
        since,
        ..demand(uid, json!({"priority": priority, "resources": {"cpu": "400m"}}))
    };
    let plan =
        schedule(&mut cluster, &mut [one("young", 0, 9), one("old", 0, 1), one("urgent", 5, 20)]);
    assert_eq!(bound(&plan), [("urgent", "c"), ("old", "c")]);
    assert_eq!(reasons(&plan), [("c", "Exhausted")]);
}

#[test]
fn each_node_says_why_not() {
    let mut nodes: Vec<(&str, Node)> =
        ["cordoned", "tainted", "silent", "lost", "far", "other-map", "small", "blind"]
            .into_iter()
            .map(|n| (n, node(Robot, 1000, Some((0.0, 0.0)))))
            .collect();
    let status = |n: &mut Node, f: fn(&mut NodeStatus)| f(n.status.as_mut().expect("set"));
    nodes[0].1.spec.unschedulable = true;
    nodes[1].1.spec.taints =
        serde_json::from_value(json!([{"key": "battery", "value": "low", "effect": "NoSchedule"}]))
            .expect("taints");
    status(&mut nodes[2].1, |s| s.pose = None);
    status(&mut nodes[3].1, |s| s.conditions[0].status = ConditionStatus::Unknown);
    status(&mut nodes[4].1, |s| s.pose.as_mut().expect("set").x = 50.0);
    status(&mut nodes[5].1, |s| s.pose.as_mut().expect("set").map = "hall".to_owned());
    status(&mut nodes[6].1, |s| s.allocatable.cpu = MilliCpu(100));
    status(&mut nodes[7].1, |s| s.sensors.clear());
    nodes.push(("cloud", node(Cloud, 1000, None)));
    let spec = json!({
        "placement": {"at": {"x": 0.0, "y": 0.0}, "within": 20.0},
        "resources": {"cpu": "500m", "sensors": ["kinect:ImageGen"]},
    });
    let plan = schedule(&mut cluster(&nodes), &mut [demand("t", spec)]);
    assert_eq!(plan.binds, []);
    let mut all = reasons(&plan);
    all.sort_unstable();
    assert_eq!(
        all,
        [
            ("blind", "NoSensor"),
            ("cloud", "WrongKind"),
            ("cordoned", "Cordoned"),
            ("far", "OutOfRange"),
            ("lost", "NotReady"),
            ("other-map", "OtherMap"),
            ("silent", "NoPose"),
            ("small", "TooSmall"),
            ("tainted", "Tainted"),
        ]
    );
}

#[test]
fn a_cluster_without_nodes_says_so_and_a_large_one_counts() {
    let plan = schedule(&mut Cluster::new(), &mut [demand("t", json!({}))]);
    assert_eq!(reasons(&plan), [("", "NoNodes")]);
    let nodes: Vec<(String, Node)> =
        (0..40).map(|i| (format!("c{i:02}"), node(Cloud, 100, None))).collect();
    let nodes: Vec<(&str, Node)> =
        nodes.iter().map(|(n, node)| (n.as_str(), node.clone())).collect();
    let plan = schedule(&mut cluster(&nodes), &mut [demand("t", json!({"resources": {"cpu": 1}}))]);
    let why = &plan.waits[0].why;
    assert_eq!(why.len(), WHY_LIMIT + 1);
    assert_eq!(why[WHY_LIMIT].message, "24 more nodes: 24 TooSmall");
}

#[test]
fn a_node_marked_prefer_no_schedule_is_the_last_resort() {
    let mut reluctant = node(Robot, 9000, Some((0.0, 0.0)));
    reluctant.spec.taints =
        serde_json::from_value(json!([{"key": "charging", "effect": "PreferNoSchedule"}]))
            .expect("taints");
    let mut cluster = cluster(&[("a", reluctant), ("b", node(Robot, 500, Some((9.0, 0.0))))]);
    let spec = json!({"placement": {"at": {"x": 0.0, "y": 0.0}, "on": "Robot"}, "resources": {"cpu": "400m"}});
    let plan = schedule(&mut cluster, &mut [demand("t", spec.clone()), demand("u", spec)]);
    assert_eq!(bound(&plan), [("t", "b"), ("u", "a")]);
}

#[test]
fn travel_time_divides_by_speed() {
    let mut slow = node(Robot, 1000, Some((2.0, 0.0)));
    slow.spec.speed = Some(0.1);
    let mut fast = node(Robot, 1000, Some((10.0, 0.0)));
    fast.spec.speed = Some(2.0);
    let nodes = [("slow", slow), ("fast", fast), ("unknown", node(Robot, 1000, Some((0.0, 0.0))))];
    let spec =
        json!({"placement": {"at": {"x": 0.0, "y": 0.0}, "cost": "TravelTime", "on": "Robot"}});
    let plan = schedule(&mut cluster(&nodes), &mut [demand("t", spec)]);
    assert_eq!(bound(&plan), [("t", "fast")]);
    assert_eq!(plan.binds[0].score, Some(5.0));
}

/// What `choose` must agree with: the best of all nodes that pass, by the written order.
fn by_scan(cluster: &Cluster, demand: &Demand) -> Option<(bool, u64)> {
    cluster
        .members()
        .filter(|(_, m)| filter::refusal(cluster.sites(), m, demand).is_none())
        .map(|(_, m)| {
            let facts = m.facts.as_ref().expect("it passed");
            let on_robot = facts.kind == Robot;
            let score = score::score(cluster.sites(), facts, &demand.spec).unwrap_or(0.0);
            (on_robot, (score * 1e6) as u64)
        })
        .min()
}

proptest! {
    #[test]
    fn the_fast_choice_is_the_best_of_all_nodes(
        nodes in proptest::collection::vec((any::<bool>(), 1..10_u64, -20..20_i32, -20..20_i32, any::<bool>()), 1..40),
        tasks in proptest::collection::vec((0..6_u64, -20..20_i32, proptest::option::of(0..30_u32), 0..4_u8), 1..20),
    ) {
        let mut cluster = Cluster::new();
        for (i, (robot, cpu, x, y, cordoned)) in nodes.into_iter().enumerate() {
            let kind = if robot { Robot } else { Cloud };
            let mut node = node(kind, cpu * 100, robot.then_some((f64::from(x), f64::from(y))));
            node.spec.unschedulable = cordoned;
            cluster.upsert_node(&name(&format!("n{i}")), &node);
        }
        for (i, (cpu, x, within, class)) in tasks.into_iter().enumerate() {
            let mut spec = json!({"placement": {"at": {"x": x, "y": 0}}, "resources": {"cpu": format!("{}m", cpu * 100)}});
            if let Some(within) = within {
                spec["placement"]["within"] = json!(within);
            }
            match class {
                0 => spec["resources"]["actuators"] = json!(["base:Drive"]),
                1 => spec["resources"]["sensors"] = json!(["kinect:ImageGen"]),
                _ => {}
            }
            let demand = demand(&format!("t{i}"), spec);
            let expected = by_scan(&cluster, &demand);
            let plan = schedule(&mut cluster, &mut [demand]);
            let got = plan.binds.first().map(|b| {
                let on_robot = cluster.member(&b.node).and_then(|m| m.facts.as_ref()).is_some_and(|f| f.kind == Robot);
                (on_robot, (b.score.unwrap_or(0.0) * 1e6) as u64)
            });
            prop_assert_eq!(got, expected);
            prop_assert_eq!(plan.binds.len() + plan.waits.len(), 1);
            for (_, member) in cluster.members() {
                prop_assert!(member.ledger.used().cpu <= member.ledger.allocatable().cpu);
            }
        }
    }
}

proptest! {
    /// Nobody is left out by the order of a pass: unless it says that there is to be another one, that one finds nothing to do.
    #[test]
    fn a_pass_that_is_the_last_leaves_nothing_undone(
        cpus in proptest::collection::vec(1..6_u64, 1..4),
        tasks in proptest::collection::vec((1..6_u64, 0..3_i32, 0..3_u64, proptest::option::of(0..4_usize)), 1..12),
        ends in proptest::collection::vec(any::<proptest::sample::Index>(), 0..6),
    ) {
        let mut cluster = Cluster::new();
        for (i, cpu) in cpus.into_iter().enumerate() {
            cluster.upsert_node(&name(&format!("n{i}")), &node(Cloud, cpu * 100, None));
        }
        let mut waiting: Vec<Demand> = Vec::new();
        let mut placed: Vec<TaskUid> = Vec::new();
        let mut ends = ends.into_iter();
        for (i, (cpu, priority, since, executor)) in tasks.into_iter().enumerate() {
            let spec = json!({"priority": priority, "resources": {"cpu": format!("{}m", cpu * 100)}});
            let mut new = Demand { since, ..demand(&format!("t{i}"), spec) };
            if let Some(executor) = executor {
                let mut spec = (*new.spec).clone();
                spec.run = serde_json::from_value(json!({"executor": {"task": format!("t{executor}")}})).expect("a run");
                new.spec = Arc::new(spec);
            }
            waiting.push(new);
            // Those that were to make room have ended by the next pass, and now and then another one.
            if let Some(end) = ends.next().filter(|_| !placed.is_empty()) {
                let uid = placed.remove(end.index(placed.len()));
                cluster.release(&uid);
            }
            let mut settled = false;
            for _ in 0..8 {
                let plan = schedule(&mut cluster, &mut waiting);
                prop_assert!(!settled || plan.binds.is_empty(), "{:?}", plan.binds);
                waiting.retain(|demand| plan.binds.iter().all(|bind| bind.uid != demand.uid));
                placed.extend(plan.binds.iter().map(|bind| bind.uid.clone()));
                let made: Vec<TaskUid> = plan.preemptions.iter().flat_map(|p| p.victims.iter().map(|v| v.uid.clone())).collect();
                // Their end is news of its own.
                settled = !plan.again && made.is_empty();
                for uid in made {
                    cluster.release(&uid);
                    placed.retain(|other| *other != uid);
                }
            }
        }
    }
}

fn avoiding(nodes: &[&str], spec: serde_json::Value) -> Demand {
    Demand { avoid: nodes.iter().map(|node| name(node)).collect(), ..demand("t", spec) }
}

#[test]
fn a_node_that_the_task_failed_on_comes_last_and_is_not_refused() {
    use muster_api::kind::node::Taint;
    let mut tainted = node(Robot, 1000, Some((3.0, 0.0)));
    tainted.spec.taints = vec![Taint {
        key: "old".to_owned(),
        value: String::new(),
        effect: TaintEffect::PreferNoSchedule,
    }];
    let nodes = [
        ("near", node(Robot, 1000, Some((1.0, 0.0)))),
        ("far", node(Robot, 1000, Some((2.0, 0.0)))),
        ("tainted", tainted),
    ];
    for cost in ["Distance", "TravelTime"] {
        let spec = || {
            json!({"placement": {"at": {"x": 0.0, "y": 0.0}, "prefer": "near", "cost": cost},
                   "resources": {"sensors": ["kinect:ImageGen"]}})
        };
        let goes_to = |avoid: &[&str]| {
            let mut nodes = nodes.clone();
            nodes.iter_mut().for_each(|(_, node)| node.spec.speed = Some(1.0));
            let plan = schedule(&mut cluster(&nodes), &mut [avoiding(avoid, spec())]);
            plan.binds[0].node.to_string()
        };
        assert_eq!(goes_to(&[]), "near", "{cost}");
        assert_eq!(goes_to(&["near"]), "far", "{cost}");
        assert_eq!(goes_to(&["near", "far"]), "tainted", "a taint is less than a failure, {cost}");
        assert_eq!(goes_to(&["near", "far", "tainted"]), "near", "all have failed, {cost}");
    }
    let pinned = json!({"placement": {"node": "near"}});
    let plan = schedule(&mut cluster(&nodes), &mut [avoiding(&["near"], pinned)]);
    assert_eq!(bound(&plan), [("t", "near")]);
    let clouds = [("c1", node(Cloud, 1000, None)), ("r1", node(Robot, 1000, Some((0.0, 0.0))))];
    let compute = json!({"resources": {"cpu": 1}});
    let plan = schedule(&mut cluster(&clouds), &mut [avoiding(&["c1"], compute)]);
    assert_eq!(
        bound(&plan),
        [("t", "r1")],
        "a robot that was not tried, before the cloud that was"
    );
}

proptest! {
    #[test]
    fn a_node_that_failed_is_taken_only_when_no_other_takes_the_task(
        nodes in proptest::collection::vec((any::<bool>(), 0..10_u64, -9..9_i32, any::<bool>()), 1..12),
        at in proptest::option::of(-9..9_i32),
        cpu in 1..8_u64,
    ) {
        let mut cluster = Cluster::new();
        let mut avoid = Vec::new();
        for (i, (robot, cpu, x, failed)) in nodes.into_iter().enumerate() {
            let kind = if robot { Robot } else { Cloud };
            let node_name = format!("n{i}");
            let node = node(kind, cpu * 100, robot.then_some((f64::from(x), 0.0)));
            cluster.upsert_node(&name(&node_name), &node);
            if failed {
                avoid.push(node_name);
            }
        }
        let mut spec = json!({"resources": {"cpu": format!("{}m", cpu * 100)}});
        if let Some(x) = at {
            spec["placement"] = json!({"at": {"x": x, "y": 0}, "within": 6});
        }
        let avoid: Vec<&str> = avoid.iter().map(String::as_str).collect();
        let demand = avoiding(&avoid, spec);
        let takes = |avoided: bool| {
            cluster.members().any(|(_, member)| {
                filter::refusal(cluster.sites(), member, &demand).is_none() && avoid.contains(&member.name.as_str()) == avoided
            })
        };
        let (others, failed) = (takes(false), takes(true));
        let plan = schedule(&mut cluster.clone(), &mut [demand.clone()]);
        match plan.binds.first() {
            Some(bind) => prop_assert_eq!(avoid.contains(&bind.node.as_str()), !others),
            None => prop_assert!(!others && !failed),
        }
    }
}

/// A name in a namespace is no permission: works go to executors of who launched them.
#[test]
fn work_goes_to_an_executor_of_its_own_framework() {
    let mut cluster = cluster(&[("r", node(Robot, 1000, Some((0.0, 0.0))))]);
    let of = |demand: Demand, framework: Option<&str>| Demand {
        framework: framework.map(Into::into),
        ..demand
    };
    let mut executor = [of(demand("executor", json!({})), Some("crew"))];
    assert_eq!(bound(&schedule(&mut cluster, &mut executor)), [("executor", "r")]);
    let work = |framework: Option<&str>| {
        let mut work = demand("work", json!({}));
        let mut spec = (*work.spec).clone();
        spec.run =
            serde_json::from_value(json!({"executor": {"task": "executor"}})).expect("a run");
        work.spec = Arc::new(spec);
        of(work, framework)
    };
    for stranger in [None, Some("others")] {
        let plan = schedule(&mut cluster, &mut [work(stranger)]);
        assert_eq!(reasons(&plan), [("r", "NoExecutor")], "{stranger:?}");
    }
    assert_eq!(bound(&schedule(&mut cluster, &mut [work(Some("crew"))])), [("work", "r")]);
}

/// Work that is older than its executor has its turn before it: the pass in which the executor finds a place is not the last.
#[test]
fn what_a_pass_gives_is_decided_on_again() {
    let mut cluster = cluster(&[("r", node(Robot, 1000, Some((0.0, 0.0))))]);
    let mut work = demand("work", json!({}));
    let mut spec = (*work.spec).clone();
    spec.run = serde_json::from_value(json!({"executor": {"task": "executor"}})).expect("a run");
    work.spec = Arc::new(spec);
    let plan = schedule(&mut cluster, &mut [work.clone()]);
    assert!(!plan.again, "nothing was given");
    let executor = Demand { since: 1, ..demand("executor", json!({})) };
    let plan = schedule(&mut cluster, &mut [work.clone(), executor]);
    assert_eq!((bound(&plan), plan.again), (vec![("executor", "r")], true));
    let plan = schedule(&mut cluster, &mut [work]);
    assert_eq!((bound(&plan), plan.again), (vec![("work", "r")], false));
}

/// Of equal priority, the namespace that has least comes first, by its weight; a more important task before all.
#[test]
fn namespaces_of_equal_priority_share_by_their_weights() {
    let mut cluster = Cluster::new();
    cluster.upsert_node(&name("c"), &node(NodeKind::Cloud, 1_000, None));
    let quota = muster_api::kind::quota::QuotaSpec { weight: 3.0, ..Default::default() };
    cluster.set_quota("heavy", Some(quota));
    let demand = |title: String, since: u64, priority: i32| {
        let spec = json!({
            "run": {"process": {"command": ["true"]}}, "resources": {"cpu": "100m"}, "priority": priority,
        });
        Demand {
            uid: TaskUid::new(title.clone()),
            title: title.into(),
            spec: Arc::new(serde_json::from_value(spec).expect("a spec")),
            since,
            avoid: Arc::default(),
            framework: None,
        }
    };
    // Ten of each, the light ones first, and there is room for ten.
    let light = (0..10).map(|i| demand(format!("light/{i}"), i, 0));
    let heavy = (0..10).map(|i| demand(format!("heavy/{i}"), 100 + i, 0));
    let first = demand("light/first".to_owned(), 1_000, 5);
    let mut demands: Vec<Demand> = light.chain(heavy).chain([first]).collect();
    let plan = schedule(&mut cluster, &mut demands);
    let bound: Vec<&str> = plan.binds.iter().map(|bind| bind.uid.as_str()).collect();
    let of = |namespace: &str| bound.iter().filter(|uid| uid.starts_with(namespace)).count();
    assert_eq!(bound[0], "light/first");
    assert_eq!((of("heavy"), of("light")), (7, 3), "{bound:?}");
    assert_eq!(bound[1], "heavy/0", "light has something already");
    assert_eq!(plan.waits.len(), 11);
}
