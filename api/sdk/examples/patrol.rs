//! Two robots patrol, and what their cameras see is recognised on a cloud server. What fails is launched again.
//!
//! ```sh
//! cargo run -p muster-sdk --example patrol -- 3,4
//! ```
//!
//! Three places are to be filled: two drives, each on a robot of its own, and one recognition on a cloud server. Offers of
//! both kinds come as they are free; each fills one open place or is declined for a while.

use std::pin::pin;
use std::time::Duration;

use muster_sdk::wire::{NodeKind, Offer, TaskState, Update};
use muster_sdk::{Framework, FrameworkHandle, Launch, Scheduler, SchedulerDriver};

/// No open place fits the offer: not again for so long, unless its node changes. A place that opens revives all.
const REFUSE: Duration = Duration::from_secs(60);

struct Place {
    name: &'static str,
    on: NodeKind,
    /// Where it runs: the task's uid and the node.
    running: Option<(String, String)>,
}

struct Patrol {
    places: Vec<Place>,
}

impl Patrol {
    fn new() -> Self {
        let place = |name, on| Place { name, on, running: None };
        let robot = NodeKind::Robot;
        let places = vec![
            place("drive-1", robot),
            place("drive-2", robot),
            place("recognition", NodeKind::Cloud),
        ];
        Patrol { places }
    }

    /// An open place that the offered node can fill; two drives do not share a robot.
    fn place_for(&mut self, offer: &Offer) -> Option<&mut Place> {
        let is_taken =
            |place: &Place| place.running.as_ref().is_some_and(|(_, node)| *node == offer.node);
        let is_robot = offer.kind() == NodeKind::Robot;
        if is_robot && (offer.actuators.is_empty() || self.places.iter().any(is_taken)) {
            return None;
        }
        self.places.iter_mut().find(|p| p.running.is_none() && p.on == offer.kind())
    }
}

fn launch(place: &Place, offer: &Offer) -> Launch {
    let launch = match place.on {
        NodeKind::Robot => Launch::process(["sh", "-c", "while :; do sleep 1; done"])
            .cpu("200m")
            .actuators(offer.actuators.clone()),
        _ => Launch::process(["sh", "-c", "while :; do :; done"]).cpu("600m"),
    };
    launch.memory("64Mi").label("patrol/place", place.name).on(offer)
}

impl Scheduler for Patrol {
    async fn resource_offers(&mut self, handle: &FrameworkHandle, offers: Vec<Offer>) {
        for offer in offers {
            let Some(place) = self.place_for(&offer) else {
                // A decline that is refused, or late, is an offer that is gone.
                drop(handle.decline_offer(&offer, Some(REFUSE)).await);
                continue;
            };
            match handle.launch_tasks([launch(place, &offer)]).await {
                Ok(launched) => {
                    println!("{} on {}", place.name, offer.node);
                    place.running = launched.into_iter().next().map(|l| (l.task, l.node));
                }
                // Another one was faster, or the node changed: what is left is offered again.
                Err(refused) => println!("{} not on {}: {refused}", place.name, offer.node),
            }
        }
    }

    async fn status_update(&mut self, handle: &FrameworkHandle, update: &Update) {
        let ended = [TaskState::Succeeded, TaskState::Failed, TaskState::Gone];
        if !ended.contains(&update.state()) {
            return;
        }
        let is_its = |place: &&mut Place| {
            place.running.as_ref().is_some_and(|(task, _)| *task == update.task)
        };
        if let Some(place) = self.places.iter_mut().find(is_its) {
            println!("{} ended: {} {}; again", place.name, update.reason, update.message);
            place.running = None;
            drop(handle.revive_offers().await);
        }
    }

    async fn disconnected(&mut self, _: &FrameworkHandle) {
        println!("the controller is away; the patrol goes on");
    }
}

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let at = std::env::args().nth(1).ok_or("say where: patrol X,Y")?;
    let (x, y) = at.split_once(',').ok_or("a position is X,Y in metres")?;
    let (handle, events) =
        Framework::builder("patrol").position(x.parse()?, y.parse()?).connect(None).await?;
    let stopper = handle.clone();
    let mut run = pin!(SchedulerDriver::new(handle, events).run(Patrol::new()));
    tokio::select! {
        ran = &mut run => ran?,
        pressed = tokio::signal::ctrl_c() => {
            pressed?;
            stopper.stop(false).await?;
            run.await?;
        }
    }
    Ok(())
}
