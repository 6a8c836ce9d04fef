//! Walls, and what meets them: a ray, and a disc that moves along a line.
//!
//! Walls are segments without thickness, found through a grid of square cells, so that a ray looks at those along its way
//! only. Everything is exact but for [`TOUCH`]; tests hold it against every wall, one by one.

use nalgebra::{Point2, Vector2};

/// Metres and directions that differ by less are the same: far below what a laser resolves, far above what `f64` loses in a
/// building.
pub const TOUCH: f64 = 1e-9;

/// The grid has at most so many cells; a larger world has larger ones.
const MOST_CELLS: f64 = 1_000_000.0;

/// Cells along one side at most, so that a long wall is in some thousand.
const MOST_ALONG: f64 = 4_096.0;

/// Cells are at least so large, metres: a robot's width, and a ray crosses two a metre.
const LEAST_CELL: f64 = 0.5;

/// A wall.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wall {
    /// One end, metres in the map frame.
    pub from: Point2<f64>,
    /// The other.
    pub to: Point2<f64>,
    /// Red, green and blue, as the camera sees it from near and straight on.
    pub color: [u8; 3],
}

/// What a ray meets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Metres from the ray's origin.
    pub distance: f64,
    /// Which of the world's walls.
    pub wall: usize,
}

/// Walls that do not move.
#[derive(Debug, Clone)]
pub struct World {
    walls: Vec<Wall>,
    grid: Grid,
}

/// Which walls are in which cell.
#[derive(Debug, Clone)]
struct Grid {
    origin: Point2<f64>,
    cell: f64,
    columns: usize,
    rows: usize,
    /// Where each cell's part of `walls` begins; one more than there are cells.
    starts: Vec<u32>,
    walls: Vec<u32>,
}

impl World {
    /// A world of these walls.
    #[must_use]
    pub fn new(walls: Vec<Wall>) -> World {
        let grid = Grid::of(&walls);
        World { walls, grid }
    }

    /// Its walls, in the order of their numbers.
    #[must_use]
    pub fn walls(&self) -> &[Wall] {
        &self.walls
    }

    /// The first wall that a ray from `origin` along `angle` meets within `reach` metres.
    #[must_use]
    pub fn cast(&self, origin: Point2<f64>, angle: f64, reach: f64) -> Option<Hit> {
        let along = Vector2::new(angle.cos(), angle.sin());
        let mut best: Option<Hit> = None;
        self.grid.walk(origin, along, reach, |walls, leaves_at| {
            for &wall in walls {
                let wall = wall as usize;
                let distance = meets(&self.walls[wall], origin, along).filter(|d| *d <= reach);
                if let Some(distance) = distance.filter(|d| best.is_none_or(|b| *d < b.distance)) {
                    best = Some(Hit { distance, wall });
                }
            }
            // A wall of this cell may be met beyond it, where another is before it.
            best.is_none_or(|b| b.distance > leaves_at)
        });
        best
    }

    /// Metres from the line between `from` and `to` to the nearest wall; infinite, when none is nearer than `within`.
    #[must_use]
    pub fn clearance(&self, from: Point2<f64>, to: Point2<f64>, within: f64) -> f64 {
        let mut least = f64::INFINITY;
        self.grid.around(from, to, within, |wall| {
            let wall = &self.walls[wall as usize];
            least = least.min(between((from, to), (wall.from, wall.to)));
        });
        if least <= within { least } else { f64::INFINITY }
    }
}

/// Where along a ray a wall is, metres; `along` has length 1.
fn meets(wall: &Wall, origin: Point2<f64>, along: Vector2<f64>) -> Option<f64> {
    let (side, start) = (wall.to - wall.from, wall.from - origin);
    let length = side.norm();
    let across = along.perp(&side);
    if across.abs() <= TOUCH * length {
        // Parallel: met only by its end, when it lies in the ray.
        let ends = [start, wall.to - origin];
        let in_line = along.perp(&start).abs() <= TOUCH;
        let ahead = ends.map(|end| along.dot(&end));
        let inside = ahead[0].min(ahead[1]) <= 0.0 && ahead[0].max(ahead[1]) >= 0.0;
        let first = if inside { 0.0 } else { ahead[0].min(ahead[1]) };
        return (in_line && first >= 0.0).then_some(first);
    }
    let (distance, at) = (start.perp(&side) / across, start.perp(&along) / across);
    let ends = TOUCH / length;
    ((-ends..=1.0 + ends).contains(&at) && distance >= -TOUCH).then_some(distance.max(0.0))
}

/// A line between two points.
type Line = (Point2<f64>, Point2<f64>);

