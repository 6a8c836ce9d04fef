//! `muster token`: tokens that agents show once to join, and those of users (`user_token`).

use jiff::Timestamp;
use muster_api::duration::Span;
use serde::Deserialize;
use serde_json::{Value, json};

use super::{Outcome, user_token};
use crate::args::span;
use crate::client::group_path;
use crate::error::CliError;
use crate::exit;
use crate::output::human;
use crate::output::objects::{Format, document};
use crate::output::table::Table;
use crate::session::Session;

/// `muster token`.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Make a token; it is shown once. With --user, of a person or a program instead of an agent
    Create(CreateArgs),
    /// List tokens, without their secrets
    #[command(visible_alias = "ls")]
    List(ListArgs),
    /// Take tokens back; agents that have joined stay, users are out at once
    Delete {
        /// The tokens' ids
        #[arg(required = true)]
        ids: Vec<String>,
    },
}

/// `muster token create`.
#[derive(Debug, clap::Args)]
pub(crate) struct CreateArgs {
    #[command(flatten)]
    terms: Terms,
    /// Only for the agent of this node
    #[arg(long, value_name = "NAME")]
    node: Option<String>,
    /// A token of this user, to whom Access objects give rights; it holds 8h
    #[arg(long, value_name = "NAME", conflicts_with_all = ["node", "uses"])]
    user: Option<String>,
    /// A group that the user is in; may be given several times
    #[arg(long = "group", value_name = "NAME", requires = "user")]
    groups: Vec<String>,
    /// Print a kubeconfig of the user, for `muster`, `kubectl` and the SDKs
    #[arg(long, requires = "user", conflicts_with = "output")]
    as_kubeconfig: bool,
    /// How to print it
    #[arg(short, long, value_enum, value_name = "FORMAT")]
    output: Option<Format>,
}

/// How long and how often a token holds.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct Terms {
    /// How long it holds [default: 1h]
    #[arg(long, value_name = "TIME", value_parser = span)]
    ttl: Option<Span>,
    /// How many agents may use it [default: any number]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    uses: Option<u32>,
}

impl Terms {
    /// How long a token for agents holds.
    pub(crate) fn ttl(&self) -> Span {
        self.ttl.unwrap_or_else(|| Span::from_secs(3600))
    }
}

/// `muster token list`.
#[derive(Debug, clap::Args)]
pub(crate) struct ListArgs {
    /// Those of users
    #[arg(long)]
    users: bool,
    /// How to print them
    #[arg(short, long, value_enum, value_name = "FORMAT")]
    output: Option<Format>,
}

/// A JoinToken as the controller shows it.
#[derive(Debug, Deserialize)]
struct Token {
    metadata: Metadata,
    #[serde(default)]
    spec: Spec,
    #[serde(default)]
    status: Status,
}

