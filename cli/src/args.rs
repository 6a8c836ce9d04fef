//! The command line. One struct a verb stands in the verb's file; here is what all of them share.

use std::path::PathBuf;

use clap::builder::styling::{AnsiColor, Styles};
use clap::{Args, Parser, Subcommand};
use muster_api::duration::Span;
use muster_api::selector::{FieldSelector, LabelSelector, SelectorError};

use crate::client::Selection;
use crate::command::{
    apply, cordon, create, delete, describe, drain, estop, exec, framework, get, lease, local,
    logs, node, offers, plan, rollout, scale, token, top, version, wait, why,
};
use crate::output::ui::Color;

/// Colours of the help: headings and literals stand out, as in cargo.
const HELP: Styles = Styles::styled()
    .header(AnsiColor::Green.on_default().bold())
    .usage(AnsiColor::Green.on_default().bold())
    .literal(AnsiColor::Cyan.on_default().bold())
    .placeholder(AnsiColor::Cyan.on_default());

/// Run tasks on a fleet of robots and cloud servers.
#[derive(Debug, Parser)]
#[command(name = "muster", version, styles = HELP, max_term_width = 100, after_help = EXIT_CODES)]
pub(crate) struct Cli {
    #[command(flatten)]
    pub(crate) global: Global,
    #[command(subcommand)]
    pub(crate) command: Command,
}

const EXIT_CODES: &str = "Exit codes: 0 done, 1 failure, 2 usage, 3 not found, 4 conflict, 5 invalid, \
6 unreachable, 7 denied, 8 timeout, 9 not placed, 10 task ended. `muster plan`: 0 nothing to do, 1 changes, 255 error.";

/// What every client verb takes.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Global options")]
pub(crate) struct Global {
    /// Which controller to ask [default: $MUSTER_CONFIG, $KUBECONFIG, ~/.muster/config]
    #[arg(long, value_name = "FILE", global = true)]
    pub(crate) kubeconfig: Option<PathBuf>,
    /// Another context of the kubeconfig than its current one
    #[arg(long, value_name = "NAME", global = true)]
    pub(crate) context: Option<String>,
    /// The namespace [default: that of the context, `default`]
    #[arg(short, long, value_name = "NAME", global = true)]
    pub(crate) namespace: Option<String>,
    /// When to use colours
    #[arg(long, value_enum, default_value_t, value_name = "WHEN", global = true)]
    pub(crate) color: Color,
}

/// The verbs.
#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Create or change objects so that they are as manifests say
    Apply(apply::Args),
    /// Create a ConfigMap or a Secret from literals and files
    #[command(subcommand)]
    Create(create::Command),
    /// Show what applying manifests would do, by the real scheduler, without doing it
    Plan(plan::Args),
    /// List objects
    Get(get::Args),
    /// Show everything about objects
    Describe(describe::Args),
    /// Say where a task runs and why, or what keeps it from running; why a framework is not offered a node; what of a task set does not serve; why an application's parts are where they are
    Why(why::Args),
    /// Show what frameworks are offered now
    Offers(offers::Args),
    /// Delete objects; a framework is torn down with its tasks
    Delete(delete::Args),
    /// Change how many tasks sets have
    Scale(scale::Args),
    /// Follow, stop, go on with or take back the change of a set's template
    #[command(subcommand)]
    Rollout(rollout::Command),
    /// Print what a task wrote
    Logs(logs::Args),
    /// Run a program in a running task, held to its limits; the program's exit code is the command's
    Exec(exec::Args),
    /// Show what nodes or tasks use, measured by the kernel
    Top(top::Args),
    /// Wait until objects are as said
    Wait(wait::Args),
    /// Let nothing new onto nodes
    Cordon(cordon::Args),
    /// Let tasks onto nodes again
    Uncordon(cordon::Args),
    /// Cordon a node and end the tasks on it
    Drain(drain::Args),
    /// Stop robots at once, whoever holds them
    Estop(estop::Args),
    /// Register nodes, and fence those that are lost
    #[command(subcommand)]
    Node(node::Command),
    /// Hold a robot's actuators yourself, instead of a task
    #[command(subcommand)]
    Lease(lease::Command),
    /// Say where a running framework works
    #[command(subcommand)]
    Framework(framework::Command),
    /// Tokens with which agents join, and tokens of users
    #[command(subcommand)]
    Token(token::Command),
    /// Print the versions of client and controller
    Version(version::Args),
    // Verbs that run something in this process are added to `local`.
    #[command(flatten)]
    Local(local::Command),
}

/// `-l` and `--field-selector`.
#[derive(Debug, Clone, Default, Args)]
pub(crate) struct Select {
    /// Only objects with these labels: `app=cam,tier!=test,zone in (a,b),!old`
    #[arg(short = 'l', long, value_name = "SELECTOR", value_parser = label_selector)]
    pub(crate) selector: Option<String>,
    /// Only objects with these fields: `status.phase=Running,metadata.name!=x`
    #[arg(long, value_name = "SELECTOR", value_parser = field_selector)]
    pub(crate) field_selector: Option<String>,
}

impl Select {
    pub(crate) fn selection(&self) -> Selection {
        Selection { labels: self.selector.clone(), fields: self.field_selector.clone() }
    }
}

