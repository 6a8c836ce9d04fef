//! `muster get`: objects as tables or in a format for programs; with `-w`, as they change.

mod poses;

use std::collections::BTreeMap;

use muster_api::kind::KindInfo;
use serde_json::Value;

use super::{FirstError, Outcome};
use crate::args::Select;
use crate::client::Selection;
use crate::error::CliError;
use crate::output::objects::{self, Format, Group, document, full_name, serialize, table};
use crate::output::table::Table;
use crate::session::Session;
use crate::target::{self, Named};
use crate::watch::{Change, Follow};

/// `muster get`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// KIND [NAME…], KIND/NAME…, all, or poses [NODE…]: where robots are now
    #[arg(value_name = "OBJECT", required = true)]
    objects: Vec<String>,
    /// How to print them
    #[arg(short, long, value_enum, default_value_t, value_name = "FORMAT")]
    output: Format,
    #[command(flatten)]
    select: Select,
    /// In every namespace
    #[arg(short = 'A', long)]
    all_namespaces: bool,
    /// Go on with every change
    #[arg(short, long)]
    watch: bool,
    /// No line with the names of the columns
    #[arg(long)]
    no_headers: bool,
}

pub(crate) async fn run(args: Args, session: &mut Session) -> Outcome {
    if let Some(nodes) = poses::asked(&args.objects)? {
        return poses::run(&args, nodes, session).await;
    }
    let named = target::parse(&args.objects)?;
    let by_name = named.iter().any(|n| n.name.is_some());
    if by_name && !args.select.selection().is_empty() {
        return Err(CliError::usage("a selector goes with a kind, not with names"));
    }
    if by_name && args.all_namespaces {
        return Err(CliError::usage("a name is in one namespace; use -n instead of -A"));
    }
    if args.watch {
        return watch(&args, &named, session).await;
    }
    let mut errors = FirstError::default();
    let groups = fetch(&args, &named, session, &mut errors).await?;
    let single = named.len() == 1 && by_name;
    match args.output {
        Format::Table | Format::Wide => print_tables(&args, &groups, session)?,
        Format::Yaml | Format::Json | Format::Name => {
            if !(single && groups.iter().all(|g| g.objects.is_empty())) {
                session.ui.print(&serialize(groups, single, args.output)?)?;
            }
        }
    }
    Ok(errors.exit())
}

