use std::time::Duration;

use jiff::{SignedDuration, Timestamp};

use super::model::Model;
use super::reason::{Obstacle, Stand, Violation};
use super::view::{ConnectionView, LinkView, PartView, ScaleView, SignalView, Snapshot};
use super::{Plan, plan};
use crate::simulation::tests::corridor;
use crate::simulation::world::roomy;

/// AnyScale's application and a world for it.
struct Bed {
    model: Model,
    scales: Vec<ScaleView>,
    parts: Vec<PartView>,
    connections: Vec<ConnectionView>,
    signals: Vec<SignalView>,
}

fn at(seconds: f64) -> Timestamp {
    Timestamp::UNIX_EPOCH + SignedDuration::from_secs_f64(seconds)
}

impl Bed {
    fn new() -> Self {
        let model = corridor();
        let part = PartView { active: true, ..PartView::default() };
        Bed {
            scales: vec![roomy("youbot", 1.0, at(0.0)), roomy("laptop", 3.5, at(0.0))],
            parts: vec![part; model.parts.len()],
            connections: vec![ConnectionView::default(); model.connections.len()],
            signals: vec![SignalView::default(); model.signals.len()],
            model,
        }
    }

    fn part(&self, name: &str) -> usize {
        self.model.parts.iter().position(|p| p.name == name).expect("a part")
    }

    fn away(mut self, names: &[&str]) -> Self {
        for name in names {
            let part = self.part(name);
            self.parts[part].scale = 1;
        }
        self
    }

    fn plan(&self, now: f64) -> Plan {
        let snapshot = Snapshot {
            model: &self.model,
            scales: &self.scales,
            parts: &self.parts,
            connections: &self.connections,
            signals: &self.signals,
        };
        plan(&snapshot, at(now))
    }

    /// The names of the parts that move, with where and whether they must.
    fn moves(&self, now: f64) -> Vec<(&str, usize, bool)> {
        let actions = self.plan(now).actions;
        actions
            .iter()
            .map(|a| (self.model.parts[a.part].name.as_str(), a.to, a.forced.is_some()))
            .collect()
    }

    fn link(&mut self, up: bool, since: f64) {
        let bandwidth = self.scales[1].link.bandwidth;
        self.scales[1].link = LinkView { up, since: at(since), bandwidth, latency: 0.002 };
    }
}

#[test]
fn tables_1_and_2_of_anyscale_leave_amcl_and_ar_to_move_and_amcl_goes_first() {
    let bed = Bed::new();
    let movable: Vec<&str> =
        bed.model.migratable().map(|i| bed.model.parts[i].name.as_str()).collect();
    assert_eq!(movable, ["amcl", "ar"]);
    let pins = |name: &str| -> Vec<&str> {
        bed.model.parts[bed.part(name)].pins.iter().map(|p| p.reason()).collect()
    };
    assert_eq!(pins("camera"), ["Sensor"]);
    assert_eq!(pins("laser"), ["Sensor", "NoTolerance"]);
    assert_eq!(pins("navigation"), ["Actuator", "NoTolerance", "NoTolerance"]);
    assert_eq!(pins("ekf"), ["NoTolerance", "NoTolerance"]);
    assert_eq!(pins("odometry"), ["NoTolerance", "NoTolerance"]);
    assert_eq!((pins("user"), pins("map-server")), (vec!["Once"], vec!["Once"]));
    let (cpu, traffic) = (
        |name| bed.model.parts[bed.part(name)].home_cpu(),
        |name: &str| {
            let part = bed.part(name);
            let of = bed.model.connections.iter().filter(|c| c.from == part || c.to == part);
            of.map(|c| c.bandwidth).sum::<f64>()
        },
    );
    assert_eq!((cpu("amcl"), cpu("ar")), (0.5, 0.33));
    assert_eq!((traffic("amcl"), traffic("ar")), (200e3, 6e6));
    assert_eq!(bed.moves(1.0), [("amcl", 1, false), ("ar", 1, false)]);
    // 2^10 mappings, of which four are left.
    assert_eq!(bed.model.mappings(2), (1024.0, 4.0));
}

#[test]
fn a_narrow_link_takes_amcl_only_and_says_what_ar_would_need() {
    let mut bed = Bed::new();
    bed.scales[0].link.bandwidth = 2e6;
    let plan = bed.plan(1.0);
    assert_eq!(bed.moves(1.0), [("amcl", 1, false)]);
    let ar = &plan.parts[bed.part("ar")];
    assert_eq!(ar.stand, Stand::AtHome);
    assert_eq!(
        ar.elsewhere[0].obstacle.to_string(),
        "the link of youbot has 2Mbit/s for the application and 6200kbit/s would be needed: 4200kbit/s more would let it \
         move"
    );
    // When it gets narrow while both are away, the one that is worth less comes home.
    let mut bed = bed.away(&["amcl", "ar"]);
    assert_eq!(bed.moves(1.0), [("ar", 0, true)]);
    bed.scales[0].link.bandwidth = 100e3;
    assert_eq!(bed.moves(1.0), [("ar", 0, true), ("amcl", 0, true)]);
}

