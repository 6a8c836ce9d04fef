//! The figures of the foundation, each beside a floor taken interleaved in the same run.
//!
//! The disk of a shared machine swings by more than an order of magnitude within hours, so absolute
//! numbers mean little: every figure that touches it is a ratio, and `fdatasync` is measured before
//! and after. When the two differ by more than 2×, the figure is printed as void.

mod fence;
mod floor;
mod footprint;
mod herd;
mod list;
mod messages;
mod placement;
mod poses;
mod ros;
mod sensors;
mod stats;
mod stops;
mod submit;
mod watchers;
mod writes;

use std::process::ExitCode;

type Figure = (&'static str, &'static str, fn() -> std::pin::Pin<Box<dyn Future<Output = ()>>>);

const FIGURES: &[Figure] = &[
    ("store", "durable writes/s at the store, 64 writers", || Box::pin(writes::store())),
    ("rest", "durable writes/s through REST, 64 clients", || Box::pin(writes::rest())),
    ("placement", "POST to Bound seen by a watch, one task at a time", || {
        Box::pin(placement::one())
    }),
    ("queue", "2 000 queued tasks on 5 000 hollow nodes until bound and durable", || {
        Box::pin(placement::queue())
    }),
    ("process", "submit to Running of a process task, against fork+exec", || {
        Box::pin(submit::process())
    }),
    ("container", "submit to Running of a container, against raw create+start", || {
        Box::pin(submit::container())
    }),
    ("messages", "framework to executor and back, against a TCP echo on loopback", || {
        Box::pin(messages::round_trip())
    }),
    ("list", "list of 10 000 nodes, against encoding it and a loopback write", || {
        Box::pin(list::nodes())
    }),
    ("watchers", "1 020 watchers, most on 1/100 of the objects, under 500 writes/s", || {
        Box::pin(watchers::all())
    }),
    ("poses", "poses of 10 000 robots over 100 streams on one core, against a bare stream", || {
        Box::pin(poses::all())
    }),
    ("stops", "from what should stop a robot until its driver reads the stop", || {
        Box::pin(stops::all())
    }),
    (
        "pose",
        "a robot's pose from rospy's publish to the controller, against a bare subscriber",
        || Box::pin(ros::pose()),
    ),
    (
        "fence",
        "a ROS driver's stop after its gate was killed; the holder's stream under attack",
        || Box::pin(fence::all()),
    ),
    ("sensors", "a camera of 1 MB and 30 Hz for 1, 8, 64 tasks, against copies and ROS", || {
        Box::pin(sensors::all())
    }),
    (
        "restart",
        "the controller killed with 1 000 agents attached, until all are reconciled",
        || Box::pin(herd::all()),
    ),
    ("footprint", "RSS and idle CPU of agent and controller", || Box::pin(footprint::all())),
];

fn main() -> ExitCode {
    let asked: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    if let [bare, pki] = &asked[..]
        && bare == "bare-stream"
    {
        poses::serve_bare(pki.as_ref());
        return ExitCode::SUCCESS;
    }
    if sensors::role(&asked) {
        return ExitCode::SUCCESS;
    }
    if asked.iter().any(|a| a == "--list") {
        for (name, what, _) in FIGURES {
            println!("{name:10} {what}");
        }
        return ExitCode::SUCCESS;
    }
    if let Some(unknown) = asked.iter().find(|a| FIGURES.iter().all(|(name, ..)| name != a)) {
        eprintln!("there is no figure {unknown:?}; --list names them");
        return ExitCode::from(2);
    }
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    for (name, what, run) in FIGURES {
        if asked.is_empty() || asked.iter().any(|a| a == name) {
            println!("\n{name}: {what}");
            runtime.block_on(run());
        }
    }
    ExitCode::SUCCESS
}
