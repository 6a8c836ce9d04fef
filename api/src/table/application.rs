//! Applications: whose they are, and what of them may move.

use crate::kind::application::pin::pins;
use crate::kind::application::{Application, ApplicationPhase, Policy};

use super::{Cell, Column, Mood, age};

pub(super) const COLUMNS: &[Column<Application>] = &[
    Column::new("HOME", |app, _| app.spec.home.as_str().into()),
    Column::new("PARTS", |app, _| app.spec.parts.len().to_string().into()),
    Column::new("MIGRATABLE", |app, _| migratable(app).into()),
    Column::new("AWAY", |app, _| away(app)),
    Column::new("POLICY", |app, _| policy(app.spec.policy).into()),
    Column::new("PHASE", |app, _| phase(app)),
    Column::new("AGE", |app, now| age(app.metadata.creation_timestamp.as_ref(), now)),
    Column::wide("SCALES", |app, _| {
        app.status.as_ref().map(|s| s.scales.join(",")).unwrap_or_default().into()
    }),
];

fn migratable(app: &Application) -> String {
    let parts = app.spec.parts.iter().filter(|part| pins(&app.spec, part).is_empty());
    parts.map(|part| part.name.as_str()).collect::<Vec<_>>().join(",")
}

/// How many parts are not at home; nothing before any was placed.
fn away(app: &Application) -> Cell {
    let parts = app.status.iter().flat_map(|s| &s.parts);
    let placed: Vec<&String> = parts.filter_map(|p| p.scale.as_ref()).collect();
    if placed.is_empty() {
        return Cell::from("");
    }
    placed.iter().filter(|scale| ***scale != app.spec.home).count().to_string().into()
}

/// How the mapping is chosen, in a word.
#[must_use]
pub fn policy(policy: Policy) -> &'static str {
    match policy {
        Policy::Optimal => "Optimal",
        Policy::Greedy => "Greedy",
        Policy::Home => "Home",
    }
}

fn phase(app: &Application) -> Cell {
    let mood = |phase| match phase {
        ApplicationPhase::Running => Mood::Good,
        ApplicationPhase::Pending => Mood::Plain,
        ApplicationPhase::Degraded => Mood::Warn,
    };
    let phase = app.status.as_ref().map(|s| s.phase);
    phase.map_or_else(|| Cell::from(""), |phase| Cell::new(format!("{phase:?}"), mood(phase)))
}
