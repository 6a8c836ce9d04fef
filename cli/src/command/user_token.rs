//! `muster token create --user`, `muster token list --users`: tokens of people and programs.

use jiff::Timestamp;
use serde::Deserialize;
use serde_json::{Value, json};

use super::Outcome;
use crate::client::{group_path, segment};
use crate::error::CliError;
use crate::exit;
use crate::output::human;
use crate::output::objects::{Format, document};
use crate::output::table::Table;
use crate::session::Session;

/// A user's token as the controller shows it.
#[derive(Debug, Deserialize)]
struct Token {
    metadata: Metadata,
    spec: Spec,
    status: Status,
}

#[derive(Debug, Deserialize)]
struct Metadata {
    name: String,
}

#[derive(Debug, Deserialize)]
struct Spec {
    user: String,
    #[serde(default)]
    groups: Vec<String>,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Status {
    expires: Timestamp,
    /// This and the next only in the answer to its making.
    #[serde(default)]
    token: Option<String>,
    #[serde(default)]
    certificate_authority_data: String,
}

/// What a token is made for, and how it is printed.
pub(super) struct New {
    pub(super) user: String,
    pub(super) groups: Vec<String>,
    pub(super) ttl_seconds: Option<u64>,
    /// As a kubeconfig, ready to be used.
    pub(super) as_kubeconfig: bool,
    pub(super) output: Option<Format>,
}

pub(super) fn token_path(id: Option<&str>) -> String {
    match id {
        None => group_path("usertokens"),
        Some(id) => group_path(&format!("usertokens/{}", segment(id))),
    }
}

pub(super) async fn create(new: New, session: &mut Session) -> Outcome {
    let mut spec = json!({"user": new.user});
    if !new.groups.is_empty() {
        spec["groups"] = new.groups.into();
    }
    if let Some(seconds) = new.ttl_seconds {
        spec["ttlSeconds"] = seconds.into();
    }
    let answer: Value = session.client.post_json(&token_path(None), &json!({"spec": spec})).await?;
    if let Some(format @ (Format::Yaml | Format::Json)) = new.output {
        session.ui.print(&document(&answer, format)?)?;
        return Ok(exit::OK);
    }
    let made: Token = read(answer, session)?;
    let Status { expires, token, certificate_authority_data } = made.status;
    let token = token.ok_or_else(|| missing("status.token", session))?;
    let left = human::age(expires, Timestamp::now());
    if new.as_kubeconfig {
        let config = kubeconfig(session, &made.spec.user, &token, &certificate_authority_data);
        session.ui.print(&document(&config, Format::Yaml)?)?;
        session.ui.note(&format!("It is {} for {left}: keep it as a secret.", made.spec.user));
        return Ok(exit::OK);
    }
    // The token alone on standard output, so that `$(muster token create --user …)` is one.
    session.ui.line(&token)?;
    session.ui.note(&format!(
        "\nIt is {} for {left}, with the rights that Access objects give. `--as-kubeconfig` prints a kubeconfig instead.",
        made.spec.user
    ));
    Ok(exit::OK)
}

/// As `muster`, `kubectl` and the SDKs read it.
fn kubeconfig(session: &Session, user: &str, token: &str, ca: &str) -> Value {
    let server = &session.client.server;
    json!({
        "apiVersion": "v1",
        "kind": "Config",
        "clusters": [{"name": "muster", "cluster": {"server": server, "certificate-authority-data": ca}}],
        "users": [{"name": user, "user": {"token": token}}],
        "contexts": [{"name": "muster", "context": {"cluster": "muster", "user": user, "namespace": session.namespace}}],
        "current-context": "muster",
    })
}

pub(super) async fn list(output: Option<Format>, session: &mut Session) -> Outcome {
    let mut answer: Value = session.client.get_json(&token_path(None)).await?;
    if let Some(format @ (Format::Yaml | Format::Json)) = output {
        session.ui.print(&document(&answer, format)?)?;
        return Ok(exit::OK);
    }
    let tokens: Vec<Token> = read(answer["items"].take(), session)?;
    if output == Some(Format::Name) {
        tokens.iter().try_for_each(|t| session.ui.line(&format!("token/{}", t.metadata.name)))?;
        return Ok(exit::OK);
    }
    if tokens.is_empty() {
        session.ui.note("there are no tokens of users");
        return Ok(exit::OK);
    }
    let now = Timestamp::now();
    let mut table = Table::new(["ID", "USER", "GROUPS", "EXPIRES"]);
    for Token { metadata, spec, status } in tokens {
        let expires = match status.expires {
            expires if expires <= now => "expired".to_owned(),
            // The age of now as seen from then.
            expires => format!("in {}", human::age(now, expires)),
        };
        table.push([metadata.name, spec.user, spec.groups.join(","), expires]);
    }
    let text = table.text(&session.ui.styles);
    session.ui.print(&text)?;
    Ok(exit::OK)
}

fn read<T: serde::de::DeserializeOwned>(value: Value, session: &Session) -> Result<T, CliError> {
    serde_json::from_value(value).map_err(|source| CliError::Answer {
        server: session.client.server.clone(),
        request: "usertokens".to_owned(),
        source,
    })
}

fn missing(field: &'static str, session: &Session) -> CliError {
    CliError::Answer {
        server: session.client.server.clone(),
        request: "POST usertokens".to_owned(),
        source: serde::de::Error::missing_field(field),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fake::Fake;

    fn made() -> Value {
        json!({"metadata": {"name": "ab"}, "spec": {"user": "ada", "groups": ["lab"]},
               "status": {"token": "musteru1.ab.cd", "certificateAuthorityData": "Y2E=", "expires": "2999-01-01T00:00:00Z"}})
    }

    #[tokio::test]
    async fn a_new_token_is_the_only_thing_on_standard_output() {
        let fake = Fake::new();
        fake.answer("POST /apis/muster.dev/v1alpha1/usertokens", made());
        let line = ["token", "create", "--user", "ada", "--group", "lab", "--ttl", "8h"];
        assert_eq!(fake.run(&line).await, (exit::OK, "musteru1.ab.cd\n".to_owned()));
        let spec = json!({"user": "ada", "groups": ["lab"], "ttlSeconds": 28_800});
        assert_eq!(fake.last_body(), json!({ "spec": spec }));
    }

    #[tokio::test]
    async fn a_kubeconfig_has_all_that_clients_need() {
        let fake = Fake::new();
        fake.answer("POST /apis/muster.dev/v1alpha1/usertokens", made());
        let (code, text) = fake.run(&["token", "create", "--user", "ada", "--as-kubeconfig"]).await;
        assert_eq!(code, exit::OK);
        let config: kube::config::Kubeconfig = serde_saphyr::from_str(&text).expect("a kubeconfig");
        assert_eq!(config.current_context.as_deref(), Some("muster"));
        assert!(text.contains("musteru1.ab.cd") && text.contains("https://fake:7443"), "{text}");
    }

    #[tokio::test]
    async fn the_list_says_whose_they_are() {
        let fake = Fake::new();
        let token = json!({"metadata": {"name": "ab"}, "spec": {"user": "ada", "groups": ["lab", "hall"]}, "status": {"expires": "2000-01-01T00:00:00Z"}});
        fake.answer("GET /apis/muster.dev/v1alpha1/usertokens", json!({"items": [token]}));
        assert_eq!(
            fake.run(&["token", "list", "--users"]).await.1,
            "ID   USER   GROUPS     EXPIRES\nab   ada    lab,hall   expired\n"
        );
    }
}
