//! A residual network (He et al., 2015, 4.2: the form for small pictures): a 3×3 convolution, three
//! stages of n blocks of two 3×3 convolutions with a shortcut, each stage at half the resolution and
//! twice the channels of the one before, then the mean of each channel and a linear classifier.
//!
//! Batch normalisation is folded into the weights, as it is for inference.

use crate::rng::Rng;

/// Classes of CIFAR-10, which this form was made for.
const CLASSES: usize = 10;
const STAGES: usize = 3;

/// Values by channel, row and column.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Tensor {
    pub(super) channels: usize,
    pub(super) height: usize,
    pub(super) width: usize,
    pub(super) values: Vec<f32>,
}

#[derive(Debug, Clone)]
struct Convolution {
    inputs: usize,
    outputs: usize,
    stride: usize,
    /// By output, input, row and column of the 3×3 kernel.
    weights: Vec<f32>,
    bias: Vec<f32>,
}

#[derive(Debug, Clone)]
struct Block {
    first: Convolution,
    second: Convolution,
}

/// The network.
#[derive(Debug, Clone)]
pub(super) struct Network {
    stem: Convolution,
    blocks: Vec<Block>,
    /// By class and channel.
    classifier: Vec<f32>,
}

impl Tensor {
    fn zeros(channels: usize, height: usize, width: usize) -> Self {
        Tensor { channels, height, width, values: vec![0.0; channels * height * width] }
    }

    fn plane(&self, channel: usize) -> &[f32] {
        &self.values[channel * self.height * self.width..][..self.height * self.width]
    }

    fn clip(&mut self) {
        for value in &mut self.values {
            *value = value.max(0.0);
        }
    }
}

impl Convolution {
    /// Weights by He's rule, so that values neither grow nor vanish with depth.
    fn new(inputs: usize, outputs: usize, stride: usize, gain: f64, rng: &mut Rng) -> Self {
        let deviation = gain * (2.0 / (inputs * 9) as f64).sqrt();
        Convolution {
            inputs,
            outputs,
            stride,
            weights: (0..inputs * outputs * 9).map(|_| rng.normal(deviation) as f32).collect(),
            bias: (0..outputs).map(|_| rng.normal(0.05) as f32).collect(),
        }
    }

    /// The picture is taken as 0 beyond its edges.
    fn apply(&self, input: &Tensor) -> Tensor {
        let (height, width) =
            (input.height.div_ceil(self.stride), input.width.div_ceil(self.stride));
        let mut output = Tensor::zeros(self.outputs, height, width);
        let padded = Padded::new(input);
        for (o, plane) in output.values.chunks_exact_mut(height * width).enumerate() {
            plane.fill(self.bias[o]);
            for i in 0..self.inputs {
                let kernel = &self.weights[(o * self.inputs + i) * 9..][..9];
                for (y, row) in plane.chunks_exact_mut(width).enumerate() {
                    let rows = [0, 1, 2].map(|k| padded.row(i, y * self.stride + k));
                    add_row(row, rows, kernel, self.stride);
                }
            }
        }
        output
    }
}

/// One row of output += three rows of input, weighted. The innermost loop of everything here: it is
/// written so that the compiler makes vector code of it.
fn add_row(output: &mut [f32], rows: [&[f32]; 3], kernel: &[f32], stride: usize) {
    if stride == 1 {
        for (row, weights) in rows.iter().zip(kernel.chunks_exact(3)) {
            let n = output.len();
            let (left, middle, right) = (&row[..n], &row[1..=n], &row[2..n + 2]);
            for (((out, a), b), c) in output.iter_mut().zip(left).zip(middle).zip(right) {
                *out += weights[0] * a + weights[1] * b + weights[2] * c;
            }
        }
    } else {
        for (x, out) in output.iter_mut().enumerate() {
            for (row, weights) in rows.iter().zip(kernel.chunks_exact(3)) {
                let at = &row[x * stride..x * stride + 3];
                *out += weights[0] * at[0] + weights[1] * at[1] + weights[2] * at[2];
            }
        }
    }
}

/// A tensor with a border of zeros.
struct Padded {
    width: usize,
    height: usize,
    values: Vec<f32>,
}

impl Padded {
    fn new(input: &Tensor) -> Self {
        let (height, width) = (input.height + 2, input.width + 2);
        let mut values = vec![0.0; input.channels * height * width];
        for (plane, to) in
            (0..input.channels).map(|c| input.plane(c)).zip(values.chunks_exact_mut(height * width))
        {
            for (row, to) in plane.chunks_exact(input.width).zip(to.chunks_exact_mut(width).skip(1))
            {
                to[1..=input.width].copy_from_slice(row);
            }
        }
        Padded { width, height, values }
    }

    fn row(&self, channel: usize, y: usize) -> &[f32] {
        &self.values[(channel * self.height + y) * self.width..][..self.width]
    }
}

impl Block {
    fn apply(&self, input: Tensor) -> Tensor {
        let mut inner = self.first.apply(&input);
        inner.clip();
        let mut output = self.second.apply(&inner);
        add_shortcut(&mut output, &input, self.first.stride);
        output.clip();
        output
    }
}

