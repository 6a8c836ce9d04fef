//! A launch as the engine wants it.

use std::collections::HashMap;
use std::fs;
use std::io;
use std::path::Path;

use bollard::models::{
    ContainerCreateBody, ContainerUpdateBody, HostConfig, HostConfigLogConfig, Mount, MountType,
    ThrottleDevice,
};
use muster_agent_core::workload::Failure;

use super::DockerConfig;
use crate::executor;
use crate::gate;
use crate::runtime::cgroup::device;
use crate::runtime::launch::{Container, Launch, Limits, Network, Program};
use crate::sensor;

/// Whose container it is.
pub(super) const LABEL_AGENT: &str = "muster.dev/agent";
/// Which task it is.
pub(super) const LABEL_UID: &str = "muster.dev/task-uid";
/// Which attempt of the task it is.
pub(super) const LABEL_ATTEMPT: &str = "muster.dev/attempt";

/// Where a container finds what is the agent's to write: places for the two below, and nothing else.
const VIEW_DIR: &str = "/run/muster";

/// The directory that is mounted there, in its task's.
const VIEW: &str = "view";

/// Where a container sees its task's run directory, which is its own to write.
const RUN_DIR: &str = "/run/muster/own";

/// Where a container sees the directory of its executor socket.
const EXECUTOR_DIR: &str = "/run/muster-executor";

/// Where a container finds its sensors' sockets.
const SENSORS_DIR: &str = "/run/muster/sensors";

/// Where a container finds the gate's socket.
const GATE_DIR: &str = "/run/muster-gate";

/// The least cpu weight that the engine gives: that of a task which reserved none.
const MIN_SHARES: i64 = 2;

/// Of the capabilities that the engine gives to root in a container, those that let it make devices, forge packets, write
/// the node's audit log, and hand capabilities on. What images do when they start (take files over, become another user,
/// listen on a low port) they go on doing.
const DROPPED: [&str; 6] = ["AUDIT_WRITE", "MKNOD", "NET_RAW", "SETFCAP", "SETPCAP", "SYS_CHROOT"];

/// The least memory limit that the engine takes.
const MIN_MEMORY: u64 = 6 << 20;

pub(super) fn body(launch: &Launch, config: &DockerConfig) -> Result<ContainerCreateBody, Failure> {
    let Program::Container(container) = &launch.program else {
        let message = "the launch is no container's".to_owned();
        return Err(Failure { reason: "NodeError".to_owned(), message, retry: false });
    };
    make_dirs(launch, container, config)?;
    let mut env = launch.env.clone();
    env.insert("MUSTER_RUN_DIR".to_owned(), RUN_DIR.to_owned());
    let socket = format!("{EXECUTOR_DIR}/{}", executor::SOCKET);
    env.insert(executor::SOCKET_ENV.to_owned(), socket);
    if env.contains_key(gate::SOCKET_ENV) {
        env.insert(gate::SOCKET_ENV.to_owned(), format!("{GATE_DIR}/{}", gate::SOCKET));
    }
    if env.contains_key(sensor::DIR_ENV) {
        env.insert(sensor::DIR_ENV.to_owned(), SENSORS_DIR.to_owned());
    }
    // Who may use the engine sees them, as everything of a container.
    let given = launch.given.iter().flat_map(|given| &given.variables);
    env.extend(given.map(|variable| (variable.name.clone(), variable.value.clone())));
    let list = |words: &[String]| if words.is_empty() { None } else { Some(words.to_vec()) };
    Ok(ContainerCreateBody {
        image: Some(container.image.clone()),
        entrypoint: list(&container.command),
        cmd: list(&container.args),
        working_dir: container.working_dir.clone(),
        user: container.run_as.clone(),
        env: Some(env.iter().map(|(name, value)| format!("{name}={value}")).collect()),
        stop_signal: Some(launch.stop_signal.name().to_owned()),
        labels: Some(labels(launch, config)),
        host_config: Some(host(launch, container, config)?),
        ..ContainerCreateBody::default()
    })
}

