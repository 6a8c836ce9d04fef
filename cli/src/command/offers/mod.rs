//! `muster offers`: what frameworks are offered now, from the scheduler's own book; with `-w`, as it changes.

mod picture;

use std::time::Duration;

use jiff::Timestamp;
use muster_api::kind::framework::Framework;
use muster_api::resource::Compute;
use serde::Deserialize;
use serde_json::{Value, json};

use self::picture::{Guest, changes, text};
use super::{Outcome, why};
use crate::client::{Selection, group_path};
use crate::error::{Class, CliError};
use crate::exit;
use crate::output::objects::{Format, document};
use crate::session::Session;
use crate::target;

/// How often `-w` looks. Offers are no objects, so there is nothing to watch.
const EVERY: Duration = Duration::from_secs(1);
/// Looks in a row that may find nobody: about as long as a watch bears with a controller that restarts.
const PATIENCE: u32 = 30;

/// `muster offers`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Only this framework, NAME or framework/NAME
    framework: Option<String>,
    /// In every namespace
    #[arg(short = 'A', long, conflicts_with = "framework")]
    all_namespaces: bool,
    /// Go on: a new picture every second on a terminal, elsewhere what changes
    #[arg(short, long)]
    watch: bool,
    /// Print what the controller says, for programs
    #[arg(short, long, value_enum, value_name = "FORMAT")]
    output: Option<Format>,
}

/// One framework as the scheduler sees it.
#[derive(Debug, Clone, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct View {
    pub(crate) connected: bool,
    pub(crate) suppressed: bool,
    /// Weighted dominant share of its namespace.
    pub(crate) share: f64,
    /// Best first.
    pub(crate) offers: Vec<Offer>,
}

/// One offer.
#[derive(Debug, Clone, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Offer {
    pub(crate) node: String,
    /// Metres or seconds, as the framework's cost says.
    #[serde(default)]
    pub(crate) score: Option<f64>,
    pub(crate) age_ms: u64,
    pub(crate) free: Compute,
    /// Nobody holds the robot's actuators.
    pub(crate) actuators: bool,
    /// Other frameworks that are shown the node.
    pub(crate) shared_with: usize,
}

/// What `GET …/offers` answers.
#[derive(Debug, Default, Deserialize)]
struct Answer {
    #[serde(default)]
    frameworks: Vec<Value>,
}

/// What is so now.
struct Look {
    guests: Vec<Guest>,
    /// The controller's words about them.
    answer: Value,
}

pub(crate) async fn run(args: Args, session: &mut Session) -> Outcome {
    if args.watch {
        return watch(&args, session).await;
    }
    let seen = look(&args, session).await?;
    match args.output {
        Some(format @ (Format::Yaml | Format::Json)) => {
            session.ui.print(&document(&seen.answer, format)?)?;
        }
        _ if seen.guests.is_empty() => session.ui.note(&nobody(&args, session)),
        _ => {
            let text = text(&seen.guests, args.all_namespaces, &session.ui.styles);
            session.ui.print(&text)?;
        }
    }
    Ok(exit::OK)
}

fn nobody(args: &Args, session: &Session) -> String {
    match args.all_namespaces {
        true => "there are no frameworks".to_owned(),
        false => format!("there are no frameworks in namespace {}", session.namespace),
    }
}

