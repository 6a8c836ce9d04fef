//! Counters of the kernel and lines of the workloads → shares of a core, frames a second, latencies.
//!
//! The controller passes on a task's cpu counter with each heartbeat. It is asked for more often than it
//! changes; only changes count as samples, so that a heartbeat's period does not blur the time.

use std::collections::BTreeMap;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

use super::api::Api;
use crate::error::CliError;

/// Much shorter than the time between heartbeats (0.6 s): a change is seen this late at most.
const LOOK: Duration = Duration::from_millis(60);
/// Lines of a log that cover any measurement: one a second.
const LOG_LINES: u64 = 700;

/// What one task did during a measurement.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Measured {
    /// Cores, from the kernel's counter.
    pub(super) cpu: Option<f64>,
    /// Units of work a second, as the workload counts them.
    pub(super) throughput: Option<f64>,
    /// Frames that came too late to be taken, of all.
    pub(super) dropped: Option<f64>,
    /// Cpu of a unit of work, ms.
    pub(super) unit_cpu_ms: Option<f64>,
    /// From frame to result, ms.
    pub(super) p50_ms: Option<f64>,
    pub(super) p99_ms: Option<f64>,
    pub(super) memory_bytes: Option<u64>,
}

/// A counter over time.
#[derive(Debug, Clone, Default)]
pub(super) struct Track {
    /// Seconds, and the counter's value in seconds of cpu, at each change.
    samples: Vec<(f64, f64)>,
    seen: Option<u64>,
}

impl Track {
    /// The counter stood at `usec` at `t`. The first value is no change: when it came is not known.
    pub(super) fn see(&mut self, t: f64, usec: u64) {
        if self.seen.is_some_and(|seen| seen != usec) {
            self.samples.push((t, usec as f64 / 1e6));
        }
        self.seen = Some(usec);
    }

    /// Cores: the median of the slopes between all pairs of samples (Theil and Sen's estimator). A moment in which the machine
    /// stood still bends a line of least squares, and not this. None: less than three samples.
    pub(super) fn slope(&self) -> Option<f64> {
        let n = self.samples.len();
        if n < 3 {
            return None;
        }
        let pairs =
            (0..n).flat_map(|i| (i + 1..n).map(move |j| (self.samples[i], self.samples[j])));
        let slope = |(a, b): ((f64, f64), (f64, f64))| (b.1 - a.1) / (b.0 - a.0);
        let mut slopes: Vec<f64> = pairs.filter(|(a, b)| b.0 > a.0).map(slope).collect();
        slopes.sort_by(f64::total_cmp);
        slopes.get(slopes.len() / 2).copied()
    }
}

/// A line of a workload.
#[derive(Debug, Clone, Deserialize)]
pub(super) struct Line {
    /// Seconds since 1970.
    pub(super) time: f64,
    /// Seconds since its start.
    t: f64,
    frames: u64,
    dropped: u64,
    units_done: u64,
    cpu_seconds: f64,
    p50_ms: f64,
    p99_ms: f64,
}

/// The progress lines of a log; others are left out.
pub(super) fn lines(log: &str) -> Vec<Line> {
    log.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
}

/// What lines from one time to another say.
pub(super) fn read(lines: &[Line], from: f64, to: f64) -> Measured {
    let within: Vec<&Line> = lines.iter().filter(|l| (from..=to).contains(&l.time)).collect();
    let (Some(first), Some(last)) = (within.first(), within.last()) else {
        return Measured::default();
    };
    let span = last.t - first.t;
    let units = last.units_done.saturating_sub(first.units_done) as f64;
    let frames = last.frames.saturating_sub(first.frames) as f64;
    let dropped = last.dropped.saturating_sub(first.dropped) as f64;
    let some = |value: f64| value.is_finite().then_some(value);
    Measured {
        throughput: some(units / span),
        dropped: some(dropped / (frames + dropped)),
        unit_cpu_ms: some(1e3 * (last.cpu_seconds - first.cpu_seconds) / units),
        p50_ms: Some(last.p50_ms),
        p99_ms: Some(last.p99_ms),
        ..Measured::default()
    }
}

fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64())
}

