//! The 8×8 cosine transform and its quantisation, as JPEG has them (ITU-T T.81, A.3.3 and annex K).

use std::f32::consts::PI;

/// Samples of a block, row by row.
pub(super) type Block = [f32; 64];

/// Steps of luminance and chrominance at quality 50 (T.81, tables K.1 and K.2), row by row.
const LUMA: [u8; 64] = [
    16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55, 14, 13, 16, 24, 40, 57, 69, 56,
    14, 17, 22, 29, 51, 87, 80, 62, 18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113,
    92, 49, 64, 78, 87, 103, 121, 120, 101, 72, 92, 95, 98, 112, 100, 103, 99,
];
const CHROMA: [u8; 64] = [
    17, 18, 24, 47, 99, 99, 99, 99, 18, 21, 26, 66, 99, 99, 99, 99, 24, 26, 56, 99, 99, 99, 99, 99,
    47, 66, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99,
    99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99,
];

/// Order of the coefficients from low to high frequency (T.81, figure A.6).
pub(super) const ZIGZAG: [usize; 64] = [
    0, 1, 8, 16, 9, 2, 3, 10, 17, 24, 32, 25, 18, 11, 4, 5, 12, 19, 26, 33, 40, 48, 41, 34, 27, 20,
    13, 6, 7, 14, 21, 28, 35, 42, 49, 56, 57, 50, 43, 36, 29, 22, 15, 23, 30, 37, 44, 51, 58, 59,
    52, 45, 38, 31, 39, 46, 53, 60, 61, 54, 47, 55, 62, 63,
];

/// The transform with its tables.
#[derive(Debug, Clone)]
pub(super) struct Transform {
    /// `basis[u][x]`, orthonormal: the inverse is the transpose.
    basis: [[f32; 8]; 8],
    luma: [f32; 64],
    chroma: [f32; 64],
}

/// Which table of steps a block is quantised with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Plane {
    Luma,
    Chroma,
}

impl Transform {
    /// `quality`: 1 to 100, with the meaning that libjpeg gave it.
    pub(super) fn new(quality: u32) -> Self {
        let quality = quality.clamp(1, 100) as f32;
        let scale = if quality < 50.0 { 50.0 / quality } else { 2.0 - quality / 50.0 };
        let steps = |table: [u8; 64]| table.map(|s| (f32::from(s) * scale).round().max(1.0));
        let mut basis = [[0.0; 8]; 8];
        for (u, row) in basis.iter_mut().enumerate() {
            let scale = if u == 0 { (1.0_f32 / 8.0).sqrt() } else { 0.5 };
            for (x, value) in row.iter_mut().enumerate() {
                *value = scale * ((2 * x + 1) as f32 * u as f32 * PI / 16.0).cos();
            }
        }
        Transform { basis, luma: steps(LUMA), chroma: steps(CHROMA) }
    }

    fn steps(&self, plane: Plane) -> &[f32; 64] {
        match plane {
            Plane::Luma => &self.luma,
            Plane::Chroma => &self.chroma,
        }
    }

    /// Samples around 0 → quantised coefficients in zigzag order.
    pub(super) fn forward(&self, block: &Block, plane: Plane) -> [i16; 64] {
        let coefficients = self.twice(block, false);
        let steps = self.steps(plane);
        ZIGZAG.map(|i| (coefficients[i] / steps[i]).round() as i16)
    }

    /// The way back.
    pub(super) fn inverse(&self, quantised: &[i16; 64], plane: Plane) -> Block {
        let steps = self.steps(plane);
        let mut coefficients = [0.0; 64];
        for (&i, &value) in ZIGZAG.iter().zip(quantised) {
            coefficients[i] = f32::from(value) * steps[i];
        }
        self.twice(&coefficients, true)
    }

    /// Transforms rows, then columns: a pass over rows that writes columns, twice.
    fn twice(&self, block: &Block, back: bool) -> Block {
        let mut turned = *block;
        for _ in 0..2 {
            let rows = turned;
            for (y, row) in rows.chunks_exact(8).enumerate() {
                for u in 0..8 {
                    let sum: f32 = (0..8)
                        .map(|x| row[x] * if back { self.basis[x][u] } else { self.basis[u][x] })
                        .sum();
                    turned[u * 8 + y] = sum;
                }
            }
        }
        turned
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    #[test]
    fn there_and_back_is_the_same() {
        let transform = Transform::new(50);
        let mut rng = Rng::new(1);
        let block: Block = [0.0; 64].map(|_: f32| rng.between(-128.0, 127.0) as f32);
        let back = transform.twice(&transform.twice(&block, false), true);
        for (a, b) in block.iter().zip(back) {
            assert!((a - b).abs() < 1e-3, "{a} {b}");
        }
    }

    #[test]
    fn a_flat_block_is_its_mean() {
        let quantised = Transform::new(50).forward(&[100.0; 64], Plane::Luma);
        assert_eq!(quantised[0], 50, "8 × mean / step");
        assert!(quantised[1..].iter().all(|&c| c == 0));
    }

    #[test]
    fn no_sample_is_off_by_more_than_its_steps_allow() {
        let transform = Transform::new(100);
        let mut rng = Rng::new(2);
        let block: Block = [0.0; 64].map(|_: f32| rng.between(-128.0, 127.0) as f32);
        let seen = transform.inverse(&transform.forward(&block, Plane::Chroma), Plane::Chroma);
        // Steps of 1: each coefficient is off by at most a half, a sample by at most 8 × 1/2.
        assert!(block.iter().zip(seen).all(|(a, b)| (a - b).abs() <= 4.0));
    }
}
