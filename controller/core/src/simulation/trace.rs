//! Links that come and go.

use super::numbers::Numbers;

/// What a link does, as stretches of time or of way.
#[derive(Debug, Clone, PartialEq)]
pub struct Trace {
    /// Each stretch's end and what the link carries in it, bits a second; 0: it is down. The last one lasts for ever.
    pub stretches: Vec<(f64, f64)>,
}

impl Trace {
    /// What the link carries at a place.
    #[must_use]
    pub fn at(&self, place: f64) -> f64 {
        let stretch = self.stretches.iter().find(|(end, _)| place < *end);
        stretch.or_else(|| self.stretches.last()).map_or(0.0, |(_, bandwidth)| *bandwidth)
    }

    /// A link that is up for 0.2 to 20 s and down for 0.1 to 6 s, in turn, for `seconds`; what it carries is between 0.1
    /// and 20 Mbit/s, anew each time.
    #[must_use]
    pub fn restless(numbers: &mut Numbers, seconds: f64) -> Self {
        let mut stretches = Vec::new();
        let (mut end, mut up) = (0.0, numbers.chance(0.7));
        while end < seconds {
            // Log-uniform: short ones are as frequent as long ones.
            let (low, high): (f64, f64) = if up { (0.2, 20.0) } else { (0.1, 6.0) };
            end += low * (high / low).powf(numbers.unit());
            let carries = if up { 1e5 * 200_f64.powf(numbers.unit()) } else { 0.0 };
            stretches.push((end, carries));
            up = !up;
        }
        Trace { stretches }
    }

    /// Coverage of a course: `share` of its `length` metres has a link of 10 to 54 Mbit/s, in 2 to 5 pieces; between them
    /// there is none. Pieces are at least 3 m long, and so are gaps.
    #[must_use]
    pub fn coverage(numbers: &mut Numbers, length: f64, share: f64) -> Self {
        const LEAST: f64 = 3.0;
        let pieces = 2 + numbers.below(4);
        let mut split = |whole: f64, into: usize| -> Vec<f64> {
            let free = (whole - LEAST * into as f64).max(0.0);
            let parts: Vec<f64> = (0..into).map(|_| numbers.between(0.1, 1.0)).collect();
            let sum: f64 = parts.iter().sum();
            parts.into_iter().map(|p| LEAST.min(whole / into as f64) + free * p / sum).collect()
        };
        let (up, down) = (split(length * share, pieces), split(length * (1.0 - share), pieces));
        let mut stretches = Vec::new();
        let mut end = 0.0;
        let first = numbers.chance(0.5);
        for (up, down) in up.into_iter().zip(down) {
            let both =
                if first { [(up, true), (down, false)] } else { [(down, false), (up, true)] };
            for (metres, covered) in both {
                end += metres;
                let carries = if covered { numbers.between(10e6, 54e6) } else { 0.0 };
                stretches.push((end, carries));
            }
        }
        Trace { stretches }
    }

    /// The share of the first `length` that is covered.
    #[must_use]
    pub fn share(&self, length: f64) -> f64 {
        let (mut begin, mut covered) = (0.0, 0.0);
        for (end, carries) in &self.stretches {
            let end = end.min(length);
            if *carries > 0.0 {
                covered += (end - begin).max(0.0);
            }
            begin = end;
        }
        covered / length
    }
}
