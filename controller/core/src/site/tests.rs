use muster_api::kind::site::SiteGrid;
use muster_api::map::{Cell, Grid};
use proptest::prelude::*;

use super::floor::Ground;
use super::*;

/// Rows from above, as one looks at them: `#` occupied, `?` unknown; cells of 1 m, the lower left corner at (0, 0).
fn map(rows: &[&str]) -> Grid {
    let cell = |c: char| match c {
        '#' => Cell::Occupied,
        '?' => Cell::Unknown,
        _ => Cell::Free,
    };
    let width = u32::try_from(rows[0].len()).unwrap();
    let height = u32::try_from(rows.len()).unwrap();
    let cells = rows.iter().rev().flat_map(|row| row.chars().map(cell)).collect();
    Grid { width, height, resolution: 1.0, origin: [0.0; 3], cells }
}

fn site(grid: &Grid, inflation: f64) -> SiteSpec {
    SiteSpec { map: None, inflation, map_file: None, grid: Some(SiteGrid::of(grid)) }
}

fn sites(grid: &Grid, inflation: f64) -> Sites {
    let mut sites = Sites::default();
    sites.set("map", Some(&site(grid, inflation)));
    sites
}

fn at(x: f64, y: f64) -> OperationPosition {
    OperationPosition { map: "map".to_owned(), x, y, z: 0.0 }
}

fn pose(x: f64, y: f64) -> Pose {
    serde_json::from_value(serde_json::json!({"x": x, "y": y})).unwrap()
}

#[test]
fn walls_count() {
    let rooms = map(&[
        "..........", //
        "..........", //
        "####.#####", //
        "..........", //
        "..........", //
    ]);
    let sites = sites(&rooms, 0.0);
    let way = |x, y| match sites.travel(&at(0.5, 4.5), &pose(x, y)) {
        Travel::Way(metres) => metres,
        other => panic!("{other:?}"),
    };
    // Straight up it were 3 m; by the door in the middle it is 4 m there and 4 m back at least.
    assert!(way(0.5, 1.5) > 8.0, "{}", way(0.5, 1.5));
    assert!((way(5.5, 4.5) - 5.0).abs() < 1e-9, "{}", way(5.5, 4.5));
    assert!((way(0.7, 4.5) - 0.2).abs() < 1e-9, "in one cell the straight line");
}

#[test]
fn where_no_way_leads_it_is_said_why() {
    let closed = map(&[
        ".....#..", //
        ".....#..", //
        "..?..#..", //
    ]);
    let sites = sites(&closed, 0.0);
    let travel = |work: (f64, f64), robot: (f64, f64)| {
        sites.travel(&at(work.0, work.1), &pose(robot.0, robot.1))
    };
    assert_eq!(travel((0.5, 0.5), (7.5, 0.5)), Travel::None(NoWay::Enclosed));
    assert_eq!(travel((5.5, 0.5), (0.5, 0.5)), Travel::None(NoWay::WorkOffFloor));
    assert_eq!(travel((2.5, 0.5), (0.5, 0.5)), Travel::None(NoWay::WorkOffFloor));
    assert_eq!(travel((0.5, 0.5), (-3.0, 0.5)), Travel::None(NoWay::RobotOffFloor));
    assert_eq!(sites.of_map("map"), Some("map"));
    let elsewhere = OperationPosition { map: "hall".to_owned(), ..at(0.5, 0.5) };
    assert_eq!(sites.travel(&elsewhere, &pose(7.5, 0.5)), Travel::NoSite);
}

#[test]
fn two_obstacles_that_touch_by_a_corner_are_a_wall() {
    let diagonal = map(&["..#", ".#.", "#.."]);
    let travel = sites(&diagonal, 0.0).travel(&at(0.5, 2.5), &pose(2.5, 0.5));
    assert_eq!(travel, Travel::None(NoWay::Enclosed));
}

#[test]
fn a_door_is_as_wide_as_the_inflation_leaves_it() {
    let row = |door: &str| format!("....{door}....");
    let rows: Vec<String> =
        (0..9).map(|i| row(if (3..6).contains(&i) { "." } else { "#" })).collect();
    let door = map(&rows.iter().map(String::as_str).collect::<Vec<_>>());
    let travel = |inflation| sites(&door, inflation).travel(&at(0.5, 4.5), &pose(8.5, 4.5));
    assert_eq!(travel(1.0), Travel::Way(8.0), "three cells wide: the one in the middle is left");
    assert_eq!(travel(2.0), Travel::None(NoWay::Enclosed));
}

#[test]
fn a_way_may_begin_and_end_beside_a_wall_and_not_behind_it() {
    let dock = map(&[
        "..........", //
        "..........", //
        "..........", //
        "##########", //
        "..........", //
        "..........", //
        "..........", //
    ]);
    let sites = sites(&dock, 1.0);
    let Travel::Way(beside) = sites.travel(&at(8.5, 4.5), &pose(0.5, 4.5)) else {
        panic!("both at the wall")
    };
    assert!((8.0..9.5).contains(&beside), "{beside}");
    assert_eq!(sites.travel(&at(8.5, 4.5), &pose(8.5, 2.5)), Travel::None(NoWay::Enclosed));
}

#[test]
fn what_a_site_says_now_counts() {
    let mut sites = sites(&map(&["...#...", "...#..."]), 0.0);
    let travel = |sites: &Sites| sites.travel(&at(0.5, 0.5), &pose(6.5, 0.5));
    assert_eq!(travel(&sites), Travel::None(NoWay::Enclosed));
    let copy = sites.clone();
    sites.set("map", Some(&site(&map(&[".......", "...#..."]), 0.0)));
    assert!(matches!(travel(&sites), Travel::Way(_)));
    assert_eq!(travel(&copy), Travel::None(NoWay::Enclosed), "a copy is as it was");
    sites.set("map", None);
    assert_eq!(travel(&sites), Travel::NoSite);
}

