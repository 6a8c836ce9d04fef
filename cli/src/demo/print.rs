//! What people and programs see. Text goes to standard output, or to standard error when that is JSON;
//! what only matters now is a spinner on a terminal, and nothing elsewhere.

use std::collections::BTreeMap;
use std::io::IsTerminal as _;
use std::path::Path;
use std::time::Duration;

use muster_api::kind::node::Node;
use muster_api::kind::task::Task;

use super::check::Check;
use super::figures::{Report, kept, percent};
use super::measure::Measured;
use crate::error::CliError;
use crate::output::human;
use crate::output::progress::Progress;
use crate::output::style::Mood;
use crate::output::table::{Cell, Table};
use crate::output::ui::Ui;

/// Why the paper's ratios are higher than what loads that add up can give.
const WHY_LESS: &str = "Loads that add up give 3.00 over the mean: three workloads use three times their mean. The paper's \
3.68 is more because its loads did not add up: gmapping and monitoring, 28.4 % alone, used 69.66 % together, \
and its workloads take what cpu they get. Here each has a frame clock and does the same work as alone.";

/// Cores that others may use without a word: the daemons and a desktop.
pub(super) const BUSY: f64 = 0.4;

/// Where everything is printed.
pub(super) struct Out<'a> {
    ui: &'a mut Ui,
    json: bool,
    terminal: bool,
    progress: Option<Progress>,
}

impl<'a> Out<'a> {
    pub(super) fn new(ui: &'a mut Ui, json: bool) -> Self {
        let terminal = std::io::stderr().is_terminal();
        Out { ui, json, terminal, progress: None }
    }

    /// What is going on now; only on a terminal.
    pub(super) fn doing(&mut self, text: &str) {
        if self.terminal {
            let progress = self.progress.get_or_insert_with(|| self.ui.progress());
            progress.show("doing", text);
        }
    }

    /// Takes what is going on off the terminal.
    pub(super) fn clear(&mut self) {
        if let Some(progress) = self.progress.take() {
            progress.end(false);
        }
    }

    /// A line beside everything.
    pub(super) fn note(&self, text: &str) {
        self.ui.note(text);
    }

    /// A line of the story.
    fn say(&mut self, text: &str) -> Result<(), CliError> {
        self.clear();
        if self.json {
            self.ui.note(text);
            return Ok(());
        }
        self.ui.line(text)
    }

    /// Before everything else: what the figures are worth.
    pub(super) fn first_line(&mut self, quotas: &Result<String, String>) -> Result<(), CliError> {
        let line = match quotas {
            Ok(how) => format!("quotas: enforced by the kernel ({how}), cpu and memory of every task"),
            Err(why) => self.ui.styles.warn.paint(format!(
                "QUOTAS ARE NOT ENFORCED: cpu and memory of tasks are not limited, usage is summed up from /proc ({})",
                human::plain(why)
            )),
        };
        self.say(&line)
    }

    /// A node that has joined.
    pub(super) fn node(&mut self, node: &Node) -> Result<(), CliError> {
        let status = node.status.clone().unwrap_or_default();
        let name = node.metadata.name.clone().unwrap_or_default();
        let place =
            status.pose.map_or(String::new(), |pose| format!(" at ({}, {})", pose.x, pose.y));
        let functions: Vec<String> =
            status.sensors.iter().chain(&status.actuators).map(ToString::to_string).collect();
        let functions =
            if functions.is_empty() { String::new() } else { format!(", {}", functions.join(" ")) };
        let allocatable = &status.allocatable;
        self.say(&format!(
            "node {name}: {:?}{place}, cpu {}, memory {}{functions}",
            node.spec.kind,
            human::cores(allocatable.cpu),
            human::bytes(allocatable.memory),
        ))
    }

    /// What a task did.
    pub(super) fn measured(
        &mut self,
        task: &str,
        when: &str,
        measured: &Measured,
        robot_millis: u64,
    ) -> Result<(), CliError> {
        let cpu = number(measured.cpu.map(|c| percent(c, robot_millis)), 1, " %");
        let rate = number(measured.throughput, 1, "/s");
        let p99 = number(measured.p99_ms, 0, " ms");
        self.say(&format!("  {when:>5}  {task:<13} cpu {cpu:>7}  work {rate:>9}  p99 {p99:>7}"))
    }

    /// Others used this many cores during a measurement, which is made again.
    pub(super) fn disturbed(&mut self, what: &str, others: f64) -> Result<(), CliError> {
        let said =
            format!("  {what}: other processes used {others:.1} cores meanwhile; measuring again");
        self.say(&self.ui.styles.warn.paint(said))
    }

