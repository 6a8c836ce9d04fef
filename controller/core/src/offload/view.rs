//! What is so now, as a decision sees it (AnyScale III-B2, the dynamic parameters).

use jiff::Timestamp;

use super::model::Model;

/// Everything that one decision looks at.
#[derive(Debug, Clone)]
pub struct Snapshot<'a> {
    /// The application.
    pub model: &'a Model,
    /// The scales; the first is home.
    pub scales: &'a [ScaleView],
    /// By part.
    pub parts: &'a [PartView],
    /// By connection.
    pub connections: &'a [ConnectionView],
    /// By signal.
    pub signals: &'a [SignalView],
}

/// A scale.
#[derive(Debug, Clone, PartialEq)]
pub struct ScaleView {
    /// The node's name.
    pub name: String,
    /// α: what a core there is worth, when one at home is worth 1.
    pub gain: f64,
    /// Cores that the application may use: what is free, and what it uses there itself.
    pub cpu: f64,
    /// Bytes, likewise.
    pub memory: f64,
    /// Why nothing can run there; none: it can.
    pub unfit: Option<String>,
    /// Its link to the network; home's is its radio.
    pub link: LinkView,
}

/// A link.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinkView {
    /// It carries something.
    pub up: bool,
    /// Since when it does, or does not.
    pub since: Timestamp,
    /// What it carries of the application, bits a second.
    pub bandwidth: f64,
    /// Seconds, one way.
    pub latency: f64,
}

/// A part.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PartView {
    /// Where it serves, an index into the scales.
    pub scale: usize,
    /// It is being moved: nothing else is begun with it.
    pub moving: bool,
    /// When it was moved last.
    pub moved_at: Option<Timestamp>,
    /// It runs now; of a part that runs sometimes, nothing is expected while it does not.
    pub active: bool,
    /// Measured mean use of cpu, cores by scale; none: not known.
    pub learned: Vec<Option<f64>>,
    /// By scale, why this part cannot run there, whatever else does; none, or no entry: it can.
    pub barred: Vec<Option<String>>,
}

/// A connection.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ConnectionView {
    /// Since when the observed frequency is below the threshold.
    pub below_since: Option<Timestamp>,
}

/// A signal.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct SignalView {
    /// Since when it is outside its limits.
    pub outside_since: Option<Timestamp>,
}

impl Snapshot<'_> {
    /// Cores that a part uses on a scale: declared for it, or measured there, or declared or measured at home, or reserved.
    #[must_use]
    pub fn cpu(&self, part: usize, scale: usize) -> f64 {
        let (model, view) = (&self.model.parts[part], &self.parts[part]);
        let learned = |k: usize| view.learned.get(k).copied().flatten();
        let declared = match scale {
            super::problem::HOME => model.cpu,
            _ => model.cpu_on.get(&self.scales[scale].name).copied(),
        };
        let here = declared.or_else(|| learned(scale));
        here.or(model.cpu).or_else(|| learned(super::problem::HOME)).unwrap_or(model.quota)
    }

    /// Why a part cannot run on a scale whatever happens.
    #[must_use]
    pub fn bar(&self, part: usize, scale: usize) -> Option<&str> {
        self.parts[part].barred.get(scale).and_then(Option::as_deref)
    }

    /// A connection's ends are on different scales, and something is expected on it.
    #[must_use]
    pub fn is_apart(&self, connection: usize) -> bool {
        let c = &self.model.connections[connection];
        let (from, to) = (&self.parts[c.from], &self.parts[c.to]);
        from.scale != to.scale && from.active && to.active
    }
}
