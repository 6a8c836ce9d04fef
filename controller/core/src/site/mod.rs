//! Ways over a site's floor: how far robots have to go to an operation position, walls counted (DESIGN §5, `TravelTime`).
//!
//! | module | holds |
//! |---|---|
//! | [`floor`] | a map with what is too near to obstacles, made once for each Site |
//! | [`wavefront`] | one search from an operation position, which gives the ways of all robots at once |
//!
//! A wavefront over 200 m × 200 m costs a good part of a second, and robots move many times in one: fronts are kept by floor and cell of the
//! operation position, the newest up to [`KEPT`]. What is kept changes no answer, so clones of [`Sites`] share it.

pub mod floor;
pub mod wavefront;

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use muster_api::kind::site::SiteSpec;
use muster_api::pose::{OperationPosition, Pose};

use self::floor::Floor;
use self::wavefront::Front;

/// Memory of the fronts that are kept, bytes; the newest one is kept whatever it takes. Six of 2 000 × 2 000 cells.
pub const KEPT: usize = 96 << 20;

/// How far a robot has to go.
#[derive(Debug, Clone, PartialEq)]
pub enum Travel {
    /// No Site says anything of the map: the straight line.
    NoSite,
    /// Metres over the floor.
    Way(f64),
    /// There is no way.
    None(NoWay),
}

/// Why there is no way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NoWay {
    /// Both are on the floor, and walls or unknown ground are between them.
    Enclosed,
    /// The operation position is beyond the map, in an obstacle, or where nobody has looked.
    WorkOffFloor,
    /// So is the robot.
    RobotOffFloor,
}

/// The floor of a Site.
#[derive(Debug, Clone)]
struct Plan {
    map: String,
    floor: Arc<Floor>,
}

/// A front that is kept.
#[derive(Debug)]
struct Kept {
    floor: Arc<Floor>,
    cell: u32,
    front: Arc<Front>,
}

/// Every Site.
#[derive(Debug, Clone, Default)]
pub struct Sites {
    /// By the Site's name.
    plans: BTreeMap<String, Plan>,
    /// The least lately used first.
    kept: Arc<Mutex<Vec<Kept>>>,
}

impl Sites {
    /// Sets or removes what a Site says.
    pub fn set(&mut self, name: &str, spec: Option<&SiteSpec>) {
        let plan = spec.and_then(|spec| {
            // Admission has read it; one that does not read says nothing.
            let grid = spec.grid.as_ref()?.grid().ok()?;
            let map = spec.map.clone().unwrap_or_else(|| name.to_owned());
            Some(Plan { map, floor: Arc::new(Floor::new(&grid, spec.inflation)) })
        });
        let old = match plan {
            Some(plan) => self.plans.insert(name.to_owned(), plan),
            None => self.plans.remove(name),
        };
        if let Some(old) = old {
            let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
            kept.retain(|kept| !Arc::ptr_eq(&kept.floor, &old.floor));
        }
    }

    /// The name of the Site of a map.
    #[must_use]
    pub fn of_map(&self, map: &str) -> Option<&str> {
        self.plans.iter().find(|(_, plan)| plan.map == map).map(|(name, _)| name.as_str())
    }

    /// How far a robot at `pose` has to go to `at`; both are in one map.
    #[must_use]
    pub fn travel(&self, at: &OperationPosition, pose: &Pose) -> Travel {
        let Some(plan) = self.plans.values().find(|plan| plan.map == at.map) else {
            return Travel::NoSite;
        };
        let floor = &plan.floor;
        let Some(cell) = floor.cell_at(at.x, at.y) else {
            return Travel::None(NoWay::WorkOffFloor);
        };
        let Some(robot) = floor.cell_at(pose.x, pose.y) else {
            return Travel::None(NoWay::RobotOffFloor);
        };
        match self.front(floor, cell).way(floor, robot) {
            // In one cell the straight line is the way.
            Some(_) if cell == robot => Travel::Way((at.x - pose.x).hypot(at.y - pose.y)),
            Some(metres) => Travel::Way(metres),
            None => Travel::None(NoWay::Enclosed),
        }
    }

    fn front(&self, floor: &Arc<Floor>, cell: u32) -> Arc<Front> {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let known = kept.iter().position(|k| k.cell == cell && Arc::ptr_eq(&k.floor, floor));
        let newest = match known {
            Some(at) if at + 1 == kept.len() => return Arc::clone(&kept[at].front),
            Some(at) => kept.remove(at),
            None => {
                Kept { floor: Arc::clone(floor), cell, front: Arc::new(Front::from(floor, cell)) }
            }
        };
        let front = Arc::clone(&newest.front);
        kept.push(newest);
        let mut used: usize = kept.iter().map(|k| k.front.bytes()).sum();
        while used > KEPT && kept.len() > 1 {
            used -= kept.remove(0).front.bytes();
        }
        front
    }
}

#[cfg(test)]
mod tests;
