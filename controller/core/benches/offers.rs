//! Speed of the decisions: nearest robots beside brute force, a full cycle of offers, placements over a moving fleet, ways over a
//! floor with walls.
//!
//! ```sh
//! cargo bench -p muster-controller-core --bench offers
//! ```

use std::hint::black_box;
use std::sync::Arc;
use std::time::{Duration, Instant};

use muster_api::condition::{self, Condition, ConditionStatus};
use muster_api::id::TaskUid;
use muster_api::kind::framework::FrameworkSpec;
use muster_api::kind::node::{Node, NodeKind, NodeSpec, NodeStatus, RuntimeStatus};
use muster_api::kind::site::{SiteGrid, SiteSpec};
use muster_api::kind::task::TaskSpec;
use muster_api::map::{Cell, Grid};
use muster_api::name::NodeName;
use muster_api::pose::{OperationPosition, Pose};
use muster_api::quantity::{Bytes, MilliCpu};
use muster_api::resource::{Compute, parse_function_list};
use muster_controller_core::cluster::Cluster;
use muster_controller_core::offer::allocator::Closest;
use muster_controller_core::offer::book::Book;
use muster_controller_core::offer::{OfferId, Wish};
use muster_controller_core::schedule::{Demand, Plan, schedule};
use muster_controller_core::space::{Slot, Space};
use nalgebra::Point3;

/// One robot for each 100 m² of floor: a busy hall.
const SQUARE_METRES_PER_ROBOT: f64 = 100.0;
const RADIUS: f64 = 25.0;
const NEAREST: usize = 16;
/// Moves for each query.
const MOVES: usize = 10;
/// Queries in a row, by the index and then by brute force: a scan of everything would leave the index's cells out of the
/// cache for each single query.
const BATCH: usize = 50;

/// Numbers that look random and are the same in every run (splitmix64).
struct Numbers(u64);

impl Numbers {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, limit: f64) -> f64 {
        (self.next() >> 11) as f64 / (1_u64 << 53) as f64 * limit
    }

    fn index(&mut self, length: usize) -> usize {
        (self.next() % length as u64) as usize
    }

    fn point(&mut self, side: f64) -> Point3<f64> {
        Point3::new(self.below(side), self.below(side), 0.0)
    }
}

fn side(robots: usize) -> f64 {
    (robots as f64 * SQUARE_METRES_PER_ROBOT).sqrt()
}

/// Half of the robots are filtered out.
fn passes(slot: Slot) -> bool {
    slot.is_multiple_of(2)
}

fn brute_force(robots: &[Point3<f64>], at: Point3<f64>) -> Vec<Slot> {
    let mut found: Vec<(f64, Slot)> = (0_u32..)
        .zip(robots)
        .filter(|(slot, _)| passes(*slot))
        .map(|(slot, p)| (nalgebra::distance(&at, p), slot))
        .filter(|(distance, _)| *distance <= RADIUS)
        .collect();
    found.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    found.truncate(NEAREST);
    found.into_iter().map(|(_, slot)| slot).collect()
}

fn indexed(space: &Space, at: Point3<f64>) -> Vec<Slot> {
    let nearest = space.nearest("map", at, RADIUS).map(|f| f.slot);
    let mut slots = Vec::with_capacity(NEAREST);
    slots.extend(nearest.filter(|slot| passes(*slot)).take(NEAREST));
    slots
}

fn nearest(robots: usize, queries: usize) {
    let (mut numbers, side) = (Numbers(1), side(robots));
    let mut places: Vec<Point3<f64>> = (0..robots).map(|_| numbers.point(side)).collect();
    let mut space = Space::default();
    for (slot, place) in (0_u32..).zip(&places) {
        space.insert(slot, "map", *place);
    }
    let (mut moving, mut by_index, mut by_scan) = (Duration::ZERO, Duration::ZERO, Duration::ZERO);
    for _ in 0..queries / BATCH {
        // Robots at 1 m/s whose poses come ten times a second.
        let start = Instant::now();
        for _ in 0..MOVES * BATCH {
            let i = numbers.index(robots);
            let step =
                nalgebra::Vector3::new(numbers.below(0.2) - 0.1, numbers.below(0.2) - 0.1, 0.0);
            places[i] += step;
            space.insert(i as Slot, "map", places[i]);
        }
        moving += start.elapsed();
        let ats: Vec<Point3<f64>> = (0..BATCH).map(|_| numbers.point(side)).collect();
        let start = Instant::now();
        let answers: Vec<Vec<Slot>> = ats.iter().map(|at| indexed(&space, *at)).collect();
        by_index += start.elapsed();
        let start = Instant::now();
        let truths: Vec<Vec<Slot>> = ats.iter().map(|at| brute_force(&places, *at)).collect();
        by_scan += start.elapsed();
        assert_eq!(answers, truths, "the answers are the same");
    }
    println!(
        "  {robots:>7} robots: {:>9.0} queries/s, brute force {:>7.0}: {:.0}×; {:.0} moves/s",
        queries as f64 / by_index.as_secs_f64(),
        queries as f64 / by_scan.as_secs_f64(),
        by_scan.as_secs_f64() / by_index.as_secs_f64(),
        (queries * MOVES) as f64 / moving.as_secs_f64(),
    );
}

