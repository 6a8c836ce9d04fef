//! Deliveries: one after another, each by the robot that is nearest to its goal and free to drive.
//!
//! ```sh
//! cargo run -p muster-sdk --example deliver -- 3,4 8,1.5
//! ```
//!
//! The framework asks only for the closest robot around the goal; when the drive has ended, it moves on to the next.

use std::collections::VecDeque;
use std::time::Duration;

use muster_sdk::wire::{Offer, TaskState, Update};
use muster_sdk::{
    Filter, Framework, FrameworkHandle, Launch, Position, Scheduler, SchedulerDriver,
};

/// A robot further away than this is not worth waiting for, metres.
const RADIUS: f64 = 50.0;

struct Deliver {
    /// The goals, the present one first; metres in the default map.
    goals: VecDeque<(f64, f64)>,
    /// Uid of the task that drives to the first.
    drive: Option<String>,
}

impl Deliver {
    async fn move_on(&mut self, handle: &FrameworkHandle) {
        let Some(&(x, y)) = self.goals.front() else {
            println!("delivered");
            if let Err(refused) = handle.stop(false).await {
                eprintln!("the framework is not torn down: {refused}");
            }
            return;
        };
        println!("next: {x},{y}");
        let moved = handle.set_position(Some(Position::at(x, y).radius(RADIUS))).await;
        if let Err(refused) = moved {
            eprintln!("the goal {x},{y} is refused: {refused}");
        }
    }
}

impl Scheduler for Deliver {
    async fn resource_offers(&mut self, handle: &FrameworkHandle, offers: Vec<Offer>) {
        for offer in offers {
            let (None, Some((x, y))) = (&self.drive, self.goals.front()) else {
                drop(handle.decline_offer(&offer, None).await);
                continue;
            };
            let drive = format!("echo driving to {x},{y}; sleep 2");
            let launch = Launch::process(["sh", "-c", drive.as_str()])
                .cpu("200m")
                .memory("64Mi")
                .actuators(offer.actuators.clone())
                .on(&offer);
            match handle.launch_tasks([launch]).await {
                Ok(launched) => {
                    let score = offer.score.unwrap_or_default();
                    println!("{} drives, {score:.2} m away", offer.node);
                    self.drive = launched.into_iter().next().map(|launched| launched.task);
                }
                // Another one was faster: what is left is offered again.
                Err(refused) => println!("{}: {refused}", offer.node),
            }
        }
    }

    async fn status_update(&mut self, handle: &FrameworkHandle, update: &Update) {
        let is_drive = self.drive.as_deref() == Some(&*update.task);
        match update.state() {
            TaskState::Succeeded if is_drive => {
                self.drive = None;
                self.goals.pop_front();
                self.move_on(handle).await;
            }
            TaskState::Failed | TaskState::Gone if is_drive => {
                println!("{} failed: {}; again", update.name, update.message);
                self.drive = None;
                drop(handle.revive_offers().await);
            }
            _ => {}
        }
    }
}

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let goal = |text: String| -> Result<(f64, f64), Box<dyn std::error::Error>> {
        let (x, y) = text.split_once(',').ok_or("a goal is X,Y in metres")?;
        Ok((x.parse()?, y.parse()?))
    };
    let goals = std::env::args().skip(1).map(goal).collect::<Result<VecDeque<_>, _>>()?;
    let &(x, y) = goals.front().ok_or("say where to: deliver X,Y…")?;
    let (handle, events) = Framework::builder("deliver")
        .position(x, y)
        .radius(RADIUS)
        .filter(Filter::robots().free_actuators().most(1))
        .failover_timeout(Duration::from_secs(30))
        .connect(None)
        .await?;
    SchedulerDriver::new(handle, events).run(Deliver { goals, drive: None }).await?;
    Ok(())
}
