//! Random decisions of a size: a generalisation of AnyScale's test bed (V: 1 robot, K−1 remote scales, N nodes of which M
//! may migrate).
//!
//! The paper does not say how its cases were drawn. Here: a part uses 5 to 60 % of a core at home (the paper's two: 33 and
//! 50 %), a remote scale is worth 1.5 to 4 times home (3.5 there), a part uses 0.5 to 1 times as much cpu on a remote
//! scale, connections carry 20 kbit/s to 6 Mbit/s, log-uniform (0.2 and 6 there). Each part that may migrate exchanges
//! data with a part that stays, and with another that may migrate in a third of the cases.

use super::numbers::Numbers;
use crate::offload::problem::{Capacity, Edge, Item, Problem};

/// How much there is of what is needed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Supply {
    /// Everything fits nearly anywhere.
    Loose,
    /// The remote scales take 40 to 80 % of the parts' cpu, the radio as much of their traffic.
    Tight,
}

impl Supply {
    /// Both.
    pub const ALL: [Supply; 2] = [Supply::Loose, Supply::Tight];

    /// As a word.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Supply::Loose => "loose",
            Supply::Tight => "tight",
        }
    }
}

/// The size of a decision.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Size {
    /// The paper's N: all parts.
    pub parts: usize,
    /// The paper's M: those that may migrate.
    pub migratable: usize,
    /// The paper's K: scales, home among them.
    pub scales: usize,
}

const MBIT: f64 = 1e6;
const MIB: f64 = 1_048_576.0;

/// A decision of this size; the same seed gives the same.
#[must_use]
pub fn draw(size: Size, supply: Supply, seed: u64) -> Problem {
    let mut numbers = Numbers::new(seed);
    let gains: Vec<f64> =
        std::iter::once(1.0).chain((1..size.scales).map(|_| numbers.between(1.5, 4.0))).collect();
    let items: Vec<Item> = (0..size.migratable).map(|_| item(&mut numbers, &gains, size)).collect();
    let mut edges = Vec::new();
    for a in 1..size.migratable {
        if numbers.chance(1.0 / 3.0) {
            edges.push(Edge { a, b: numbers.below(a), traffic: traffic(&mut numbers) });
        }
    }
    let mut problem = Problem { items, scales: Vec::new(), edges };
    problem.scales = scales(&mut numbers, &problem, &gains, supply);
    problem
}

/// Log-uniform.
fn traffic(numbers: &mut Numbers) -> f64 {
    0.02 * MBIT * (300_f64).powf(numbers.unit())
}

fn item(numbers: &mut Numbers, gains: &[f64], size: Size) -> Item {
    let home = numbers.between(0.05, 0.6);
    let mut cpu = vec![home];
    cpu.extend(gains[1..].iter().map(|_| home * numbers.between(0.5, 1.0)));
    // A part has one or two connections with those that stay; with none that stays (M = N) they are sensors.
    let links = 1 + usize::from(size.parts > 1 && numbers.chance(0.4));
    Item {
        value: cpu.iter().zip(gains).map(|(cpu, gain)| cpu * gain).collect(),
        allowed: vec![true; gains.len()],
        memory: numbers.between(32.0, 256.0) * MIB,
        traffic: (0..links).map(|_| traffic(numbers)).sum(),
        cpu,
    }
}

fn scales(
    numbers: &mut Numbers,
    problem: &Problem,
    gains: &[f64],
    supply: Supply,
) -> Vec<Capacity> {
    let remote = (gains.len() - 1).max(1) as f64;
    let sum = |of: fn(&Item) -> f64| problem.items.iter().map(of).sum::<f64>();
    let (cpu, memory, traffic) = (sum(|i| i.cpu[0]), sum(|i| i.memory), sum(|i| i.traffic));
    let mut share = |low: f64, high: f64| match supply {
        Supply::Loose => numbers.between(1.5, 3.0),
        Supply::Tight => numbers.between(low, high),
    };
    let radio = traffic * share(0.4, 0.8);
    gains
        .iter()
        .enumerate()
        .map(|(k, gain)| Capacity {
            // A part uses 0.75 as much there, on average.
            cpu: 0.75 * cpu / remote * share(0.4, 0.8),
            memory: memory / remote * share(0.6, 1.2),
            bandwidth: if k == 0 { radio } else { traffic / remote * share(0.6, 1.2) },
            ..Capacity::unlimited(*gain)
        })
        .collect()
}
