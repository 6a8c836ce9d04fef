//! Quotas, measured from the kernel. Needs root and cgroups.

mod common;

use std::time::{Duration, Instant};

use common::agent::Agent;
use common::controller::Controller;
use common::cpu::Accounts;
use common::until;
use muster_api::wire::agent::v1 as proto;
use serde_json::json;

#[test]
fn half_a_core_is_half_a_core() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    controller.assign(
        "spin",
        json!({
            "resources": { "cpu": "500m", "memory": "64Mi" },
            "run": { "process": { "command": ["sh", "-c", "while :; do :; done"] } },
        }),
    );
    controller.wait_running("spin");
    let group = |controller| agent.group("spin", 1, controller);
    Accounts { cpuacct: group("cpuacct"), cpu: group("cpu") }.assert_share(0.5);
    // The agent looks at its clock before the account: one reading beside others may be too large, not each.
    let told = until("usage within the quota", || {
        controller.usage("spin").filter(|usage| (50..=650).contains(&usage.cpu_millis))
    });
    assert!(told.memory_bytes > 0, "{told:?}");
}

#[test]
fn too_much_memory_is_reported_as_such() {
    let controller = Controller::start();
    let _agent = Agent::start(&controller);
    // dd holds one block in memory.
    controller.assign(
        "fat",
        json!({
            "resources": { "memory": "64Mi" },
            "run": { "process": { "command": ["dd", "if=/dev/zero", "of=/dev/null", "bs=200M", "count=1"] } },
        }),
    );
    let end = controller.wait_end("fat");
    assert_eq!(
        (end.reason.as_str(), end.exit_code, end.signal),
        ("OOMKilled", Some(137), Some(9)),
        "{end:?}"
    );
}

#[test]
fn a_fork_bomb_stays_in_its_bounds_and_ends() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    controller.assign(
        "bomb",
        json!({
            "resources": { "pids": 40, "cpu": "300m" },
            "gracePeriodSeconds": 0,
            "run": { "process": { "command": ["sh", "-c", "trap '' TERM; while :; do sh -c 'while :; do sleep 1000 & done'; done"] } },
        }),
    );
    controller.wait_running("bomb");
    let group = agent.group("bomb", 1, "pids");
    until("a full group", || {
        let text = std::fs::read_to_string(group.join("pids.current")).ok()?;
        (text.trim().parse::<u64>().ok()? >= 30).then_some(())
    });
    controller.stop("bomb", 0);
    controller.wait_end("bomb");
    assert!(!group.exists());
}

#[test]
fn io_rates_are_in_the_kernel() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let begun = Instant::now();
    controller.assign(
        "io",
        json!({
            "resources": { "io": { "readBps": "2Mi", "writeBps": "1Mi" } },
            "run": { "process": { "command": ["sh", "-c",
                "dd if=/dev/zero of=file bs=1M count=3 oflag=direct 2>/dev/null; sleep 1000"] } },
        }),
    );
    controller.wait_running("io");
    let file = agent.group("io", 1, "blkio").join("blkio.throttle.write_bps_device");
    assert!(std::fs::read_to_string(file).unwrap().trim().ends_with(" 1048576"));
    let written = agent.task_dir("io").join("work/file");
    until("three MiB", || (std::fs::metadata(&written).ok()?.len() >= 3 << 20).then_some(()));
    assert!(begun.elapsed() >= Duration::from_millis(1_800), "{:?}", begun.elapsed());
}

#[test]
fn a_limit_that_cannot_be_enforced_is_refused() {
    let controller = Controller::start();
    // A file system in memory has no disk to throttle.
    let dir = tempfile::tempdir_in("/dev/shm").unwrap();
    let _agent = Agent::start_in(dir, &controller, &[]);
    controller.assign(
        "shm",
        json!({
            "resources": { "io": { "readBps": "1Mi" } },
            "run": { "process": { "command": ["true"] } },
        }),
    );
    let end = controller.wait_end("shm");
    assert_eq!(
        (end.phase(), end.reason.as_str()),
        (proto::TaskPhase::Failed, "QuotaNotEnforced"),
        "{end:?}"
    );
}