fn robot(at: Point3<f64>) -> Node {
    let spec = NodeSpec::new(NodeKind::Robot);
    let mut node = Node::new("n", spec);
    let functions = |text| parse_function_list(text).expect("functions").into_iter().collect();
    node.status = Some(NodeStatus {
        allocatable: Compute::new(MilliCpu(4000), Bytes(8 << 30)),
        sensors: functions("kinect:ImageGen,LaserGen"),
        actuators: functions("base:Drive"),
        pose: Some(pose(at)),
        conditions: vec![Condition {
            r#type: condition::READY.to_owned(),
            status: ConditionStatus::True,
            reason: String::new(),
            message: String::new(),
            last_transition_time: None,
        }],
        runtimes: vec![RuntimeStatus {
            name: "process".to_owned(),
            available: true,
            version: String::new(),
            message: String::new(),
        }],
        ..NodeStatus::default()
    });
    node
}

fn pose(at: Point3<f64>) -> Pose {
    Pose {
        map: "map".to_owned(),
        x: at.x,
        y: at.y,
        z: at.z,
        yaw: 0.0,
        stamp: None,
        source: String::new(),
        localized: true,
        covariance: None,
    }
}

fn fleet(robots: usize, numbers: &mut Numbers) -> (Cluster, Vec<NodeName>, Vec<Point3<f64>>) {
    let mut cluster = Cluster::new();
    let (mut names, mut places) = (Vec::new(), Vec::new());
    for i in 0..robots {
        let place = numbers.point(side(robots));
        let name = NodeName::new(format!("robot-{i}")).expect("a name");
        cluster.upsert_node(&name, &robot(place));
        names.push(name);
        places.push(place);
    }
    (cluster, names, places)
}

fn position(at: Point3<f64>) -> OperationPosition {
    OperationPosition { map: "map".to_owned(), x: at.x, y: at.y, z: at.z }
}

fn cycle(robots: usize, frameworks: usize) {
    let mut numbers = Numbers(2);
    let (mut cluster, names, mut places) = fleet(robots, &mut numbers);
    let mut book = Book::new(Box::new(Closest), OfferId::first(0));
    let mut seats = Vec::new();
    for i in 0..frameworks {
        let spec = FrameworkSpec {
            position: Some(position(numbers.point(side(robots)))),
            radius: Some(RADIUS),
            ..FrameworkSpec::default()
        };
        seats.push(book.register(Wish::new(&format!("team-{}", i % 10), &spec)));
    }
    let start = Instant::now();
    let notices = book.refresh(&mut cluster, Duration::from_secs(1));
    let first = start.elapsed();
    let offers: usize = notices.values().map(|n| n.offered.len()).sum();
    // Every robot moves, and everybody is looked at again.
    for (name, place) in names.iter().zip(&mut places) {
        *place += nalgebra::Vector3::new(numbers.below(0.2) - 0.1, numbers.below(0.2) - 0.1, 0.0);
        cluster.set_pose(name, &pose(*place));
    }
    let start = Instant::now();
    let again = book.refresh(&mut cluster, Duration::from_secs(2));
    let moved = start.elapsed();
    let changed: usize = again.values().map(|n| n.offered.len() + n.rescinded.len()).sum();
    println!(
        "  {robots} agents × {frameworks} frameworks: {offers} offers in {:.1} ms; after every robot moved {changed} \
         changes in {:.1} ms",
        first.as_secs_f64() * 1e3,
        moved.as_secs_f64() * 1e3,
    );
}

/// Moves a robot a little and places a task; the plan, and what both took.
fn decide_after_move(
    cluster: &mut Cluster,
    (name, place): (&NodeName, &mut Point3<f64>),
    (uid, placement): (&TaskUid, serde_json::Value),
) -> (Plan, Duration) {
    let spec = serde_json::json!({
        "placement": placement,
        "resources": {"cpu": "100m", "memory": "64Mi", "sensors": ["kinect:ImageGen"]},
        "run": {"process": {"command": ["true"]}},
    });
    let spec: TaskSpec = serde_json::from_value(spec).expect("a spec");
    let mut demand = [Demand {
        uid: uid.clone(),
        title: format!("default/{}", uid.as_str()).into(),
        spec: Arc::new(spec),
        since: 0,
        avoid: Arc::default(),
        framework: None,
    }];
    *place += nalgebra::Vector3::new(0.1, 0.0, 0.0);
    let pose = pose(*place);
    let start = Instant::now();
    cluster.set_pose(name, &pose);
    let plan = schedule(cluster, &mut demand);
    (plan, start.elapsed())
}