fn label_selector(text: &str) -> Result<String, SelectorError> {
    LabelSelector::parse(text).map(|_| text.to_owned())
}

fn field_selector(text: &str) -> Result<String, SelectorError> {
    FieldSelector::parse(text).map(|_| text.to_owned())
}

/// Reads a duration, with its suggestion when it is none.
pub(crate) fn span(text: &str) -> Result<Span, String> {
    text.parse::<Span>().map_err(|error| format!("{error}; {}", error.suggestion()))
}

/// Reads `KEY=VALUE`.
pub(crate) fn pair(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((key, value)) if !key.is_empty() => Ok((key.to_owned(), value.to_owned())),
        _ => Err("write KEY=VALUE".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    fn read(line: &str) -> Result<Cli, clap::Error> {
        Cli::try_parse_from(line.split_whitespace())
    }

    #[test]
    fn the_definition_is_sound() {
        Cli::command().debug_assert();
    }

    #[test]
    fn global_options_stand_before_or_after_the_verb() {
        for line in
            ["muster -n lab get tasks", "muster get tasks -n lab", "muster get -n lab tasks"]
        {
            assert_eq!(read(line).expect(line).global.namespace.as_deref(), Some("lab"));
        }
    }

    #[test]
    fn the_controller_s_kubeconfig_is_not_the_clients() {
        let cli = read("muster controller --kubeconfig k").expect("good");
        let Command::Local(local::Command::Controller(args)) = cli.command else {
            panic!("another verb")
        };
        assert_eq!(args.kubeconfig.as_deref(), Some(std::path::Path::new("k")));
    }

    #[test]
    fn lines_that_people_write_are_understood() {
        for line in [
            "muster apply -f a.yaml -f dir --wait --timeout 90s",
            "muster apply -f - --dry-run -o yaml",
            "muster create configmap c --from-literal a=b --from-file dir",
            "muster create secret s --from-file=k=path --type=kubernetes.io/tls",
            "muster get all -A",
            "muster get tk x y -o wide",
            "muster get task/x node/y -w",
            "muster get tasks -l app=cam --field-selector status.phase=Running",
            "muster describe node turtlebot-1",
            "muster delete -f a.yaml --wait=false --now",
            "muster delete tasks --all --grace-period 3",
            "muster logs task/x -f --tail 20 --since 5m -p --timestamps",
            "muster top nodes",
            "muster wait task/x --for=phase=Running --timeout 60s",
            "muster wait task/x --for delete",
            "muster wait node/r --for=jsonpath={.status.free.cpu}=2",
            "muster why task/x",
            "muster why framework/x",
            "muster why taskset/x",
            "muster why app/x",
            "muster simulate offload --cases 10 --traces 0",
            "muster offers",
            "muster offers deliver -w -o json",
            "muster offers -A",
            "muster plan -f dir",
            "muster cordon a b",
            "muster drain a --grace-period 5 --timeout 2m",
            "muster node register r1 --kind robot --speed 0.5 --label area=lab",
            "muster node fence r1 --reason off --by ada --yes",
            "muster scale taskset/x --replicas=3",
            "muster scale ts/x ts/y --replicas 0 --current-replicas 2",
            "muster rollout status ts/x --timeout 10s --watch=false",
            "muster rollout undo taskset/x --to-revision=2",
            "muster rollout history ts/x --revision 3",
            "muster rollout pause ts/x ts/y",
            "muster rollout resume x",
            "muster rollout restart x",
            "muster delete taskset x --cascade=orphan",
            "muster node lock r1 --holder ada --reason tray",
            "muster node unlock r1 --holder ada",
            "muster token create --ttl 2h --node r1 --uses 3",
            "muster lease take r1 --reason stuck",
            "muster lease acquire r1/arm",
            "muster lease return r1",
            "muster framework set-position deliver --at -3,4 --radius 20",
            "muster framework set-position deliver --everywhere",
            "muster framework set-position deliver --clicked --ros-master http://r1:11311 --topic /goal",
            "muster token list",
            "muster token create --user ada --group lab --ttl 8h --as-kubeconfig",
            "muster token list --users",
            "muster token delete abc",
            "muster completion bash",
            "muster controller --data-dir d --listen 127.0.0.1:0 --kubeconfig k",
            "muster agent --join https://h:1 --token t --name r --kind robot --position static:-1,2",
            "muster version --client -o json",
        ] {
            if let Err(error) = read(line) {
                panic!("{line}: {error}");
            }
        }
    }

    #[test]
    fn lines_that_mean_nothing_are_refused_as_usage_errors() {
        for line in [
            "muster",
            "muster apply",
            "muster get tasks -l a=b=c(",
            "muster wait task/x --for=phase=Dancing",
            "muster wait task/x --timeout 60",
            "muster delete tasks --now --grace-period 3",
            "muster node register r1 --kind plane",
            "muster node fence r1 --yes",
            "muster token create --user ada --node r1",
            "muster token create --group lab",
            "muster plan",
            "muster offers deliver -A",
        ] {
            assert_eq!(
                read(line).expect_err(line).exit_code(),
                i32::from(crate::exit::USAGE),
                "{line}"
            );
        }
    }
}