#[test]
fn few_fronts_are_kept_and_none_that_is_old() {
    let grid = Grid {
        width: 1000,
        height: 1000,
        resolution: 0.1,
        origin: [0.0; 3],
        cells: vec![Cell::Free; 1_000_000],
    };
    let sites = sites(&grid, 0.0);
    for i in 0..30 {
        let Travel::Way(metres) = sites.travel(&at(f64::from(i) + 0.05, 0.05), &pose(50.05, 0.05))
        else {
            panic!()
        };
        assert!((metres - f64::from(50 - i)).abs() < 1e-6);
    }
    let kept = sites.kept.lock().unwrap();
    assert_eq!(kept.len(), KEPT / kept[0].front.bytes());
}

/// Bellman and Ford's search, by king's and knight's moves between cells that are free.
fn brute_force(free: &dyn Fn(i64, i64) -> bool, size: i64, from: (i64, i64)) -> Vec<Option<u32>> {
    let mut costs = vec![None; usize::try_from(size * size).unwrap()];
    let index = |x: i64, y: i64| usize::try_from(y * size + x).unwrap();
    costs[index(from.0, from.1)] = free(from.0, from.1).then_some(0);
    loop {
        let mut changed = false;
        for (x, y) in (0..size).flat_map(|y| (0..size).map(move |x| (x, y))) {
            let Some(cost) = costs[index(x, y)] else { continue };
            for (dx, dy) in (-2..=2_i64).flat_map(|dy| (-2..=2_i64).map(move |dx| (dx, dy))) {
                let (far, near) = (dx.abs().max(dy.abs()), dx.abs().min(dy.abs()));
                let (step, beside) = match (far, near) {
                    (1, 0) => (5, vec![]),
                    (1, 1) => (7, vec![(dx, 0), (0, dy)]),
                    (2, 1) => (11, vec![(dx / 2, dy / 2), (dx.signum(), dy.signum())]),
                    _ => continue,
                };
                let (tx, ty) = (x + dx, y + dy);
                if !free(tx, ty) || !beside.iter().all(|(bx, by)| free(x + bx, y + by)) {
                    continue;
                }
                let known = &mut costs[index(tx, ty)];
                if known.is_none_or(|known| known > cost + step) {
                    *known = Some(cost + step);
                    changed = true;
                }
            }
        }
        if !changed {
            return costs;
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(128))]

    #[test]
    fn ways_are_as_by_brute_force(
        obstacles in proptest::collection::vec(prop::bool::weighted(0.3), 144),
        (x, y) in (0..12_i64, 0..12_i64),
        inflation in prop_oneof![Just(0.0), Just(1.0)],
    ) {
        let cells = obstacles.iter().map(|o| if *o { Cell::Occupied } else { Cell::Free }).collect();
        let grid = Grid { width: 12, height: 12, resolution: 1.0, origin: [0.0; 3], cells };
        let occupied = |x: i64, y: i64| obstacles[usize::try_from(y * 12 + x).unwrap()];
        let inside = |x: i64, y: i64| (0..12).contains(&x) && (0..12).contains(&y);
        let free = |x: i64, y: i64| {
            let mut around = vec![(0, 0)];
            if inflation > 0.0 {
                around.extend([(1, 0), (-1, 0), (0, 1), (0, -1)]);
            }
            inside(x, y) && around.into_iter().all(|(dx, dy)| !inside(x + dx, y + dy) || !occupied(x + dx, y + dy))
        };
        let floor = Floor::new(&grid, inflation);
        let middle = |n: i64| n as f64 + 0.5;
        for (x, y) in (0..12).flat_map(|y| (0..12).map(move |x| (x, y))) {
            let cell = floor.cell_at(middle(x), middle(y));
            prop_assert_eq!(cell.is_none(), occupied(x, y));
            let ground = cell.map(|cell| floor.ground[cell as usize]);
            prop_assert_eq!(ground == Some(Ground::Free), free(x, y));
        }
        if !free(x, y) {
            return Ok(());
        }
        let front = Front::from(&floor, floor.cell_at(middle(x), middle(y)).unwrap());
        let truth = brute_force(&free, 12, (x, y));
        for (x, y) in (0..12).flat_map(|y| (0..12).map(move |x| (x, y))).filter(|(x, y)| free(*x, *y)) {
            let way = front.way(&floor, floor.cell_at(middle(x), middle(y)).unwrap());
            let wanted = truth[usize::try_from(y * 12 + x).unwrap()].map(|cost| f64::from(cost) / 5.0);
            prop_assert_eq!(way, wanted, "({}, {})", x, y);
        }
    }

    #[test]
    fn open_floor_is_measured_to_two_percent((x, y) in (0..40_u32, 0..40_u32), (u, v) in (0..40_u32, 0..40_u32)) {
        let grid = Grid { width: 40, height: 40, resolution: 0.05, origin: [-1.0, 3.0, 0.7], cells: vec![Cell::Free; 1600] };
        let floor = Floor::new(&grid, 0.0);
        let cell = |x: u32, y: u32| (y + 2) * 44 + x + 2;
        let way = Front::from(&floor, cell(x, y)).way(&floor, cell(u, v)).unwrap();
        let straight = (f64::from(x) - f64::from(u)).hypot(f64::from(y) - f64::from(v)) * 0.05;
        prop_assert!(way >= straight * 0.983 && way <= straight * 1.02, "{way} {straight}");
    }
}
