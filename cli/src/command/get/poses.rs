//! `muster get poses`: where robots are now. Poses are no objects: they come from the controller's memory, many times a
//! second, and a watch of them skips what it has no time to show.

use muster_api::pose::Pose;
use serde::Deserialize;
use serde_json::{Value, json};

use super::{Args, Rows, print_each};
use crate::client::{group_path, segment, with_query};
use crate::command::{FirstError, Outcome};
use crate::error::CliError;
use crate::output::human;
use crate::output::objects::{Format, document};
use crate::output::style::Mood;
use crate::output::table::{Cell, Table};
use crate::session::Session;

const WORDS: [&str; 2] = ["poses", "pose"];
const HEAD: [&str; 6] = ["NODE", "POSE", "YAW", "MAP", "SOURCE", "AGE"];

/// What the controller says of one robot.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Item {
    node: String,
    map: String,
    x: f64,
    y: f64,
    z: f64,
    yaw: f64,
    source: String,
    localized: bool,
    age_ms: Option<u64>,
}

#[derive(Debug, Deserialize)]
struct Event {
    r#type: String,
    object: Value,
}

/// The nodes that are named, when the words ask for poses at all.
pub(super) fn asked(words: &[String]) -> Result<Option<Vec<String>>, CliError> {
    let Some((first, rest)) = words.split_first() else { return Ok(None) };
    if WORDS.contains(&first.as_str()) {
        return Ok(Some(rest.to_vec()));
    }
    let names = words.iter().filter_map(|w| w.split_once('/')).filter(|(of, _)| WORDS.contains(of));
    let names: Vec<String> = names.map(|(_, name)| name.to_owned()).collect();
    match names.len() {
        0 => Ok(None),
        n if n == words.len() => Ok(Some(names)),
        _ => Err(CliError::usage("poses are no objects; ask for them alone")),
    }
}

pub(super) async fn run(args: &Args, nodes: Vec<String>, session: &mut Session) -> Outcome {
    if !args.select.selection().is_empty() {
        return Err(CliError::usage(
            "poses have no labels and no fields to select by; name the nodes",
        ));
    }
    if args.watch {
        return watch(args, &nodes, session).await;
    }
    let mut errors = FirstError::default();
    let mut items = Vec::new();
    if nodes.is_empty() {
        let list: Value = session.client.get_json(&group_path("poses")).await?;
        items.extend(list["items"].as_array().into_iter().flatten().cloned());
    }
    for node in &nodes {
        let path = group_path(&format!("nodes/{}/pose", segment(node)));
        match session.client.get_json(&path).await {
            Ok(item) => items.push(item),
            Err(error) if error.is_not_found() && nodes.len() > 1 => {
                errors.note(error, &session.ui)?
            }
            Err(error) => return Err(error),
        }
    }
    if items.is_empty() && nodes.is_empty() && args.output == Format::Table {
        session.ui.note("no robot's place is known");
    }
    let mut printer = Printer { args, rows: Rows::new(!args.no_headers) };
    match args.output {
        Format::Yaml | Format::Json => {
            let list = json!({ "apiVersion": muster_api::API_VERSION, "kind": "PoseList", "items": items });
            let only = (nodes.len() == 1).then(|| items.first().cloned()).flatten();
            session.ui.print(&document(&only.unwrap_or(list), args.output)?)?;
        }
        _ => printer.print(&items, session)?,
    }
    Ok(errors.exit())
}

/// The poses there are, then a row a move. A watch that ends by its time is begun again.
async fn watch(args: &Args, nodes: &[String], session: &mut Session) -> Outcome {
    let names = nodes.join(",");
    let mut pairs = vec![("watch", "true")];
    if !names.is_empty() {
        pairs.push(("nodes", &names));
    }
    let path = with_query(&group_path("poses"), &pairs);
    let mut printer = Printer { args, rows: Rows::new(!args.no_headers) };
    loop {
        let mut stream = session.client.stream(&path).await?;
        let mut first = Some(Vec::new());
        while let Some(line) = stream.next_line().await? {
            let event: Event =
                serde_json::from_slice(&line).map_err(|source| unread(session, source))?;
            match (event.r#type.as_str(), &mut first) {
                ("BOOKMARK", _) => {
                    let mut items = first.take().unwrap_or_default();
                    items.sort_by_key(|item: &Value| item["node"].to_string());
                    printer.print(&items, session)?;
                }
                ("DELETED", _) => session.ui.note(&format!(
                    "pose/{} is gone",
                    event.object["node"].as_str().unwrap_or("-")
                )),
                (_, Some(first)) => first.push(event.object),
                (_, None) => printer.print(&[event.object], session)?,
            }
        }
    }
}

