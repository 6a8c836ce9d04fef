use proptest::prelude::*;

use super::*;

const EVERY_SECOND: Timing =
    Timing { initial_delay_ms: 0, period_ms: 1_000, success_threshold: 1, failure_threshold: 3 };

fn prober(probes: Probes) -> Prober {
    Prober::new(&probes, &Verdicts::default(), Boot(0))
}

/// Asks once at each period, and answers with `+`, `-` or `?`: what came of it, one letter a check.
/// `S` started, `R` ready, `N` not ready, `F` failed, `.` nothing.
fn play(prober: &mut Prober, role: Role, answers: &str) -> String {
    let mut at = prober.next().unwrap_or_default();
    let mut told = String::new();
    for answer in answers.chars() {
        if !prober.due(at).contains(&role) {
            told.push(' ');
            continue;
        }
        let answer = match answer {
            '+' => Answer::Success,
            '-' => Answer::Failure("no".to_owned()),
            _ => Answer::Unknown("cannot".to_owned()),
        };
        told.push(match prober.answer(role, answer) {
            None => '.',
            Some(Verdict::Started) => 'S',
            Some(Verdict::Ready) => 'R',
            Some(Verdict::NotReady { .. }) => 'N',
            Some(Verdict::Failed { .. }) => 'F',
        });
        at = at.plus(EVERY_SECOND.period_ms);
    }
    told
}

/// kubelet's worker: the state changes when as many answers of one kind have come in a row as the threshold says; an
/// error of the probe itself is thrown away; after a failure that ends the container nothing is asked.
#[test]
fn thresholds_are_those_of_kubernetes() {
    let table = [
        // Readiness begins as a failure; why is told at the first one, once.
        (Role::Readiness, 1, 3, "+", "R"),
        (Role::Readiness, 1, 3, "---+", "N..R"),
        (Role::Readiness, 2, 3, "+-++", ".N.R"),
        (Role::Readiness, 3, 1, "++-+++-", "..N..RN"),
        (Role::Readiness, 1, 3, "+--+---+", "R.....NR"),
        (Role::Readiness, 1, 3, "+--?-", "R...N"),
        (Role::Readiness, 1, 3, "??+", "N.R"),
        // Liveness begins as a success.
        (Role::Liveness, 1, 3, "--+---", ".....F"),
        (Role::Liveness, 1, 1, "+-", ".F"),
        (Role::Liveness, 1, 3, "--?-+", "...F "),
        (Role::Liveness, 1, 2, "????", "...."),
        // Start-up succeeds once, and is not asked again.
        (Role::Startup, 1, 3, "--++", "N.S "),
        (Role::Startup, 1, 3, "---+", "N.F "),
        (Role::Startup, 1, 2, "-?-", "N.F"),
    ];
    for (role, success_threshold, failure_threshold, answers, expected) in table {
        let timing = Timing { success_threshold, failure_threshold, ..EVERY_SECOND };
        let mut probes = Probes::default();
        match role {
            Role::Startup => probes.startup = Some(timing),
            Role::Readiness => probes.readiness = Some(timing),
            Role::Liveness => probes.liveness = Some(timing),
        }
        let told = play(&mut prober(probes), role, answers);
        assert_eq!(told, expected, "{role}, {success_threshold}/{failure_threshold}: {answers}");
    }
}

#[test]
fn start_up_holds_the_others_back_and_they_wait_for_their_own_delay() {
    let later = Timing { initial_delay_ms: 5_000, ..EVERY_SECOND };
    let mut prober = prober(Probes {
        startup: Some(EVERY_SECOND),
        readiness: Some(EVERY_SECOND),
        liveness: Some(later),
    });
    assert_eq!(prober.due(Boot(0)), [Role::Startup]);
    assert_eq!((prober.due(Boot(9_000)), prober.next()), (vec![], None), "one at a time");
    assert_eq!(prober.answer(Role::Startup, Answer::Success), Some(Verdict::Started));
    assert_eq!(prober.next(), Some(Boot(0)), "at once");
    assert_eq!(prober.due(Boot(2_000)), [Role::Readiness]);
    assert_eq!(prober.next(), Some(Boot(5_000)));
    assert_eq!(prober.due(Boot(5_000)), [Role::Liveness], "readiness is still under way");
    assert_eq!(prober.answer(Role::Readiness, Answer::Success), Some(Verdict::Ready));
    assert_eq!(prober.due(Boot(5_000)), [Role::Readiness], "its period has passed");
}

#[test]
fn another_life_of_the_agent_goes_on_from_what_was_found() {
    let probes = Probes {
        startup: Some(EVERY_SECOND),
        readiness: Some(EVERY_SECOND),
        liveness: Some(EVERY_SECOND),
    };
    let verdicts = Verdicts { started: true, ready: true, why: String::new() };
    let mut prober = Prober::new(&probes, &verdicts, Boot(0));
    assert_eq!(prober.due(Boot(60_000)), [Role::Readiness, Role::Liveness]);
    assert_eq!(prober.answer(Role::Readiness, Answer::Success), None, "it was ready");
    assert_eq!(play(&mut prober, Role::Readiness, "---"), "..N", "three in a row, as ever");
}

