//! What was measured, beside what is promised, and what was broken.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crate::fault::Fault;
use crate::writer::Wrote;

/// A survivor is Ready so long after a fault has ended.
const READY_WITHIN: Duration = Duration::from_secs(5);
/// A silent node is found out in so long: `detectAfter`, and what the clocks' ticks and a list take.
const DETECTED_WITHIN: Duration = Duration::from_millis(2_250);

/// What one kind of fault has shown.
#[derive(Debug, Default)]
struct Row {
    times: usize,
    ready: Vec<Duration>,
    detected: Vec<Duration>,
}

/// The outcome so far.
#[derive(Debug)]
pub(crate) struct Report {
    pub(crate) broken: Vec<String>,
    pub(crate) lasted: Duration,
    begun: Instant,
    slack: f64,
    rows: BTreeMap<Fault, Row>,
    /// Each with how long it took and the bound that it had then.
    figures: BTreeMap<String, Vec<(Duration, Duration)>>,
    wrote: Option<Wrote>,
}

impl Report {
    pub(crate) fn new(slack: f64) -> Report {
        let (begun, lasted) = (Instant::now(), Duration::ZERO);
        let (broken, rows, figures) = (Vec::new(), BTreeMap::new(), BTreeMap::new());
        Report { broken, lasted, begun, slack, rows, figures, wrote: None }
    }

    /// Something that must not be.
    pub(crate) fn broken(&mut self, how: String) {
        println!("{:7.1} s  BROKEN: {how}", self.begun.elapsed().as_secs_f64());
        self.broken.push(how);
    }

    pub(crate) fn say(&self, what: &str) {
        println!("{:7.1} s  {what}", self.begun.elapsed().as_secs_f64());
    }

    pub(crate) fn began(&mut self, fault: Fault) {
        self.rows.entry(fault).or_default().times += 1;
    }

    pub(crate) fn has_seen(&self, all: &[Fault]) -> bool {
        all.iter().all(|fault| self.rows.contains_key(fault))
    }

    /// All nodes are ready and answer, so long after the fault's end.
    pub(crate) fn recovered(&mut self, fault: Fault, after: Duration) {
        self.rows.entry(fault).or_default().ready.push(after);
        self.hold(&format!("{fault}: every node is ready again"), after, READY_WITHIN);
    }

    /// A node was found out, so long after it went silent.
    pub(crate) fn detected(&mut self, fault: Fault, after: Duration) {
        self.rows.entry(fault).or_default().detected.push(after);
        if fault == Fault::CutToAgent {
            // What it says arrives until it gives up, which is for it to know.
            return;
        }
        self.hold(&format!("{fault}: the node counts as lost"), after, DETECTED_WITHIN);
    }

    /// A figure with its bound.
    pub(crate) fn measured(&mut self, what: &str, took: Duration, bound: Duration) {
        self.figures.entry(what.to_owned()).or_default().push((took, bound));
        self.hold(what, took, bound);
    }

    fn hold(&mut self, what: &str, took: Duration, bound: Duration) {
        if took > bound.mul_f64(self.slack) {
            self.broken(format!("{what} after {took:.2?}; {bound:.2?} is promised"));
        }
    }

    pub(crate) fn wrote(&mut self, wrote: Wrote) {
        self.wrote = Some(wrote);
    }

    pub(crate) fn print(&self) {
        println!("\n{:<24} {:>5}  {:>14}  {:>14}", "FAULT", "TIMES", "LOST AFTER", "READY AFTER");
        for (fault, row) in &self.rows {
            println!(
                "{:<24} {:>5}  {:>14}  {:>14}",
                fault.to_string(),
                row.times,
                worst(&row.detected),
                worst(&row.ready)
            );
        }
        println!();
        for (what, all) in &self.figures {
            // The one that came nearest to its bound.
            let share =
                |(took, bound): &(Duration, Duration)| took.as_secs_f64() / bound.as_secs_f64();
            let worst = all.iter().max_by(|a, b| share(a).total_cmp(&share(b)));
            let Some((took, bound)) = worst else { continue };
            let (took, bound, times) = (took.as_secs_f64(), bound.as_secs_f64(), all.len());
            println!("{what}: {took:.2} s of at most {bound:.2} s ({times} times, the worst)");
        }
        if let Some(wrote) = &self.wrote {
            println!("{wrote}");
        }
        let faults: usize = self.rows.values().map(|row| row.times).sum();
        let lasted = self.lasted.as_secs();
        println!("{faults} faults in {lasted} s, {} violations", self.broken.len());
        for broken in &self.broken {
            println!("  {broken}");
        }
    }
}

/// The longest of these.
fn worst(all: &[Duration]) -> String {
    all.iter()
        .max()
        .map_or_else(|| "-".to_owned(), |most| format!("{:.0} ms", most.as_secs_f64() * 1e3))
}