fn decisions(robots: usize, tasks: usize) {
    let mut numbers = Numbers(3);
    let (mut cluster, names, mut places) = fleet(robots, &mut numbers);
    let mut spent = Duration::ZERO;
    for i in 0..tasks {
        let (x, y) = (numbers.below(side(robots)), numbers.below(side(robots)));
        let placement = serde_json::json!({"at": {"x": x, "y": y}, "within": RADIUS});
        let uid = TaskUid::new(format!("task-{i}"));
        let moved = numbers.index(robots);
        let place = (&names[moved], &mut places[moved]);
        let (plan, took) = decide_after_move(&mut cluster, place, (&uid, placement));
        spent += took;
        black_box(&plan);
        // A fleet in use: half of the tasks stay.
        if i % 2 == 0 {
            cluster.release(&uid);
        }
    }
    println!(
        "  {robots} moving nodes, one thread: {:.0} decisions/s, each after a move",
        tasks as f64 / spent.as_secs_f64()
    );
}

/// A building of 100 m × 100 m at 5 cm: rooms of 10 m, each with a door of 1 m to every neighbour.
fn building() -> SiteSpec {
    const SIDE: u32 = 2_000;
    const ROOM: u32 = 200;
    const DOOR: std::ops::Range<u32> = 90..110;
    let wall = |at: u32, along: u32| at % ROOM < 2 && !DOOR.contains(&(along % ROOM));
    let cell = |x: u32, y: u32| {
        let rim = [x, y].into_iter().any(|at| !(2..SIDE - 2).contains(&at));
        if rim || wall(x, y) || wall(y, x) { Cell::Occupied } else { Cell::Free }
    };
    let cells = (0..SIDE).flat_map(|y| (0..SIDE).map(move |x| cell(x, y))).collect();
    let grid = Grid { width: SIDE, height: SIDE, resolution: 0.05, origin: [0.0; 3], cells };
    SiteSpec { map: None, inflation: 0.3, map_file: None, grid: Some(SiteGrid::of(&grid)) }
}

fn travel(robots: usize, positions: usize, tasks: usize) {
    let (mut numbers, spec) = (Numbers(4), building());
    let (mut cluster, names, mut places) = fleet(robots, &mut numbers);
    for (name, place) in names.iter().zip(&places) {
        let mut node = robot(*place);
        node.spec.speed = Some(0.5);
        cluster.upsert_node(name, &node);
    }
    let start = Instant::now();
    cluster.set_site("map", Some(&spec));
    println!(
        "  floor of 2000 × 2000 cells from its Site: {:.0} ms",
        start.elapsed().as_secs_f64() * 1e3
    );
    // The middles of rooms: nobody works in a wall.
    let room = |numbers: &mut Numbers| f64::from(numbers.index(10) as u32) * 10.0 + 3.0;
    let works: Vec<OperationPosition> = (0..positions)
        .map(|_| position(Point3::new(room(&mut numbers), room(&mut numbers), 0.0)))
        .collect();
    let (mut fronts, mut first) = (Duration::ZERO, Vec::new());
    for work in &works {
        let start = Instant::now();
        first.push(cluster.sites().travel(work, &pose(places[0])));
        fronts += start.elapsed();
    }
    black_box(&first);
    println!("  wavefront over them: {:.0} ms", fronts.as_secs_f64() * 1e3 / positions as f64);
    let mut spent = Duration::ZERO;
    for i in 0..tasks {
        let at = &works[i % positions];
        let placement = serde_json::json!({"at": at, "cost": "TravelTime", "on": "Robot"});
        let uid = TaskUid::new(format!("way-{i}"));
        let moved = numbers.index(robots);
        let place = (&names[moved], &mut places[moved]);
        let (plan, took) = decide_after_move(&mut cluster, place, (&uid, placement));
        spent += took;
        assert_eq!(plan.binds.len(), 1, "some robot can come");
        cluster.release(&uid);
    }
    println!(
        "  {robots} moving robots by travel time, {positions} places of work: {:.0} decisions/s, each of all robots",
        tasks as f64 / spent.as_secs_f64()
    );
}

fn main() {
    println!("{NEAREST} nearest within {RADIUS} m, half of the robots filtered out:");
    nearest(10_000, 20_000);
    nearest(100_000, 2_000);
    println!("offers:");
    cycle(10_000, 1_000);
    println!("placement:");
    decisions(10_000, 40_000);
    println!("ways:");
    travel(100, 5, 2_000);
}
