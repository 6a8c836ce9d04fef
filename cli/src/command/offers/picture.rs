//! What is shown of frameworks and their offers, and what of it is a change.

use std::collections::BTreeMap;
use std::time::Duration;

use jiff::Timestamp;
use muster_api::kind::framework::Framework;
use muster_api::kind::task::{Cost, NodeRefusal};

use super::{Offer, View};
use crate::output::columns::framework::share;
use crate::output::columns::task::{refusals, score};
use crate::output::human;
use crate::output::style::{Mood, Styles};
use crate::output::table::{Cell, Table};

/// How it stands with a framework.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Standing {
    Connected,
    /// Connected, and wants no offers.
    Suppressed,
    /// No session; what it left behind stays for the rest of its failover timeout.
    Away {
        left: Option<String>,
    },
}

/// A framework and what is known of it.
#[derive(Debug)]
pub(super) struct Guest {
    pub(super) namespace: String,
    pub(super) name: String,
    standing: Standing,
    share: f64,
    /// What scores mean.
    cost: Cost,
    offers: Vec<Offer>,
    /// Why it has no offers, by node.
    pub(super) why: Vec<NodeRefusal>,
}

impl Guest {
    /// `view`: none when the scheduler has not heard of it since it began.
    pub(super) fn new(object: &Framework, view: Option<View>, now: Timestamp) -> Self {
        let text = |t: &Option<String>| t.clone().unwrap_or_default();
        let status = object.status.clone().unwrap_or_default();
        let timeout = object.spec.failover_timeout.0.as_duration();
        let left = status.disconnected_at.map(|t| human::left(timeout, t.0, now));
        let standing = match &view {
            Some(v) if v.connected && v.suppressed => Standing::Suppressed,
            Some(v) if v.connected => Standing::Connected,
            _ => Standing::Away { left },
        };
        let (share, offers) = view.map_or((status.share, Vec::new()), |v| (v.share, v.offers));
        Guest {
            namespace: text(&object.metadata.namespace),
            name: text(&object.metadata.name),
            standing,
            share,
            cost: object.spec.cost,
            offers,
            why: Vec::new(),
        }
    }

    /// It could have offers and has none.
    pub(super) fn wants_reasons(&self) -> bool {
        self.standing == Standing::Connected && self.offers.is_empty()
    }

    fn key(&self) -> (&str, &str) {
        (&self.namespace, &self.name)
    }

    fn word(&self) -> (&'static str, Mood) {
        match self.standing {
            Standing::Connected => ("connected", Mood::Good),
            Standing::Suppressed => ("suppressed", Mood::Warn),
            Standing::Away { .. } => ("away", Mood::Bad),
        }
    }

    /// Why it has no offers.
    fn reason(&self) -> String {
        match &self.standing {
            Standing::Suppressed => "it wants none until it calls Revive".to_owned(),
            Standing::Away { left: Some(left) } => {
                format!("it is away; its tasks are ended in {left} if it does not come back")
            }
            Standing::Away { left: None } => "it is away".to_owned(),
            Standing::Connected if self.why.is_empty() => "there is no node to offer".to_owned(),
            Standing::Connected => format!("no node fits: {}", refusals(&self.why)),
        }
    }

    fn scored(&self, offer: &Offer) -> Option<String> {
        offer.score.map(|s| score(s, self.cost))
    }

    /// What of an offer is worth a line when it changes.
    fn facts(&self, offer: &Offer) -> String {
        let cpu = format!("cpu {}", human::cores(offer.free.cpu));
        let memory = format!("memory {}", human::bytes(offer.free.memory));
        let actuators = offer.actuators.then(|| "AR free".to_owned());
        let all: Vec<String> =
            self.scored(offer).into_iter().chain([cpu, memory]).chain(actuators).collect();
        all.join(", ")
    }

    fn offered(&self) -> BTreeMap<&str, String> {
        self.offers.iter().map(|o| (o.node.as_str(), self.facts(o))).collect()
    }
}

