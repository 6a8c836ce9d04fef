//! `muster simulate`: the decisions of production over random worlds, with their distributions.

use std::time::{Duration, Instant};

use muster_api::kind::application::Application;
use muster_controller_core::offload::model::Model;
use muster_controller_core::simulation::instance::{Size, Supply};
use muster_controller_core::simulation::sweep::{case, decide, judge, spread};
use muster_controller_core::simulation::{course, world};

use super::Outcome;
use crate::exit;
use crate::output::table::Table;
use crate::output::ui::Ui;

/// What is simulated.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// AnyScale's decisions: how near to the optimum they are, how fast, and what they do when links come and go
    Offload(Args),
}

/// `muster simulate offload`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Decisions of each size, loose and tight
    #[arg(long, default_value_t = 20, value_name = "N")]
    cases: u64,
    /// Every number of migratable parts of 6, 12 and 18, and 2 to 8 scales; with --cases 1000 that takes hours
    #[arg(long)]
    sweep: bool,
    /// Random link traces of 40 s
    #[arg(long, default_value_t = 1000, value_name = "N")]
    traces: u64,
    /// Drives over AnyScale's course
    #[arg(long, default_value_t = 200, value_name = "N")]
    drives: u64,
    /// Where the random numbers begin
    #[arg(long, default_value_t = 0, value_name = "SEED")]
    seed: u64,
}

pub(crate) fn run(command: &Command, ui: &mut Ui) -> Outcome {
    let Command::Offload(args) = command;
    sweep(args, ui)?;
    large(ui)?;
    let model = corridor();
    drives(args, &model, ui)?;
    traces(args, &model, ui)?;
    Ok(exit::OK)
}

/// AnyScale's application, as the examples have it.
fn corridor() -> Model {
    let text = include_str!("../../../manifests/examples/application.yaml");
    let documents = muster_api::manifest::parse("application.yaml", text);
    let object = documents.ok().and_then(|documents| documents.first()?.admit().ok());
    let application: Application = serde_json::from_value(object.unwrap_or_default())
        .expect("the example is admitted by a test, and is part of this program");
    Model::of(&application.spec)
}

fn sizes(sweep: bool) -> Vec<(usize, usize, Vec<usize>)> {
    let all = |parts: usize| (1..=parts).map(move |m| (parts, m, (2..=8).collect()));
    match sweep {
        true => [6, 12, 18].into_iter().flat_map(all).collect(),
        false => [(6, 6), (12, 6), (12, 12), (18, 9), (18, 18)]
            .map(|(n, m)| (n, m, vec![2, 4, 8]))
            .into(),
    }
}

/// What one row of the sweep has.
#[derive(Default)]
struct Row {
    ours: Vec<f64>,
    greedy: Vec<f64>,
    seconds: Vec<f64>,
    proven: usize,
}

impl Row {
    fn take(&mut self, other: &Row) {
        self.ours.extend(&other.ours);
        self.greedy.extend(&other.greedy);
        self.seconds.extend(&other.seconds);
        self.proven += other.proven;
    }

    fn cells(&mut self) -> Vec<String> {
        let percent = |share: f64| format!("{:.3}", share * 100.0);
        let shares = [0.5, 0.9, 0.99, 1.0];
        let (mean, ours) = spread(&mut self.ours, &shares);
        let (greedy_mean, greedy) = spread(&mut self.greedy, &shares);
        let (_, seconds) = spread(&mut self.seconds, &[0.5, 0.99, 1.0]);
        let mut cells = vec![percent(mean)];
        cells.extend(ours.iter().map(|d| percent(*d)));
        cells.push(percent(greedy_mean));
        cells.extend(greedy.iter().map(|d| percent(*d)));
        cells.extend(seconds.iter().map(|s| format!("{:.2}", s * 1e3)));
        cells.push(format!("{:.0}%", 100.0 * self.proven as f64 / self.ours.len().max(1) as f64));
        cells
    }
}

