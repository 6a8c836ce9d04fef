//! The frame clock: gives a workload a frame at a time, measures, and says once a second how it goes.
//!
//! One thread works; frames that it cannot take in time are dropped, as a camera's would be.

use std::collections::VecDeque;
use std::fs::File;
use std::io::Write as _;
use std::path::PathBuf;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use serde_json::{Map, Value, json};

use super::clock::{Stop, cpu_time};
use super::pace::{self, Choice, Governor, Target};
use crate::exit;

/// A program that works on frames.
pub(super) trait Work {
    /// What it is called in its progress.
    fn name(&self) -> &'static str;

    /// How much work a frame is from now on; what a unit is, is the workload's own matter.
    fn set_units(&mut self, units: u32);

    /// Takes one frame and does its work.
    fn frame(&mut self);

    /// What it has found so far.
    fn findings(&mut self) -> Map<String, Value>;
}

/// Flags that all workloads on frames have.
#[derive(Debug, Clone, clap::Args)]
pub(super) struct Pacing {
    /// Frames per second that the sensor gives; with --load the most
    #[arg(long, value_name = "HZ", value_parser = positive)]
    pub(super) rate: Option<f64>,
    /// With --load the fewest frames per second
    #[arg(long, value_name = "HZ", default_value = "0.5", value_parser = positive)]
    pub(super) min_rate: f64,
    /// Hold this share of one core, 0.153, by the frame rate; measured as cpu time
    #[arg(long, value_name = "FRACTION", value_parser = positive)]
    pub(super) load: Option<f64>,
    /// Work per frame; with --load the default is what keeps the rate below --rate
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) units_per_frame: Option<u32>,
    /// Seed of everything random
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(super) seed: u64,
    /// End after this many seconds
    #[arg(long, value_name = "SECONDS", value_parser = positive)]
    pub(super) duration: Option<f64>,
    /// Write the progress lines to a file, too
    #[arg(long, value_name = "FILE")]
    pub(super) stats: Option<PathBuf>,
}

/// Parses a number above 0.
pub(super) fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(number) if number > 0.0 && number.is_finite() => Ok(number),
        _ => Err("not a number above 0".to_owned()),
    }
}

impl Pacing {
    /// `usual`: the rate of a usual sensor of this kind; none: as fast as the cpu allows.
    fn target(&self, usual: Option<f64>) -> Target {
        Target {
            load: self.load,
            min_rate: self.min_rate,
            max_rate: self.rate.or(usual),
            units: self.units_per_frame,
        }
    }
}

/// A second is long enough for a mean and short enough to watch.
const WINDOW: Duration = Duration::from_secs(1);
/// How often the rate is corrected: some frames, so that a mean over a few seconds is already right.
const CORRECTION: Duration = Duration::from_millis(200);
/// Latencies of this many windows make the percentiles.
const LATENCY_WINDOWS: usize = 10;

/// Runs a workload until a signal or its `--duration` ends it.
pub(super) fn run(mut work: impl Work, pacing: &Pacing, usual_rate: Option<f64>) -> u8 {
    let stop = Stop::on_signals();
    let mut output = match Output::open(pacing.stats.as_ref()) {
        Ok(output) => output,
        Err(error) => {
            eprintln!("error: cannot write the statistics: {error}");
            return exit::FAILURE;
        }
    };
    let begin = Instant::now();
    let target = pacing.target(usual_rate);
    let unit_cost = calibrate(&mut work, &target, &stop);
    let choice = pace::choose(&target, unit_cost);
    work.set_units(choice.units);
    let cost = unit_cost * f64::from(choice.units);
    output.line(&begun(&work, &target, &choice, cost));
    let governor = Governor::new(&target, cost);
    let end = pacing.duration.map(|s| begin + Duration::from_secs_f64(s));
    Loop { work, output, governor, choice, begin, end, stop }.run();
    exit::OK
}

/// Frames measured at least, after one that only warms caches up.
const CALIBRATION_FRAMES: usize = 5;
/// Cpu time measured at least, so that a cheap frame is not measured by its noise.
const CALIBRATION_CPU: Duration = Duration::from_millis(80);

