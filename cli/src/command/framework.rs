//! `muster framework`: where a running framework works, as somebody else says it.
//!
//! A position is one of the command line's, or each one that somebody clicks in rviz, which publishes it on `/clicked_point`
//! (Avalon, IV-A3). What is not named stays as the framework has it: a click changes no radius.

use muster_api::kind::framework::{Framework, FrameworkPosition, FrameworkSpec};
use muster_api::kind::task::Cost;
use muster_api::pose::{DEFAULT_MAP, OperationPosition};
use muster_ros1::geometry_msgs::PointStamped;
use muster_ros1::node::{MasterState, SubscribeOptions};
use muster_ros1::{Node, NodeOptions};
use serde_json::json;

use super::Outcome;
use crate::client::path;
use crate::error::CliError;
use crate::exit;
use crate::session::Session;
use crate::target;

/// `muster framework`.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Set where a connected framework works; it is told, and is offered the robots near there
    SetPosition(Args),
}

/// `muster framework set-position`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The framework
    name: String,
    #[command(flatten)]
    place: Place,
    /// The map whose frame the numbers are in; of a click, the frame of the message
    #[arg(long, value_name = "MAP", conflicts_with = "everywhere")]
    map: Option<String>,
    /// How far from it a robot may be, metres, or `any`
    #[arg(long, value_name = "METRES|any", value_parser = radius, conflicts_with = "everywhere")]
    radius: Option<Radius>,
    /// What robots are scored by
    #[arg(long, value_enum, conflicts_with = "everywhere")]
    cost: Option<Score>,
    /// The ROS 1 master of the clicks; else `ROS_MASTER_URI`
    #[arg(long, value_name = "URI", requires = "clicked")]
    ros_master: Option<String>,
    /// Where they are published
    #[arg(long, value_name = "TOPIC", default_value = "/clicked_point", requires = "clicked")]
    topic: String,
}

#[derive(Debug, clap::Args)]
#[group(required = true, multiple = false)]
struct Place {
    /// This one, metres
    #[arg(long, value_name = "X,Y[,Z]", allow_hyphen_values = true, value_parser = point)]
    at: Option<Point>,
    /// No position: all robots, without a score
    #[arg(long)]
    everywhere: bool,
    /// Each point that is clicked in rviz, until this is interrupted
    #[arg(long)]
    clicked: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Point([f64; 3]);

fn point(text: &str) -> Result<Point, String> {
    let numbers: Vec<f64> = text
        .split(',')
        .map(|number| number.trim().parse().ok().filter(|number: &f64| number.is_finite()))
        .collect::<Option<_>>()
        .unwrap_or_default();
    match numbers[..] {
        [x, y] => Ok(Point([x, y, 0.0])),
        [x, y, z] => Ok(Point([x, y, z])),
        _ => Err("write X,Y or X,Y,Z, in metres".to_owned()),
    }
}

/// None: any.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Radius(Option<f64>);

fn radius(text: &str) -> Result<Radius, String> {
    match text.parse::<f64>() {
        _ if text == "any" => Ok(Radius(None)),
        Ok(metres) if metres >= 0.0 && metres.is_finite() => Ok(Radius(Some(metres))),
        _ => Err("write a number of metres, or any".to_owned()),
    }
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Score {
    /// Metres
    Distance,
    /// Seconds at the robot's speed
    TravelTime,
}

pub(crate) async fn run(command: Command, session: &mut Session) -> Outcome {
    let Command::SetPosition(args) = command;
    if args.place.clicked {
        return follow(&args, session).await;
    }
    let place = args.place.at.map(|point| (point, None));
    set(&args, place, session).await
}

/// Sets it to this point, in this frame where the message names one.
async fn set(
    args: &Args,
    place: Option<(Point, Option<String>)>,
    session: &mut Session,
) -> Outcome {
    let info = target::kind("framework")?;
    let namespace = Some(session.namespace.as_str());
    let spec = match place {
        None => FrameworkPosition::default(),
        Some((Point([x, y, z]), frame)) => {
            let present = session.client.get(info, namespace, &args.name).await?;
            let present: Framework = serde_json::from_value(present).map_err(|error| {
                CliError::usage(format!("framework/{} cannot be read: {error}", args.name))
            })?;
            let present = present.spec;
            let map = args.map.clone().or(frame);
            let map = map.or_else(|| present.position.map(|position| position.map));
            FrameworkPosition {
                position: Some(OperationPosition {
                    map: map.unwrap_or_else(|| DEFAULT_MAP.to_owned()),
                    x,
                    y,
                    z,
                }),
                radius: args.radius.map_or(present.radius, |radius| radius.0),
                cost: match args.cost {
                    None => present.cost,
                    Some(Score::Distance) => Cost::Distance,
                    Some(Score::TravelTime) => Cost::TravelTime,
                },
            }
        }
    };
    let uri = format!("{}/position", path(info, namespace, Some(&args.name)));
    let set: Framework = session.client.post_json(&uri, &json!({ "spec": spec })).await?;
    session.ui.line(&format!("framework/{} works {}", args.name, words(&set.spec)))?;
    Ok(exit::OK)
}

fn words(spec: &FrameworkSpec) -> String {
    let Some(OperationPosition { map, x, y, z }) = &spec.position else {
        return "everywhere".to_owned();
    };
    let up = if *z == 0.0 { String::new() } else { format!(", {z:.2}") };
    let within = spec.radius.map(|radius| format!(", within {radius:.2} m"));
    format!("at ({x:.2}, {y:.2}{up}) of map {map:?}{}", within.unwrap_or_default())
}

/// Sets it to each point that is clicked.
async fn follow(args: &Args, session: &mut Session) -> Outcome {
    let options = NodeOptions {
        name: format!("muster_set_position_{}", std::process::id()),
        master: args.ros_master.clone(),
        ..NodeOptions::default()
    };
    let unusable = |error: String| CliError::Usage { message: error, hint: None };
    let node = Node::start(options).await.map_err(|error| unusable(error.to_string()))?;
    let clicks = node.subscribe::<PointStamped>(&args.topic, SubscribeOptions::default());
    let mut clicks = clicks.map_err(|error| unusable(error.to_string()))?;
    let mut state = node.state();
    let outcome = loop {
        // Cancel safe: a message that was not taken stays, and so does a state.
        tokio::select! {
            click = clicks.next() => match click {
                Ok((PointStamped { header, point }, _)) => {
                    let point = Point([point.x, point.y, point.z]);
                    let frame = header.frame_id.trim_start_matches('/').to_owned();
                    let frame = Some(frame).filter(|frame| !frame.is_empty());
                    // A click that is refused does not end it: the next one may be better.
                    match set(args, Some((point, frame)), session).await {
                        Err(CliError::BrokenPipe) => break Err(CliError::BrokenPipe),
                        Err(error) => session.ui.report(&error),
                        Ok(_) => {}
                    }
                }
                Err(error) => session.ui.note(&format!("a click is not understood: {error}")),
            },
            Ok(()) = state.changed() => {
                let now = state.borrow_and_update().clone();
                if now == MasterState::Registered {
                    session.ui.note(&format!("waiting for clicks on {}", args.topic));
                }
            }
            why = node.ended() => {
                let hint = Some("another node of this name has taken its place".to_owned());
                break Err(CliError::Failed { what: why, hint });
            }
            _ = tokio::signal::ctrl_c() => break Ok(exit::OK),
        }
    };
    node.shut_down().await;
    outcome
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::*;
    use crate::fake::Fake;

    const PATH: &str = "/apis/muster.dev/v1alpha1/namespaces/default/frameworks/deliver";

    fn framework(spec: &Value) -> Value {
        json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Framework", "metadata": {"name": "deliver"}, "spec": spec,
        })
    }

