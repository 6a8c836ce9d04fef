//! Avalon's machine-learning task (CR-SR): classifies camera frames with a residual network. The paper
//! runs a trained resnet34 on the robot's notebook; here the network has the same form and real
//! arithmetic, with weights drawn from the seed, so its classes mean nothing and its checksum is a test.

mod network;

use serde_json::{Map, Value, json};

use super::run::{self, Pacing, Work, rounded};
use super::scene::{Image, Scene};
use network::{Network, Tensor};

/// A fast camera.
const CAMERA_HZ: f64 = 60.0;

/// Flags of `muster workload recognition`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    #[command(flatten)]
    pacing: Pacing,
    /// Layers of the network: 6 n + 2
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = depth)]
    depth: usize,
    /// Channels of the first stage; each later stage has twice as many
    #[arg(long, value_name = "N", default_value_t = 16, value_parser = clap::value_parser!(u32).range(1..=256))]
    channels: u32,
    /// Pixels across and down
    #[arg(long, value_name = "N", default_value_t = 32, value_parser = clap::value_parser!(u32).range(8..=512))]
    size: u32,
}

fn depth(text: &str) -> Result<usize, String> {
    match text.parse::<usize>() {
        Ok(n) if (8..=1202).contains(&n) && n % 6 == 2 => Ok(n),
        _ => Err("not 6 n + 2; try 8, 14, 20, 32, 56 or 110".to_owned()),
    }
}

pub(super) fn run(args: &Args) -> u8 {
    let size = args.size as usize;
    let work = Recognition {
        scene: Scene::new(size, size, args.pacing.seed),
        network: Network::new((args.depth - 2) / 6, args.channels as usize, args.pacing.seed),
        crops: 1,
        inferences: 0,
        top: 0,
        confidence: 0.0,
        checksum: 0,
    };
    run::run(work, &args.pacing, Some(CAMERA_HZ))
}

/// A unit is one inference: a frame of three units is looked at three times, as detectors do with regions.
struct Recognition {
    scene: Scene,
    network: Network,
    crops: u32,
    inferences: u64,
    top: usize,
    confidence: f32,
    /// Of every score of every inference, in order.
    checksum: u64,
}

impl Work for Recognition {
    fn name(&self) -> &'static str {
        "recognition"
    }

    fn set_units(&mut self, units: u32) {
        self.crops = units;
    }

    fn frame(&mut self) {
        for _ in 0..self.crops {
            let scores = self.network.classify(&input(self.scene.frame()));
            self.inferences += 1;
            let best = scores.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1));
            if let Some((class, &confidence)) = best {
                (self.top, self.confidence) = (class, confidence);
            }
            for score in scores {
                self.checksum = self.checksum.rotate_left(5) ^ u64::from(score.to_bits());
            }
        }
    }

    fn findings(&mut self) -> Map<String, Value> {
        let mut found = Map::new();
        found.insert("inferences".into(), json!(self.inferences));
        found.insert("top_class".into(), json!(self.top));
        found.insert("confidence".into(), json!(rounded(f64::from(self.confidence), 4)));
        found.insert("checksum".into(), json!(format!("{:016x}", self.checksum)));
        found
    }
}

/// Colours as numbers around 0.
fn input(image: &Image) -> Tensor {
    let values = image.planes.iter().flatten().map(|&v| (f32::from(v) - 127.5) / 64.0).collect();
    Tensor { channels: 3, height: image.height, width: image.width, values }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_seed_sees_the_same() {
        let look = |seed| {
            let mut work = Recognition {
                scene: Scene::new(16, 16, seed),
                network: Network::new(1, 4, seed),
                crops: 2,
                inferences: 0,
                top: 0,
                confidence: 0.0,
                checksum: 0,
            };
            work.frame();
            work.findings()
        };
        assert_eq!(look(1), look(1));
        assert_ne!(look(1)["checksum"], look(2)["checksum"]);
        assert_eq!(look(1)["inferences"], 2);
    }

    #[test]
    fn depths_are_those_of_the_family() {
        assert_eq!(depth("20"), Ok(20));
        assert!(depth("21").is_err() && depth("2").is_err());
    }
}