/// Where the task writes, and what it sees around that.
fn make_dirs(launch: &Launch, container: &Container, config: &DockerConfig) -> Result<(), Failure> {
    let failed = |what: &'static str, path: &Path| {
        let path = path.to_owned();
        move |error: io::Error| Failure {
            reason: "NodeError".to_owned(),
            message: format!("failed to {what} {}: {error}", path.display()),
            retry: true,
        }
    };
    let task = config.tasks.join(launch.id.uid.as_str());
    let (run, view) = (task.join("run"), task.join(VIEW));
    let places = [RUN_DIR, SENSORS_DIR].into_iter().filter_map(|place| {
        Path::new(place).strip_prefix(VIEW_DIR).ok().map(|place| view.join(place))
    });
    for dir in places.chain([run.clone()]) {
        fs::create_dir_all(&dir).map_err(failed("make", &dir))?;
    }
    let Some((uid, gid)) = container.user else { return Ok(()) };
    match std::os::unix::fs::chown(&run, Some(uid), Some(gid)) {
        // Of an agent that is not root: the program runs, and cannot write there.
        Err(error) if error.kind() == io::ErrorKind::PermissionDenied => Ok(()),
        done => done.map_err(failed("hand over", &run)),
    }
}

fn labels(launch: &Launch, config: &DockerConfig) -> HashMap<String, String> {
    HashMap::from([
        (LABEL_AGENT.to_owned(), config.identity.clone()),
        (LABEL_UID.to_owned(), launch.id.uid.to_string()),
        (LABEL_ATTEMPT.to_owned(), launch.id.attempt.to_string()),
    ])
}

fn host(
    launch: &Launch,
    container: &Container,
    config: &DockerConfig,
) -> Result<HostConfig, Failure> {
    let limits = &launch.limits;
    let sizes = update(limits);
    let task = config.tasks.join(launch.id.uid.as_str());
    let mut mounts = vec![
        mount(&task.join(VIEW).display().to_string(), VIEW_DIR, true),
        mount(&task.join("run").display().to_string(), RUN_DIR, false),
    ];
    // The directory, not the socket: another life of the agent makes that anew.
    let seat = task.join(executor::DIR);
    if seat.exists() {
        mounts.push(mount(&seat.display().to_string(), EXECUTOR_DIR, true));
    }
    // As the launch knows it; the directory outlives every gate.
    let gate = launch.env.get(gate::SOCKET_ENV).map(Path::new).and_then(Path::parent);
    if let Some(dir) = gate.filter(|dir| dir.exists()) {
        mounts.push(mount(&dir.display().to_string(), GATE_DIR, true));
    }
    let sensors = launch.env.get(sensor::DIR_ENV).filter(|dir| Path::new(dir).exists());
    if let Some(dir) = sensors {
        mounts.push(mount(dir, SENSORS_DIR, true));
    }
    mounts.extend(container.mounts.iter().map(|m| mount(&m.host, &m.container, m.read_only)));
    let files = config.files.bound(launch);
    mounts.extend(files.iter().map(|f| mount(&f.host.display().to_string(), &f.container, true)));
    let throttle = |bps: Option<u64>| -> Result<Option<Vec<ThrottleDevice>>, Failure> {
        let Some(bps) = bps else { return Ok(None) };
        let path = disk(config)?;
        Ok(Some(vec![ThrottleDevice { path: Some(path), rate: Some(signed(bps)) }]))
    };
    Ok(HostConfig {
        nano_cpus: sizes.nano_cpus,
        cpu_shares: sizes.cpu_shares,
        memory: sizes.memory,
        memory_swap: sizes.memory_swap,
        pids_limit: sizes.pids_limit,
        blkio_device_read_bps: throttle(limits.read_bps)?,
        blkio_device_write_bps: throttle(limits.write_bps)?,
        network_mode: Some(
            match container.network {
                Network::Host => "host",
                Network::None => "none",
                Network::Bridge => "bridge",
            }
            .to_owned(),
        ),
        mounts: Some(mounts),
        cap_drop: Some(DROPPED.map(str::to_owned).to_vec()),
        // Beside the engine's own filter of system calls.
        security_opt: Some(vec!["no-new-privileges:true".to_owned()]),
        // The engine's own bounds, like those of process tasks.
        log_config: Some(HostConfigLogConfig {
            typ: Some("json-file".to_owned()),
            config: Some(HashMap::from([
                ("max-size".to_owned(), "10m".to_owned()),
                ("max-file".to_owned(), "5".to_owned()),
            ])),
        }),
        auto_remove: Some(false),
        ..HostConfig::default()
    })
}