/// Metres between two lines.
fn between(one: Line, other: Line) -> f64 {
    if cross(one, other) {
        return 0.0;
    }
    let ends = [
        to_line(one.0, other),
        to_line(one.1, other),
        to_line(other.0, one),
        to_line(other.1, one),
    ];
    ends.into_iter().fold(f64::INFINITY, f64::min)
}

fn cross(one: Line, other: Line) -> bool {
    let side = |line: Line, point: Point2<f64>| (line.1 - line.0).perp(&(point - line.0));
    let apart = |line: Line, ends: Line| side(line, ends.0) * side(line, ends.1) < 0.0;
    apart(one, other) && apart(other, one)
}

fn to_line(point: Point2<f64>, line: Line) -> f64 {
    let side = line.1 - line.0;
    let squared = side.norm_squared();
    let at =
        if squared > 0.0 { ((point - line.0).dot(&side) / squared).clamp(0.0, 1.0) } else { 0.0 };
    (line.0 + side * at - point).norm()
}

impl Grid {
    fn of(walls: &[Wall]) -> Grid {
        let ends = || walls.iter().flat_map(|wall| [wall.from, wall.to]);
        let edge = |axis: usize, pick: fn(f64, f64) -> f64| {
            ends().map(|p| p[axis]).reduce(pick).unwrap_or(0.0)
        };
        let least = Point2::new(edge(0, f64::min), edge(1, f64::min));
        let size = Point2::new(edge(0, f64::max), edge(1, f64::max)) - least;
        let even = (size.x.max(1.0) * size.y.max(1.0) / MOST_CELLS).sqrt();
        let cell = even.max(size.max() / MOST_ALONG).max(LEAST_CELL);
        // Walls along the rim are inside of it.
        let origin = least - Vector2::repeat(cell / 2.0);
        let count = |length: f64| index(((length + cell) / cell).floor()) + 1;
        let (columns, rows) = (count(size.x), count(size.y));
        let mut grid = Grid { origin, cell, columns, rows, starts: Vec::new(), walls: Vec::new() };
        grid.fill(walls);
        grid
    }

    fn fill(&mut self, walls: &[Wall]) {
        let mut pairs: Vec<(usize, u32)> = Vec::new();
        let reach = self.cell * std::f64::consts::FRAC_1_SQRT_2 + TOUCH;
        for (number, wall) in (0_u32..).zip(walls) {
            // Row by row, each with that part of the wall which can be near it: a wall across is not in every cell around it.
            for (from, to) in self.by_rows(wall, reach) {
                for (cell, middle) in self.cells_of(from, to, 0.0) {
                    // What passes a cell is no farther from its middle than its corners are.
                    if to_line(middle, (wall.from, wall.to)) <= reach {
                        pairs.push((cell, number));
                    }
                }
            }
        }
        pairs.sort_unstable();
        let mut starts = vec![0_u32; self.columns * self.rows + 1];
        for (cell, _) in &pairs {
            starts[cell + 1] += 1;
        }
        for cell in 1..starts.len() {
            starts[cell] += starts[cell - 1];
        }
        self.starts = starts;
        self.walls = pairs.into_iter().map(|(_, wall)| wall).collect();
    }

    /// A box for each row of cells that a wall passes, by two of its corners: of the row's height, and as wide as what of the
    /// wall is within `reach` of the row.
    fn by_rows(&self, wall: &Wall, reach: f64) -> impl Iterator<Item = Line> + use<> {
        let (origin, cell, count) = (self.origin, self.cell, self.rows);
        let (from, side) = (wall.from, wall.to - wall.from);
        let row = |y: f64| index(((y - origin.y) / cell).floor()).min(count - 1);
        let (low, high) = (wall.from.y.min(wall.to.y), wall.from.y.max(wall.to.y));
        (row(low)..row(high) + 1).map(move |row| {
            let (bottom, top) =
                (origin.y + count_of(row) * cell, origin.y + count_of(row + 1) * cell);
            let at = |y: f64, level: f64| {
                if side.y == 0.0 { level } else { ((y - from.y) / side.y).clamp(0.0, 1.0) }
            };
            let x = [at(bottom - reach, 0.0), at(top + reach, 1.0)].map(|at| from.x + side.x * at);
            let middle = f64::midpoint(bottom, top);
            let corner = |x: f64| Point2::new(x, middle);
            (corner(x[0].min(x[1]) - reach), corner(x[0].max(x[1]) + reach))
        })
    }

