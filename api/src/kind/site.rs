//! Site: the floor plan of a map, by which the cost `TravelTime` finds its ways.
//!
//! A robotics team has a map_server map, a YAML file and an image. `muster apply` reads both beside the manifest
//! (`spec.mapFile`) and stores what they say in `spec.grid`: free, occupied and unknown cells as runs, some tens of kilobytes for a
//! building. Where a map has a Site, robots in it are scored by their way over the floor; where it has none, by the straight line.

use kube::CustomResource;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{KindInfo, admit_spec, any_change};
use crate::map::{Cell, Grid, MOST_CELLS};
use crate::validate::Violations;

/// How far ways keep from obstacles when nobody says, metres: a robot of 60 cm.
pub const INFLATION: f64 = 0.3;

/// The most that they may, metres.
pub const MOST_INFLATION: f64 = 5.0;

/// Bytes of a grid's text at most.
const LONGEST: usize = 2 << 20;

/// The floor plan of a map.
#[derive(CustomResource, Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[kube(
    group = "muster.dev",
    version = "v1alpha1",
    kind = "Site",
    plural = "sites",
    derive = "PartialEq"
)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct SiteSpec {
    /// The map whose frame robots' poses and operation positions are in; absent: the Site's name. Of two Sites of one map the
    /// first by name counts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub map: Option<String>,
    /// How far ways keep from what is occupied, metres: the radius of the widest robot.
    #[serde(default = "inflation")]
    pub inflation: f64,
    /// A map_server map's YAML file, beside the manifest: `muster apply` puts what it says into `grid`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub map_file: Option<String>,
    /// The floor plan.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub grid: Option<SiteGrid>,
}

fn inflation() -> f64 {
    INFLATION
}

/// A floor plan.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct SiteGrid {
    /// Cells across.
    pub width: u32,
    /// Cells up.
    pub height: u32,
    /// Metres across a cell.
    pub resolution: f64,
    /// Where the lower left corner is in the map frame.
    pub origin: Origin,
    /// The cells, rows from below, each from the left, as runs of one sort: a letter (f free, o occupied, u unknown) and, where it
    /// is longer than one, its length: `f12o2u`.
    pub cells: String,
}

/// Where a grid's lower left corner is.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct Origin {
    /// East, metres.
    pub x: f64,
    /// North, metres.
    pub y: f64,
    /// The grid's turn, radians.
    #[serde(default)]
    pub yaw: f64,
}

/// Why a floor plan does not read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum GridError {
    /// There are too many cells, or none.
    #[error("{width} x {height} cells are not 1 to {MOST_CELLS}")]
    Size {
        /// Cells across.
        width: u32,
        /// Cells up.
        height: u32,
    },
    /// A run that is none.
    #[error("at character {at}: a run is f, o or u and a length from 1, as in f12")]
    Run {
        /// Where it begins, from 1.
        at: usize,
    },
    /// Runs for another size.
    #[error("its runs are {found} cells, the size says {wanted}")]
    Count {
        /// What the runs have.
        found: u64,
        /// What the size has.
        wanted: u64,
    },
}

impl SiteGrid {
    /// A map's.
    #[must_use]
    pub fn of(grid: &Grid) -> SiteGrid {
        let mut cells = String::new();
        for run in grid.cells.chunk_by(|a, b| a == b) {
            cells.push(letter(run[0]));
            if run.len() > 1 {
                cells.push_str(&run.len().to_string());
            }
        }
        let [x, y, yaw] = grid.origin;
        let (width, height, resolution) = (grid.width, grid.height, grid.resolution);
        SiteGrid { width, height, resolution, origin: Origin { x, y, yaw }, cells }
    }

    /// The map again.
    ///
    /// # Errors
    ///
    /// Where its runs are none.
    pub fn grid(&self) -> Result<Grid, GridError> {
        let (width, height) = (self.width, self.height);
        let wanted = u64::from(width) * u64::from(height);
        if !(1..=MOST_CELLS).contains(&wanted) {
            return Err(GridError::Size { width, height });
        }
        let mut cells = Vec::with_capacity(usize::try_from(wanted).unwrap_or(0));
        let mut rest = self.cells.as_str();
        while let Some(first) = rest.chars().next() {
            let run = || GridError::Run { at: self.cells.len() - rest.len() + 1 };
            let cell = cell(first).ok_or_else(run)?;
            let digits = rest[1..].bytes().take_while(u8::is_ascii_digit).count();
            let length: u64 = match &rest[1..=digits] {
                "" => 1,
                text => text.parse().ok().filter(|length| *length > 0).ok_or_else(run)?,
            };
            let found = (cells.len() as u64).saturating_add(length);
            if found > wanted {
                return Err(GridError::Count { found, wanted });
            }
            cells.resize(usize::try_from(found).unwrap_or(0), cell);
            rest = &rest[1 + digits..];
        }
        if cells.len() as u64 != wanted {
            return Err(GridError::Count { found: cells.len() as u64, wanted });
        }
        let Origin { x, y, yaw } = self.origin;
        Ok(Grid { width, height, resolution: self.resolution, origin: [x, y, yaw], cells })
    }
}