/// Option A of the paper: every `stride`-th sample, channels that are new begin at 0.
fn add_shortcut(output: &mut Tensor, input: &Tensor, stride: usize) {
    for channel in 0..input.channels {
        let from = input.plane(channel);
        for y in 0..output.height {
            for x in 0..output.width {
                output.values[(channel * output.height + y) * output.width + x] +=
                    from[y * stride * input.width + x * stride];
            }
        }
    }
}

impl Network {
    /// `n` blocks a stage: 6 n + 2 layers.
    pub(super) fn new(n: usize, channels: usize, seed: u64) -> Self {
        let mut rng = Rng::new(seed);
        let stem = Convolution::new(3, channels, 1, 1.0, &mut rng);
        let mut blocks = Vec::new();
        let mut inputs = channels;
        // The branch of a block adds little to its shortcut, as after training.
        let gain = 0.5;
        for stage in 0..STAGES {
            let outputs = channels << stage;
            for block in 0..n {
                let stride = if stage > 0 && block == 0 { 2 } else { 1 };
                blocks.push(Block {
                    first: Convolution::new(inputs, outputs, stride, 1.0, &mut rng),
                    second: Convolution::new(outputs, outputs, 1, gain, &mut rng),
                });
                inputs = outputs;
            }
        }
        let deviation = (1.0 / inputs as f64).sqrt();
        let classifier = (0..CLASSES * inputs).map(|_| rng.normal(deviation) as f32).collect();
        Network { stem, blocks, classifier }
    }

    /// The probability of each class.
    pub(super) fn classify(&self, image: &Tensor) -> Vec<f32> {
        let mut tensor = self.stem.apply(image);
        tensor.clip();
        for block in &self.blocks {
            tensor = block.apply(tensor);
        }
        let area = (tensor.height * tensor.width) as f32;
        let means: Vec<f32> =
            (0..tensor.channels).map(|c| tensor.plane(c).iter().sum::<f32>() / area).collect();
        let scores = self.classifier.chunks_exact(means.len());
        softmax(scores.map(|row| row.iter().zip(&means).map(|(w, m)| w * m).sum()).collect())
    }
}

fn softmax(mut scores: Vec<f32>) -> Vec<f32> {
    let most = scores.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    for score in &mut scores {
        *score = (*score - most).exp();
    }
    let sum: f32 = scores.iter().sum();
    scores.iter_mut().for_each(|score| *score /= sum);
    scores
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The definition, sample by sample.
    fn slowly(convolution: &Convolution, input: &Tensor) -> Tensor {
        let stride = convolution.stride;
        let (height, width) = (input.height.div_ceil(stride), input.width.div_ceil(stride));
        let mut output = Tensor::zeros(convolution.outputs, height, width);
        for o in 0..convolution.outputs {
            for y in 0..height {
                for x in 0..width {
                    let mut sum = convolution.bias[o];
                    for i in 0..convolution.inputs {
                        for ky in 0..3 {
                            for kx in 0..3 {
                                let (Some(v), Some(u)) = (
                                    (y * stride + ky).checked_sub(1),
                                    (x * stride + kx).checked_sub(1),
                                ) else {
                                    continue;
                                };
                                if v < input.height && u < input.width {
                                    let weight = (o * convolution.inputs + i) * 9 + ky * 3 + kx;
                                    sum += convolution.weights[weight]
                                        * input.plane(i)[v * input.width + u];
                                }
                            }
                        }
                    }
                    output.values[(o * height + y) * width + x] = sum;
                }
            }
        }
        output
    }

    #[test]
    fn convolutions_are_what_they_are_defined_as() {
        let mut rng = Rng::new(1);
        for (stride, height, width) in [(1, 5, 7), (2, 5, 7), (2, 6, 8)] {
            let mut input = Tensor::zeros(3, height, width);
            input.values.iter_mut().for_each(|v| *v = rng.normal(1.0) as f32);
            let convolution = Convolution::new(3, 4, stride, 1.0, &mut rng);
            let (fast, slow) = (convolution.apply(&input), slowly(&convolution, &input));
            assert_eq!((fast.height, fast.width), (slow.height, slow.width));
            for (a, b) in fast.values.iter().zip(&slow.values) {
                assert!((a - b).abs() < 1e-4, "stride {stride}: {a} {b}");
            }
        }
    }

    #[test]
    fn a_deep_network_neither_vanishes_nor_explodes() {
        let network = Network::new(3, 8, 4);
        assert_eq!(network.blocks.len() * 2 + 2, 20, "6 n + 2 layers");
        let mut image = Tensor::zeros(3, 16, 16);
        let mut rng = Rng::new(2);
        image.values.iter_mut().for_each(|v| *v = rng.normal(1.0) as f32);
        let scores = network.classify(&image);
        assert!((scores.iter().sum::<f32>() - 1.0).abs() < 1e-4);
        assert!(scores.iter().all(|s| s.is_finite() && *s > 0.0), "{scores:?}");
        assert_eq!(scores, network.classify(&image));
    }
}