/// The objects say who there is, also those that the scheduler has not heard of since it began; it says the rest.
async fn look(args: &Args, session: &Session) -> Result<Look, CliError> {
    let client = &session.client;
    let info = target::kind("framework")?;
    let namespace = (!args.all_namespaces).then_some(session.namespace.as_str());
    let objects = match &args.framework {
        Some(word) => {
            let named = target::one(word, "framework")?;
            vec![client.get(info, namespace, named.name.unwrap_or_default()).await?]
        }
        None => client.list(info, namespace, &Selection::default()).await?.items,
    };
    let uri = group_path("offers");
    let read =
        |source| CliError::Answer { server: client.server.clone(), request: uri.clone(), source };
    let mut answer: Answer = client.get_json(&uri).await?;
    let mut guests = Vec::new();
    let mut words = Vec::new();
    for object in objects {
        let object: Framework = serde_json::from_value(object).map_err(read)?;
        let uid = object.metadata.uid.as_deref().unwrap_or_default();
        let at = answer.frameworks.iter().position(|v| v["uid"] == uid);
        let said = at.map(|i| answer.frameworks.swap_remove(i));
        let view: Option<View> =
            said.clone().map(serde_json::from_value).transpose().map_err(read)?;
        words.extend(said);
        guests.push(guest(object, view, session).await?);
    }
    Ok(Look { guests, answer: json!({ "frameworks": words }) })
}

async fn guest(
    object: Framework,
    view: Option<View>,
    session: &Session,
) -> Result<Guest, CliError> {
    let mut guest = Guest::new(&object, view, Timestamp::now());
    if guest.wants_reasons() {
        match why::not_offered(&guest.namespace, &guest.name, session).await {
            Ok(why) => guest.why = why,
            // It went between the two requests.
            Err(error) if error.is_not_found() => {}
            Err(error) => return Err(error),
        }
    }
    Ok(guest)
}

async fn watch(args: &Args, session: &mut Session) -> Outcome {
    let mut before: Option<Vec<Guest>> = None;
    let mut missed = 0;
    loop {
        match look(args, session).await {
            Ok(seen) => {
                missed = 0;
                show(args, &seen, before.as_deref(), session)?;
                before = Some(seen.guests);
            }
            Err(error) if before.is_none() => return Err(error),
            Err(error) if error.class() == Class::Unreachable && missed < PATIENCE => missed += 1,
            Err(error) if error.is_not_found() => {
                let name = args.framework.as_deref().unwrap_or_default();
                session.ui.note(&format!("{name} is gone"));
                return Ok(exit::OK);
            }
            Err(error) => return Err(error),
        }
        tokio::time::sleep(EVERY).await;
    }
}