/// All of them, each with its offers or the reason that it has none.
pub(super) fn text(guests: &[Guest], namespaces: bool, styles: &Styles) -> String {
    let mut text = String::new();
    for (i, guest) in guests.iter().enumerate() {
        if i > 0 {
            text.push('\n');
        }
        let name = human::plain(&guest.name);
        let place = if namespaces { format!(" in {}", guest.namespace) } else { String::new() };
        let (word, mood) = guest.word();
        let count = human::count(guest.offers.len(), "offer");
        text.push_str(&format!(
            "framework/{name}{place}: {}, share {}, {count}\n",
            styles.of(mood).paint(word),
            share(guest.share)
        ));
        match guest.offers.is_empty() {
            true => {
                let reason = guest.reason();
                text.push_str(&format!("{reason}; see `muster why framework/{name}`\n"));
            }
            false => text.push_str(&table(guest).text(styles)),
        }
    }
    text
}

fn table(guest: &Guest) -> Table {
    let mut table = Table::new(["NODE", "SCORE", "CPU", "MEMORY", "AR", "AGE", "SHARED-WITH"]);
    for offer in &guest.offers {
        let actuators =
            if offer.actuators { Cell::new("free", Mood::Good) } else { Cell::from("") };
        // Whole seconds, as ages have everywhere.
        let age = Duration::from_secs(offer.age_ms / 1000);
        table.push([
            Cell::from(&offer.node),
            guest.scored(offer).unwrap_or_default().into(),
            human::cores(offer.free.cpu).into(),
            human::bytes(offer.free.memory).into(),
            actuators,
            human::duration(age).into(),
            offer.shared_with.to_string().into(),
        ]);
    }
    table
}

/// What is another than before, a line each. Ages are none, and with whom a node is shared is the others' affair.
pub(super) fn changes(before: &[Guest], after: &[Guest]) -> Vec<String> {
    let mut lines = Vec::new();
    let title = |guest: &Guest| format!("framework/{}", human::plain(&guest.name));
    let same = |a: &Guest, b: &Guest| a.key() == b.key();
    for gone in before.iter().filter(|b| !after.iter().any(|a| same(a, b))) {
        lines.push(format!("{}: gone", title(gone)));
    }
    for now in after {
        let old = before.iter().find(|b| same(b, now));
        let title = title(now);
        if old.is_none_or(|o| o.word() != now.word()) {
            lines.push(format!("{title}: {}", now.word().0));
        }
        if old.is_none_or(|o| share(o.share) != share(now.share)) {
            lines.push(format!("{title}: share {}", share(now.share)));
        }
        let had = old.map(Guest::offered).unwrap_or_default();
        let has = now.offered();
        for node in had.keys().filter(|node| !has.contains_key(*node)) {
            lines.push(format!("{title}: - {node}"));
        }
        for (node, facts) in has.iter().filter(|(node, facts)| had.get(*node) != Some(*facts)) {
            lines.push(format!("{title}: + {node} ({facts})"));
        }
    }
    lines
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::fake::framework;

    fn guest(name: &str, connected: bool, suppressed: bool, share: f64) -> Guest {
        let object = serde_json::from_value(framework(name, json!({}))).expect("a framework");
        let view = View { connected, suppressed, share, offers: Vec::new() };
        Guest::new(&object, Some(view), Timestamp::UNIX_EPOCH)
    }

    #[test]
    fn standing_share_and_end_are_changes_and_a_hair_of_share_is_none() {
        let before = [guest("a", true, false, 0.25), guest("b", true, false, 0.0)];
        let after = [guest("a", true, true, 0.251), guest("c", false, false, 0.5)];
        assert_eq!(changes(&before, &before), [""; 0]);
        assert_eq!(
            changes(&before, &after),
            [
                "framework/b: gone",
                "framework/a: suppressed",
                "framework/c: away",
                "framework/c: share 0.50"
            ]
        );
    }

    #[test]
    fn one_without_offers_says_why_in_a_line() {
        let mut lost = framework("lost", json!({"disconnectedAt": "1970-01-01T00:00:00Z"}));
        lost["spec"]["failoverTimeout"] = json!("60s");
        let lost = serde_json::from_value(lost).expect("a framework");
        let now = Timestamp::from_second(12).expect("in range");
        let guests = [guest("mute", true, true, 0.0), Guest::new(&lost, None, now)];
        assert_eq!(
            text(&guests, false, &Styles::default()),
            "framework/mute: suppressed, share 0.00, 0 offers\n\
             it wants none until it calls Revive; see `muster why framework/mute`\n\
             \n\
             framework/lost: away, share 0.00, 0 offers\n\
             it is away; its tasks are ended in 48s if it does not come back; see `muster why framework/lost`\n"
        );
    }
}
