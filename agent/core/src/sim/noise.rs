//! Seeded randomness: the same seed and number give the same noise, in whatever order it is asked for.

use std::f64::consts::TAU;

/// A normal deviate of mean 0 and deviation 1, the `index`th of this seed (Box–Muller over SplitMix64).
#[must_use]
pub fn normal(seed: u64, index: u64) -> f64 {
    let (one, two) =
        (uniform(seed, index.wrapping_mul(2)), uniform(seed, index.wrapping_mul(2) + 1));
    // Never the logarithm of 0.
    (-2.0 * (1.0 - one).ln()).sqrt() * (TAU * two).cos()
}

/// In [0, 1), the `index`th of this seed.
#[must_use]
pub fn uniform(seed: u64, index: u64) -> f64 {
    let mut z = seed.wrapping_add(index.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    #[expect(clippy::cast_precision_loss, reason = "53 bits")]
    let unit = ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64;
    unit
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deviates_are_normal_and_the_seed_s_own() {
        let all: Vec<f64> = (0..20_000).map(|i| normal(7, i)).collect();
        let mean = all.iter().sum::<f64>() / 20_000.0;
        let variance = all.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / 20_000.0;
        assert!(mean.abs() < 0.03 && (variance - 1.0).abs() < 0.05, "{mean} {variance}");
        assert!(all.iter().all(|x| x.is_finite()));
        assert_eq!(normal(7, 3).to_bits(), normal(7, 3).to_bits());
        assert!(normal(7, 3).to_bits() != normal(8, 3).to_bits());
    }
}
