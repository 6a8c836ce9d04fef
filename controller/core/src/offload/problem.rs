//! One decision as numbers: migratable parts, scales, what each mapping is worth and what it needs.
//!
//! Scale 0 is home. What is pinned there is not in it, but for its traffic with migratable parts. Every scale hangs on the
//! network by one link (home's is its radio): a connection whose ends are on different scales loads the links of both.
//!
//! Home's cpu and memory bind nothing here: they are held for every part at any time, so that everything can come home at
//! once ([`crate::offload::model::Model::home_need`]).

/// The index of home among scales.
pub const HOME: usize = 0;

/// Where each part is: an index into [`Problem::scales`] for each of [`Problem::items`].
pub type Mapping = Vec<usize>;

/// One decision.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Problem {
    /// The parts that may move.
    pub items: Vec<Item>,
    /// The scales; the first is home.
    pub scales: Vec<Capacity>,
    /// Connections between parts that may move.
    pub edges: Vec<Edge>,
}

/// A part that may move. Vectors are by scale.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Item {
    /// What it is worth there.
    pub value: Vec<f64>,
    /// Cores it uses there.
    pub cpu: Vec<f64>,
    /// It may be there at all.
    pub allowed: Vec<bool>,
    /// Memory, bytes; the same everywhere.
    pub memory: f64,
    /// What it exchanges with parts that stay at home, bits a second.
    pub traffic: f64,
}

/// What a scale can take of the application.
#[derive(Debug, Clone, PartialEq)]
pub struct Capacity {
    /// The paper's α; also the order of Algorithm 1.
    pub gain: f64,
    /// Cores.
    pub cpu: f64,
    /// Bytes.
    pub memory: f64,
    /// What its link carries, bits a second.
    pub bandwidth: f64,
    /// What a connection over its link costs.
    pub latency_cost: f64,
    /// What a bit a second over its link costs.
    pub traffic_cost: f64,
}

/// A connection between two parts that may move.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Edge {
    /// One end, an index into [`Problem::items`].
    pub a: usize,
    /// The other.
    pub b: usize,
    /// Bits a second.
    pub traffic: f64,
}

/// What a mapping needs, by scale.
#[derive(Debug, Clone, PartialEq)]
pub struct Load {
    /// Cores.
    pub cpu: Vec<f64>,
    /// Bytes.
    pub memory: Vec<f64>,
    /// Bits a second over the scale's link.
    pub link: Vec<f64>,
}

impl Capacity {
    /// A scale that takes everything, of this gain.
    #[must_use]
    pub fn unlimited(gain: f64) -> Self {
        Capacity {
            gain,
            cpu: f64::INFINITY,
            memory: f64::INFINITY,
            bandwidth: f64::INFINITY,
            latency_cost: 0.0,
            traffic_cost: 0.0,
        }
    }
}

impl Problem {
    /// Everything at home.
    #[must_use]
    pub fn all_home(&self) -> Mapping {
        vec![HOME; self.items.len()]
    }

    /// What a mapping needs, counted from nothing.
    #[must_use]
    pub fn load(&self, mapping: &[usize]) -> Load {
        let zero = vec![0.0; self.scales.len()];
        let mut load = Load { cpu: zero.clone(), memory: zero.clone(), link: zero };
        for (item, scale) in self.items.iter().zip(mapping) {
            load.cpu[*scale] += item.cpu[*scale];
            load.memory[*scale] += item.memory;
            if *scale != HOME {
                load.link[*scale] += item.traffic;
                load.link[HOME] += item.traffic;
            }
        }
        for edge in &self.edges {
            let (a, b) = (mapping[edge.a], mapping[edge.b]);
            if a != b {
                load.link[a] += edge.traffic;
                load.link[b] += edge.traffic;
            }
        }
        load
    }

    /// What a mapping is worth, counted from nothing.
    #[must_use]
    pub fn value(&self, mapping: &[usize]) -> f64 {
        let worth: f64 =
            self.items.iter().zip(mapping).map(|(item, scale)| item.value[*scale]).sum();
        let cost: f64 =
            self.edges.iter().map(|e| self.edge_cost(e.traffic, mapping[e.a], mapping[e.b])).sum();
        worth - cost
    }

    /// What a connection costs whose ends are on these scales.
    #[must_use]
    pub fn edge_cost(&self, traffic: f64, a: usize, b: usize) -> f64 {
        if a == b {
            return 0.0;
        }
        let end = |k: usize| self.scales[k].latency_cost + traffic * self.scales[k].traffic_cost;
        end(a) + end(b)
    }

    /// For each part the connections it is an end of: the other part and the traffic.
    #[must_use]
    pub fn neighbours(&self) -> Vec<Vec<(usize, f64)>> {
        let mut all = vec![Vec::new(); self.items.len()];
        for edge in &self.edges {
            all[edge.a].push((edge.b, edge.traffic));
            all[edge.b].push((edge.a, edge.traffic));
        }
        all
    }
}
