//! What recognition's framework keeps in the cloud (CR): trains a small network by stochastic gradient
//! descent with momentum on labelled frames that it makes itself. Without `--rate` or `--load` it takes
//! all the cpu that it is given, as training does; a quota is what holds it.

use serde_json::{Map, Value, json};

use super::rng::Rng;
use super::run::{self, Pacing, Work, rounded};

/// Flags of `muster workload training`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    #[command(flatten)]
    pacing: Pacing,
    /// Frames in a step
    #[arg(long, value_name = "N", default_value_t = 32, value_parser = clap::value_parser!(u32).range(1..=4096))]
    batch: u32,
    /// Neurons of the hidden layer
    #[arg(long, value_name = "N", default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=4096))]
    hidden: u32,
    /// Step size
    #[arg(long, value_name = "X", default_value = "0.05", value_parser = run::positive)]
    learning_rate: f64,
}

/// Frames are this many pixels across and down.
const SIDE: usize = 16;
const PIXELS: usize = SIDE * SIDE;
/// Disc, box, cross, stripes.
const CLASSES: usize = 4;
const MOMENTUM: f32 = 0.9;
/// How much of the loss's and accuracy's mean a step is.
const SMOOTHING: f32 = 0.02;

pub(super) fn run(args: &Args) -> u8 {
    run::run(Training::new(args), &args.pacing, None)
}

/// A unit is one step.
struct Training {
    rng: Rng,
    hidden: Layer,
    output: Layer,
    rate: f32,
    batch: usize,
    units: u32,
    steps: u64,
    first_loss: Option<f32>,
    loss: f32,
    accuracy: f32,
}

#[derive(Debug, Clone)]
struct Layer {
    inputs: usize,
    /// By output and input, the bias last.
    weights: Vec<f32>,
    gradient: Vec<f32>,
    velocity: Vec<f32>,
}

impl Layer {
    fn new(inputs: usize, outputs: usize, rng: &mut Rng) -> Self {
        let deviation = (2.0 / inputs as f64).sqrt();
        let n = (inputs + 1) * outputs;
        let weights = (0..n).map(|_| rng.normal(deviation) as f32).collect();
        Layer { inputs, weights, gradient: vec![0.0; n], velocity: vec![0.0; n] }
    }

    fn forward(&self, input: &[f32]) -> Vec<f32> {
        let rows = self.weights.chunks_exact(self.inputs + 1);
        rows.map(|row| row[self.inputs] + dot(&row[..self.inputs], input)).collect()
    }

    /// Adds to the gradient, and returns the error at the input.
    fn backward(&mut self, input: &[f32], error: &[f32]) -> Vec<f32> {
        let mut below = vec![0.0; self.inputs];
        let rows = self.weights.chunks_exact(self.inputs + 1);
        let gradients = self.gradient.chunks_exact_mut(self.inputs + 1);
        for ((row, gradient), &e) in rows.zip(gradients).zip(error) {
            for (((g, b), w), x) in gradient.iter_mut().zip(&mut below).zip(row).zip(input) {
                *g += e * x;
                *b += e * w;
            }
            gradient[self.inputs] += e;
        }
        below
    }

    fn step(&mut self, rate: f32) {
        let all = self.weights.iter_mut().zip(&mut self.velocity).zip(&mut self.gradient);
        for ((weight, velocity), gradient) in all {
            *velocity = MOMENTUM * *velocity - rate * *gradient;
            *weight += *velocity;
            *gradient = 0.0;
        }
    }
}

/// Eight sums beside each other: one sum in order cannot be made vector code.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0; 8];
    let (a8, b8) = (a.chunks_exact(8), b.chunks_exact(8));
    let rest: f32 = a8.remainder().iter().zip(b8.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in a8.zip(b8) {
        for ((sum, x), y) in sums.iter_mut().zip(x).zip(y) {
            *sum += x * y;
        }
    }
    sums.iter().sum::<f32>() + rest
}

impl Training {
    fn new(args: &Args) -> Self {
        let mut rng = Rng::new(args.pacing.seed);
        let hidden = args.hidden as usize;
        Training {
            hidden: Layer::new(PIXELS, hidden, &mut rng),
            output: Layer::new(hidden, CLASSES, &mut rng),
            rng,
            rate: args.learning_rate as f32,
            batch: args.batch as usize,
            units: 1,
            steps: 0,
            first_loss: None,
            loss: 0.0,
            accuracy: 0.0,
        }
    }

