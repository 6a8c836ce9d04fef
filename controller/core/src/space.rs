//! Which robots are nearest: a hash grid per map over live poses.
//!
//! A robot that moves inside its cell costs a write, one that changes cell two. A query walks rings
//! of cells outwards from the position and stops as soon as no farther ring can hold anything nearer.
//! Cells are columns: height counts in distances (robots on several floors), not in the grid.

use std::cmp::Ordering;
use std::collections::{BinaryHeap, HashMap};
use std::hash::{BuildHasherDefault, Hasher};

use nalgebra::Point3;

/// Side of a cell, metres. Radii of work in a building are 5 to 50 m: a query then touches about ten cells, and a cell of
/// a busy hall (one robot per 100 m²) holds four robots. With sides of 10 m the benchmark `offers` is slower.
const CELL: f64 = 20.0;

/// Room for the robots of the first rings, so that a query allocates once.
const READY: usize = 64;

/// Number of a node in the cluster's table; the index knows nothing else of it.
pub type Slot = u32;

type Cell = (i32, i32);

/// Mixes the two numbers of a cell by multiplication. The keys are our own, so nobody can choose them to collide, and
/// a query that walks fifty cells spends its time on distances instead of on hashes.
#[derive(Debug, Clone, Copy, Default)]
struct CellHasher(u64);

impl Hasher for CellHasher {
    fn finish(&self) -> u64 {
        // The table takes its bucket from the low bits and its tag from the high ones.
        self.0 ^ (self.0 >> 32)
    }

    fn write(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.write_i32(i32::from(*byte));
        }
    }

    fn write_i32(&mut self, number: i32) {
        // The odd number nearest to 2^64 over the golden ratio, as in Fibonacci hashing (Knuth, TAOCP 3, 6.4).
        self.0 =
            (self.0.rotate_left(5) ^ u64::from(number as u32)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    }
}

type Cells = HashMap<Cell, Vec<(Slot, Point3<f64>)>, BuildHasherDefault<CellHasher>>;

/// Robots of one map, by position.
#[derive(Debug, Clone, Default)]
struct Grid {
    cells: Cells,
    /// Bounds of all cells that ever held a robot: where rings may stop.
    low: Option<(Cell, Cell)>,
}

/// Where one robot is: its map's number, and its position there.
type Place = (usize, Point3<f64>);

/// Robots by map and position.
#[derive(Debug, Clone, Default)]
pub struct Space {
    grids: Vec<Grid>,
    /// Numbers of the maps.
    maps: HashMap<String, usize>,
    /// Where each robot is now, by slot: slots are dense.
    places: Vec<Option<Place>>,
}

/// A robot that a query found.
#[derive(Debug, Clone, Copy)]
pub struct Found {
    /// The robot.
    pub slot: Slot,
    /// Metres from the query's position.
    pub distance: f64,
}

/// The greatest of all is the nearest, as a [`BinaryHeap`] gives the greatest first.
impl Ord for Found {
    fn cmp(&self, other: &Self) -> Ordering {
        other.distance.total_cmp(&self.distance).then(other.slot.cmp(&self.slot))
    }
}

impl PartialOrd for Found {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Found {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Found {}

fn cell_of(position: &Point3<f64>) -> Cell {
    // Saturating: a position beyond 2^31 cells lands in the last one, and is still compared by its
    // true distance.
    ((position.x / CELL).floor() as i32, (position.y / CELL).floor() as i32)
}

impl Space {
    /// Puts or moves a robot. The position is in the frame of `map`, metres, finite.
    pub fn insert(&mut self, slot: Slot, map: &str, position: Point3<f64>) {
        let (map, cell) = (self.number_of(map), cell_of(&position));
        let index = slot as usize;
        if self.places.len() <= index {
            self.places.resize(index + 1, None);
        }
        match &mut self.places[index] {
            Some((old_map, old)) if *old_map == map && cell_of(old) == cell => {
                *old = position;
                let entries = self.grids[map].cells.get_mut(&cell);
                let entry = entries.and_then(|c| c.iter_mut().find(|(s, _)| *s == slot));
                entry.expect("a robot is in the cell of its place").1 = position;
                return;
            }
            Some(_) => self.remove(slot),
            None => {}
        }
        let grid = &mut self.grids[map];
        grid.cells.entry(cell).or_default().push((slot, position));
        let (low, high) = grid.low.get_or_insert((cell, cell));
        *low = (low.0.min(cell.0), low.1.min(cell.1));
        *high = (high.0.max(cell.0), high.1.max(cell.1));
        self.places[index] = Some((map, position));
    }

