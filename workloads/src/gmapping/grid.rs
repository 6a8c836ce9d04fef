//! An occupancy grid: for each cell the log-odds that something is there (Moravec, Elfes 1985), and the
//! mean of where beams ended in it, so that matching is finer than the cells are (as gmapping has it).

use super::world::{Bounds, MAX_RANGE};
use super::{Pose, Scan};

/// What a beam that passes, and one that ends there, adds.
const PASSED: f32 = -0.4;
const HIT: f32 = 0.9;
/// A cell is never surer than this, so that it can still change.
const SUREST: f32 = 6.0;
/// A cell above this is a wall for matching.
const WALL: f32 = 0.6;
/// Deviation of the end of a beam from a wall's cell when the pose is right, m.
const MATCH_DEVIATION: f64 = 0.08;
/// Likelihood of a beam that ends where no wall is known: new walls, glass, people.
const SURPRISE: f64 = 0.05;
/// Metres around the rooms that the map has, too: poses may be a little wrong.
const MARGIN: f64 = 0.5;

/// Ends of beams that make a cell's mean: later ones go on moving it a little.
const MEAN_OF: f32 = 30.0;

#[derive(Debug, Clone, Copy, Default)]
struct Cell {
    /// Log-odds; 0 is not known.
    odds: f32,
    /// Beams that ended here, up to [`MEAN_OF`].
    hits: f32,
    /// Mean of where, in cells from the cell's corner.
    mean: [f32; 2],
}

/// A map.
#[derive(Debug, Clone)]
pub(super) struct Grid {
    /// Of the corner of cell (0, 0), m.
    origin: [f64; 2],
    /// Metres across a cell.
    resolution: f64,
    width: usize,
    height: usize,
    /// Row by row.
    cells: Vec<Cell>,
}

impl Grid {
    pub(super) fn new([left, bottom, right, top]: Bounds, resolution: f64) -> Self {
        let count = |length: f64| ((length + 2.0 * MARGIN) / resolution).ceil() as usize;
        let (width, height) = (count(right - left), count(top - bottom));
        Grid {
            origin: [left - MARGIN, bottom - MARGIN],
            resolution,
            width,
            height,
            cells: vec![Cell::default(); width * height],
        }
    }

    /// Column and row as real numbers: a cell's corner is at its number.
    fn cell(&self, x: f64, y: f64) -> (f64, f64) {
        ((x - self.origin[0]) / self.resolution, (y - self.origin[1]) / self.resolution)
    }

    fn at(&self, column: i64, row: i64) -> Option<usize> {
        let (column, row) = (usize::try_from(column).ok()?, usize::try_from(row).ok()?);
        (column < self.width && row < self.height).then_some(row * self.width + column)
    }

    /// Log-likelihood of a scan from a pose: of how far each beam ends from a wall that is known.
    /// Every `stride`-th beam is looked at.
    pub(super) fn likelihood(&self, pose: &Pose, scan: &Scan, stride: usize) -> f64 {
        let scale = 1.0 / (2.0 * MATCH_DEVIATION * MATCH_DEVIATION);
        let beams = (0..scan.ranges.len()).step_by(stride);
        beams
            .filter(|&beam| scan.ranges[beam] < MAX_RANGE)
            .map(|beam| {
                let (sin, cos) = (pose.yaw + scan.direction(beam)).sin_cos();
                let range = scan.ranges[beam];
                let squared = self.wall_near(pose.x + range * cos, pose.y + range * sin);
                (SURPRISE + squared.map_or(0.0, |d| (-d * scale).exp())).ln()
            })
            .sum()
    }

    /// Squared metres to the nearest wall's mean among the nine cells around a point.
    fn wall_near(&self, x: f64, y: f64) -> Option<f64> {
        let (cx, cy) = self.cell(x, y);
        let (column, row) = (cx.floor() as i64, cy.floor() as i64);
        let mut nearest = f64::INFINITY;
        for r in row - 1..=row + 1 {
            for c in column - 1..=column + 1 {
                let cell = self.at(c, r).map(|i| &self.cells[i]);
                if let Some(cell) = cell.filter(|cell| cell.odds > WALL) {
                    let [mx, my] = cell.mean.map(f64::from);
                    let (dx, dy) = (c as f64 + mx - cx, r as f64 + my - cy);
                    nearest = nearest.min(dx * dx + dy * dy);
                }
            }
        }
        nearest.is_finite().then_some(nearest * self.resolution * self.resolution)
    }

    /// Draws a scan into the map.
    pub(super) fn draw(&mut self, pose: &Pose, scan: &Scan) {
        for (beam, &range) in scan.ranges.iter().enumerate() {
            let direction = pose.yaw + scan.direction(beam);
            self.draw_beam(pose, direction, range);
            if range < MAX_RANGE {
                let (sin, cos) = direction.sin_cos();
                self.hit(self.cell(pose.x + range * cos, pose.y + range * sin));
            }
        }
    }

