use std::collections::BTreeSet;

use muster_api::kind::access::{AccessSpec, Subject, SubjectKind};

use super::*;

fn grant(role: Role, namespace: Option<&str>) -> Grant {
    Grant { role, namespace: namespace.map(str::to_owned), host_access: false }
}

fn action<'a>(verb: Verb, what: &'a str, namespace: Option<&'a str>) -> Action<'a> {
    let (resource, subresource) = match what.split_once('/') {
        Some((resource, subresource)) => (resource, Some(subresource)),
        None => (what, None),
    };
    Action { verb, group: "muster.dev", resource, subresource, namespace, name: Some("x") }
}

fn may(held: &[Grant], verb: Verb, what: &str, namespace: Option<&str>) -> bool {
    let asked = Asked::Right(action(verb, what, namespace));
    decide(&Who::User(held.to_vec()), &asked).is_ok()
}

#[test]
fn no_row_is_hidden_by_another() {
    let names: BTreeSet<&str> = table::TABLE.iter().map(|row| row.what).collect();
    assert_eq!(names.len(), table::TABLE.len());
}

#[test]
fn each_role_may_what_the_one_below_it_may() {
    let ladder = [Role::Viewer, Role::Developer, Role::Operator, Role::Admin];
    for row in table::TABLE {
        for verb in Verb::ALL {
            for pair in ladder.windows(2) {
                let below = row.allows(pair[0], verb);
                assert!(!below || row.allows(pair[1], verb), "{} {verb:?} {pair:?}", row.what);
            }
        }
    }
}

#[test]
fn a_role_in_a_namespace_ends_at_its_border() {
    let lab = [grant(Role::Admin, Some("lab"))];
    for row in table::TABLE {
        for verb in Verb::ALL {
            let here = may(&lab, verb, row.what, Some("lab"));
            let there = may(&lab, verb, row.what, Some("hall"));
            let everywhere = may(&lab, verb, row.what, None);
            let shared = row.reach(verb) == Reach::Anywhere;
            assert!(shared || !there && !everywhere, "{} {verb:?}", row.what);
            assert!(here || row.reach(verb) == Reach::Cluster || !row.allows(Role::Admin, verb));
        }
    }
    assert!(!may(&lab, Verb::Create, "quotas", Some("lab")), "nobody raises their own quota");
    assert!(!may(&lab, Verb::Create, "accesses", None), "nor gives themselves a role");
    assert!(may(&lab, Verb::Get, "nodes", None), "robots are everybody's to look at");
    assert!(!may(&lab, Verb::Patch, "nodes", None));
}

#[test]
fn what_no_row_names_is_for_admins_of_the_cluster() {
    for role in Role::ALL {
        let is_admin = role == Role::Admin;
        assert_eq!(may(&[grant(role, None)], Verb::Get, "things", None), is_admin, "{role}");
        assert!(!may(&[grant(role, Some("lab"))], Verb::Get, "things", Some("lab")), "{role}");
    }
}

#[test]
fn an_agent_speaks_for_its_node_alone() {
    let who = Who::Node("r1".to_owned());
    let asks = |verb, what, name| {
        let action = Action { name: Some(name), ..action(verb, what, None) };
        decide(&who, &Asked::Right(action)).is_ok()
    };
    assert!(asks(Verb::Get, "nodes", "r1") && asks(Verb::Get, "nodes/pose", "r1"));
    assert!(asks(Verb::Create, "nodes/session", "r1"));
    for row in table::TABLE {
        for verb in Verb::ALL {
            assert!(!asks(verb, row.what, "r2"), "{} {verb:?}", row.what);
            let own = (verb, row.what);
            let read = matches!(own, (Verb::Get, "nodes" | "nodes/pose"));
            assert_eq!(asks(verb, row.what, "r1"), read, "{own:?}");
        }
    }
    assert!(!asks(Verb::Create, "nodes/session", "r2"));
}