    /// The result.
    pub(super) fn report(&mut self, report: &Report) -> Result<(), CliError> {
        self.clear();
        if self.json {
            let text = serde_json::to_string_pretty(report).unwrap_or_default();
            return self.ui.line(&text);
        }
        let (styles, places) = (&self.ui.styles, placements(report));
        let text = format!("\n{}\n{}\n", places.text(styles), figures(report).text(styles));
        self.ui.print(&text)?;
        for line in ratios(report) {
            self.ui.line(&line)?;
        }
        self.ui.line(&format!("\n{WHY_LESS}\n"))?;
        for check in &report.checks {
            let line = self.check(check);
            self.ui.line(&line)?;
        }
        if report.others > BUSY {
            let text = self.ui.styles.warn.paint(format!(
                "other processes used up to {:.1} of this machine's {} cores meanwhile: shares and throughputs suffer from it",
                report.others, report.cores
            ));
            self.ui.line(&text)?;
        }
        self.ui.line(&format!("took {:.0} s", report.seconds))
    }

    fn check(&self, check: &Check) -> String {
        let styles = &self.ui.styles;
        let mark = match check.passed {
            Some(true) => styles.good.paint("ok  "),
            Some(false) => styles.bad.paint("FAIL"),
            None => styles.warn.paint("-   "),
        };
        format!("{mark} {}: {}", check.what, human::plain(&check.found))
    }

    /// How to look at what stays up.
    pub(super) fn invite(&mut self, kubeconfig: &Path) -> Result<(), CliError> {
        let path = kubeconfig.display();
        self.say(&format!(
            "\nIt stays up until Ctrl-C. In another shell:\n\n  muster --kubeconfig {path} get tasks -o wide\n  \
             muster --kubeconfig {path} why task/second-driver\n  muster --kubeconfig {path} logs -f gmapping\n"
        ))
    }

    /// How long one picture of the live view is measured.
    pub(super) fn view_period(&self) -> Duration {
        // Three changes of a counter make a slope; a log wants less.
        Duration::from_secs(if self.terminal { 3 } else { 15 })
    }

    /// What runs now: drawn over itself on a terminal, else a line.
    pub(super) fn view(
        &mut self,
        tasks: &[Task],
        found: &BTreeMap<String, Measured>,
    ) -> Result<(), CliError> {
        let mut table = Table::new(["TASK", "PHASE", "NODE", "CPU", "WORK"]);
        let mut line = Vec::new();
        for task in tasks {
            let name = task.metadata.name.clone().unwrap_or_default();
            let status = task.status.clone().unwrap_or_default();
            let measured = found.get(&name).copied().unwrap_or_default();
            let cpu = number(measured.cpu.map(|c| c * 1e3), 0, "m");
            line.push(format!("{name} {cpu}"));
            let work = number(measured.throughput, 1, "/s");
            let node = status.node.unwrap_or_default();
            table.push([name, status.phase.to_string(), node, cpu, work]);
        }
        if !self.terminal {
            return self.say(&line.join("  "));
        }
        let text = table.text(&self.ui.styles);
        let progress = self.progress.get_or_insert_with(|| self.ui.progress());
        for (i, line) in text.lines().enumerate() {
            progress.settle(&format!("{i:03}"), " ", line);
        }
        Ok(())
    }
}

/// A number that may not be there.
fn number(value: Option<f64>, digits: usize, unit: &str) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.digits$}{unit}"))
}

/// Who runs where, and by what right.
fn placements(report: &Report) -> Table {
    let mut table = Table::new(["TASK", "CLASS", "NODE", "SCORE", "LEASE", "EPOCH", "QUOTA"]);
    for row in &report.rows {
        let place = match (&row.node, &row.waits) {
            (Some(node), _) => Cell::from(node),
            (None, Some((reason, _))) => Cell::new(format!("waits: {reason}"), Mood::Warn),
            (None, None) => Cell::new(&row.phase, Mood::Warn),
        };
        let (lease, epoch) = match &row.lease {
            Some(held) => (held.name.clone(), held.epoch.to_string()),
            None => Default::default(),
        };
        table.push([
            Cell::from(&row.task),
            Cell::from(&row.class),
            place,
            Cell::from(number(row.score, 2, " m")),
            Cell::from(lease),
            Cell::from(epoch),
            Cell::from(row.quota_millis.map(|q| format!("{q}m")).unwrap_or_default()),
        ]);
    }
    table
}

