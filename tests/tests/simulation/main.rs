//! The simulation at a size for every day; `tests/run` does more steps.

#![allow(clippy::unwrap_used, clippy::allow_attributes, reason = "tests")]

use std::process::Command;

/// Runs it; gives whether no invariant was broken, and what it said.
fn simulate(args: &[&str]) -> (bool, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_simulate")).args(args).output().unwrap();
    (output.status.success(), String::from_utf8(output.stdout).unwrap())
}

#[test]
fn nothing_is_broken_by_some_thousand_steps_with_faults() {
    let (well, said) = simulate(&["--seed", "1", "--steps", "4000", "--run", "400"]);
    assert!(well, "{said}");
    assert!(said.contains("10 runs, 4000 steps") && said.contains("0 violations"), "{said}");
}

#[test]
fn a_seed_is_a_run() {
    let run = |seed| simulate(&["--seed", seed, "--steps", "150", "--log"]).1;
    let first = run("7");
    assert!(first.lines().count() > 150, "{first}");
    assert_eq!(first, run("7"));
    assert_ne!(first, run("8"));
}

/// Plants a fault, and looks that it breaks one of these invariants, in one of some runs.
fn is_found(mutation: &str, invariants: &[&str]) {
    is_found_within("2400", mutation, invariants);
}

fn is_found_within(steps: &str, mutation: &str, invariants: &[&str]) {
    let args =
        ["--seed", "1", "--steps", steps, "--run", "300", "--no-shrink", "--mutate", mutation];
    let (well, said) = simulate(&args);
    assert!(!well, "{mutation} is not found: {said}");
    let broken = said.lines().find_map(|line| line.split_once(" is broken by seed "));
    let (broken, _) = broken.unwrap_or_else(|| panic!("{said}"));
    assert!(invariants.contains(&broken), "{mutation}: {said}");
}

#[test]
fn a_double_lease_is_found() {
    is_found("double-lease", &["one_driver"]);
}

#[test]
fn a_lost_write_is_found() {
    // Whoever runs a task that the store has lost is told to end it; an end that it has lost is told by nobody again.
    let shows = [
        "nothing_acknowledged_is_lost",
        "work_outlives_its_managers",
        "everything_ends_or_explains_itself",
    ];
    is_found("lost-write", &shows);
}

#[test]
fn a_double_run_is_found() {
    // A second run beside a first one breaks whatever is looked at first.
    let any = ["nothing_runs_twice", "no_oversubscription", "one_driver"];
    is_found("double-run", &any);
}

#[test]
fn a_leak_is_found() {
    is_found("leak", &["one_driver"]);
}

#[test]
fn cpu_that_is_not_there_is_found() {
    is_found("overcommit", &["no_oversubscription"]);
}

#[test]
fn an_end_that_is_never_told_is_found() {
    is_found("lost-end", &["everything_ends_or_explains_itself"]);
}

#[test]
fn a_task_that_never_ends_is_found() {
    is_found("deaf-to-stops", &["everything_ends_or_explains_itself"]);
}

#[test]
fn a_framework_that_is_given_up_too_soon_is_found() {
    is_found("hasty-failover", &["work_outlives_its_managers"]);
}

#[test]
fn an_end_that_no_framework_heard_of_is_found() {
    is_found("forged-ack", &["nothing_acknowledged_is_lost", "work_outlives_its_managers"]);
}

#[test]
fn an_offer_that_does_not_come_is_found() {
    is_found("lost-offer", &["everything_ends_or_explains_itself"]);
}

#[test]
fn a_person_who_was_told_too_soon_that_a_robot_is_theirs_is_found() {
    // The grant that the person has does not count at the gate, which shows at the latest when all is quiet.
    is_found("forged-hold", &["one_driver", "everything_ends_or_explains_itself"]);
}

#[test]
fn a_rollout_that_takes_too_much_down_is_found() {
    is_found_within("12000", "hasty-rollout", &["work_outlives_its_managers"]);
}

#[test]
fn a_part_that_a_robot_begins_too_soon_is_found() {
    is_found_within("12000", "hasty-standby", &["nothing_runs_twice"]);
}

#[test]
fn no_run_begins_when_the_time_is_over() {
    let (well, said) = simulate(&["--steps", "400", "--run", "10", "--within", "0"]);
    assert!(well && said.contains("0 runs, 0 steps"), "{said}");
}

#[test]
fn a_failure_is_made_short() {
    let (well, said) =
        simulate(&["--seed", "1", "--steps", "300", "--run", "300", "--mutate", "double-lease"]);
    assert!(!well, "{said}");
    let again = said.lines().find_map(|line| line.strip_prefix("again (")).unwrap();
    let steps: u32 = again.split(' ').next().unwrap().parse().unwrap();
    assert!(steps < 20, "{again}");
    let command = again.split_once("simulate ").unwrap().1;
    let (well, replayed) = simulate(&command.split(' ').collect::<Vec<_>>());
    assert!(!well && replayed.contains("one_driver is broken"), "{replayed}");
}