#[test]
fn nobody_may_what_is_open_and_no_more() {
    assert!(decide(&Who::Nobody, &Asked::Open).is_ok());
    assert_eq!(decide(&Who::Nobody, &Asked::Known), Err(Denied::WhoAreYou));
    let get = Asked::Right(action(Verb::Get, "tasks", Some("default")));
    assert_eq!(decide(&Who::Nobody, &get), Err(Denied::WhoAreYou));
    assert!(decide(&Who::User(Vec::new()), &Asked::Known).is_ok());
}

#[test]
fn a_refusal_says_what_the_user_is_and_which_role_may() {
    let told = |held: &[Grant], verb, what, namespace| {
        let asked = Asked::Right(action(verb, what, namespace));
        decide(&Who::User(held.to_vec()), &asked).unwrap_err().to_string()
    };
    let viewer = grant(Role::Viewer, Some("lab"));
    assert_eq!(
        told(&[], Verb::Get, "tasks", Some("lab")),
        "no Access object gives the user a role; viewer in the namespace \"lab\" may"
    );
    assert_eq!(
        told(std::slice::from_ref(&viewer), Verb::Create, "tasks", Some("hall")),
        "the user is viewer in the namespace \"lab\"; developer in the namespace \"hall\" may"
    );
    assert_eq!(
        told(&[grant(Role::Operator, None), viewer], Verb::Create, "accesses", None),
        "the user is operator of the whole cluster and viewer in the namespace \"lab\"; admin of the whole cluster may"
    );
    assert_eq!(
        told(&[], Verb::Create, "frameworks/session", Some("lab")),
        "no Access object gives the user a role; framework in the namespace \"lab\" may"
    );
}

#[test]
fn rights_add_up_by_name_and_by_group() {
    let subject = |kind, name: &str| Subject { kind, name: name.to_owned() };
    let spec = |role, namespaces: Option<&[&str]>, subject| AccessSpec {
        host_access: false,
        role,
        namespaces: namespaces.map(|all| all.iter().map(|&name| name.to_owned()).collect()),
        subjects: vec![subject],
    };
    let objects = [
        spec(Role::Developer, Some(&["lab", "hall"]), subject(SubjectKind::User, "ada")),
        spec(Role::Operator, None, subject(SubjectKind::Group, "shift")),
        spec(Role::Viewer, None, subject(SubjectKind::Group, "system:authenticated")),
        spec(Role::Developer, Some(&["lab"]), subject(SubjectKind::User, "ada")),
        // A user and a group of one name are two.
        spec(Role::Admin, None, subject(SubjectKind::Group, "ada")),
    ];
    let grants = Grants::of(&objects);
    let everybody = grant(Role::Viewer, None);
    let ada = [
        grant(Role::Developer, Some("hall")),
        grant(Role::Developer, Some("lab")),
        everybody.clone(),
    ];
    assert_eq!(grants.held_by("ada", &[]), ada);
    assert_eq!(grants.held_by("bob", &[]), std::slice::from_ref(&everybody));
    let shift = ["shift".to_owned()];
    assert_eq!(grants.held_by("bob", &shift), [grant(Role::Operator, None), everybody]);
}

#[test]
fn the_rules_that_are_told_are_those_that_count() {
    let who = Who::User(vec![grant(Role::Developer, Some("lab")), grant(Role::Viewer, None)]);
    for namespace in ["lab", "hall"] {
        let told = rules(&who, namespace);
        for row in table::TABLE {
            let rule = told.iter().find(|rule| rule.resource == row.what);
            let verbs = rule.and_then(|rule| rule.verbs.clone()).unwrap_or_default();
            for verb in Verb::ALL {
                let asked = Asked::Right(action(verb, row.what, Some(namespace)));
                let allowed = decide(&who, &asked).is_ok();
                assert_eq!(allowed, verbs.contains(&verb), "{} {verb:?} {namespace}", row.what);
            }
        }
    }
    let all = rules(&Who::User(vec![grant(Role::Admin, None)]), "lab");
    assert_eq!(all, [Rule { resource: "*", name: None, verbs: None }]);
}
