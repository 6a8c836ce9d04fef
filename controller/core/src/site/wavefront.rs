//! One search over a floor, from an operation position outwards.
//!
//! Steps go to the 16 cells of a chess king and knight, and cost 5, 7 and 11 for the 1, √2 and √5 of a cell that they are long (Borgefors,
//! "Distance transformations in digital images", 1986). On open floor a way is from 1.7 % shorter to 2 % longer than the straight line
//! between the cells' middles; around corners it is as exact as its pieces. A step does not pass between two blocked cells that touch.
//! Costs are small whole numbers, so that Dijkstra's queue is a ring of lists and each cell is settled in constant time (Dial).

use super::floor::{Floor, Ground};

/// What a step to the side costs; [`Front::way`] divides by it.
const SIDE: u32 = 5;

/// Lists of cells that wait: a power of two above the dearest step.
const RING: usize = 16;

/// Not reached.
const FAR: u32 = u32::MAX;

/// Cells across and up.
type Move = (i64, i64);

/// A quarter turn, or some.
type Turn = fn(Move) -> Move;

/// A step: across, up, its cost, and what must be free beside it.
type Step = (i64, i64, u32, [Move; 2]);

/// The steps of one quarter; the others are the same, turned.
const QUARTER: [Step; 4] = [
    (1, 0, SIDE, [(1, 0), (1, 0)]),
    (1, 1, 7, [(1, 0), (0, 1)]),
    (2, 1, 11, [(1, 0), (1, 1)]),
    (1, 2, 11, [(0, 1), (1, 1)]),
];

/// The same on a floor of one width: offsets of cells.
#[derive(Debug, Clone, Copy)]
struct Offset {
    to: i64,
    cost: u32,
    beside: [i64; 2],
}

fn offsets(floor: &Floor) -> Vec<Offset> {
    let width = i64::from(floor.width);
    let turns: [Turn; 4] = [|(x, y)| (x, y), |(x, y)| (-y, x), |(x, y)| (-x, -y), |(x, y)| (y, -x)];
    let offset = |turn: Turn, (x, y, cost, beside): Step| {
        let at = |place| {
            let (x, y) = turn(place);
            y * width + x
        };
        Offset { to: at((x, y)), cost, beside: beside.map(at) }
    };
    turns.into_iter().flat_map(|turn| QUARTER.map(|step| offset(turn, step))).collect()
}

/// The ways from one cell to all others.
#[derive(Debug)]
pub struct Front {
    /// By cell; [`FAR`]: no way leads there.
    costs: Vec<u32>,
}

impl Front {
    /// The front from `cell`, over free ground. Where the cell is near to an obstacle, the way first leads out of there, by ground
    /// that is near to obstacles too.
    #[must_use]
    pub fn from(floor: &Floor, cell: u32) -> Front {
        let mut search = Search::new(floor, vec![FAR; floor.ground.len()]);
        if floor.ground[cell as usize] == Ground::Near {
            exits(floor, cell).into_iter().for_each(|(cell, cost)| search.reach(cell, cost));
        } else {
            search.reach(cell, 0);
        }
        search.run(|ground| ground == Ground::Free);
        Front { costs: search.costs }
    }

    /// Metres to a cell; none: no way leads there.
    #[must_use]
    pub fn way(&self, floor: &Floor, cell: u32) -> Option<f64> {
        let cost = match floor.ground[cell as usize] {
            Ground::Near => {
                let known = |at: u32| Some(self.costs[at as usize]).filter(|cost| *cost != FAR);
                let out = exits(floor, cell).into_iter();
                out.filter_map(|(at, cost)| Some(known(at)? + cost)).min()?
            }
            Ground::Free | Ground::Blocked => {
                Some(self.costs[cell as usize]).filter(|c| *c != FAR)?
            }
        };
        Some(f64::from(cost) / f64::from(SIDE) * floor.resolution)
    }