    #[tokio::test]
    async fn what_is_not_named_stays() {
        let fake = Fake::new();
        let present = json!({"position": {"map": "hall", "x": 1.0, "y": 1.0}, "radius": 20.0, "cost": "TravelTime"});
        fake.answer(&format!("GET {PATH}"), framework(&present));
        let moved = json!({"position": {"map": "hall", "x": -3.0, "y": 4.5, "z": 0.0}, "radius": 20.0, "cost": "TravelTime"});
        fake.answer(&format!("POST {PATH}/position"), framework(&moved));
        let line = ["framework", "set-position", "deliver", "--at", "-3,4.5"];
        let said = "framework/deliver works at (-3.00, 4.50) of map \"hall\", within 20.00 m\n";
        assert_eq!(fake.run(&line).await, (exit::OK, said.to_owned()));
        assert_eq!(fake.last_body(), json!({ "spec": moved }));
        let any = [
            "framework",
            "set-position",
            "deliver",
            "--at",
            "1,2,3",
            "--radius",
            "any",
            "--map",
            "roof",
            "--cost",
            "distance",
        ];
        fake.run(&any).await;
        let asked =
            json!({"position": {"map": "roof", "x": 1.0, "y": 2.0, "z": 3.0}, "cost": "Distance"});
        assert_eq!(fake.last_body(), json!({ "spec": asked }));
        fake.run(&["framework", "set-position", "deliver", "--everywhere"]).await;
        assert_eq!(fake.last_body(), json!({"spec": {"cost": "Distance"}}));
    }

    #[test]
    fn points_and_radii_are_numbers() {
        assert_eq!(point("1, -2.5"), Ok(Point([1.0, -2.5, 0.0])));
        for bad in ["", "1", "1,2,3,4", "a,b", "1,inf", "nan,0"] {
            assert!(point(bad).is_err(), "{bad}");
        }
        assert_eq!((radius("any"), radius("2")), (Ok(Radius(None)), Ok(Radius(Some(2.0)))));
        for bad in ["-1", "inf", "far"] {
            assert!(radius(bad).is_err(), "{bad}");
        }
    }
}
