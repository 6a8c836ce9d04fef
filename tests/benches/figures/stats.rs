//! Percentiles, and how figures are printed.

use std::time::Duration;

/// Samples of one thing.
#[derive(Debug, Default)]
pub(crate) struct Samples(Vec<Duration>);

impl Samples {
    pub(crate) fn push(&mut self, sample: Duration) {
        self.0.push(sample);
    }

    /// The value below which the fraction `q` of the samples lies (nearest rank).
    pub(crate) fn quantile(&self, q: f64) -> Duration {
        let mut sorted = self.0.clone();
        sorted.sort_unstable();
        let rank = ((sorted.len() as f64 * q).ceil() as usize).clamp(1, sorted.len());
        sorted[rank - 1]
    }

    pub(crate) fn median(&self) -> Duration {
        self.quantile(0.5)
    }

    pub(crate) fn line(&self, name: &str) {
        println!(
            "  {name:34} p50 {:>9.3} ms  p95 {:>9.3} ms  p99 {:>9.3} ms  n={}",
            millis(self.median()),
            millis(self.quantile(0.95)),
            millis(self.quantile(0.99)),
            self.0.len()
        );
    }
}

pub(crate) fn millis(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}

/// Prints a figure beside its aim.
pub(crate) fn figure(name: &str, value: f64, unit: &str, aim: &str) {
    println!("  => {name}: {value:.2}{unit}   (aim {aim})");
}
