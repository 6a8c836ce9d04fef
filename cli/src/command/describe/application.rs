//! An Application: its parts with what keeps them at home, its connections, and where they could go.

use jiff::Timestamp;
use muster_api::kind::application::pin::pins;
use muster_api::kind::application::{
    Application, ApplicationStatus, Connection, ConnectionStatus, MoveStage, Part, PartStatus, Runs,
};
use muster_api::quantity::BitRate;

use super::{begin, condition_table, when};
use crate::output::columns::application::policy;
use crate::output::human;
use crate::output::sheet::Sheet;
use crate::output::table::Table;

pub(super) fn describe(sheet: &mut Sheet, app: &Application, now: Timestamp) {
    begin(sheet, &app.metadata, now);
    let nothing = ApplicationStatus::default();
    let (spec, status) = (&app.spec, app.status.as_ref().unwrap_or(&nothing));
    sheet.field("Phase", format!("{:?}", status.phase));
    sheet.field("Home", &spec.home);
    sheet.list("Scales", status.scales.iter().cloned());
    sheet.field("Policy", policy(spec.policy));
    sheet.field(
        "Times",
        format!(
            "looks every {}, a moved part stays {}, home takes {}",
            spec.period, spec.cooldown, spec.return_time
        ),
    );
    if !status.mappings.is_empty() {
        let (all, left) = (&status.mappings, &status.allowed_mappings);
        sheet.field("Mappings", format!("{left} of {all}: the others are pruned"));
    }
    if let Some(value) = status.value {
        let bound = status.bound.map(|bound| format!(", at most {bound:.3} could be"));
        sheet.field("Worth", format!("{value:.3}{}", bound.unwrap_or_default()));
    }
    let mut parts = Table::new(["NAME", "CLASS", "RUNS", "CPU", "NOW", "TASK", "WHY"]);
    for part in &spec.parts {
        parts.push(row(app, status, part));
    }
    sheet.table("Parts", parts);
    let standby =
        |part: &PartStatus| Some(format!("{} ({})", part.name, part.standby.as_ref()?.name));
    sheet.list("Stand by at home", status.parts.iter().filter_map(standby));
    let mut table =
        Table::new(["TOPIC", "FROM", "TO", "NOW", "MIN", "OPT", "TOLERANCE", "BANDWIDTH"]);
    for connection in &spec.connections {
        table.push(connection_row(connection, status));
    }
    sheet.table("Connections", table);
    if !status.signals.is_empty() {
        sheet.table("Signals", signal_table(app, status, now));
    }
    if !status.timeline.is_empty() {
        sheet.table("Mappings", timeline(status, now));
    }
    sheet.table("Conditions", condition_table(&status.conditions, now));
}

fn row(app: &Application, status: &ApplicationStatus, part: &Part) -> [String; 7] {
    let pins = pins(&app.spec, part);
    let of = status.part(&part.name);
    let because = pins.iter().map(ToString::to_string).collect::<Vec<_>>().join("; ");
    let said = of.map(|p| p.message.clone()).filter(|m| !m.is_empty() && pins.is_empty());
    [
        part.name.clone(),
        if pins.is_empty() { "Migratable" } else { "Critical" }.to_owned(),
        match part.runs {
            Runs::Always => "always".to_owned(),
            Runs::Sometimes => format!("sometimes, {:.0}%", part.share() * 100.0),
            Runs::Once => "once".to_owned(),
        },
        part.cpu.map(human::cores).unwrap_or_default(),
        of.map(place).unwrap_or_default(),
        of.and_then(|p| p.task.as_ref()).map(|task| task.name.clone()).unwrap_or_default(),
        said.unwrap_or(because),
    ]
}