/// What each did: cpu as a part of the robot's CR, and its own work.
fn figures(report: &Report) -> Table {
    let mut table = Table::new([
        "TASK",
        "PAPER",
        "ALONE",
        "TWO",
        "THREE",
        "FULL",
        "WORK ALONE",
        "THREE",
        "KEPT",
        "P99 ALONE",
        "THREE",
    ]);
    let with_sign = |value: Option<f64>| number(value, 1, "%");
    let share = |m: &Option<Measured>| {
        with_sign(m.and_then(|m| m.cpu).map(|c| percent(c, report.robot_millis)))
    };
    for row in report.rows.iter().filter(|row| row.node.is_some()) {
        let of = |m: &Option<Measured>, field: fn(&Measured) -> Option<f64>, digits, unit| {
            number(m.as_ref().and_then(field), digits, unit)
        };
        let kept = kept(row.alone.as_ref(), row.three.as_ref());
        table.push([
            row.task.clone(),
            with_sign(row.paper_percent),
            share(&row.alone),
            share(&row.two),
            share(&row.three),
            share(&row.full),
            of(&row.alone, |m| m.throughput, 1, "/s"),
            of(&row.three, |m| m.throughput, 1, "/s"),
            number(kept.map(|k| k * 100.0), 0, "%"),
            of(&row.alone, |m| m.p99_ms, 0, " ms"),
            of(&row.three, |m| m.p99_ms, 0, " ms"),
        ]);
    }
    let totals = &report.totals;
    let sums = [totals.sum_alone, totals.two, totals.three, totals.full].map(with_sign);
    let robot = ["robot".to_owned(), String::new()].into_iter().chain(sums);
    table.push(robot.chain([(); 5].map(|()| String::new())));
    table
}

fn ratios(report: &Report) -> Vec<String> {
    let totals = &report.totals;
    let paper = &totals.paper;
    let ratio = |value: Option<f64>| number(value, 2, "x");
    vec![
        format!(
            "CPU in % of the robot's CR, {}m: alone, two and three together, full with more users of its camera (their own row).",
            report.robot_millis
        ),
        format!(
            "three together {} of the robot (paper: {:.2} %); two together {} (paper: {:.2} %)",
            number(totals.three, 1, " %"),
            paper.three,
            number(totals.two, 1, " %"),
            paper.two
        ),
        format!(
            "together / mean alone   {} (paper: {:.2})",
            ratio(totals.over_mean),
            paper.over_mean
        ),
        format!(
            "together / least alone  {} (paper: up to {:.2})",
            ratio(totals.over_least),
            paper.over_least
        ),
        format!(
            "own throughput kept     {} at least",
            number(totals.least_throughput_kept.map(|k| k * 100.0), 0, " %")
        ),
    ]
}

#[cfg(test)]
mod tests {
    use super::super::figures::Row;
    use super::super::figures::tests::rows;
    use super::super::figures::totals;
    use super::super::scenario::ROBOT;
    use super::*;
    use crate::output::style::Styles;

    fn report() -> Report {
        let rows = rows();
        let totals = totals(&rows, ROBOT, 1000);
        Report {
            quotas: None,
            robot_millis: 1000,
            rows,
            totals,
            others: 0.9,
            cores: 2,
            checks: Vec::new(),
            seconds: 1.0,
        }
    }

    #[test]
    fn a_table_has_a_row_a_task_and_one_for_the_robot() {
        let text = figures(&report()).text(&Styles::default());
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), 5, "{text}");
        let words = |line: usize| lines[line].split_whitespace().collect::<Vec<_>>();
        let gmapping =
            ["gmapping", "15.3%", "15.3%", "15.3%", "15.3%", "-", "10.0/s", "9.5/s", "95%"];
        assert_eq!(words(1)[..9], gmapping);
        assert_eq!(words(4)[..6], ["robot", "-", "80.1%", "28.4%", "80.1%", "-"]);
    }

    #[test]
    fn who_waits_says_why() {
        let mut report = report();
        let waits = Some(("LeaseHeld".to_owned(), "held".to_owned()));
        report.rows.push(Row { task: "second-driver".into(), waits, ..Row::default() });
        let text = placements(&report).text(&Styles::default());
        assert!(text.contains("waits: LeaseHeld") && text.contains("2.83 m"), "{text}");
    }

    #[test]
    fn ratios_are_printed_as_they_are() {
        let text = ratios(&report()).join("\n");
        for part in ["3.00x (paper: 3.68)", "6.11x (paper: up to 7.51)", "95 % at least", "80.1 %"]
        {
            assert!(text.contains(part), "{part}: {text}");
        }
    }

    #[test]
    fn programs_read_names_that_stay() {
        let json = serde_json::to_value(report()).expect("JSON");
        assert_eq!(json["rows"][0]["alone"]["cpu"], 0.153);
        assert_eq!(json["totals"]["paper"]["overMean"], 3.68);
        assert_eq!(json["rows"][0]["paperPercent"], 15.3);
    }
}