/// Cpu seconds of a unit: of the median frame, because a process's first frames are dear. Measured with
/// the units that are asked for, if any, so that what a frame costs beside them is in it.
fn calibrate(work: &mut impl Work, target: &Target, stop: &Stop) -> f64 {
    let units = target.units.unwrap_or(1);
    // Without a share to hold the cost is only told.
    let least = if target.load.is_some() { CALIBRATION_CPU } else { Duration::ZERO };
    work.set_units(units);
    work.frame();
    let begin = cpu_time();
    let mut costs = Vec::new();
    while !stop.is_set() && (costs.len() < CALIBRATION_FRAMES || cpu_time() - begin < least) {
        let before = cpu_time();
        work.frame();
        costs.push((cpu_time() - before).as_secs_f64());
    }
    costs.sort_by(f64::total_cmp);
    costs.get(costs.len() / 2).map_or(1e-3, |cost| cost / f64::from(units))
}

fn begun(work: &impl Work, target: &Target, choice: &Choice, cost: f64) -> Value {
    json!({
        "event": "calibrated",
        "workload": work.name(),
        "load": target.load,
        "min_rate": target.min_rate,
        "max_rate": target.max_rate,
        "rate": choice.rate.map(|rate| rounded(rate, 3)),
        "units": choice.units,
        "frame_cpu_ms": rounded(cost * 1e3, 3),
        "reachable": choice.reachable,
    })
}

/// Seconds since 1970: what the demo compares with its own clock.
fn unix_time() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64())
}

/// So that lines stay readable.
pub(super) fn rounded(value: f64, digits: i32) -> f64 {
    let scale = 10_f64.powi(digits);
    (value * scale).round() / scale
}

struct Output {
    file: Option<File>,
    gone: bool,
}

impl Output {
    fn open(path: Option<&PathBuf>) -> std::io::Result<Self> {
        Ok(Output { file: path.map(File::create).transpose()?, gone: false })
    }

    fn line(&mut self, value: &Value) {
        let line = format!("{value}\n");
        let mut stdout = std::io::stdout().lock();
        // A robot goes on working when nobody reads its log.
        self.gone |= stdout.write_all(line.as_bytes()).and_then(|()| stdout.flush()).is_err();
        if let Some(file) = &mut self.file {
            let _ = file.write_all(line.as_bytes());
        }
    }
}

struct Loop<W> {
    work: W,
    output: Output,
    governor: Option<Governor>,
    choice: Choice,
    begin: Instant,
    end: Option<Instant>,
    stop: Stop,
}

/// One window of measurement.
struct Window {
    begin: Instant,
    cpu: Duration,
    frames: u64,
    dropped: u64,
    latencies: Vec<f64>,
}

impl Window {
    fn new() -> Self {
        let (begin, cpu) = (Instant::now(), cpu_time());
        Window { begin, cpu, frames: 0, dropped: 0, latencies: Vec::new() }
    }
}

impl<W: Work> Loop<W> {
    fn run(mut self) {
        let mut window = Window::new();
        let mut correction = Window::new();
        let mut totals = Totals::default();
        let mut next = Instant::now();
        loop {
            let due = next;
            let ended = self.end.is_some_and(|end| due.max(Instant::now()) >= end);
            if ended || self.stop.sleep_until(due) {
                break;
            }
            self.work.frame();
            let now = Instant::now();
            window.frames += 1;
            correction.frames += 1;
            window.latencies.push(now.saturating_duration_since(due).as_secs_f64());
            next = match self.choice.rate {
                None => now,
                Some(rate) => {
                    let period = Duration::from_secs_f64(1.0 / rate);
                    let late = now.saturating_duration_since(due + period);
                    // A frame that waits while the next one comes is overwritten by it.
                    let dropped = (late.as_secs_f64() * rate).floor();
                    window.dropped += dropped as u64;
                    due + period + period.mul_f64(dropped)
                }
            };
            if now.duration_since(correction.begin) >= CORRECTION {
                self.correct(&std::mem::replace(&mut correction, Window::new()));
            }
            if now.duration_since(window.begin) >= WINDOW {
                let old = std::mem::replace(&mut window, Window::new());
                self.close(old, &mut totals);
            }
        }
        self.close(window, &mut totals);
    }

    fn correct(&mut self, window: &Window) {
        let wall = window.begin.elapsed().as_secs_f64();
        let cpu = cpu_time().saturating_sub(window.cpu).as_secs_f64();
        if let Some(governor) = &mut self.governor {
            self.choice.rate = Some(governor.after(wall, cpu, window.frames));
        }
    }

