//! Which robots are nearest: a grid of two levels per map over live poses.
//!
//! A map's floor is cut into tiles, found by a hash, and a tile into cells. A tile keeps its robots in one slice ordered by
//! cell, row by row, so that a query reads the part of each row that its circle covers as one run of memory.
//! A robot that moves inside its cell costs a write, one that changes cell moves its tile's robots between the two.
//!
//! A query reads circles that double, and gives what each adds in order of distance: who asks for the nearest of a large
//! radius pays for a small one. Cells are columns: height counts in distances (robots on several floors), not in the grid.

use std::cmp::Ordering;
use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};

use nalgebra::Point3;

/// Side of a cell, metres. Radii of work in a building are 5 to 50 m; smaller cells follow the circle more closely and
/// make more rows to read; with 8 m the benchmark `offers` is slower. A power of two, so that a cell's edges are exact.
const CELL: f64 = 16.0;

/// Cells along a tile's side.
const SIDE: usize = 8;

/// Cells of a tile.
const CELLS: usize = SIDE * SIDE;

/// Radius of a query's first circle, metres.
const FIRST: f64 = 25.0;

/// Room for the robots of the first circle, so that a query allocates once.
const READY: usize = 64;

/// Rounding of a sum of coordinates, relative to them: a circle's bounds are widened by it, so that a robot whose distance
/// rounds to the radius is inside. Coarser than `f64`'s own by four digits.
const SLACK: f64 = 1e-12;

/// Number of a node in the cluster's table; the index knows nothing else of it.
pub type Slot = u32;

/// Column and row, of a cell or of a tile.
type Key = (i32, i32);

/// Mixes the two numbers of a tile by multiplication. The keys are our own, so nobody can choose them to collide.
#[derive(Debug, Clone, Copy, Default)]
struct TileHasher(u64);

impl Hasher for TileHasher {
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

/// One robot in its tile.
type Entry = (Slot, Point3<f64>);

/// A square of cells with robots.
#[derive(Debug, Clone)]
struct Tile {
    /// Ordered by cell.
    robots: Vec<Entry>,
    /// Where each cell's robots begin; the last number is how many there are.
    begin: [u32; CELLS + 1],
}

impl Tile {
    fn new() -> Self {
        Self { robots: Vec::new(), begin: [0; CELLS + 1] }
    }

    fn insert(&mut self, cell: usize, entry: Entry) {
        self.robots.insert(self.begin[cell + 1] as usize, entry);
        self.begin[cell + 1..].iter_mut().for_each(|b| *b += 1);
    }

    fn index_of(&self, cell: usize, slot: Slot) -> usize {
        let (from, to) = (self.begin[cell] as usize, self.begin[cell + 1] as usize);
        let inside = self.robots[from..to].iter().position(|(s, _)| *s == slot);
        from + inside.expect("a robot is in the cell of its place")
    }

    fn remove(&mut self, cell: usize, slot: Slot) {
        self.robots.remove(self.index_of(cell, slot));
        self.begin[cell + 1..].iter_mut().for_each(|b| *b -= 1);
    }

    /// The robots of a row's cells `from..=to`.
    fn row(&self, row: usize, from: usize, to: usize) -> &[Entry] {
        let first = row * SIDE;
        &self.robots[self.begin[first + from] as usize..self.begin[first + to + 1] as usize]
    }
}

/// Robots of one map, by position.
#[derive(Debug, Clone, Default)]
struct Grid {
    /// Tiles that hold a robot.
    tiles: HashMap<Key, Box<Tile>, BuildHasherDefault<TileHasher>>,
    robots: usize,
}

impl Grid {
    fn insert(&mut self, entry: Entry) {
        let (tile, cell) = place_of(&entry.1);
        self.tiles.entry(tile).or_insert_with(|| Box::new(Tile::new())).insert(cell, entry);
        self.robots += 1;
    }

    fn remove(&mut self, (slot, position): Entry) {
        let (key, cell) = place_of(&position);
        let tile = self.tiles.get_mut(&key).expect("a robot is in the tile of its place");
        tile.remove(cell, slot);
        if tile.robots.is_empty() {
            self.tiles.remove(&key);
        }
        self.robots -= 1;
    }