    fn step(&mut self) {
        let (mut loss, mut right) = (0.0, 0);
        for _ in 0..self.batch {
            let class = self.rng.below(CLASSES);
            let frame = labelled(class, &mut self.rng);
            let mut inner = self.hidden.forward(&frame);
            inner.iter_mut().for_each(|v| *v = v.max(0.0));
            let likely = softmax(self.output.forward(&inner));
            loss -= likely[class].max(1e-9).ln();
            let best = likely.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1));
            right += usize::from(best.is_some_and(|(guess, _)| guess == class));
            let part = 1.0 / self.batch as f32;
            let error: Vec<f32> = likely
                .iter()
                .enumerate()
                .map(|(i, p)| part * (p - f32::from(u8::from(i == class))))
                .collect();
            let mut below = self.output.backward(&inner, &error);
            for (error, value) in below.iter_mut().zip(&inner) {
                *error *= f32::from(u8::from(*value > 0.0));
            }
            self.hidden.backward(&frame, &below);
        }
        self.hidden.step(self.rate);
        self.output.step(self.rate);
        self.note(loss / self.batch as f32, right as f32 / self.batch as f32);
    }

    fn note(&mut self, loss: f32, accuracy: f32) {
        self.steps += 1;
        if self.first_loss.is_none() {
            (self.first_loss, self.loss, self.accuracy) = (Some(loss), loss, accuracy);
        }
        self.loss += SMOOTHING * (loss - self.loss);
        self.accuracy += SMOOTHING * (accuracy - self.accuracy);
    }
}

impl Work for Training {
    fn name(&self) -> &'static str {
        "training"
    }

    fn set_units(&mut self, units: u32) {
        self.units = units;
    }

    fn frame(&mut self) {
        for _ in 0..self.units {
            self.step();
        }
    }

    fn findings(&mut self) -> Map<String, Value> {
        let mut found = Map::new();
        found.insert("steps".into(), json!(self.steps));
        found.insert("first_loss".into(), json!(self.first_loss.map(|l| rounded(l.into(), 4))));
        found.insert("loss".into(), json!(rounded(self.loss.into(), 4)));
        found.insert("accuracy".into(), json!(rounded(self.accuracy.into(), 4)));
        found
    }
}

fn softmax(mut scores: Vec<f32>) -> Vec<f32> {
    let most = scores.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    scores.iter_mut().for_each(|s| *s = (*s - most).exp());
    let sum: f32 = scores.iter().sum();
    scores.iter_mut().for_each(|s| *s /= sum);
    scores
}

/// A frame with one thing on it, anywhere, of any size and contrast, under much noise.
fn labelled(class: usize, rng: &mut Rng) -> Vec<f32> {
    let side = SIDE as f64;
    let (cx, cy) = (rng.between(5.0, side - 5.0), rng.between(5.0, side - 5.0));
    let (size, contrast) = (rng.between(2.5, 5.0), rng.between(0.6, 1.4) as f32);
    let phase = rng.below(4);
    let mut frame = Vec::with_capacity(PIXELS);
    for y in 0..SIDE {
        for x in 0..SIDE {
            let (dx, dy) = ((x as f64 - cx).abs(), (y as f64 - cy).abs());
            let on = match class {
                0 => dx * dx + dy * dy < size * size,
                1 => dx.max(dy) < size && dx.max(dy) > size - 1.5,
                2 => dx.min(dy) < 1.0 && dx.max(dy) < size + 1.0,
                _ => ((x + y + phase) / 2).is_multiple_of(2),
            };
            // Uniform noise, from one draw.
            let noise = (rng.unit() as f32 - 0.5) * 1.6;
            frame.push(if on { contrast } else { 0.0 } + noise - 0.3);
        }
    }
    frame
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, clap::Parser)]
    struct Flags {
        #[command(flatten)]
        args: Args,
    }

    fn training(flags: &[&str]) -> Training {
        let all = ["training"].iter().chain(flags);
        Training::new(&<Flags as clap::Parser>::parse_from(all).args)
    }

    #[test]
    fn it_learns() {
        let mut training = training(&["--batch", "16", "--hidden", "24"]);
        for _ in 0..400 {
            training.step();
        }
        let first = training.first_loss.unwrap();
        assert!(training.loss < 0.7 * first, "{} → {}", first, training.loss);
        assert!(training.accuracy > 0.6, "a guess would be right in 0.25: {}", training.accuracy);
    }

    #[test]
    fn a_seed_is_a_course() {
        let loss = |seed| {
            let mut training = training(&["--seed", seed, "--batch", "4"]);
            (0..5).for_each(|_| training.step());
            training.loss.to_bits()
        };
        assert_eq!(loss("3"), loss("3"));
        assert_ne!(loss("3"), loss("4"));
    }

    #[test]
    fn gradients_are_the_slopes() {
        let mut rng = Rng::new(1);
        let mut layer = Layer::new(3, 2, &mut rng);
        let (input, error) = ([0.5, -1.0, 2.0], [1.0, -2.0]);
        let below = layer.backward(&input, &error);
        let loss = |layer: &Layer, input: &[f32]| dot(&layer.forward(input), &error);
        for i in 0..layer.weights.len() {
            let mut moved = layer.clone();
            moved.weights[i] += 1e-2;
            let slope = (loss(&moved, &input) - loss(&layer, &input)) / 1e-2;
            assert!((slope - layer.gradient[i]).abs() < 1e-2, "weight {i}");
        }
        for i in 0..3 {
            let mut moved = input;
            moved[i] += 1e-2;
            let slope = (loss(&layer, &moved) - loss(&layer, &input)) / 1e-2;
            assert!((slope - below[i]).abs() < 1e-2, "input {i}");
        }
    }
}