    fn close(&mut self, window: Window, totals: &mut Totals) {
        let wall = window.begin.elapsed().as_secs_f64();
        let cpu = cpu_time().saturating_sub(window.cpu).as_secs_f64();
        if wall <= 0.0 {
            return;
        }
        totals.add(&window);
        let per_second = |n: u64| n as f64 / wall;
        let (p50, p99) = totals.percentiles();
        let mut line = json!({
            "workload": self.work.name(),
            "time": rounded(unix_time(), 3),
            "t": rounded(self.begin.elapsed().as_secs_f64(), 3),
            "frames": totals.frames,
            "dropped": totals.dropped,
            "units": self.choice.units,
            "units_done": totals.frames * u64::from(self.choice.units),
            "throughput": rounded(per_second(window.frames), 2),
            "rate": self.choice.rate.map(|rate| rounded(rate, 3)),
            "cpu": rounded(cpu / wall, 4),
            "cpu_seconds": rounded(cpu_time().as_secs_f64(), 4),
            "frame_cpu_ms": self.governor.as_ref().map(|g| rounded(g.cost() * 1e3, 3)),
            "p50_ms": rounded(p50 * 1e3, 2),
            "p99_ms": rounded(p99 * 1e3, 2),
        });
        if let Value::Object(members) = &mut line {
            members.append(&mut self.work.findings());
        }
        self.output.line(&line);
    }
}

/// Since the start.
#[derive(Default)]
struct Totals {
    frames: u64,
    dropped: u64,
    recent: VecDeque<Vec<f64>>,
}

impl Totals {
    fn add(&mut self, window: &Window) {
        self.frames += window.frames;
        self.dropped += window.dropped;
        self.recent.push_back(window.latencies.clone());
        if self.recent.len() > LATENCY_WINDOWS {
            self.recent.pop_front();
        }
    }

    /// Median and 99th percentile of what is recent, seconds.
    fn percentiles(&self) -> (f64, f64) {
        let mut all: Vec<f64> = self.recent.iter().flatten().copied().collect();
        all.sort_by(f64::total_cmp);
        let at = |part: f64| {
            let index = (all.len() as f64 * part).ceil() as usize;
            all.get(index.saturating_sub(1)).copied().unwrap_or(0.0)
        };
        (at(0.5), at(0.99))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Counting(u32);

    impl Work for Counting {
        fn name(&self) -> &'static str {
            "counting"
        }

        fn set_units(&mut self, units: u32) {
            self.0 = units;
        }

        fn frame(&mut self) {
            let until = cpu_time() + Duration::from_micros(200) * self.0;
            while cpu_time() < until {
                std::hint::spin_loop();
            }
        }

        fn findings(&mut self) -> Map<String, Value> {
            Map::new()
        }
    }

    #[test]
    fn lines_say_what_was_chosen_and_what_came_of_it() {
        let file = std::env::temp_dir().join(format!("muster-run-{}", std::process::id()));
        let pacing = Pacing {
            rate: Some(50.0),
            min_rate: 0.5,
            load: None,
            units_per_frame: Some(2),
            seed: 1,
            // The calibration is in it.
            duration: Some(3.0),
            stats: Some(file.clone()),
        };
        run(Counting(1), &pacing, None);
        let text = std::fs::read_to_string(&file).unwrap();
        let _ = std::fs::remove_file(&file);
        let lines: Vec<Value> =
            text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        assert_eq!(lines[0]["event"], "calibrated");
        assert_eq!((&lines[0]["rate"], &lines[0]["units"]), (&json!(50.0), &json!(2)));
        let last = lines.last().unwrap();
        let frames = last["frames"].as_u64().unwrap();
        assert!((1..=151).contains(&frames), "{last}");
        assert_eq!(last["units_done"], frames * 2);
    }

    #[test]
    fn percentiles_are_of_what_is_recent() {
        let mut totals = Totals::default();
        for second in 0..30 {
            let mut window = Window::new();
            window.latencies = vec![f64::from(second); 10];
            totals.add(&window);
        }
        assert_eq!(totals.percentiles(), (24.0, 29.0));
        assert_eq!(Totals::default().percentiles(), (0.0, 0.0));
    }
}
