//! The result: a row a task, and the paper's totals. Pure.

use serde::Serialize;

use super::check::Check;
use super::measure::Measured;
use super::scenario::{PAPER_THREE, PAPER_TWO};

/// The lease that a task holds.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(super) struct Held {
    pub(super) name: String,
    pub(super) epoch: u64,
}

/// One task.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Row {
    pub(super) task: String,
    pub(super) class: String,
    pub(super) phase: String,
    pub(super) node: Option<String>,
    /// Metres to the operation position, when it was placed.
    pub(super) score: Option<f64>,
    pub(super) lease: Option<Held>,
    /// Why it waits: the word, and the sentence.
    pub(super) waits: Option<(String, String)>,
    /// Millicores that it reserved, and the most that the kernel should let it use.
    pub(super) quota_millis: Option<u64>,
    /// Share of the robot's CPU alone in the paper, %.
    pub(super) paper_percent: Option<f64>,
    pub(super) alone: Option<Measured>,
    /// Beside one other (Fig. 5, before 165 s).
    pub(super) two: Option<Measured>,
    /// Beside two others (Fig. 5, after 165 s).
    pub(super) three: Option<Measured>,
    /// With more users of the camera.
    pub(super) full: Option<Measured>,
}

/// What the demo found.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Report {
    /// How the kernel holds tasks to their quotas; none: it does not.
    pub(super) quotas: Option<String>,
    /// Millicores: what the shared robot offers, its CR.
    pub(super) robot_millis: u64,
    pub(super) rows: Vec<Row>,
    pub(super) totals: Totals,
    /// Most cores that anything else on this machine used during a measurement, and all it has.
    pub(super) others: f64,
    pub(super) cores: usize,
    pub(super) checks: Vec<Check>,
    pub(super) seconds: f64,
}

/// Of the robot's CPU, %, and what sharing it gains.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Totals {
    pub(super) mean_alone: Option<f64>,
    pub(super) least_alone: Option<f64>,
    pub(super) sum_alone: Option<f64>,
    pub(super) two: Option<f64>,
    pub(super) three: Option<f64>,
    /// The robot with more users of its camera; not part of the paper's ratios.
    pub(super) full: Option<f64>,
    /// Three together / mean alone.
    pub(super) over_mean: Option<f64>,
    /// Three together / least alone.
    pub(super) over_least: Option<f64>,
    /// Least of the three's throughput together / alone.
    pub(super) least_throughput_kept: Option<f64>,
    pub(super) paper: PaperTotals,
}

/// The same in the paper (V-A).
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct PaperTotals {
    pub(super) two: f64,
    pub(super) three: f64,
    pub(super) over_mean: f64,
    pub(super) over_least: f64,
}

impl Default for PaperTotals {
    fn default() -> Self {
        PaperTotals { two: PAPER_TWO, three: PAPER_THREE, over_mean: 3.68, over_least: 7.51 }
    }
}

/// Cores as a percentage of the robot's CR.
pub(super) fn percent(cores: f64, robot_millis: u64) -> f64 {
    cores * 1e5 / robot_millis.max(1) as f64
}

/// Together / alone.
pub(super) fn kept(alone: Option<&Measured>, together: Option<&Measured>) -> Option<f64> {
    let (alone, together) = (alone?.throughput?, together?.throughput?);
    (alone > 0.0).then(|| together / alone)
}

impl Row {
    /// One of the three of the paper's figures.
    pub(super) fn is_of_the_paper(&self) -> bool {
        self.paper_percent.is_some()
    }
}

