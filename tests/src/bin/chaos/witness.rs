//! What the programs themselves wrote down. Each holds a lock for as long as it lives, which the kernel lets go when its last
//! process is gone: two that hold the same right at once cannot both have it, whatever anybody believes.

use std::collections::BTreeMap;
use std::fs;

use muster_tests::docker;
use serde_json::{Value, json};

use crate::house::House;
use crate::report::Report;

/// The program of a resident that alone may hold `right`.
pub(crate) fn program(house: &House, right: &str, name: &str) -> String {
    let dir = house.witness.display();
    format!(
        "exec 9>{dir}/locks/{right}; \
         /usr/bin/flock -n 9 || {{ echo {name} $MUSTER_UID $MUSTER_ATTEMPT >>{dir}/doubled; exit 99; }}; \
         echo $MUSTER_UID $MUSTER_ATTEMPT >>{dir}/starts/{name}; exec sleep 100000"
    )
}

/// A process that runs `script`.
pub(crate) fn process(script: &str) -> Value {
    json!({"process": {"command": ["sh", "-c", script]}})
}

/// A container that runs `script`, and sees the witness' directory.
pub(crate) fn container(house: &House, script: &str) -> Value {
    let dir = house.witness.display().to_string();
    // The image is a busybox, which has no flock.
    let of_host = |path: &str| json!({"hostPath": path, "mountPath": path, "readOnly": true});
    json!({"container": {
        "image": docker::IMAGE,
        "command": ["sh", "-c", script],
        "network": "None",
        "pullPolicy": "Never",
        "mounts": [
            {"hostPath": dir, "mountPath": dir}, of_host("/usr"), of_host("/lib"), of_host("/lib64"),
        ],
    }})
}

/// Starts that programs of this name have written down: uid and attempt, the oldest first.
pub(crate) fn starts(house: &House, name: &str) -> Vec<(String, u64)> {
    let text = fs::read_to_string(house.witness.join("starts").join(name)).unwrap_or_default();
    let lines = text.lines().filter_map(|line| line.split_once(' '));
    lines.filter_map(|(uid, n)| Some((uid.to_owned(), n.parse().ok()?))).collect()
}

/// At most one of a right at a time, and each attempt once.
pub(crate) fn check(house: &House, report: &mut Report) {
    let doubled = fs::read_to_string(house.witness.join("doubled")).unwrap_or_default();
    for line in doubled.lines() {
        report.broken(format!("two at once: {line} began while another held its right"));
    }
    for entry in fs::read_dir(house.witness.join("starts")).expect("it is there").flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let mut seen = BTreeMap::<_, usize>::new();
        for start in starts(house, &name) {
            *seen.entry(start).or_default() += 1;
        }
        for ((uid, attempt), times) in seen.into_iter().filter(|(_, times)| *times > 1) {
            report.broken(format!("{name}: attempt {attempt} of {uid} began {times} times"));
        }
    }
}