    fn number_of(&mut self, map: &str) -> usize {
        if let Some(number) = self.maps.get(map) {
            return *number;
        }
        self.grids.push(Grid::default());
        self.maps.insert(map.to_owned(), self.grids.len() - 1);
        self.grids.len() - 1
    }

    /// Takes a robot out.
    pub fn remove(&mut self, slot: Slot) {
        let place = self.places.get_mut(slot as usize).and_then(Option::take);
        let Some((map, position)) = place else { return };
        let (cells, cell) = (&mut self.grids[map].cells, cell_of(&position));
        let entries = cells.get_mut(&cell).expect("a robot is in the cell of its place");
        entries.retain(|(s, _)| *s != slot);
        if entries.is_empty() {
            cells.remove(&cell);
        }
    }

    /// The robots of `map` within `radius` metres of `at` (the rim is inside), nearest first; equal
    /// distances by slot (Avalon, Alg. 1: range filter and ascending reorder). The iterator does work
    /// only as far as it is taken.
    #[must_use]
    pub fn nearest(&self, map: &str, at: Point3<f64>, radius: f64) -> Nearest<'_> {
        Nearest {
            grid: self.maps.get(map).map(|number| &self.grids[*number]),
            at,
            radius,
            ring: 0,
            ready: BinaryHeap::with_capacity(READY),
            done: false,
        }
    }
}

/// Robots by distance; see [`Space::nearest`].
#[derive(Debug)]
pub struct Nearest<'a> {
    grid: Option<&'a Grid>,
    at: Point3<f64>,
    radius: f64,
    /// The next ring of cells to look into.
    ring: i64,
    /// Found and not yet given. A heap: a dense ring holds hundreds, of which mostly one is taken.
    ready: BinaryHeap<Found>,
    done: bool,
}

impl Nearest<'_> {
    /// Every robot nearer than this has been found: the edge of the rings looked into.
    fn certain(&self) -> f64 {
        let (cx, cy) = cell_of(&self.at);
        let inner = (self.ring - 1) as f64;
        let edge = |coordinate: f64, cell: i32| {
            let into = coordinate - f64::from(cell) * CELL;
            into.min(CELL - into)
        };
        inner * CELL + edge(self.at.x, cx).min(edge(self.at.y, cy)).max(0.0)
    }

    fn look_into_next_ring(&mut self) {
        let Some(grid) = self.grid else {
            self.done = true;
            return;
        };
        let Some((low, high)) = grid.low else {
            self.done = true;
            return;
        };
        let (cx, cy) = cell_of(&self.at);
        let (cx, cy, ring) = (i64::from(cx), i64::from(cy), self.ring);
        let (x0, x1) = (i64::from(low.0), i64::from(high.0));
        let (y0, y1) = (i64::from(low.1), i64::from(high.1));
        let mut look = |x: i64, y: i64| {
            if x < x0 || x > x1 || y < y0 || y > y1 {
                return;
            }
            // Inside the bounds, which are i32.
            let Some(entries) = grid.cells.get(&(x as i32, y as i32)) else { return };
            for (slot, position) in entries {
                let distance = nalgebra::distance(&self.at, position);
                if distance <= self.radius {
                    self.ready.push(Found { slot: *slot, distance });
                }
            }
        };
        // Only the part of the ring inside the bounds is walked: a query far outside of all robots
        // must not walk millions of empty cells.
        for x in (cx - ring).max(x0)..=(cx + ring).min(x1) {
            look(x, cy - ring);
            if ring > 0 {
                look(x, cy + ring);
            }
        }
        for y in (cy - ring + 1).max(y0)..=(cy + ring - 1).min(y1) {
            look(cx - ring, y);
            look(cx + ring, y);
        }
        let past_bounds = cx - ring <= x0 && cx + ring >= x1 && cy - ring <= y0 && cy + ring >= y1;
        self.ring += 1;
        if past_bounds || self.certain() > self.radius {
            self.done = true;
        } else if self.ready.is_empty() {
            self.skip_to_bounds((x0, x1), (y0, y1), (cx, cy));
        }
    }

    /// Rings that lie wholly outside the bounds hold nothing.
    fn skip_to_bounds(&mut self, (x0, x1): (i64, i64), (y0, y1): (i64, i64), (cx, cy): (i64, i64)) {
        let outside = |c: i64, low: i64, high: i64| (low - c).max(c - high).max(0);
        self.ring = self.ring.max(outside(cx, x0, x1).max(outside(cy, y0, y1)));
    }
}