fn sweep(args: &Args, ui: &mut Ui) -> Outcome {
    if args.cases == 0 {
        return Ok(exit::OK);
    }
    ui.line("Deviation from the proven optimum, %; time of a decision, ms")?;
    let mut table = Table::new([
        "SUPPLY", "N", "M", "K", "MEAN", "P50", "P90", "P99", "WORST", "ALG.1", "P50", "P90",
        "P99", "WORST", "T50", "T99", "TMAX", "PROVEN",
    ]);
    for supply in Supply::ALL {
        let mut all = Row::default();
        for (parts, migratable, scales) in sizes(args.sweep) {
            for scales in scales {
                let mut row = Row::default();
                for seed in args.seed..args.seed.saturating_add(args.cases) {
                    one(&mut row, Size { parts, migratable, scales }, supply, seed);
                }
                all.take(&row);
                let head = [supply.as_str().to_owned()]
                    .into_iter()
                    .chain([parts, migratable, scales].map(|n| n.to_string()));
                table.push(head.chain(row.cells()));
            }
        }
        let head = [supply.as_str(), "all", "", ""].map(str::to_owned);
        table.push(head.into_iter().chain(all.cells()));
    }
    let text = table.text(&ui.styles);
    ui.print(&text)?;
    Ok(exit::OK)
}

fn one(row: &mut Row, size: Size, supply: Supply, seed: u64) {
    let problem = case(size, supply, seed);
    let start = Instant::now();
    let found = decide(&problem);
    row.seconds.push(start.elapsed().as_secs_f64());
    if let Some(found) = found {
        let case = judge(&problem, &found);
        row.ours.push(case.deviation);
        row.greedy.push(case.greedy);
        row.proven += usize::from(case.proven);
    }
}

/// What no search is exact for.
fn large(ui: &mut Ui) -> Outcome {
    ui.line("\n200 parts on 50 scales")?;
    for supply in Supply::ALL {
        let size = Size { parts: 200, migratable: 200, scales: 50 };
        let problem = case(size, supply, 1);
        let start = Instant::now();
        let found = decide(&problem);
        let took = milliseconds(start.elapsed());
        if let Some(found) = found {
            let gap = found.gap() * 100.0;
            ui.line(&format!("{}: {took:.0} ms, proven gap {gap:.1} %", supply.as_str()))?;
        }
    }
    Ok(exit::OK)
}

fn milliseconds(span: Duration) -> f64 {
    span.as_secs_f64() * 1e3
}

fn drives(args: &Args, model: &Model, ui: &mut Ui) -> Outcome {
    let amcl = model.parts.iter().position(|part| part.name == "amcl");
    let Some(amcl) = amcl.filter(|_| args.drives > 0) else { return Ok(exit::OK) };
    let (mut savings, mut violated) = (Vec::new(), 0.0);
    for seed in args.seed..args.seed.saturating_add(args.drives) {
        let drive = course::drive(model, amcl, seed);
        savings.push(drive.saving() * 100.0);
        violated += drive.record.violated;
    }
    let (mean, at) = spread(&mut savings, &[0.0, 0.01, 0.5]);
    ui.line(&format!(
        "\n{} drives of 115 m, 45 to 65 % covered: {mean:.1} % of what can be saved is saved (least {:.1}, p1 {:.1}, p50 \
         {:.1}); {violated:.1} s beyond a tolerance",
        args.drives, at[0], at[1], at[2]
    ))?;
    Ok(exit::OK)
}

fn traces(args: &Args, model: &Model, ui: &mut Ui) -> Outcome {
    if args.traces == 0 {
        return Ok(exit::OK);
    }
    let mut sum = world::Record::default();
    for seed in args.seed..args.seed.saturating_add(args.traces) {
        let record = world::restless(model, 40.0, seed);
        sum.out += record.out;
        sum.returned += record.returned;
        sum.alone += record.alone;
        sum.flaps += record.flaps;
        sum.lost += record.lost;
        sum.twice += record.twice;
        sum.violated += record.violated;
    }
    let world::Record { out, returned, alone, flaps, lost, twice, violated, .. } = sum;
    ui.line(&format!(
        "\n{} link traces of 40 s: {out} moves out, {returned} returns, {alone} by the robot alone; {flaps} flaps, {lost} \
         parts lost, {twice} run twice, {violated:.1} s beyond a tolerance",
        args.traces
    ))?;
    Ok(exit::OK)
}