/// The objects, grouped by kind in the order they were named. Of several things the rest is fetched
/// when one is not there.
async fn fetch(
    args: &Args,
    named: &[Named<'_>],
    session: &mut Session,
    errors: &mut FirstError,
) -> Result<Vec<Group>, CliError> {
    let namespace = (!args.all_namespaces).then_some(session.namespace.as_str());
    let mut groups: Vec<Group> = Vec::new();
    for Named { info, name } in named {
        let objects = match name {
            Some(name) => session.client.get(info, namespace, name).await.map(|o| vec![o]),
            None => {
                let list = session.client.list(info, namespace, &args.select.selection()).await;
                list.map(|l| l.items)
            }
        };
        let objects = match objects {
            Ok(objects) => objects,
            Err(error) if error.is_not_found() && named.len() > 1 => {
                errors.note(error, &session.ui)?;
                continue;
            }
            Err(error) => return Err(error),
        };
        match groups.iter_mut().find(|g| g.info.kind == info.kind) {
            Some(group) => group.objects.extend(objects),
            None => groups.push(Group { info, objects }),
        }
    }
    Ok(groups)
}

fn print_tables(args: &Args, groups: &[Group], session: &mut Session) -> Result<(), CliError> {
    let filled: Vec<&Group> = groups.iter().filter(|g| !g.objects.is_empty()).collect();
    if filled.is_empty() && !groups.is_empty() {
        session.ui.note(&nothing(args, groups, &session.namespace));
    }
    for (i, group) in filled.iter().enumerate() {
        if i > 0 {
            session.ui.line("")?;
        }
        let wide = args.output == Format::Wide;
        let mut table = table(group, wide, args.all_namespaces, groups.len() > 1);
        if args.no_headers {
            table = table.without_head();
        }
        let text = table.text(&session.ui.styles);
        session.ui.print(&text)?;
    }
    Ok(())
}

fn nothing(args: &Args, groups: &[Group], namespace: &str) -> String {
    let kinds: Vec<&str> = groups.iter().map(|g| g.info.plural).collect();
    let namespaced = groups.iter().any(|g| g.info.namespaced) && !args.all_namespaces;
    let place = if namespaced { format!(" in namespace {namespace}") } else { String::new() };
    let selected = if args.select.selection().is_empty() { "" } else { " that are selected" };
    format!("there are no {}{selected}{place}", kinds.join(", "))
}

/// `-w`: the list first, then a row a change, with columns that keep their places.
async fn watch(args: &Args, named: &[Named<'_>], session: &mut Session) -> Outcome {
    let [Named { info, name }] = named else {
        return Err(CliError::usage("one kind or one object can be watched at a time"));
    };
    if let Some(name) = name {
        // A name that does not exist is an error here, as without -w.
        session.client.get(info, Some(&session.namespace), name).await?;
    }
    let selection = name.map_or_else(|| args.select.selection(), Selection::name);
    let namespace = (!args.all_namespaces).then_some(session.namespace.as_str());
    let mut follow = Follow::new(&session.client, info, namespace, selection);
    let mut first = BTreeMap::new();
    let mut printer = Printer { args, info, rows: Rows::new(!args.no_headers) };
    let mut order = Vec::new();
    let mut synced = false;
    loop {
        match follow.next().await? {
            Change::Synced if !synced => {
                synced = true;
                let listed = order.iter().filter_map(|k| first.remove(k)).collect();
                printer.print(listed, session)?;
            }
            Change::Synced => {}
            Change::Applied(object) if !synced => {
                let key = crate::watch::key(&object);
                order.push(key.clone());
                first.insert(key, object);
            }
            Change::Applied(object) => printer.print(vec![object], session)?,
            Change::Deleted(object) => printer.print_deleted(object, session)?,
        }
    }
}

/// A table that goes on: one head, and columns that keep their places.
struct Rows {
    widths: Vec<u16>,
    head: bool,
}

impl Rows {
    fn new(head: bool) -> Self {
        Rows { widths: Vec::new(), head }
    }

    fn print(&mut self, mut table: Table, session: &mut Session) -> Result<(), CliError> {
        if !std::mem::take(&mut self.head) {
            table = table.without_head();
        }
        table.at_least(&self.widths);
        let (text, widths) = table.render(&session.ui.styles);
        self.widths = widths;
        session.ui.print(&text)
    }
}

/// Objects that come one after the other: a line each as JSON, a document each as YAML.
fn print_each(objects: &[Value], format: Format, session: &mut Session) -> Result<(), CliError> {
    objects.iter().try_for_each(|object| match format {
        Format::Yaml => {
            let text = document(object, Format::Yaml)?;
            session.ui.print(&format!("---\n{text}"))
        }
        _ => session.ui.line(&object.to_string()),
    })
}

struct Printer<'a> {
    args: &'a Args,
    info: &'static KindInfo,
    rows: Rows,
}

impl Printer<'_> {
    fn print(&mut self, objects: Vec<Value>, session: &mut Session) -> Result<(), CliError> {
        if objects.is_empty() {
            return Ok(());
        }
        match self.args.output {
            Format::Table | Format::Wide => self.print_rows(objects, session),
            Format::Name => {
                objects.iter().try_for_each(|object| session.ui.line(&full_name(self.info, object)))
            }
            Format::Json | Format::Yaml => print_each(&objects, self.args.output, session),
        }
    }

    fn print_rows(&mut self, objects: Vec<Value>, session: &mut Session) -> Result<(), CliError> {
        let group = Group { info: self.info, objects };
        let wide = self.args.output == Format::Wide;
        let table = objects::table(&group, wide, self.args.all_namespaces, false);
        self.rows.print(table, session)
    }

    /// What is gone is said, not shown as if it were still there.
    fn print_deleted(&mut self, object: Value, session: &mut Session) -> Result<(), CliError> {
        match self.args.output {
            Format::Table | Format::Wide | Format::Name => {
                session.ui.note(&format!("{} is gone", full_name(self.info, &object)));
                Ok(())
            }
            Format::Json | Format::Yaml => self.print(vec![object], session),
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::exit;
    use crate::fake::{Fake, task};

    #[tokio::test]
    async fn names_kinds_and_selectors() {
        let fake = Fake::new();
        fake.put("tasks/default/a", task("a", json!({"phase": "Running", "node": "r1"})));
        fake.put("tasks/default/b", task("b", json!({"phase": "Pending"})));
        let (code, text) = fake.run(&["get", "tasks", "-o", "name"]).await;
        assert_eq!((code, text.as_str()), (exit::OK, "task/a\ntask/b\n"));
        let (_, text) = fake.run(&["get", "tk", "b", "--no-headers"]).await;
        assert!(text.starts_with("b   Pending"), "{text}");
        let (_, text) = fake.run(&["get", "task/a", "-o", "json"]).await;
        let object: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        assert_eq!(object["metadata"]["name"], "a");
        let (_, text) = fake
            .run(&["get", "tasks", "--field-selector", "status.phase=Running", "-o", "name"])
            .await;
        assert_eq!(text, "task/a\n");
        let (_, text) = fake.run(&["get", "all", "-A"]).await;
        assert!(text.starts_with("NAMESPACE   NAME     PHASE"), "{text}");
        assert!(text.contains("task/a"), "{text}");
    }

    #[tokio::test]
    async fn one_missing_name_does_not_hide_the_others() {
        let fake = Fake::new();
        fake.put("tasks/default/a", task("a", json!({})));
        let (code, text) = fake.run(&["get", "task/x", "task/a", "-o", "name"]).await;
        assert_eq!((code, text.as_str()), (exit::NOT_FOUND, "task/a\n"));
        let error = fake.try_run(&["get", "task", "x"]).await.expect_err("not there");
        assert_eq!(error.class().exit(), exit::NOT_FOUND);
    }

    #[tokio::test]
    async fn nothing_is_no_error() {
        assert_eq!(Fake::new().run(&["get", "tasks"]).await, (exit::OK, String::new()));
    }
}