    /// Memory that it takes.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.costs.len() * size_of::<u32>()
    }
}

/// The free cells to which ways lead out of ground that is near to obstacles, with their costs, and the near ground passed: not farther
/// than twice the reach, the depth of the corner between two walls.
fn exits(floor: &Floor, cell: u32) -> Vec<(u32, u32)> {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a few cells")]
    let most = ((2.0 * floor.reach + 2.0) * f64::from(SIDE)) as u32;
    let offsets = offsets(floor);
    let mut known = std::collections::BTreeMap::from([(cell, 0_u32)]);
    let mut queue = std::collections::BTreeSet::from([(0_u32, cell)]);
    let mut found = Vec::new();
    while let Some((cost, cell)) = queue.pop_first() {
        found.push((cell, cost));
        if floor.ground[cell as usize] == Ground::Free {
            continue;
        }
        for offset in &offsets {
            let Some(to) = step(floor, cell, offset, |ground| ground != Ground::Blocked) else {
                continue;
            };
            let cost = cost + offset.cost;
            if cost <= most && known.get(&to).is_none_or(|known| *known > cost) {
                if let Some(old) = known.insert(to, cost) {
                    queue.remove(&(old, to));
                }
                queue.insert((cost, to));
            }
        }
    }
    found
}

/// Where a step leads, if ground of this sort allows it.
fn step(floor: &Floor, cell: u32, offset: &Offset, is: impl Fn(Ground) -> bool) -> Option<u32> {
    let at = |by: i64| usize::try_from(i64::from(cell) + by).ok();
    let allows = |by: i64| at(by).is_some_and(|at| is(floor.ground[at]));
    (allows(offset.to) && offset.beside.into_iter().all(allows))
        .then(|| u32::try_from(i64::from(cell) + offset.to).ok())?
}

/// Dijkstra's search with a ring of lists.
struct Search<'a> {
    floor: &'a Floor,
    costs: Vec<u32>,
    /// Beyond the ring: where the search begins, dearest first.
    starts: Vec<(u32, u32)>,
}

impl<'a> Search<'a> {
    fn new(floor: &'a Floor, costs: Vec<u32>) -> Search<'a> {
        Search { floor, costs, starts: Vec::new() }
    }

    fn reach(&mut self, cell: u32, cost: u32) {
        let known = &mut self.costs[cell as usize];
        if cost < *known {
            *known = cost;
        }
        self.starts.push((cost, cell));
    }

    fn run(&mut self, is: impl Fn(Ground) -> bool) {
        let offsets = offsets(self.floor);
        self.starts.sort_unstable_by(|a, b| b.cmp(a));
        let mut ring: [Vec<u32>; RING] = Default::default();
        let (mut now, mut waiting) = (0_u32, 0_usize);
        loop {
            while let Some((_, cell)) = self.starts.pop_if(|(cost, _)| *cost <= now) {
                ring[now as usize % RING].push(cell);
                waiting += 1;
            }
            if waiting == 0 {
                match self.starts.last() {
                    Some((cost, _)) => now = *cost,
                    None => return,
                }
                continue;
            }
            let mut list = std::mem::take(&mut ring[now as usize % RING]);
            waiting -= list.len();
            for cell in list.drain(..) {
                // It was reached more cheaply since, or is ground on which no way goes on.
                if self.costs[cell as usize] != now || !is(self.floor.ground[cell as usize]) {
                    continue;
                }
                for offset in &offsets {
                    let to = i64::from(cell) + offset.to;
                    let (Ok(at), cost) = (usize::try_from(to), now + offset.cost) else { continue };
                    if self.costs[at] > cost && step(self.floor, cell, offset, &is).is_some() {
                        self.costs[at] = cost;
                        ring[cost as usize % RING].push(u32::try_from(at).unwrap_or(FAR));
                        waiting += 1;
                    }
                }
            }
            ring[now as usize % RING] = list;
            now += 1;
        }
    }
}
