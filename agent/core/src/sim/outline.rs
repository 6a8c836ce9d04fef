//! The walls of a map: where occupied cells end.

use muster_api::map::{Cell, Grid};
use nalgebra::{Point2, Rotation2, Vector2};

use super::world::Wall;

/// The edges between occupied cells and others, each as long as it is straight, of this color.
#[must_use]
pub fn outline(map: &Grid, color: [u8; 3]) -> Vec<Wall> {
    let (width, height) = (i64::from(map.width), i64::from(map.height));
    let [x, y, turn] = map.origin;
    let corner = |column: i64, row: i64| {
        #[expect(clippy::cast_precision_loss, reason = "cells of a map")]
        let at = Vector2::new(column as f64, row as f64) * map.resolution;
        Point2::new(x, y) + Rotation2::new(turn) * at
    };
    let occupied = |column: i64, row: i64| {
        let inside = (0..width).contains(&column) && (0..height).contains(&row);
        inside
            && usize::try_from(row * width + column)
                .is_ok_and(|at| map.cells.get(at) == Some(&Cell::Occupied))
    };
    let mut walls = Vec::new();
    let mut edge = |from: (i64, i64), to: (i64, i64)| {
        walls.push(Wall { from: corner(from.0, from.1), to: corner(to.0, to.1), color });
    };
    for row in 0..=height {
        let is_edge = |column| occupied(column, row - 1) != occupied(column, row);
        runs(width, is_edge, |from, to| edge((from, row), (to, row)));
    }
    for column in 0..=width {
        let is_edge = |row| occupied(column - 1, row) != occupied(column, row);
        runs(height, is_edge, |from, to| edge((column, from), (column, to)));
    }
    walls
}

/// Each longest run of places below `length` that are so.
fn runs(length: i64, is: impl Fn(i64) -> bool, mut each: impl FnMut(i64, i64)) {
    let mut begun = None;
    for at in 0..=length {
        match (at < length && is(at), begun) {
            (true, None) => begun = Some(at),
            (false, Some(from)) => {
                each(from, at);
                begun = None;
            }
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_block_has_four_walls_where_the_map_says() {
        let row = |text: &str| -> Vec<Cell> {
            text.chars().map(|c| if c == '#' { Cell::Occupied } else { Cell::Free }).collect()
        };
        let cells = [row("...."), row(".##."), row(".##.")].concat();
        let map = Grid { width: 4, height: 3, resolution: 0.5, origin: [1.0, 2.0, 0.0], cells };
        let walls = outline(&map, [9; 3]);
        let has = |x1, y1, x2, y2| {
            let (from, to) = (Point2::new(x1, y1), Point2::new(x2, y2));
            walls.contains(&Wall { from, to, color: [9; 3] })
        };
        assert_eq!(walls.len(), 4, "{walls:?}");
        assert!(has(1.5, 2.5, 2.5, 2.5) && has(1.5, 3.5, 2.5, 3.5), "{walls:?}");
        assert!(has(1.5, 2.5, 1.5, 3.5) && has(2.5, 2.5, 2.5, 3.5), "{walls:?}");
        let turned =
            outline(&Grid { origin: [1.0, 2.0, std::f64::consts::FRAC_PI_2], ..map }, [9; 3]);
        assert!((turned[0].from - Point2::new(0.5, 2.5)).norm() < 1e-9, "{:?}", turned[0]);
    }
}
