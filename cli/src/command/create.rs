//! `muster create`: ConfigMaps and Secrets from literals and files, as kubectl makes them.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use k8s_openapi::ByteString;
use muster_api::kind::keyed::check_key;
use serde_json::{Value, json};

use super::Outcome;
use crate::args::pair;
use crate::client::Mode;
use crate::error::CliError;
use crate::exit;
use crate::session::Session;
use crate::target;

/// `muster create`.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Settings for tasks
    #[command(visible_alias = "cm")]
    Configmap(Values),
    /// Passwords and keys for tasks
    Secret(SecretArgs),
}

/// Where the values come from.
#[derive(Debug, clap::Args)]
pub(crate) struct Values {
    /// Its name
    name: String,
    /// A key and its value
    #[arg(long, value_name = "KEY=VALUE", value_parser = pair)]
    from_literal: Vec<(String, String)>,
    /// A file, or every file of a directory; the key is the file's name when none is given
    #[arg(long, value_name = "[KEY=]PATH")]
    from_file: Vec<String>,
    /// It can never be changed
    #[arg(long)]
    immutable: bool,
    /// Only ask whether it would be taken
    #[arg(long)]
    dry_run: bool,
}

/// `muster create secret`.
#[derive(Debug, clap::Args)]
pub(crate) struct SecretArgs {
    #[command(flatten)]
    values: Values,
    /// What it is for; `kubernetes.io/tls` and others have keys that must be there
    #[arg(long = "type", value_name = "TYPE", default_value = "Opaque")]
    kind: String,
}

pub(crate) async fn run(command: Command, session: &mut Session) -> Outcome {
    let (kind, values, object) = match &command {
        Command::Configmap(values) => ("ConfigMap", values, config_map(values)?),
        Command::Secret(args) => ("Secret", &args.values, secret(args)?),
    };
    let info = target::kind(&kind.to_lowercase())?;
    let mode = if values.dry_run { Mode::DryRun } else { Mode::Store };
    session.client.create(info, Some(&session.namespace), &object, mode).await?;
    let suffix = if values.dry_run { " (dry run)" } else { "" };
    session.ui.line(&format!("{}/{} created{suffix}", info.singular, values.name))?;
    Ok(exit::OK)
}

fn config_map(values: &Values) -> Result<Value, CliError> {
    let (mut data, mut binary) = (json!({}), json!({}));
    for (key, value) in values.read()? {
        match String::from_utf8(value) {
            Ok(text) => data[key] = text.into(),
            Err(error) => binary[key] = json!(ByteString(error.into_bytes())),
        }
    }
    let mut object = values.object("ConfigMap");
    object["data"] = data;
    object["binaryData"] = binary;
    Ok(object)
}

fn secret(args: &SecretArgs) -> Result<Value, CliError> {
    let mut data = json!({});
    for (key, value) in args.values.read()? {
        data[key] = json!(ByteString(value));
    }
    let mut object = args.values.object("Secret");
    object["data"] = data;
    object["type"] = args.kind.as_str().into();
    Ok(object)
}

impl Values {
    fn object(&self, kind: &str) -> Value {
        let mut object = json!({"apiVersion": "v1", "kind": kind, "metadata": {"name": self.name}});
        if self.immutable {
            object["immutable"] = true.into();
        }
        object
    }

    fn read(&self) -> Result<BTreeMap<String, Vec<u8>>, CliError> {
        let mut values = BTreeMap::new();
        for (key, value) in &self.from_literal {
            add(&mut values, key.clone(), value.clone().into_bytes())?;
        }
        for source in &self.from_file {
            let (key, path) = match source.split_once('=') {
                Some((key, path)) => (Some(key.to_owned()), Path::new(path)),
                None => (None, Path::new(source)),
            };
            for (name, path) in files(path)? {
                let failed = |source| CliError::Read { path: path.clone(), source };
                let value = fs::read(&path).map_err(failed)?;
                add(&mut values, key.clone().unwrap_or(name), value)?;
            }
        }
        Ok(values)
    }
}

fn add(
    values: &mut BTreeMap<String, Vec<u8>>,
    key: String,
    value: Vec<u8>,
) -> Result<(), CliError> {
    if let Err(reason) = check_key(&key) {
        return Err(CliError::Usage {
            message: format!("{key:?} cannot be a key: {reason}"),
            hint: Some("--from-file=KEY=PATH gives a file another key".to_owned()),
        });
    }
    match values.insert(key.clone(), value) {
        None => Ok(()),
        Some(_) => Err(CliError::usage(format!("the key {key:?} is there twice"))),
    }
}

/// The file, or the files of the directory, by name; directories in it are passed over, as kubectl does.
fn files(path: &Path) -> Result<Vec<(String, PathBuf)>, CliError> {
    let failed = |source| CliError::Read { path: path.to_owned(), source };
    let name = |path: &Path| {
        path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
    };
    if !fs::metadata(path).map_err(failed)?.is_dir() {
        return Ok(vec![(name(path), path.to_owned())]);
    }
    let mut all = Vec::new();
    for entry in fs::read_dir(path).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        if path.is_file() {
            all.push((name(&path), path));
        }
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use crate::exit;
    use crate::fake::Fake;

    #[tokio::test]
    async fn values_come_from_literals_and_files() {
        let dir = tempfile::tempdir().expect("a directory");
        let (text, raw) = (dir.path().join("app.yaml"), dir.path().join("raw"));
        std::fs::write(&text, "a: 1\n").expect("written");
        std::fs::write(&raw, [0xff]).expect("written");
        let fake = Fake::new();
        let (text, raw) =
            (text.display().to_string(), format!("--from-file=bin={}", raw.display()));
        let line = ["create", "cm", "c", "--from-literal=k=v=w", "--from-file", &text, &raw];
        assert_eq!(fake.run(&line).await, (exit::OK, "configmap/c created\n".to_owned()));
        let body = fake.last_body();
        assert_eq!(body["data"], serde_json::json!({"k": "v=w", "app.yaml": "a: 1\n"}));
        assert_eq!(body["binaryData"], serde_json::json!({"bin": "/w=="}));

        let line = ["create", "secret", "s", "--from-literal=k=v", "--immutable"];
        assert_eq!(fake.run(&line).await, (exit::OK, "secret/s created\n".to_owned()));
        let body = fake.last_body();
        assert_eq!(body["data"], serde_json::json!({"k": "dg=="}));
        assert_eq!((&body["type"], &body["immutable"]), (&"Opaque".into(), &true.into()));
    }

    #[tokio::test]
    async fn a_key_that_cannot_be_one_is_refused_here() {
        let fake = Fake::new();
        for line in [
            ["create", "cm", "c", "--from-literal=a b=c", "--from-literal=x=y"],
            ["create", "cm", "c", "--from-literal=a=b", "--from-literal=a=c"],
        ] {
            let error = fake.try_run(&line).await.expect_err("refused");
            assert_eq!(error.class().exit(), exit::USAGE);
        }
    }
}