    /// The cells around a line, each with its middle.
    fn cells_of(
        &self,
        from: Point2<f64>,
        to: Point2<f64>,
        margin: f64,
    ) -> impl Iterator<Item = (usize, Point2<f64>)> + use<> {
        let (origin, cell, columns) = (self.origin, self.cell, self.columns);
        let span = |axis: usize, count: usize| {
            let (a, b) = (from[axis].min(to[axis]) - margin, from[axis].max(to[axis]) + margin);
            let place = |at: f64| ((at - origin[axis]) / cell).floor();
            let last = place(b);
            let none = last < 0.0 || place(a) >= count_of(count);
            if none { 1..1 } else { index(place(a))..index(last).min(count - 1) + 1 }
        };
        let (across, up) = (span(0, self.columns), span(1, self.rows));
        up.flat_map(move |row| {
            across.clone().map(move |column| {
                let half = |at: usize| (count_of(at) + 0.5) * cell;
                (row * columns + column, origin + Vector2::new(half(column), half(row)))
            })
        })
    }

    fn walls_of(&self, cell: usize) -> &[u32] {
        &self.walls[self.starts[cell] as usize..self.starts[cell + 1] as usize]
    }

    fn around(&self, from: Point2<f64>, to: Point2<f64>, within: f64, mut each: impl FnMut(u32)) {
        for (cell, _) in self.cells_of(from, to, within) {
            self.walls_of(cell).iter().copied().for_each(&mut each);
        }
    }

    /// Calls `cell` with the walls of each cell along a ray and where the ray leaves it, while it says to go on (Amanatides and
    /// Woo, "A fast voxel traversal algorithm").
    fn walk(
        &self,
        origin: Point2<f64>,
        along: Vector2<f64>,
        reach: f64,
        mut cell: impl FnMut(&[u32], f64) -> bool,
    ) {
        let Some(enters) = self.enters(origin, along).filter(|at| *at <= reach) else { return };
        let start = origin + along * enters - self.origin;
        let counts = [self.columns, self.rows];
        let mut place =
            [0, 1].map(|axis| index((start[axis] / self.cell).floor()).min(counts[axis] - 1));
        let step = [0, 1].map(|axis| self.cell / along[axis].abs());
        // Where the ray leaves the present cell, by each axis.
        let mut leaves = [0, 1].map(|axis: usize| {
            let edge = count_of(place[axis] + usize::from(along[axis] > 0.0)) * self.cell;
            if along[axis] == 0.0 {
                f64::INFINITY
            } else {
                enters + (edge - start[axis]) / along[axis]
            }
        });
        loop {
            let axis = usize::from(leaves[1] < leaves[0]);
            let at = leaves[axis];
            if !cell(self.walls_of(place[1] * self.columns + place[0]), at) || at > reach {
                return;
            }
            leaves[axis] += step[axis];
            let next =
                if along[axis] > 0.0 { place[axis] + 1 } else { place[axis].wrapping_sub(1) };
            if next >= counts[axis] {
                return;
            }
            place[axis] = next;
        }
    }

    /// Where a ray comes into the grid, metres; none: it passes by.
    fn enters(&self, origin: Point2<f64>, along: Vector2<f64>) -> Option<f64> {
        let (mut first, mut last) = (0.0_f64, f64::INFINITY);
        for (axis, count) in [(0, self.columns), (1, self.rows)] {
            let (low, high) = (self.origin[axis], self.origin[axis] + count_of(count) * self.cell);
            if along[axis] == 0.0 {
                if !(low..=high).contains(&origin[axis]) {
                    return None;
                }
                continue;
            }
            let (a, b) = ((low - origin[axis]) / along[axis], (high - origin[axis]) / along[axis]);
            (first, last) = (first.max(a.min(b)), last.min(a.max(b)));
        }
        (first <= last).then_some(first)
    }
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "below MOST_CELLS, and at least 0"
)]
fn index(at: f64) -> usize {
    at.max(0.0) as usize
}

#[expect(clippy::cast_precision_loss, reason = "below MOST_CELLS")]
fn count_of(at: usize) -> f64 {
    at as f64
}

#[cfg(test)]
pub(super) mod tests {
    use std::f64::consts::{FRAC_PI_2, PI, TAU};

    use proptest::prelude::*;

    use super::*;

    pub(in crate::sim) fn wall(x1: f64, y1: f64, x2: f64, y2: f64) -> Wall {
        Wall { from: Point2::new(x1, y1), to: Point2::new(x2, y2), color: [200; 3] }
    }

    /// A room with its corners at (x1, y1) and (x2, y2).
    pub(in crate::sim) fn room(x1: f64, y1: f64, x2: f64, y2: f64) -> Vec<Wall> {
        vec![wall(x1, y1, x2, y1), wall(x2, y1, x2, y2), wall(x2, y2, x1, y2), wall(x1, y2, x1, y1)]
    }

    pub(in crate::sim) fn walls() -> impl Strategy<Value = Vec<Wall>> {
        // Half metres: walls that touch, lie in line and are parallel to rays.
        let at = || (-40..40_i32).prop_map(|half| f64::from(half) / 2.0);
        let one = (at(), at(), at(), at()).prop_map(|(a, b, c, d)| wall(a, b, c, d));
        proptest::collection::vec(one.prop_filter("a point is none", |w| w.from != w.to), 0..12)
    }

