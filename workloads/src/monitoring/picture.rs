//! A whole picture: colours apart (YCbCr, the chrominance at half the resolution), blocks, bits.

use super::bits::{Reader, Writer};
use super::dct::{Block, Plane, Transform};
use crate::scene::Image;

/// Encodes and decodes at one quality.
#[derive(Debug)]
pub(super) struct Coder {
    transform: Transform,
}

/// Samples around 0.
#[derive(Debug, Clone)]
struct Samples {
    width: usize,
    height: usize,
    values: Vec<f32>,
}

impl Coder {
    pub(super) fn new(quality: u32) -> Self {
        Coder { transform: Transform::new(quality) }
    }

    pub(super) fn encode(&self, image: &Image) -> Vec<u8> {
        let mut writer = Writer::default();
        writer.unsigned(image.width as u32);
        writer.unsigned(image.height as u32);
        for (samples, plane) in apart(image).iter().zip(PLANES) {
            let mut before = 0;
            for top in (0..samples.height).step_by(8) {
                for left in (0..samples.width).step_by(8) {
                    let quantised = self.transform.forward(&samples.block(left, top), plane);
                    writer.block(&quantised, before);
                    before = quantised[0];
                }
            }
        }
        writer.finish()
    }

    /// None: the bytes are no picture.
    pub(super) fn decode(&self, code: &[u8]) -> Option<Image> {
        let mut reader = Reader::new(code);
        let (width, height) = (reader.unsigned()? as usize, reader.unsigned()? as usize);
        if !(1..=LARGEST).contains(&width) || !(1..=LARGEST).contains(&height) {
            return None;
        }
        let mut planes = Vec::with_capacity(3);
        for (plane, (width, height)) in PLANES.into_iter().zip(sizes(width, height)) {
            let mut samples = Samples { width, height, values: vec![0.0; width * height] };
            let mut before = 0;
            for top in (0..height).step_by(8) {
                for left in (0..width).step_by(8) {
                    let quantised = reader.block(before)?;
                    before = quantised[0];
                    samples.put(left, top, &self.transform.inverse(&quantised, plane));
                }
            }
            planes.push(samples);
        }
        Some(together(width, height, &planes))
    }
}

/// Pixels across or down.
const LARGEST: usize = 4096;

const PLANES: [Plane; 3] = [Plane::Luma, Plane::Chroma, Plane::Chroma];

fn sizes(width: usize, height: usize) -> [(usize, usize); 3] {
    let half = (width.div_ceil(2), height.div_ceil(2));
    [(width, height), half, half]
}

impl Samples {
    /// The block at a corner; what is past the edge repeats the edge.
    fn block(&self, left: usize, top: usize) -> Block {
        let mut block = [0.0; 64];
        for (i, row) in block.chunks_exact_mut(8).enumerate() {
            let y = (top + i).min(self.height - 1);
            let line = &self.values[y * self.width..(y + 1) * self.width];
            for (j, value) in row.iter_mut().enumerate() {
                *value = line[(left + j).min(self.width - 1)];
            }
        }
        block
    }

    fn put(&mut self, left: usize, top: usize, block: &Block) {
        for (i, row) in block.chunks_exact(8).enumerate().take(self.height - top) {
            for (j, &value) in row.iter().enumerate().take(self.width - left) {
                self.values[(top + i) * self.width + left + j] = value;
            }
        }
    }
}

/// ITU-T T.871: full-range BT.601.
fn apart(image: &Image) -> [Samples; 3] {
    let [(width, height), (half_width, half_height), _] = sizes(image.width, image.height);
    let empty = |width, height| Samples { width, height, values: vec![0.0; width * height] };
    let mut luma = empty(width, height);
    let mut blue = empty(half_width, half_height);
    let mut red = empty(half_width, half_height);
    for y in 0..height {
        for x in 0..width {
            let [r, g, b] = [0, 1, 2].map(|c| f32::from(image.planes[c][y * width + x]));
            luma.values[y * width + x] = 0.299 * r + 0.587 * g + 0.114 * b - 128.0;
            // Four pixels share a sample: each adds its quarter.
            let half = (y / 2) * half_width + x / 2;
            blue.values[half] += 0.25 * (-0.168_736 * r - 0.331_264 * g + 0.5 * b);
            red.values[half] += 0.25 * (0.5 * r - 0.418_688 * g - 0.081_312 * b);
        }
    }
    [luma, blue, red]
}

fn together(width: usize, height: usize, planes: &[Samples]) -> Image {
    let mut image = Image { width, height, planes: [0; 3].map(|_| vec![0; width * height]) };
    for y in 0..height {
        for x in 0..width {
            let luma = planes[0].values[y * width + x] + 128.0;
            let [blue, red] = [1, 2].map(|p| {
                let plane: &Samples = &planes[p];
                plane.values[(y / 2) * plane.width + x / 2]
            });
            let colours = [
                luma + 1.402 * red,
                luma - 0.344_136 * blue - 0.714_136 * red,
                luma + 1.772 * blue,
            ];
            for (plane, colour) in image.planes.iter_mut().zip(colours) {
                plane[y * width + x] = colour.round().clamp(0.0, 255.0) as u8;
            }
        }
    }
    image
}

/// How alike two pictures of one size are, dB; above 30 is good.
pub(super) fn psnr(a: &Image, b: &Image) -> f64 {
    let pairs = a.planes.iter().flatten().zip(b.planes.iter().flatten());
    let squares: f64 = pairs.map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    let mean = squares / (a.width * a.height * 3) as f64;
    20.0 * 255.0_f64.log10() - 10.0 * mean.max(1e-9).log10()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Scene;

    #[test]
    fn a_picture_comes_back_alike_and_was_small() {
        let image = Scene::new(160, 120, 9).frame().clone();
        let mut before = (0.0, 0);
        for quality in [20, 60, 95] {
            let coder = Coder::new(quality);
            let code = coder.encode(&image);
            let psnr = psnr(&image, &coder.decode(&code).expect("a picture"));
            assert!(psnr > before.0 && code.len() > before.1, "{quality}: {psnr} dB");
            assert!(code.len() * 3 < 160 * 120 * 3, "{quality}: {} bytes", code.len());
            before = (psnr, code.len());
        }
        assert!(before.0 > 28.0, "{before:?}");
    }

    #[test]
    fn sizes_need_not_be_multiples_of_a_block() {
        let image = Scene::new(37, 21, 9).frame().clone();
        let coder = Coder::new(80);
        let seen = coder.decode(&coder.encode(&image)).expect("a picture");
        assert_eq!((seen.width, seen.height), (37, 21));
        assert!(psnr(&image, &seen) > 20.0);
        assert_eq!(coder.decode(&[0x5a; 3]), None);
    }
}