#[test]
fn a_dead_link_is_tolerated_until_a_part_must_be_on_its_way_home() {
    let mut bed = Bed::new().away(&["amcl", "ar"]);
    bed.link(false, 10.0);
    // ar tolerates 1 s, amcl 2 s; home takes 0.5 s.
    assert_eq!(bed.moves(10.4), []);
    assert_eq!(bed.plan(10.4).look_again, at(10.5));
    assert_eq!(bed.moves(10.5), [("ar", 0, true)]);
    let bed = {
        let ar = bed.part("ar");
        bed.parts[ar].scale = 0;
        bed
    };
    assert_eq!(bed.moves(11.4), []);
    assert_eq!(bed.moves(11.5), [("amcl", 0, true)]);
    let Stand::Returns(Violation::Frequency { link: Some(link), .. }) =
        &bed.plan(11.5).parts[bed.part("amcl")].stand
    else {
        panic!("it returns for its frequency")
    };
    assert_eq!(link, "laptop");
}

#[test]
fn a_part_that_is_idle_misses_no_messages() {
    let mut bed = Bed::new().away(&["ar"]);
    let ar = bed.part("ar");
    bed.parts[ar].active = false;
    bed.link(false, 10.0);
    assert_eq!(bed.moves(60.0), []);
}

#[test]
fn a_connection_that_is_too_slow_over_a_link_that_is_up_brings_its_part_home() {
    let mut bed = Bed::new().away(&["amcl", "ar"]);
    let image = bed.model.connections.iter().position(|c| c.topic == "/camera/image");
    bed.connections[image.expect("a connection")].below_since = Some(at(5.0));
    assert_eq!(bed.moves(5.4), []);
    assert_eq!(bed.moves(5.5), [("ar", 0, true)]);
}

#[test]
fn a_signal_outside_its_limits_brings_its_parts_home() {
    let mut bed = Bed::new().away(&["amcl", "ar"]);
    bed.signals[0].outside_since = Some(at(5.0));
    assert_eq!(bed.moves(6.4), []);
    assert_eq!(bed.moves(6.5), [("amcl", 0, true)]);
    let said = bed.plan(6.5).parts[bed.part("amcl")].stand.to_string();
    assert_eq!(said, "comes home: the signal angular-velocity is not at most 4 deg/s");
    // At home nothing can be done about it.
    let mut bed = Bed::new();
    bed.signals[0].outside_since = Some(at(5.0));
    assert!(bed.moves(60.0).iter().all(|(_, _, forced)| !forced));
}

#[test]
fn what_was_moved_stays_for_the_cool_down_and_says_until_when() {
    let mut bed = Bed::new();
    let amcl = bed.part("amcl");
    bed.parts[amcl].moved_at = Some(at(100.0));
    assert_eq!(bed.moves(109.9), [("ar", 1, false)]);
    assert_eq!(bed.plan(109.9).parts[amcl].stand, Stand::CoolsDown { until: at(110.0) });
    assert_eq!(bed.moves(110.0), [("amcl", 1, false), ("ar", 1, false)]);
}

#[test]
fn noise_in_what_scales_are_worth_moves_nothing() {
    let mut bed = Bed::new();
    bed.scales[1].gain = 1.04;
    assert_eq!(bed.moves(1.0), []);
    let obstacle = &bed.plan(1.0).parts[bed.part("amcl")].elsewhere[0].obstacle;
    assert_eq!(obstacle.reason(), Obstacle::TooLittle { least: 0.0 }.reason());
    bed.scales[1].gain = 1.06;
    assert_eq!(bed.moves(1.0).len(), 2);
    let mut bed = bed.away(&["amcl", "ar"]);
    bed.scales[1].gain = 0.96;
    assert_eq!(bed.moves(1.0), []);
}

#[test]
fn a_scale_that_is_full_takes_what_is_worth_most_and_an_unfit_one_loses_all() {
    let mut bed = Bed::new();
    bed.scales[1].cpu = 0.6;
    assert_eq!(bed.moves(1.0), [("amcl", 1, false)]);
    let mut bed = Bed::new().away(&["amcl", "ar"]);
    bed.scales[1].unfit = Some("it is cordoned".into());
    assert_eq!(bed.moves(1.0), [("ar", 0, true), ("amcl", 0, true)]);
}

#[test]
fn the_policies_greedy_and_home_do_what_they_say() {
    let mut bed = Bed::new();
    bed.model.policy = muster_api::kind::application::Policy::Greedy;
    // One part a look, and the hungriest.
    assert_eq!(bed.moves(1.0), [("amcl", 1, false)]);
    let mut bed = bed.away(&["amcl"]);
    assert_eq!(bed.moves(1.0), [("ar", 1, false)]);
    bed.model.policy = muster_api::kind::application::Policy::Home;
    assert_eq!(bed.moves(1.0), [("amcl", 0, false)]);
}

#[test]
fn a_robot_is_told_beforehand_what_to_do_alone() {
    let bed = Bed::new().away(&["amcl", "ar"]);
    let fallback = bed.plan(1.0).fallback;
    let of = |name: &str| fallback.iter().find(|f| f.part == bed.part(name)).map(|f| f.after);
    assert_eq!(of("amcl"), Some(Duration::from_millis(1500)));
    assert_eq!(of("ar"), Some(Duration::from_millis(500)));
}

#[test]
fn what_costs_latency_or_energy_weighs_against_cpu() {
    let mut bed = Bed::new();
    bed.model.objective.latency = 1000.0;
    assert_eq!(bed.moves(1.0), []);
    let mut bed = Bed::new();
    bed.scales[1].gain = 1.0;
    assert_eq!(bed.moves(1.0), []);
    bed.model.objective.energy = 1.0;
    assert_eq!(bed.moves(1.0).len(), 2);
}
