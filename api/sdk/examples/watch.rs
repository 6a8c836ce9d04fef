//! Watches a function of a sensor, as a task that asked for it, and says what comes.
//!
//! ```yaml
//! resources: {sensors: ["kinect:ImageGen"]}
//! run: {process: {command: [watch, "kinect:ImageGen"]}}
//! ```
//!
//! With a number behind it so many frames may wait; with a second one it rests so many milliseconds after each.

use std::time::Duration;

use muster_sdk::sensor::{Mode, Sensor};

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1);
    let function = args.next().ok_or("usage: watch DEVICE:FUNCTION [QUEUE [PAUSE_MS]]")?;
    let mode = match args.next().map(|text| text.parse()).transpose()? {
        None | Some(0 | 1) => Mode::Latest,
        Some(depth) => Mode::Queue(depth),
    };
    let pause = args.next().map(|text| text.parse()).transpose()?.map(Duration::from_millis);
    let mut sensor = Sensor::open(&function, mode).await?;
    loop {
        let frame = sensor.next().await?;
        let age = frame.stamp.elapsed().unwrap_or_default().as_secs_f64() * 1e3;
        let (sequence, length, dropped) = (frame.sequence, frame.data.len(), frame.dropped);
        // Numbers begin anew with each life of the agent.
        let life = sensor.life();
        println!(
            "{sequence} {length} bytes, {dropped} dropped before, {age:.1} ms old, life {life}"
        );
        if let Some(pause) = pause {
            tokio::time::sleep(pause).await;
        }
    }
}