impl Iterator for Nearest<'_> {
    type Item = Found;

    fn next(&mut self) -> Option<Found> {
        loop {
            match self.ready.peek() {
                // Strictly less: an equal distance with a smaller slot may still come from the next ring.
                Some(found) if self.done || found.distance < self.certain() => {
                    return self.ready.pop();
                }
                None if self.done => return None,
                _ => self.look_into_next_ring(),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn brute_force(
        robots: &HashMap<Slot, Point3<f64>>,
        at: Point3<f64>,
        radius: f64,
    ) -> Vec<(Slot, f64)> {
        let mut all: Vec<(Slot, f64)> = robots
            .iter()
            .map(|(slot, p)| (*slot, nalgebra::distance(&at, p)))
            .filter(|(_, d)| *d <= radius)
            .collect();
        all.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        all
    }

    #[test]
    fn the_rim_is_inside_and_equal_distances_have_a_stable_order() {
        let mut space = Space::default();
        for (slot, x) in [(3, -5.0), (1, 5.0), (2, 5.000_001)] {
            space.insert(slot, "map", Point3::new(x, 0.0, 0.0));
        }
        let slots: Vec<Slot> =
            space.nearest("map", Point3::origin(), 5.0).map(|f| f.slot).collect();
        assert_eq!(slots, [1, 3]);
        assert_eq!(space.nearest("other", Point3::origin(), 5.0).count(), 0);
    }

    #[test]
    fn a_query_far_away_ends_soon() {
        let mut space = Space::default();
        space.insert(1, "map", Point3::new(0.0, 0.0, 0.0));
        let found: Vec<Slot> = space
            .nearest("map", Point3::new(1e12, -1e12, 0.0), f64::INFINITY)
            .map(|f| f.slot)
            .collect();
        assert_eq!(found, [1]);
    }

    proptest! {
        #[test]
        fn answers_are_those_of_brute_force(
            moves in proptest::collection::vec((0..24_u32, -60.0..60.0_f64, -60.0..60.0_f64, 0.0..6.0_f64, 0..8_u8), 1..120),
            at in (-80.0..80.0_f64, -80.0..80.0_f64),
            radius in prop_oneof![0.0..150.0_f64, Just(f64::INFINITY)],
        ) {
            let (mut space, mut robots) = (Space::default(), HashMap::new());
            for (slot, x, y, z, what) in moves {
                if what == 0 {
                    space.remove(slot);
                    robots.remove(&slot);
                } else {
                    // Whole metres make equal distances likely.
                    let position = Point3::new(x.round(), y.round(), z.round());
                    space.insert(slot, "map", position);
                    robots.insert(slot, position);
                }
            }
            let at = Point3::new(at.0.round(), at.1.round(), 0.0);
            let found: Vec<(Slot, f64)> = space.nearest("map", at, radius).map(|f| (f.slot, f.distance)).collect();
            prop_assert_eq!(found, brute_force(&robots, at, radius));
        }
    }
}