#[test]
fn verdicts_say_what_is_missing() {
    let probes =
        Probes { startup: Some(EVERY_SECOND), readiness: Some(EVERY_SECOND), liveness: None };
    let mut verdicts = Verdicts::default();
    assert_eq!(verdicts.missing(&probes), Some(Role::Startup));
    verdicts.take(&Verdict::NotReady { why: "no".to_owned() });
    verdicts.take(&Verdict::Started);
    assert_eq!((verdicts.missing(&probes), verdicts.why.as_str()), (Some(Role::Readiness), ""));
    verdicts.take(&Verdict::Ready);
    assert_eq!(verdicts.missing(&probes), None);
    let alive = Probes { liveness: Some(EVERY_SECOND), ..Probes::default() };
    assert!(!alive.tell_ready() && Verdicts::default().missing(&alive).is_none());
}

#[test]
fn words_are_shortened_between_characters() {
    assert_eq!(shorten(" a\n\tb\u{7}c "), "a b c");
    let long = shorten(&"ü".repeat(400));
    assert_eq!((long.chars().count(), long.ends_with("ü…")), (129, true));
}

fn timing() -> impl Strategy<Value = Option<Timing>> {
    let timing = (0..5_000_u64, 1..5_000_u64, 1..4_u32, 1..4_u32);
    prop::option::of(timing.prop_map(
        |(initial_delay_ms, period_ms, success_threshold, failure_threshold)| Timing {
            initial_delay_ms,
            period_ms,
            success_threshold,
            failure_threshold,
        },
    ))
}

fn answers() -> impl Strategy<Value = Vec<(u64, u8, usize)>> {
    prop::collection::vec((1..3_000_u64, 0..3_u8, 0..3_usize), 1..80)
}

proptest! {
    /// Whatever the answers are and whenever they come: one check of a probe at a time, none too early or too often,
    /// none of the others before start-up, none after a failure; and the verdicts are what a plain count says.
    #[test]
    fn checks_are_asked_for_in_order(
        startup in timing(), readiness in timing(), liveness in timing(), steps in answers(),
    ) {
        let startup = startup.map(|t| Timing { success_threshold: 1, ..t });
        let liveness = liveness.map(|t| Timing { success_threshold: 1, ..t });
        let probes = Probes { startup, readiness, liveness };
        let mut prober = prober(probes);
        let mut verdicts = Verdicts::default();
        let mut under_way: Vec<Role> = Vec::new();
        let mut asked: Vec<(Role, u64)> = Vec::new();
        let mut rows: [(bool, u32); 3] = [(true, 0); 3];
        let (mut now, mut over) = (0, false);
        for (pass, answer, which) in steps {
            now += pass;
            let next = prober.next();
            let due = prober.due(Boot(now));
            prop_assert_eq!(!due.is_empty(), next.is_some_and(|at| at <= Boot(now)));
            for role in due {
                let timing = probes.of(role).expect("asked for what there is");
                prop_assert!(!over && !under_way.contains(&role) && now >= timing.initial_delay_ms);
                prop_assert_eq!(role == Role::Startup, startup.is_some() && !verdicts.started);
                let before = asked.iter().rev().find(|(r, _)| *r == role);
                prop_assert!(before.is_none_or(|(_, at)| now - at >= timing.period_ms));
                asked.push((role, now));
                under_way.push(role);
            }
            if under_way.is_empty() {
                continue;
            }
            let role = under_way.remove(which % under_way.len());
            let row = &mut rows[role as usize];
            let answer = match answer {
                0 => Answer::Success,
                1 => Answer::Failure("no".to_owned()),
                _ => Answer::Unknown("cannot".to_owned()),
            };
            if let Answer::Success | Answer::Failure(_) = answer {
                let success = answer == Answer::Success;
                *row = if row.0 == success { (success, row.1 + 1) } else { (success, 1) };
            }
            let (row, counted) = (*row, !matches!(answer, Answer::Unknown(_)));
            let timing = probes.of(role).expect("asked for");
            let ready = verdicts.ready;
            let verdict = prober.answer(role, answer);
            if let Some(verdict) = &verdict {
                verdicts.take(verdict);
            }
            match role {
                _ if over => prop_assert_eq!(&verdict, &None, "nothing counts after the end"),
                Role::Liveness | Role::Startup => {
                    let failed = counted && !row.0 && row.1 >= timing.failure_threshold;
                    prop_assert_eq!(matches!(verdict, Some(Verdict::Failed { .. })), failed);
                    let started = role == Role::Startup && counted && row.0;
                    prop_assert_eq!(verdict == Some(Verdict::Started), started);
                    over |= failed;
                }
                Role::Readiness => {
                    let enough = |n| counted && row.1 >= n;
                    let now_ready = if row.0 && enough(timing.success_threshold) {
                        true
                    } else {
                        ready && (row.0 || !enough(timing.failure_threshold))
                    };
                    prop_assert_eq!(verdicts.ready, now_ready);
                }
            }
        }
    }

    #[test]
    fn what_was_said_stays_short(said in "\\PC{0,400}") {
        prop_assert!(shorten(&said).len() <= MAX_SAID + '…'.len_utf8());
    }
}
