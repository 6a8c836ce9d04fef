//! `muster top`: what nodes and tasks use, measured by the kernels of the nodes.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use muster_api::kind::node::Node;
use muster_api::kind::task::Task;
use muster_api::quantity::{Bytes, MilliCpu};
use serde::Deserialize;
use serde_json::{Value, json};

use super::Outcome;
use crate::client::{Selection, group_path};
use crate::error::CliError;
use crate::exit;
use crate::output::human;
use crate::output::objects::{Format, document};
use crate::output::table::Table;
use crate::session::Session;
use crate::target;

/// `muster top`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// nodes or tasks
    kind: String,
    /// Only these
    names: Vec<String>,
    /// Most first, by this
    #[arg(long, value_enum, default_value_t)]
    sort_by: Sort,
    /// Tasks of every namespace
    #[arg(short = 'A', long)]
    all_namespaces: bool,
    /// Print the numbers, for programs
    #[arg(short, long, value_enum, value_name = "FORMAT")]
    output: Option<Format>,
}

#[derive(Debug, Clone, Copy, Default, clap::ValueEnum)]
enum Sort {
    #[default]
    Name,
    Cpu,
    Memory,
}

/// What `GET …/usage` answers.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Usage {
    nodes: Vec<NodeUsage>,
    tasks: Vec<TaskUsage>,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct NodeUsage {
    name: String,
    cpu_millis: u64,
    memory_bytes: u64,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct TaskUsage {
    namespace: String,
    name: String,
    node: String,
    cpu_millis: u64,
    memory_bytes: u64,
}

pub(crate) async fn run(args: Args, session: &mut Session) -> Outcome {
    let kind = target::kind(&args.kind)?;
    if !matches!(kind.kind, "Node" | "Task") {
        return Err(CliError::usage(format!("{} use nothing; try nodes or tasks", kind.plural)));
    }
    let answer: Value = session.client.get_json(&group_path("usage")).await?;
    let usage: Usage =
        serde_json::from_value(answer.clone()).map_err(|source| CliError::Answer {
            server: session.client.server.clone(),
            request: "GET usage".to_owned(),
            source,
        })?;
    if let Some(format @ (Format::Yaml | Format::Json)) = args.output {
        let part = &answer[kind.plural];
        session.ui.print(&document(&json!({ kind.plural: part }), format)?)?;
        return Ok(exit::OK);
    }
    let table = match kind.kind {
        "Node" => nodes(&args, usage.nodes, session).await?,
        _ => tasks(&args, usage.tasks, session).await?,
    };
    if table.is_empty() {
        session.ui.note(&format!("no node has measured any {} yet", kind.plural));
        return Ok(exit::OK);
    }
    let text = table.text(&session.ui.styles);
    session.ui.print(&text)?;
    Ok(exit::OK)
}

async fn nodes(args: &Args, mut all: Vec<NodeUsage>, session: &Session) -> Result<Table, CliError> {
    let list = session.client.list(target::kind("node")?, None, &Selection::default()).await?;
    let statuses: BTreeMap<String, _> = list
        .items
        .into_iter()
        .filter_map(|o| serde_json::from_value::<Node>(o).ok())
        .filter_map(|n| Some((n.metadata.name?, n.status.unwrap_or_default())))
        .collect();
    all.retain(|n| args.names.is_empty() || args.names.contains(&n.name));
    sort(&mut all, args.sort_by, |n| (n.name.clone(), n.cpu_millis, n.memory_bytes));
    let mut table =
        Table::new(["NAME", "CPU", "CPU%", "RESERVED", "MEMORY", "MEMORY%", "RESERVED"]);
    for n in all {
        let status = statuses.get(&n.name);
        let (cpu, memory) =
            status.map_or((0, 0), |s| (s.allocatable.cpu.0, s.allocatable.memory.0));
        table.push([
            n.name.clone(),
            human::cores(MilliCpu(n.cpu_millis)),
            human::percent(n.cpu_millis, cpu),
            status.map(|s| human::cores(s.used.cpu)).unwrap_or_default(),
            human::bytes(Bytes(n.memory_bytes)),
            human::percent(n.memory_bytes, memory),
            status.map(|s| human::bytes(s.used.memory)).unwrap_or_default(),
        ]);
    }
    Ok(table)
}

async fn tasks(args: &Args, mut all: Vec<TaskUsage>, session: &Session) -> Result<Table, CliError> {
    let namespace = (!args.all_namespaces).then_some(session.namespace.as_str());
    let list = session.client.list(target::kind("task")?, namespace, &Selection::default()).await?;
    let reserved: BTreeMap<(String, String), _> = list
        .items
        .into_iter()
        .filter_map(|o| serde_json::from_value::<Task>(o).ok())
        .filter_map(|t| Some(((t.metadata.namespace?, t.metadata.name?), t.spec.resources)))
        .collect();
    all.retain(|t| {
        namespace.is_none_or(|ns| t.namespace == ns)
            && (args.names.is_empty() || args.names.contains(&t.name))
    });
    sort(&mut all, args.sort_by, |t| {
        (format!("{}/{}", t.namespace, t.name), t.cpu_millis, t.memory_bytes)
    });
    let mut table = Table::new(["NAME", "NODE", "CPU", "LIMIT", "MEMORY", "LIMIT"]);
    for t in &all {
        let limits = reserved.get(&(t.namespace.clone(), t.name.clone()));
        table.push([
            t.name.clone(),
            t.node.clone(),
            human::cores(MilliCpu(t.cpu_millis)),
            limits.and_then(|r| r.cpu).map(human::cores).unwrap_or_default(),
            human::bytes(Bytes(t.memory_bytes)),
            limits.and_then(|r| r.memory).map(human::bytes).unwrap_or_default(),
        ]);
    }
    if args.all_namespaces {
        table.prepend("NAMESPACE", all.into_iter().map(|t| t.namespace));
    }
    Ok(table)
}

fn sort<T>(all: &mut [T], by: Sort, key: impl Fn(&T) -> (String, u64, u64)) {
    match by {
        Sort::Name => all.sort_by_key(|t| key(t).0),
        Sort::Cpu => all.sort_by_key(|t| Reverse(key(t).1)),
        Sort::Memory => all.sort_by_key(|t| Reverse(key(t).2)),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::fake::{Fake, node, task};

    #[tokio::test]
    async fn use_stands_beside_what_is_allowed() {
        let fake = Fake::new();
        fake.put("nodes/r1", node("r1", json!({
            "allocatable": {"cpu": "2", "memory": "1Gi"}, "used": {"cpu": "1500m", "memory": "512Mi"},
        })));
        let mut t = task("t", json!({"phase": "Running", "node": "r1"}));
        t["spec"]["resources"] = json!({"cpu": "500m"});
        fake.put("tasks/default/t", t);
        fake.answer("GET /apis/muster.dev/v1alpha1/usage", json!({
            "nodes": [{"name": "r1", "cpuMillis": 500, "memoryBytes": 268_435_456}],
            "tasks": [
                {"namespace": "default", "name": "t", "uid": "u", "node": "r1", "cpuMillis": 499, "memoryBytes": 1_048_576, "cpuTotalUsec": 1},
                {"namespace": "other", "name": "x", "uid": "v", "node": "r1", "cpuMillis": 1, "memoryBytes": 1, "cpuTotalUsec": 1},
            ],
        }));
        assert_eq!(
            fake.run(&["top", "nodes"]).await.1,
            "NAME   CPU   CPU%   RESERVED   MEMORY   MEMORY%   RESERVED\n\
             r1     0.5   25%    1.5        256Mi    25%       512Mi\n"
        );
        assert_eq!(
            fake.run(&["top", "tasks"]).await.1,
            "NAME   NODE   CPU     LIMIT   MEMORY   LIMIT\nt      r1     0.499   0.5     1Mi      -\n"
        );
    }
}