/// The totals of rows. A sum is there only when every part of it was measured.
pub(super) fn totals(rows: &[Row], robot: &str, robot_millis: u64) -> Totals {
    let cpu = |of: fn(&Row) -> Option<&Measured>, row: &Row| {
        of(row)?.cpu.map(|cores| percent(cores, robot_millis))
    };
    let paper: Vec<&Row> = rows.iter().filter(|row| row.is_of_the_paper()).collect();
    let alone: Option<Vec<f64>> = paper.iter().map(|row| cpu(|r| r.alone.as_ref(), row)).collect();
    let alone = alone.filter(|a| !a.is_empty());
    let sum = alone.as_ref().map(|a| a.iter().sum::<f64>());
    let mean = alone.as_ref().map(|a| a.iter().sum::<f64>() / a.len() as f64);
    let least = alone.as_ref().and_then(|a| a.iter().copied().reduce(f64::min));
    let two: Vec<f64> = paper.iter().filter_map(|row| cpu(|r| r.two.as_ref(), row)).collect();
    let three: Option<Vec<f64>> = paper.iter().map(|row| cpu(|r| r.three.as_ref(), row)).collect();
    let three = three.filter(|t| !t.is_empty()).map(|t| t.iter().sum::<f64>());
    let on_robot = rows.iter().filter(|row| row.node.as_deref() == Some(robot));
    let full: Vec<f64> = on_robot.filter_map(|row| cpu(|r| r.full.as_ref(), row)).collect();
    let ratio = |below: Option<f64>| Some(three? / below.filter(|b| *b > 0.0)?);
    let all_kept: Option<Vec<f64>> =
        paper.iter().map(|row| kept(row.alone.as_ref(), row.three.as_ref())).collect();
    Totals {
        mean_alone: mean,
        least_alone: least,
        sum_alone: sum,
        two: (two.len() == 2).then(|| two.iter().sum()),
        three,
        full: (!full.is_empty()).then(|| full.iter().sum()),
        over_mean: ratio(mean),
        over_least: ratio(least),
        least_throughput_kept: all_kept.and_then(|k| k.into_iter().reduce(f64::min)),
        paper: PaperTotals::default(),
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::scenario::{ROBOT, WORKLOADS};
    use super::*;

    pub(in super::super) fn measured(cpu: f64, throughput: f64) -> Measured {
        Measured { cpu: Some(cpu), throughput: Some(throughput), ..Measured::default() }
    }

    /// The paper's three on a robot of one core, each the same alone and together.
    pub(in super::super) fn rows() -> Vec<Row> {
        let shares = [0.153, 0.131, 0.517];
        let rows = WORKLOADS.iter().zip(shares).enumerate().map(|(i, (workload, share))| Row {
            task: workload.name.to_owned(),
            class: workload.class.to_owned(),
            phase: "Running".to_owned(),
            node: Some(ROBOT.to_owned()),
            score: Some(8.0_f64.sqrt()),
            paper_percent: Some(workload.paper_percent),
            alone: Some(measured(share, 10.0)),
            two: (i < 2).then(|| measured(share, 10.0)),
            three: Some(measured(share, 9.5)),
            ..Row::default()
        });
        rows.collect()
    }

    #[test]
    fn additive_load_gives_three() {
        let totals = totals(&rows(), ROBOT, 1000);
        let near =
            |a: Option<f64>, b: f64| assert!((a.expect("measured") - b).abs() < 1e-6, "{a:?}");
        near(totals.mean_alone, 26.7);
        near(totals.sum_alone, 80.1);
        near(totals.two, 28.4);
        near(totals.three, 80.1);
        near(totals.over_mean, 3.0);
        near(totals.over_least, 80.1 / 13.1);
        near(totals.least_throughput_kept, 0.95);
        assert_eq!(totals.full, None);
    }

    #[test]
    fn the_papers_ratios_are_those_of_its_own_figures() {
        let paper = PaperTotals::default();
        let alone: Vec<f64> = WORKLOADS.iter().map(|w| w.paper_percent).collect();
        let mean = alone.iter().sum::<f64>() / 3.0;
        assert!((paper.three / mean - paper.over_mean).abs() < 0.01);
        assert!((paper.three / 13.1 - paper.over_least).abs() < 0.01);
    }

    #[test]
    fn what_was_not_measured_is_no_part_of_a_sum() {
        let mut rows = rows();
        rows[1].three = None;
        rows.push(Row {
            full: Some(measured(0.1, 1.0)),
            node: Some(ROBOT.into()),
            ..Row::default()
        });
        rows.push(Row {
            full: Some(measured(0.3, 1.0)),
            node: Some("cloud-1".into()),
            ..Row::default()
        });
        let totals = totals(&rows, ROBOT, 2000);
        assert_eq!(
            (totals.three, totals.over_mean, totals.least_throughput_kept),
            (None, None, None)
        );
        assert_eq!(totals.full, Some(5.0), "of a robot with two cores; others' nodes do not count");
    }
}