    #[test]
    fn large_worlds_have_bounded_grids() {
        let far = 1e6;
        for walls in [
            vec![wall(-far, 0.0, far, 1.0)],
            vec![wall(-far, -far, far, far), wall(-far, far, far, -far)],
            vec![wall(0.0, -far, 0.0, far), wall(0.0, 0.0, 1e-3, 0.0)],
        ] {
            let world = World::new(walls.clone());
            let grid = &world.grid;
            assert!(count_of(grid.columns.max(grid.rows)) <= MOST_ALONG + 2.0, "{}", grid.columns);
            // A line passes no more cells than columns and rows together, and touches as many.
            assert!(grid.walls.len() <= 4 * (grid.columns + grid.rows), "{}", grid.walls.len());
            let hit = world.cast(Point2::new(-2.0, -1.0), FRAC_PI_2, far).map(|hit| hit.wall);
            let nearest = walls.iter().enumerate().filter_map(|(number, wall)| {
                let up = Vector2::new(0.0, 1.0);
                meets(wall, Point2::new(-2.0, -1.0), up).map(|at| (at, number))
            });
            assert_eq!(hit, nearest.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, number)| number));
        }
    }

    #[test]
    fn a_ray_meets_the_nearest_wall() {
        let mut walls = room(0.0, 0.0, 10.0, 4.0);
        walls.push(wall(6.0, 1.0, 6.0, 3.0));
        let world = World::new(walls);
        let cast = |x, y, angle| world.cast(Point2::new(x, y), angle, 30.0);
        assert_eq!(cast(1.0, 2.0, 0.0).map(|h| h.wall), Some(4));
        assert!((cast(1.0, 2.0, 0.0).unwrap().distance - 5.0).abs() < TOUCH);
        assert!((cast(1.0, 0.5, 0.0).unwrap().distance - 9.0).abs() < TOUCH);
        assert!((cast(1.0, 2.0, PI).unwrap().distance - 1.0).abs() < TOUCH);
        assert!((cast(-5.0, 2.0, 0.0).unwrap().distance - 5.0).abs() < TOUCH, "from outside");
        assert_eq!(cast(-5.0, 2.0, FRAC_PI_2), None);
        assert_eq!(world.cast(Point2::new(1.0, 2.0), 0.0, 4.9), None, "beyond its reach");
    }

    proptest! {
        #[test]
        fn rays_are_as_by_every_wall_one_by_one(
            walls in walls(),
            (x, y) in (-25.0..25.0, -25.0..25.0_f64),
            angle in prop_oneof![0.0..TAU, (0..8_i32).prop_map(|eighth| f64::from(eighth) * TAU / 8.0)],
            reach in 0.5..60.0_f64,
        ) {
            let (origin, along) = (Point2::new(x, y), Vector2::new(angle.cos(), angle.sin()));
            let nearest = walls.iter().filter_map(|w| meets(w, origin, along)).reduce(f64::min);
            let nearest = nearest.filter(|d| *d <= reach);
            let cast = World::new(walls).cast(origin, angle, reach).map(|hit| hit.distance);
            prop_assert!(
                match (nearest, cast) {
                    (Some(a), Some(b)) => (a - b).abs() < 1e-6,
                    (a, b) => a.is_none() && b.is_none() || a.or(b).is_some_and(|d| (d - reach).abs() < 1e-6),
                },
                "{nearest:?} {cast:?}"
            );
        }

        #[test]
        fn clearance_is_as_by_every_wall_one_by_one(
            walls in walls(),
            (x, y) in (-25.0..25.0, -25.0..25.0_f64),
            (dx, dy) in (-3.0..3.0, -3.0..3.0_f64),
            within in 0.1..8.0_f64,
        ) {
            let (from, to) = (Point2::new(x, y), Point2::new(x + dx, y + dy));
            // Brute force: many points of the line.
            let sample = |t: f64| {
                let at = from + (to - from) * t;
                walls.iter().map(|w| to_line(at, (w.from, w.to))).fold(f64::INFINITY, f64::min)
            };
            let least = (0..=400).map(|i| sample(f64::from(i) / 400.0)).fold(f64::INFINITY, f64::min);
            let found = World::new(walls.clone()).clearance(from, to, within);
            // Between two samples the line comes nearer by half their distance at most.
            let slack = (to - from).norm() / 800.0 + 1e-9;
            if found.is_finite() {
                prop_assert!(found <= least + 1e-9 && found >= least - slack, "{found} {least}");
            } else {
                prop_assert!(least > within - slack, "{least}");
            }
        }
    }
}