/// One look of a watch.
fn show(
    args: &Args,
    seen: &Look,
    before: Option<&[Guest]>,
    session: &mut Session,
) -> Result<(), CliError> {
    let picture = || match seen.guests.is_empty() {
        true => format!("{}\n", nobody(args, session)),
        false => text(&seen.guests, args.all_namespaces, &session.ui.styles),
    };
    let changes = before.map(|before| changes(before, &seen.guests));
    let same = changes.as_ref().is_some_and(Vec::is_empty);
    match (args.output, changes) {
        (Some(Format::Json | Format::Yaml), _) if same => Ok(()),
        (Some(Format::Json), _) => session.ui.line(&seen.answer.to_string()),
        (Some(Format::Yaml), _) => {
            let text = document(&seen.answer, Format::Yaml)?;
            session.ui.print(&format!("---\n{text}"))
        }
        (_, _) if session.ui.redraws() => {
            let text = picture();
            session.ui.redraw(&text)
        }
        (_, None) => {
            let text = picture();
            session.ui.print(&text)
        }
        (_, Some(changes)) => changes.iter().try_for_each(|line| session.ui.line(line)),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use crate::exit;
    use crate::fake::{Fake, framework};

    const OFFERS: &str = "GET /apis/muster.dev/v1alpha1/offers";
    const WHY: &str = "GET /apis/muster.dev/v1alpha1/namespaces/default/frameworks/patrol/why";

    fn with_uid(name: &str) -> Value {
        let mut object = framework(name, json!({"connected": true}));
        object["metadata"]["uid"] = format!("u-{name}").into();
        object
    }

    fn view(name: &str, offers: Value) -> Value {
        json!({
            "uid": format!("u-{name}"), "namespace": "default", "name": name, "connected": true,
            "suppressed": false, "share": 0.25, "offers": offers,
        })
    }

    fn offer(node: &str, score: f64) -> Value {
        json!({
            "id": "o-1", "node": node, "score": score, "ageMs": 4200, "actuators": true,
            "free": {"cpu": "1500m", "memory": "3Gi"}, "sharedWith": 1,
        })
    }

    fn fleet() -> Fake {
        let fake = Fake::new();
        fake.put("frameworks/default/deliver", with_uid("deliver"));
        fake.put("frameworks/default/patrol", with_uid("patrol"));
        let mut cloud = offer("c1", 0.0);
        cloud["score"] = Value::Null;
        cloud["actuators"] = false.into();
        let offers = json!([offer("r1", 2.5), cloud]);
        fake.answer(
            OFFERS,
            json!({"frameworks": [view("patrol", json!([])), view("deliver", offers)]}),
        );
        let why = |node: &str, reason: &str| json!({"node": node, "reason": reason, "message": ""});
        let why = json!([why("r1", "LeaseHeld"), why("r2", "LeaseHeld"), why("r3", "OutOfRange")]);
        fake.answer(WHY, json!({"why": why, "framework": view("patrol", json!([]))}));
        fake
    }

    #[tokio::test]
    async fn each_framework_shows_its_offers_or_why_it_has_none() {
        let fake = fleet();
        assert_eq!(
            fake.run(&["offers"]).await,
            (
                exit::OK,
                "framework/deliver: connected, share 0.25, 2 offers\n\
                 NODE   SCORE   CPU   MEMORY   AR     AGE   SHARED-WITH\n\
                 r1     2.50m   1.5   3Gi      free   4s    1\n\
                 c1     -       1.5   3Gi      -      4s    1\n\
                 \n\
                 framework/patrol: connected, share 0.25, 0 offers\n\
                 no node fits: LeaseHeld×2,OutOfRange; see `muster why framework/patrol`\n"
                    .to_owned()
            )
        );
        let (_, text) = fake.run(&["offers", "-A"]).await;
        assert!(text.starts_with("framework/deliver in default: connected"), "{text}");
    }

    #[tokio::test]
    async fn one_framework_and_what_the_controller_says_of_it() {
        let fake = fleet();
        let (_, text) = fake.run(&["offers", "framework/deliver", "-o", "json"]).await;
        let answer: Value = serde_json::from_str(&text).expect("JSON");
        assert_eq!(answer["frameworks"].as_array().map(Vec::len), Some(1));
        assert_eq!(answer["frameworks"][0]["offers"][0]["node"], "r1");
        let error = fake.try_run(&["offers", "nobody"]).await.expect_err("not there");
        assert_eq!(error.class().exit(), exit::NOT_FOUND);
        assert_eq!(Fake::new().run(&["offers"]).await, (exit::OK, String::new()));
    }

    async fn until_looked(fake: &Fake, times: usize) {
        let looks = || fake.requests().iter().filter(|r| r.ends_with("/v1alpha1/offers")).count();
        while looks() < times {
            tokio::time::sleep(std::time::Duration::from_millis(20)).await;
        }
    }

    #[tokio::test]
    async fn a_watch_prints_what_changes_until_its_framework_is_gone() {
        let fake = fleet();
        let (done, ()) = tokio::join!(fake.run(&["offers", "deliver", "-w"]), async {
            until_looked(&fake, 1).await;
            let offers = json!([offer("r2", 1.0)]);
            fake.answer(OFFERS, json!({"frameworks": [view("deliver", offers)]}));
            until_looked(&fake, 2).await;
            fake.remove("frameworks/default/deliver");
        });
        let (code, text) = done;
        assert_eq!(code, exit::OK);
        let changes: Vec<&str> = text.lines().skip(4).collect();
        assert_eq!(
            changes,
            [
                "framework/deliver: - c1",
                "framework/deliver: - r1",
                "framework/deliver: + r2 (1.00m, cpu 1.5, memory 3Gi, AR free)",
            ],
            "{text}"
        );
    }
}