    /// Visits each cell along a beam once (Amanatides, Woo 1987).
    fn draw_beam(&mut self, pose: &Pose, direction: f64, range: f64) {
        let (sin, cos) = direction.sin_cos();
        let (x, y) = self.cell(pose.x, pose.y);
        let length = range / self.resolution;
        let axis = |start: f64, slope: f64| {
            let step = if slope > 0.0 { 1_i64 } else { -1 };
            let edge =
                if slope > 0.0 { start.floor() + 1.0 - start } else { start - start.floor() };
            // A beam along the other axis never reaches an edge of this one.
            let scale = 1.0 / slope.abs().max(1e-12);
            (step, edge * scale, scale)
        };
        let (step_x, mut next_x, cell_x) = axis(x, cos);
        let (step_y, mut next_y, cell_y) = axis(y, sin);
        let (mut column, mut row) = (x.floor() as i64, y.floor() as i64);
        loop {
            self.add(column, row, PASSED);
            if next_x.min(next_y) > length {
                return;
            }
            if next_x < next_y {
                column += step_x;
                next_x += cell_x;
            } else {
                row += step_y;
                next_y += cell_y;
            }
        }
    }

    fn add(&mut self, column: i64, row: i64, odds: f32) {
        if let Some(i) = self.at(column, row) {
            self.cells[i].odds = (self.cells[i].odds + odds).clamp(-SUREST, SUREST);
        }
    }

    /// A beam ended here, which was counted as one that passed.
    fn hit(&mut self, (x, y): (f64, f64)) {
        let (column, row) = (x.floor(), y.floor());
        let Some(i) = self.at(column as i64, row as i64) else { return };
        self.add(column as i64, row as i64, HIT - PASSED);
        let cell = &mut self.cells[i];
        cell.hits = (cell.hits + 1.0).min(MEAN_OF);
        for (mean, end) in cell.mean.iter_mut().zip([x - column, y - row]) {
            *mean += (end as f32 - *mean) / cell.hits;
        }
    }

    /// Square metres that are known.
    pub(super) fn known(&self) -> f64 {
        let known = self.cells.iter().filter(|cell| cell.odds != 0.0).count();
        known as f64 * self.resolution * self.resolution
    }

    /// Part of the floor that is known. `is_floor` says what is floor.
    pub(super) fn coverage(&self, is_floor: impl Fn(f64, f64) -> bool) -> f64 {
        let (mut floor, mut known) = (0_u32, 0_u32);
        for (i, cell) in self.cells.iter().enumerate() {
            let x = self.origin[0] + ((i % self.width) as f64 + 0.5) * self.resolution;
            let y = self.origin[1] + ((i / self.width) as f64 + 0.5) * self.resolution;
            if is_floor(x, y) {
                floor += 1;
                known += u32::from(cell.odds != 0.0);
            }
        }
        f64::from(known) / f64::from(floor.max(1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gmapping::world::World;
    use crate::rng::Rng;

    fn drawn() -> (World, Scan, Grid) {
        let world = World::rooms();
        let scan = world.scan(&Pose::default(), 120, &mut Rng::new(1));
        let mut grid = Grid::new(world.bounds(), 0.1);
        grid.draw(&Pose::default(), &scan);
        (world, scan, grid)
    }

    #[test]
    fn the_right_pose_is_the_likeliest() {
        let (_, scan, grid) = drawn();
        let right = grid.likelihood(&Pose::default(), &scan, 1);
        for (x, y, yaw) in [(0.3, 0.0, 0.0), (0.0, -0.3, 0.0), (0.0, 0.0, 0.15)] {
            let wrong = grid.likelihood(&Pose { x, y, yaw }, &scan, 1);
            assert!(wrong < right - 10.0, "{x} {y} {yaw}: {wrong} against {right}");
        }
    }

    #[test]
    fn what_was_passed_is_free_and_what_was_hit_is_a_wall() {
        let (world, _, grid) = drawn();
        let odds = |x: f64, y: f64| {
            let (c, r) = grid.cell(x, y);
            grid.cells[grid.at(c as i64, r as i64).unwrap()].odds
        };
        assert!(odds(0.5, 0.5) < 0.0 && odds(9.5, 6.5) == 0.0);
        assert!(odds(-2.0, 0.02).max(odds(-2.05, 0.02)) > WALL);
        let covered = grid.coverage(|x, y| world.is_floor(x, y));
        assert!((0.1..0.6).contains(&covered), "{covered}");
    }
}