fn unread(session: &Session, source: serde_json::Error) -> CliError {
    let server = session.client.server.clone();
    CliError::Answer { server, request: "GET poses".to_owned(), source }
}

struct Printer<'a> {
    args: &'a Args,
    rows: Rows,
}

impl Printer<'_> {
    fn print(&mut self, items: &[Value], session: &mut Session) -> Result<(), CliError> {
        if items.is_empty() {
            return Ok(());
        }
        match self.args.output {
            Format::Table | Format::Wide => self.print_rows(items, session),
            Format::Name => items.iter().try_for_each(|item| {
                session.ui.line(&format!("pose/{}", item["node"].as_str().unwrap_or_default()))
            }),
            Format::Json | Format::Yaml => print_each(items, self.args.output, session),
        }
    }

    fn print_rows(&mut self, items: &[Value], session: &mut Session) -> Result<(), CliError> {
        let mut table = Table::new(HEAD);
        for item in items {
            let item: Item =
                serde_json::from_value(item.clone()).map_err(|source| unread(session, source))?;
            table.push(row(item));
        }
        self.rows.print(table, session)
    }
}

fn row(item: Item) -> [Cell; 6] {
    let at = Pose {
        // The map has a column of its own.
        map: muster_api::pose::DEFAULT_MAP.to_owned(),
        x: item.x,
        y: item.y,
        z: item.z,
        yaw: item.yaw,
        stamp: None,
        source: String::new(),
        localized: item.localized,
        covariance: None,
    };
    let (place, mood) = match item.localized {
        true => (at.to_string(), Mood::Plain),
        false => (format!("{at} (lost)"), Mood::Bad),
    };
    let age = item.age_ms.map(|ms| human::duration(std::time::Duration::from_millis(ms)));
    [
        item.node.into(),
        Cell::new(place, mood),
        format!("{:.2}", item.yaw).into(),
        item.map.into(),
        item.source.into(),
        // Nobody has said so since the controller began: a checkpoint.
        age.unwrap_or_else(|| "checkpoint".to_owned()).into(),
    ]
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::exit;
    use crate::fake::Fake;

    const POSES: &str = "GET /apis/muster.dev/v1alpha1/poses";

    fn pose(node: &str, x: f64) -> serde_json::Value {
        json!({"node": node, "map": "lab", "x": x, "y": 2.5, "z": 0.0, "yaw": 1.5, "source": "mocap", "localized": true, "ageMs": 40})
    }

    #[tokio::test]
    async fn poses_are_rows_or_documents() {
        let fake = Fake::new();
        let lost = json!({"node": "r2", "map": "map", "x": 1.0, "y": 0.0, "z": 0.5, "yaw": 0.0, "source": "", "localized": false});
        fake.answer(POSES, json!({"items": [pose("r1", 1.0), lost]}));
        fake.answer("GET /apis/muster.dev/v1alpha1/nodes/r1/pose", pose("r1", 1.0));
        assert_eq!(
            fake.run(&["get", "poses"]).await.1,
            "NODE   POSE                    YAW    MAP   SOURCE   AGE\n\
             r1     1.00,2.50               1.50   lab   mocap    40ms\n\
             r2     1.00,0.00,0.50 (lost)   0.00   map   -        checkpoint\n"
        );
        let (code, text) = fake.run(&["get", "pose/r1", "-o", "json"]).await;
        let one: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        assert_eq!((code, &one["node"]), (exit::OK, &json!("r1")));
        assert_eq!(fake.run(&["get", "pose", "r1", "-o", "name"]).await.1, "pose/r1\n");
        let (_, text) = fake.run(&["get", "poses", "-o", "yaml"]).await;
        assert!(text.contains("PoseList"), "{text}");
        let mixed = fake.try_run(&["get", "pose/r1", "task/a"]).await.expect_err("no objects");
        assert_eq!(mixed.class().exit(), exit::USAGE);
        let missing = fake.try_run(&["get", "pose", "r9"]).await.expect_err("not there");
        assert_eq!(missing.class().exit(), exit::NOT_FOUND);
    }
}