fn signed(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

/// The limits that a container can be given while it runs.
pub(super) fn update(limits: &Limits) -> ContainerUpdateBody {
    let memory = limits.memory_bytes.map(|bytes| signed(bytes.max(MIN_MEMORY)));
    ContainerUpdateBody {
        nano_cpus: limits.cpu_millis.map(|millis| signed(millis.saturating_mul(1_000_000))),
        cpu_shares: Some(limits.cpu_millis.map_or(MIN_SHARES, |millis| {
            signed(millis.saturating_mul(1_024) / 1_000).max(MIN_SHARES)
        })),
        memory,
        // Memory and swap together: no swap.
        memory_swap: memory,
        pids_limit: limits.pids.map(signed),
        ..ContainerUpdateBody::default()
    }
}

/// `uid` or `uid:gid` of an image; names mean something inside of it only.
pub(super) fn user_ids(user: &str) -> Option<(u32, u32)> {
    let (uid, gid) = user.split_once(':').unwrap_or((user, "0"));
    Some((uid.parse().ok()?, gid.parse().ok()?))
}

fn mount(source: &str, target: &str, read_only: bool) -> Mount {
    Mount {
        source: Some(source.to_owned()),
        target: Some(target.to_owned()),
        typ: Some(MountType::BIND),
        read_only: Some(read_only),
        ..Mount::default()
    }
}

fn disk(config: &DockerConfig) -> Result<String, Failure> {
    let refused = |message: String| Failure {
        reason: "QuotaNotEnforced".to_owned(),
        message: format!("an I/O rate cannot be enforced here: {message}"),
        retry: false,
    };
    match device::disk_of(&config.tasks) {
        Ok(Some(disk)) => device::path_of(disk).map_err(|error| refused(error.to_string())),
        Ok(None) => Err(refused(format!("{} is on no block device", config.tasks.display()))),
        Err(error) => Err(refused(error.to_string())),
    }
}

/// `name`, `tag` of an image; a digest goes where the tag does, and no tag is `latest`, not all.
pub(super) fn image_and_tag(image: &str) -> (&str, &str) {
    if let Some((name, digest)) = image.split_once('@') {
        return (name, digest);
    }
    match image.rsplit_once(':') {
        // A colon before a slash is a registry's port.
        Some((name, tag)) if !tag.contains('/') => (name, tag),
        _ => (image, "latest"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn users_by_number() {
        assert_eq!(user_ids("1000"), Some((1000, 0)));
        assert_eq!(user_ids("1000:50"), Some((1000, 50)));
        assert_eq!(user_ids("node"), None);
        assert_eq!(user_ids(""), None);
    }

    #[test]
    fn images_and_tags() {
        assert_eq!(image_and_tag("a"), ("a", "latest"));
        assert_eq!(image_and_tag("a:1"), ("a", "1"));
        assert_eq!(image_and_tag("host:5000/a"), ("host:5000/a", "latest"));
        assert_eq!(image_and_tag("host:5000/a:2"), ("host:5000/a", "2"));
        assert_eq!(image_and_tag("a@sha256:0"), ("a", "sha256:0"));
    }
}
