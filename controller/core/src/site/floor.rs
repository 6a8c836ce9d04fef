//! A map as robots can drive on it.

use muster_api::map::{Cell, Grid};

/// What a cell is to a robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ground {
    /// A way may lead over it.
    Free,
    /// Free, and too near to an obstacle for a way; one may begin or end there, at a dock, a shelf, a table.
    Near,
    /// Occupied, unknown, or the frame around the map.
    Blocked,
}

/// Cells around a map that are blocked, so that a step of two never leaves it.
const FRAME: u32 = 2;

/// A map in a frame of blocked cells.
#[derive(Debug)]
pub struct Floor {
    /// Cells across, the frame's too.
    pub(super) width: u32,
    /// Metres across a cell.
    pub(super) resolution: f64,
    /// How far ways keep from obstacles, cells.
    pub(super) reach: f64,
    origin: [f64; 3],
    /// Rows from below, each from the left.
    pub(super) ground: Vec<Ground>,
}

impl Floor {
    /// The floor of a map whose ways keep `inflation` metres from what is occupied, measured between cells' middles. Unknown ground
    /// is no way, and keeps none away.
    #[must_use]
    pub fn new(map: &Grid, inflation: f64) -> Floor {
        let (width, height) = (map.width + 2 * FRAME, map.height + 2 * FRAME);
        let mut ground = vec![Ground::Blocked; width as usize * height as usize];
        let columns = map.width as usize;
        for (row, cells) in map.cells.chunks(columns.max(1)).enumerate() {
            let start = (row + FRAME as usize) * width as usize + FRAME as usize;
            for (ground, cell) in ground[start..].iter_mut().zip(cells) {
                if *cell == Cell::Free {
                    *ground = Ground::Free;
                }
            }
        }
        let reach = inflation / map.resolution;
        let mut floor =
            Floor { width, resolution: map.resolution, reach, origin: map.origin, ground };
        floor.inflate(map);
        floor
    }

    /// What is as near to an occupied cell as the reach is no way any more.
    fn inflate(&mut self, map: &Grid) {
        let disc = disc(self.reach);
        let (columns, rows) = (i64::from(map.width), i64::from(map.height));
        let occupied = |column: i64, row: i64| {
            let inside = (0..columns).contains(&column) && (0..rows).contains(&row);
            inside
                && usize::try_from(row * columns + column)
                    .is_ok_and(|at| map.cells[at] == Cell::Occupied)
        };
        for row in 0..rows {
            for column in 0..columns {
                let around = [(1, 0), (-1, 0), (0, 1), (0, -1)];
                // What is within an obstacle is not nearer to anything than its rim.
                let rim = || around.iter().any(|(dx, dy)| !occupied(column + dx, row + dy));
                if !occupied(column, row) || !rim() {
                    continue;
                }
                for (dx, dy) in &disc {
                    let (column, row) = (column + dx, row + dy);
                    if !((0..columns).contains(&column) && (0..rows).contains(&row)) {
                        continue;
                    }
                    let frame = i64::from(FRAME);
                    let at = (row + frame) * i64::from(self.width) + column + frame;
                    if let Some(ground) =
                        usize::try_from(at).ok().and_then(|at| self.ground.get_mut(at))
                        && *ground == Ground::Free
                    {
                        *ground = Ground::Near;
                    }
                }
            }
        }
    }

    /// The cell at a place in the map frame, if a robot can be there.
    #[must_use]
    pub fn cell_at(&self, x: f64, y: f64) -> Option<u32> {
        let (east, north) = (x - self.origin[0], y - self.origin[1]);
        let (sin, cos) = self.origin[2].sin_cos();
        let frame = f64::from(FRAME);
        let across = ((cos * east + sin * north) / self.resolution).floor() + frame;
        let up = ((cos * north - sin * east) / self.resolution).floor() + frame;
        let rows = self.ground.len() / self.width as usize;
        #[expect(clippy::cast_precision_loss, reason = "rows of a map")]
        let inside =
            (0.0..f64::from(self.width)).contains(&across) && (0.0..rows as f64).contains(&up);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "inside the map"
        )]
        let cell = inside.then(|| up as u32 * self.width + across as u32)?;
        (self.ground[cell as usize] != Ground::Blocked).then_some(cell)
    }
}

/// The cells within `reach` of one.
fn disc(reach: f64) -> Vec<(i64, i64)> {
    #[expect(clippy::cast_possible_truncation, reason = "a few cells")]
    let most = reach.max(0.0).floor() as i64;
    let square = (-most..=most).flat_map(|dy| (-most..=most).map(move |dx| (dx, dy)));
    #[expect(clippy::cast_precision_loss, reason = "a few cells")]
    let within = |(dx, dy): &(i64, i64)| (*dx as f64).hypot(*dy as f64) <= reach;
    square.filter(within).collect()
}