/// What was measured.
#[derive(Debug, Default)]
pub(super) struct Found {
    /// By name.
    pub(super) tasks: BTreeMap<String, Measured>,
    /// Cores that everything else on this machine used: the daemons, and what is no part of the demo.
    pub(super) others: f64,
}

/// Measures tasks, given as (name, uid), for a time. `tell` hears the shares so far, by uid.
pub(super) async fn measure(
    api: &Api,
    tasks: &[(String, String)],
    time: Duration,
    mut tell: impl FnMut(&BTreeMap<String, f64>),
) -> Result<Found, CliError> {
    let mut machine = Vec::new();
    let mut tracks: BTreeMap<&str, Track> = BTreeMap::new();
    let mut memory = BTreeMap::new();
    let begin = now();
    let end = begin + time.as_secs_f64();
    while now() < end {
        let usage = api.usage().await?;
        // All nodes of the demo are on one machine, and each sees all of it.
        machine.extend(usage.nodes.iter().map(|n| n.cpu_millis as f64 / 1e3));
        for usage in usage.tasks {
            let Some((name, uid)) = tasks.iter().find(|(_, uid)| *uid == usage.uid) else {
                continue;
            };
            tracks.entry(uid).or_default().see(now(), usage.cpu_total_usec);
            memory.insert(name.as_str(), usage.memory_bytes);
        }
        let shares = tracks.iter().filter_map(|(uid, t)| Some(((*uid).to_owned(), t.slope()?)));
        tell(&shares.collect());
        tokio::time::sleep(LOOK).await;
    }
    let mut measured = Found::default();
    for (name, uid) in tasks {
        let said = read(&lines(&api.log(name, LOG_LINES).await?), begin, now());
        let cpu = tracks.get(uid.as_str()).and_then(Track::slope);
        let memory_bytes = memory.get(name.as_str()).copied();
        measured.tasks.insert(name.clone(), Measured { cpu, memory_bytes, ..said });
    }
    let all = machine.iter().sum::<f64>() / machine.len().max(1) as f64;
    let ours: f64 = measured.tasks.values().filter_map(|m| m.cpu).sum();
    measured.others = (all - ours).max(0.0);
    Ok(measured)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_share_is_the_slope_between_changes() {
        let mut track = Track::default();
        // A heartbeat each 0.6 s, looked at each 0.06 s, for 6 s at 0.25 cores, from anywhere.
        for look in 0..100 {
            let t = 0.02 + f64::from(look) * 0.06;
            let beat = (t / 0.6).floor() * 0.6;
            track.see(t, 1_000_000 + (beat * 0.25 * 1e6) as u64);
        }
        let slope = track.slope().expect("samples");
        assert!((slope - 0.25).abs() < 0.005, "{slope}");
    }

    #[test]
    fn too_little_is_no_measurement() {
        let mut track = Track::default();
        assert_eq!(track.slope(), None);
        for (t, usec) in [(0.0, 5), (1.0, 9), (2.0, 9), (3.0, 13)] {
            track.see(t, usec);
        }
        assert_eq!(track.slope(), None, "two changes only");
    }

    #[test]
    fn lines_within_the_time_count() {
        let log = (0..10).map(|i| {
            format!(
                r#"{{"time": {}, "t": {i}, "frames": {}, "dropped": {i}, "units_done": {}, "cpu_seconds": {}, "p50_ms": 1.5, "p99_ms": {i}.0, "loss": 0.1}}"#,
                100 + i, i * 9, i * 18, f64::from(i) * 0.36
            )
        });
        let log =
            format!("{{\"event\":\"calibrated\"}}\nnoise\n{}", log.collect::<Vec<_>>().join("\n"));
        let all = lines(&log);
        assert_eq!(all.len(), 10);
        let measured = read(&all, 102.0, 106.5);
        assert_eq!(measured.throughput, Some(18.0));
        assert_eq!(measured.dropped, Some(0.1));
        assert_eq!(measured.p99_ms, Some(6.0));
        assert!((measured.unit_cpu_ms.expect("units") - 20.0).abs() < 1e-9);
        assert_eq!(read(&all, 200.0, 300.0), Measured::default());
    }
}