/// Where a part serves, and what its other task does.
fn place(part: &PartStatus) -> String {
    let scale = part.scale.clone().unwrap_or_default();
    let Some(other) = &part.other else { return scale };
    match part.stage.unwrap_or_default() {
        MoveStage::Settled => scale,
        MoveStage::Making | MoveStage::Switching => format!("{scale}, next {}", other.scale),
        MoveStage::Breaking | MoveStage::Aborting | MoveStage::Alone => {
            format!("{scale}, ends on {}", other.scale)
        }
    }
}

fn timeline(status: &ApplicationStatus, now: Timestamp) -> Table {
    let mut table = Table::new(["SINCE", "MOVED", "AWAY", "WHY"]);
    for mapping in &status.timeline {
        let away = mapping.away.iter().map(|(part, scale)| format!("{part} on {scale}"));
        let away = away.collect::<Vec<_>>().join(", ");
        let why = mapping.message.clone();
        table.push([when(mapping.since.0, now), mapping.part.clone(), away, why]);
    }
    table
}

fn signal_table(app: &Application, status: &ApplicationStatus, now: Timestamp) -> Table {
    let mut table = Table::new(["NAME", "NOW", "MIN", "MAX", "OUTSIDE"]);
    for signal in &status.signals {
        let spec = app.spec.signals.iter().find(|s| s.name == signal.name);
        let unit = spec.map(|s| s.unit.as_str()).unwrap_or_default();
        let number = |value: Option<f64>| value.map(|v| format!("{v}{unit}")).unwrap_or_default();
        table.push([
            signal.name.clone(),
            number(signal.value),
            number(spec.and_then(|s| s.min)),
            number(spec.and_then(|s| s.max)),
            signal.outside_since.as_ref().map(|at| when(at.0, now)).unwrap_or_default(),
        ]);
    }
    table
}

fn connection_row(connection: &Connection, status: &ApplicationStatus) -> [String; 8] {
    let hz = |hz: Option<f64>| hz.map(|hz| format!("{hz}Hz")).unwrap_or_default();
    let same = |s: &&ConnectionStatus| {
        (&s.topic, &s.from, &s.to) == (&connection.topic, &connection.from, &connection.to)
    };
    let seen = status.connections.iter().find(same);
    let watched = connection.min_hz.is_some();
    let rate = connection.bandwidth;
    [
        connection.topic.clone(),
        connection.from.clone(),
        connection.to.clone(),
        hz(seen.and_then(|seen| seen.hz)),
        hz(connection.min_hz),
        hz(connection.opt_hz),
        if watched { connection.tolerance.to_string() } else { String::new() },
        if rate == BitRate(0) { String::new() } else { format!("{rate}bit/s") },
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::style::Styles;

    #[test]
    fn the_paper_s_application_shows_what_is_critical_and_why() {
        let text = include_str!("../../../../manifests/examples/application.yaml");
        let documents = muster_api::manifest::parse("application.yaml", text).expect("it parses");
        let object = documents[0].admit().expect("it is admitted");
        let app: Application = serde_json::from_value(object).expect("an Application");
        let mut sheet = Sheet::default();
        describe(&mut sheet, &app, Timestamp::UNIX_EPOCH);
        let text = sheet.text(&Styles::default());
        let line = |name: &str| {
            let words = |line: &str| line.split_whitespace().collect::<Vec<_>>().join(" ");
            text.lines().map(words).find(|l| l.starts_with(name)).expect(name)
        };
        assert_eq!(
            line("camera"),
            "camera Critical always - - - it reads the sensor xtion:ImageGen"
        );
        assert_eq!(line("amcl"), "amcl Migratable always 0.5 - - -");
        assert_eq!(line("ar"), "ar Migratable sometimes, 40% 0.33 - - -");
        assert_eq!(
            line("odometry"),
            "odometry Critical always 0.05 - - its connection /wheels with odometer tolerates no pause; its connection \
             /odom with ekf tolerates no pause"
        );
        assert_eq!(line("/markers"), "/markers ar navigation - 1Hz 30Hz 1s 50kbit/s");
    }
}