#[derive(Debug, Deserialize)]
struct Metadata {
    name: String,
}

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
struct Spec {
    node_name: Option<String>,
    uses: Option<u32>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Status {
    /// Only in the answer to its making.
    token: Option<String>,
    expires: Option<Timestamp>,
    used: u32,
}

pub(crate) async fn run(command: Command, session: &mut Session) -> Outcome {
    match command {
        Command::Create(args) => create(args, session).await,
        Command::List(args) => list(args, session).await,
        Command::Delete { ids } => {
            for id in ids {
                match session.client.delete_path(&token_path(Some(&id))).await {
                    Err(error) if error.is_not_found() => {
                        session.client.delete_path(&user_token::token_path(Some(&id))).await?;
                    }
                    deleted => deleted?,
                }
                session.ui.line(&format!("token/{id} deleted"))?;
            }
            Ok(exit::OK)
        }
    }
}

fn token_path(id: Option<&str>) -> String {
    match id {
        None => group_path("jointokens"),
        Some(id) => group_path(&format!("jointokens/{}", crate::client::segment(id))),
    }
}

async fn create(args: CreateArgs, session: &mut Session) -> Outcome {
    if let Some(user) = args.user {
        let new = user_token::New {
            user,
            groups: args.groups,
            ttl_seconds: args.terms.ttl.map(|ttl| ttl.as_duration().as_secs().max(1)),
            as_kubeconfig: args.as_kubeconfig,
            output: args.output,
        };
        return user_token::create(new, session).await;
    }
    let answer = make(&args.terms, args.node.as_deref(), session).await?;
    if let Some(format @ (Format::Yaml | Format::Json)) = args.output {
        session.ui.print(&document(&answer, format)?)?;
        return Ok(exit::OK);
    }
    let token = secret(&answer, session)?;
    // The token alone on standard output, so that `$(muster token create)` is one.
    session.ui.line(&token)?;
    let name = args.node.as_deref().unwrap_or("NAME");
    session.ui.note(&format!(
        "\nOn the robot or server, within {}:\n\n  {}",
        args.terms.ttl(),
        join_command(&session.client.server, &token, name, "robot|cloud")
    ));
    Ok(exit::OK)
}

/// Makes a token.
pub(crate) async fn make(
    terms: &Terms,
    node: Option<&str>,
    session: &Session,
) -> Result<Value, CliError> {
    let mut spec = json!({"ttlSeconds": terms.ttl().as_duration().as_secs().max(1)});
    if let Some(node) = node {
        spec["nodeName"] = node.into();
    }
    if let Some(uses) = terms.uses {
        spec["uses"] = uses.into();
    }
    session.client.post_json(&token_path(None), &json!({"spec": spec})).await
}

/// The text of a token that was just made.
pub(crate) fn secret(answer: &Value, session: &Session) -> Result<String, CliError> {
    let token: Token = read(answer.clone(), session)?;
    token.status.token.ok_or_else(|| CliError::Answer {
        server: session.client.server.clone(),
        request: "POST jointokens".to_owned(),
        source: serde::de::Error::missing_field("status.token"),
    })
}

/// What is typed where the agent runs.
pub(crate) fn join_command(server: &str, token: &str, name: &str, kind: &str) -> String {
    format!("muster agent --join {server} --token {token} --name {name} --kind {kind}")
}

fn read<T: serde::de::DeserializeOwned>(value: Value, session: &Session) -> Result<T, CliError> {
    serde_json::from_value(value).map_err(|source| CliError::Answer {
        server: session.client.server.clone(),
        request: "jointokens".to_owned(),
        source,
    })
}

async fn list(args: ListArgs, session: &mut Session) -> Outcome {
    if args.users {
        return user_token::list(args.output, session).await;
    }
    let mut answer: Value = session.client.get_json(&token_path(None)).await?;
    match args.output {
        Some(format @ (Format::Yaml | Format::Json)) => {
            session.ui.print(&document(&answer, format)?)?;
            return Ok(exit::OK);
        }
        Some(Format::Name | Format::Table | Format::Wide) | None => {}
    }
    let tokens: Vec<Token> = read(answer["items"].take(), session)?;
    if args.output == Some(Format::Name) {
        tokens.iter().try_for_each(|t| session.ui.line(&format!("token/{}", t.metadata.name)))?;
        return Ok(exit::OK);
    }
    if tokens.is_empty() {
        session.ui.note("there are no tokens");
        return Ok(exit::OK);
    }
    let now = Timestamp::now();
    let mut table = Table::new(["ID", "NODE", "EXPIRES", "USED"]);
    for token in tokens {
        let expires = match token.status.expires {
            Some(t) if t <= now => "expired".to_owned(),
            // The age of now as seen from then.
            Some(t) => format!("in {}", human::age(now, t)),
            None => String::new(),
        };
        let of = token.spec.uses.map(|n| format!("/{n}")).unwrap_or_default();
        let node = token.spec.node_name.unwrap_or_else(|| "any".to_owned());
        table.push([token.metadata.name, node, expires, format!("{}{of}", token.status.used)]);
    }
    let text = table.text(&session.ui.styles);
    session.ui.print(&text)?;
    Ok(exit::OK)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::exit;
    use crate::fake::Fake;

    #[tokio::test]
    async fn a_new_token_is_the_only_thing_on_standard_output() {
        let fake = Fake::new();
        let made = json!({"metadata": {"name": "ab"}, "spec": {}, "status": {"token": "muster1.ab.cd.ef", "used": 0}});
        fake.answer("POST /apis/muster.dev/v1alpha1/jointokens", made);
        let printed =
            fake.run(&["token", "create", "--ttl", "2h", "--node", "r1", "--uses", "3"]).await;
        assert_eq!(printed, (exit::OK, "muster1.ab.cd.ef\n".to_owned()));
        assert_eq!(
            fake.last_body(),
            json!({"spec": {"ttlSeconds": 7200, "nodeName": "r1", "uses": 3}})
        );
    }

    #[tokio::test]
    async fn the_list_shows_no_secrets() {
        let fake = Fake::new();
        let token = json!({"metadata": {"name": "ab"}, "spec": {"nodeName": "r1", "uses": 3}, "status": {"expires": "2000-01-01T00:00:00Z", "used": 1}});
        fake.answer("GET /apis/muster.dev/v1alpha1/jointokens", json!({"items": [token]}));
        assert_eq!(
            fake.run(&["token", "list"]).await.1,
            "ID   NODE   EXPIRES   USED\nab   r1     expired   1/3\n"
        );
    }
}