    /// Moves a robot inside its tile.
    fn shift(&mut self, slot: Slot, from: &Point3<f64>, to: Point3<f64>) {
        let ((key, old), (_, new)) = (place_of(from), place_of(&to));
        let tile = self.tiles.get_mut(&key).expect("a robot is in the tile of its place");
        if old == new {
            let index = tile.index_of(old, slot);
            tile.robots[index].1 = to;
        } else {
            tile.remove(old, slot);
            tile.insert(new, (slot, to));
        }
    }
}

/// Number of the cell along one axis. Saturating: beyond 2^31 cells a position lands in the last one, and is still
/// compared by its true distance.
fn cell_of(coordinate: f64) -> i32 {
    let cells = coordinate / CELL;
    let towards_zero = cells as i32;
    towards_zero.saturating_sub(i32::from(cells < f64::from(towards_zero)))
}

fn tile_of(cell: i32) -> i32 {
    cell.div_euclid(SIDE as i32)
}

/// The tile of a position, and the cell in it.
fn place_of(position: &Point3<f64>) -> (Key, usize) {
    let (x, y) = (cell_of(position.x), cell_of(position.y));
    let side = SIDE as i32;
    let cell = y.rem_euclid(side) * side + x.rem_euclid(side);
    ((tile_of(x), tile_of(y)), cell as usize)
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
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Found {
    /// The robot.
    pub slot: Slot,
    /// Metres from the query's position.
    pub distance: f64,
}

impl Found {
    /// The nearest, and of equals the smallest slot, is the last. The bits of numbers that are not negative are ordered
    /// as they are.
    fn farthest_first(&self, other: &Self) -> Ordering {
        let (one, two) = (other.distance.to_bits(), self.distance.to_bits());
        one.cmp(&two).then(other.slot.cmp(&self.slot))
    }
}

impl Space {
    /// Puts or moves a robot. The position is in the frame of `map`, metres, finite.
    pub fn insert(&mut self, slot: Slot, map: &str, position: Point3<f64>) {
        let map = self.number_of(map);
        let index = slot as usize;
        if self.places.len() <= index {
            self.places.resize(index + 1, None);
        }
        match self.places[index].replace((map, position)) {
            Some((old_map, old)) if old_map == map && place_of(&old).0 == place_of(&position).0 => {
                self.grids[map].shift(slot, &old, position);
            }
            old => {
                if let Some((old_map, old)) = old {
                    self.grids[old_map].remove((slot, old));
                }
                self.grids[map].insert((slot, position));
            }
        }
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
        if let Some((map, position)) = place {
            self.grids[map].remove((slot, position));
        }
    }

    /// The robots of `map` within `radius` metres of `at` (the rim is inside), nearest first; equal
    /// distances by slot (Avalon, Alg. 1: range filter and ascending reorder). The iterator does work
    /// only as far as it is taken.
    #[must_use]
    pub fn nearest(&self, map: &str, at: Point3<f64>, radius: f64) -> Nearest<'_> {
        let grid = self.maps.get(map).map(|number| &self.grids[*number]);
        Nearest { grid, at, radius, seen: -1.0, found: 0, ready: Vec::with_capacity(READY) }
    }
}

/// Robots by distance; see [`Space::nearest`].
#[derive(Debug)]
pub struct Nearest<'a> {
    /// None when everything has been found.
    grid: Option<&'a Grid>,
    at: Point3<f64>,
    radius: f64,
    /// Every robot up to this distance has been found; negative before the first circle.
    seen: f64,
    /// How many that are.
    found: usize,
    /// Found and not yet given; the nearest last.
    ready: Vec<Found>,
}

impl Nearest<'_> {
    /// Reads the next circle.
    fn widen(&mut self, grid: &Grid) {
        let reach = if self.seen < 0.0 { FIRST } else { self.seen * 2.0 }.min(self.radius);
        let circle = Circle { at: self.at, reach, seen: self.seen };
        let ([left, low], [right, high]) = circle.tiles();
        let area =
            (i64::from(right) - i64::from(left) + 1) * (i64::from(high) - i64::from(low) + 1);
        if area > grid.tiles.len() as i64 {
            // A circle wider than all robots together.
            for ((x, y), tile) in &grid.tiles {
                if (left..=right).contains(x) && (low..=high).contains(y) {
                    circle.read(tile, *x, &circle.rows(*y), &mut self.ready);
                }
            }
        } else {
            for y in low..=high {
                let rows = circle.rows(y);
                for x in left..=right {
                    if let Some(tile) = grid.tiles.get(&(x, y)) {
                        circle.read(tile, x, &rows, &mut self.ready);
                    }
                }
            }
        }
        self.ready.sort_unstable_by(Found::farthest_first);
        self.seen = reach;
        self.found += self.ready.len();
        if reach >= self.radius || self.found == grid.robots {
            self.grid = None;
        }
    }
}