fn letter(cell: Cell) -> char {
    match cell {
        Cell::Free => 'f',
        Cell::Occupied => 'o',
        Cell::Unknown => 'u',
    }
}

fn cell(letter: char) -> Option<Cell> {
    match letter {
        'f' => Some(Cell::Free),
        'o' => Some(Cell::Occupied),
        'u' => Some(Cell::Unknown),
        _ => None,
    }
}

fn rules(spec: &SiteSpec, violations: &mut Violations) {
    if !(0.0..=MOST_INFLATION).contains(&spec.inflation) {
        violations
            .invalid("spec.inflation", format!("{} is not 0 to {MOST_INFLATION} m", spec.inflation))
            .suggest("the radius of the widest robot; 0.3 is usual");
    }
    if spec.map.as_deref() == Some("") {
        violations.invalid("spec.map", "a map has a name").suggest("leave it out: the Site's name");
    }
    if spec.map_file.is_some() {
        violations
            .forbidden(
                "spec.mapFile",
                "only `muster apply` reads files; it stores what they say in spec.grid",
            )
            .suggest("apply the manifest with `muster apply -f`");
        return;
    }
    let Some(grid) = &spec.grid else {
        violations
            .required("spec.mapFile")
            .suggest("a map_server map beside the manifest, for example \"lab.yaml\"");
        return;
    };
    if !(grid.resolution.is_finite() && grid.resolution > 0.0) {
        violations.invalid(
            "spec.grid.resolution",
            format!("{} is not a length above 0", grid.resolution),
        );
    }
    if ![grid.origin.x, grid.origin.y, grid.origin.yaw].iter().all(|part| part.is_finite()) {
        violations.invalid("spec.grid.origin", "is not finite");
    }
    if grid.cells.len() > LONGEST {
        violations
            .invalid("spec.grid.cells", format!("is longer than {LONGEST} bytes"))
            .suggest("clear single cells of noise, or use a coarser resolution");
    } else if let Err(error) = grid.grid() {
        violations.invalid("spec.grid.cells", error.to_string());
    }
}

pub(super) const INFO: KindInfo = KindInfo {
    group: crate::GROUP,
    version: crate::VERSION,
    kind: "Site",
    plural: "sites",
    singular: "site",
    short_names: &[],
    namespaced: false,
    has_status: false,
    selectable: &[],
    schema: |g| g.subschema_for::<Site>(),
    admit_body: |object: &mut Value, violations| admit_spec::<SiteSpec>(object, violations, rules),
    admit_change: any_change,
};

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;

    fn problems(spec: Value) -> Vec<String> {
        let object = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Site", "metadata": {"name": "lab"}, "spec": spec
        });
        match super::super::admit(&object) {
            Ok(_) => Vec::new(),
            Err(violations) => violations.iter().map(ToString::to_string).collect(),
        }
    }

    fn grid(cells: &str) -> Value {
        json!({"width": 4, "height": 2, "resolution": 0.5, "origin": {"x": 0, "y": 0}, "cells": cells})
    }

    #[test]
    fn what_makes_no_sense_is_refused_with_its_place() {
        assert_eq!(problems(json!({"grid": grid("f6ou")})), [""; 0]);
        assert_eq!(
            problems(json!({"inflation": -1})),
            [
                "spec.inflation: -1 is not 0 to 5 m; the radius of the widest robot; 0.3 is usual",
                "spec.mapFile: is required; a map_server map beside the manifest, for example \"lab.yaml\"",
            ]
        );
        let cells = |text| problems(json!({"grid": grid(text)})).join("|");
        assert_eq!(cells("f6o"), "spec.grid.cells: its runs are 7 cells, the size says 8");
        assert_eq!(
            cells("f99999999999"),
            "spec.grid.cells: its runs are 99999999999 cells, the size says 8"
        );
        for (text, at) in [("f6x", 3), ("f0o8", 1), ("8", 1), ("f6é", 3)] {
            let wanted = format!(
                "spec.grid.cells: at character {at}: a run is f, o or u and a length from 1, as in f12"
            );
            assert_eq!(cells(text), wanted, "{text}");
        }
        assert!(
            problems(json!({"mapFile": "lab.yaml"}))[0].contains("only `muster apply` reads files")
        );
    }

    proptest! {
        #[test]
        fn a_map_comes_back_as_it_was(
            width in 1..20_u32,
            height in 1..20_u32,
            sorts in proptest::collection::vec(0..3_u8, 400),
        ) {
            let sort = |n: u8| [Cell::Free, Cell::Occupied, Cell::Unknown][usize::from(n)];
            let cells = sorts.into_iter().take((width * height) as usize).map(sort).collect();
            let grid = Grid { width, height, resolution: 0.05, origin: [1.0, -2.0, 0.5], cells };
            prop_assert_eq!(SiteGrid::of(&grid).grid(), Ok(grid));
        }
    }
}