impl Iterator for Nearest<'_> {
    type Item = Found;

    fn next(&mut self) -> Option<Found> {
        loop {
            if let Some(found) = self.ready.pop() {
                return Some(found);
            }
            let grid = self.grid?;
            self.widen(grid);
        }
    }
}

/// What a query reads at once: the robots within `reach` metres and farther than `seen`.
#[derive(Debug)]
struct Circle {
    at: Point3<f64>,
    reach: f64,
    seen: f64,
}

/// The cells of a tile's rows that a circle covers: from the first row on, the first and the last column of each, in the
/// map's count of cells.
#[derive(Debug)]
struct Rows {
    first: usize,
    columns: [(i32, i32); SIDE],
    end: usize,
}

impl Circle {
    /// What rounding may add to a sum of `coordinate` and the reach.
    fn slack(&self, coordinate: f64) -> f64 {
        (coordinate.abs() + self.reach) * SLACK
    }

    /// The cells between `centre - half` and `centre + half`.
    fn cells(&self, centre: f64, half: f64) -> (i32, i32) {
        let half = half + self.slack(centre);
        (cell_of(centre - half), cell_of(centre + half))
    }

    /// The tiles of the square around it: lowest and highest column and row.
    fn tiles(&self) -> ([i32; 2], [i32; 2]) {
        let ((left, right), (low, high)) =
            (self.cells(self.at.x, self.reach), self.cells(self.at.y, self.reach));
        ([left, low].map(tile_of), [right, high].map(tile_of))
    }

    fn rows(&self, tile: i32) -> Rows {
        let begin = cell_at(tile);
        let (low, high) = self.cells(self.at.y, self.reach);
        let (first, end) = (within(low, begin), within(high, begin) + 1);
        let slack = self.slack(self.at.y);
        let mut columns = [(0, 0); SIDE];
        for (row, columns) in columns.iter_mut().enumerate().take(end).skip(first) {
            // How far the circle reaches along x at this row's edge that is nearest to the centre.
            let bottom = (begin + row as i64) as f64 * CELL;
            let off = (bottom - self.at.y).max(self.at.y - (bottom + CELL)) - slack;
            let off = off.max(0.0);
            // A row beyond the circle: the last one holds everything that is farther out.
            let half = if off < self.reach {
                (self.reach * self.reach - off * off).sqrt()
            } else {
                self.reach
            };
            *columns = self.cells(self.at.x, half);
        }
        Rows { first, columns, end }
    }

    /// Adds a tile's robots that are in the circle.
    fn read(&self, tile: &Tile, column: i32, rows: &Rows, to: &mut Vec<Found>) {
        let begin = cell_at(column);
        // Most robots outside are told without a root.
        let almost = self.reach * self.reach * (1.0 + 4.0 * f64::EPSILON);
        for row in rows.first..rows.end {
            let (left, right) = rows.columns[row];
            for (slot, position) in tile.row(row, within(left, begin), within(right, begin)) {
                let squared = nalgebra::distance_squared(&self.at, position);
                if squared > almost {
                    continue;
                }
                let distance = squared.sqrt();
                if distance <= self.reach && distance > self.seen {
                    to.push(Found { slot: *slot, distance });
                }
            }
        }
    }
}

/// The first cell of a tile along one axis. Wider than a cell's number: the last tile ends beyond it.
fn cell_at(tile: i32) -> i64 {
    i64::from(tile) * SIDE as i64
}

/// The place of a cell in the tile that begins at `begin`, or of the tile's cell that is nearest to it.
fn within(cell: i32, begin: i64) -> usize {
    (i64::from(cell) - begin).clamp(0, SIDE as i64 - 1) as usize
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

    #[test]
    fn positions_beyond_the_last_cell_are_compared_by_their_distance() {
        let mut space = Space::default();
        for (slot, x) in [(1, 0.0), (2, 30.0), (3, 61.0)] {
            space.insert(slot, "map", Point3::new(x, 2e12, 0.0));
        }
        let slots: Vec<Slot> =
            space.nearest("map", Point3::new(0.0, 2e12, 0.0), 60.0).map(|f| f.slot).collect();
        assert_eq!(slots, [1, 2]);
    }

    proptest! {
        #[test]
        fn answers_are_those_of_brute_force(
            moves in proptest::collection::vec((0..24_u32, -200.0..200.0_f64, -200.0..200.0_f64, 0.0..6.0_f64, 0..8_u8), 1..160),
            at in (-220.0..220.0_f64, -220.0..220.0_f64),
            radius in prop_oneof![0.0..450.0_f64, Just(f64::INFINITY)],
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
