//! What a camera on a robot sees: a floor, a wall, things that move, and noise. Colour, 8 bits.

use super::rng::Rng;

/// A colour image, one plane a colour: red, green, blue.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Image {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) planes: [Vec<u8>; 3],
}

/// A scene with a seed: its n-th frame is always the same.
#[derive(Debug, Clone)]
pub(super) struct Scene {
    things: Vec<Thing>,
    noise: Rng,
    frame: u32,
    image: Image,
}

/// Something that moves. Positions and sizes are in parts of the image's height.
#[derive(Debug, Clone)]
struct Thing {
    round: bool,
    at: [f64; 2],
    /// Per frame.
    speed: [f64; 2],
    size: f64,
    colour: [u8; 3],
}

/// Sensor noise, in steps of 255, at most.
const NOISE: i32 = 6;
/// People and boxes in view.
const THINGS: usize = 7;
/// Squares of the floor, in parts of the image's height.
const TILE: f64 = 0.11;

impl Scene {
    pub(super) fn new(width: usize, height: usize, seed: u64) -> Self {
        let mut rng = Rng::new(seed);
        let aspect = width as f64 / height as f64;
        let things = (0..THINGS)
            .map(|_| Thing {
                round: rng.below(2) == 0,
                at: [rng.between(0.0, aspect), rng.unit()],
                speed: [rng.between(-0.01, 0.01), rng.between(-0.006, 0.006)],
                size: rng.between(0.06, 0.2),
                colour: [0; 3].map(|_| rng.below(256) as u8),
            })
            .collect();
        let planes = [0; 3].map(|_| vec![0; width * height]);
        Scene { things, noise: rng, frame: 0, image: Image { width, height, planes } }
    }

    /// The next frame.
    pub(super) fn frame(&mut self) -> &Image {
        self.frame += 1;
        self.paint_room();
        let aspect = self.image.width as f64 / self.image.height as f64;
        for thing in &mut self.things {
            for (axis, end) in [(0, aspect), (1, 1.0)] {
                thing.at[axis] += thing.speed[axis];
                if !(0.0..=end).contains(&thing.at[axis]) {
                    thing.speed[axis] = -thing.speed[axis];
                }
            }
            paint(&mut self.image, thing);
        }
        self.add_noise();
        &self.image
    }

    /// A wall that is brighter at its top, and a floor of tiles that pass below the robot.
    fn paint_room(&mut self) {
        let (width, height) = (self.image.width, self.image.height);
        let tile = (TILE * height as f64).max(1.0) as usize;
        let passed = self.frame as usize / 2;
        for y in 0..height {
            let row = y * width..(y + 1) * width;
            if y < height * 3 / 5 {
                let shade = 200 - (y * 90 / height) as u8;
                for (plane, tint) in self.image.planes.iter_mut().zip([10, 4, 0]) {
                    plane[row.clone()].fill(shade + tint);
                }
            } else {
                for x in 0..width {
                    let dark = ((x / tile) + (y + passed) / tile).is_multiple_of(2);
                    for (plane, tint) in self.image.planes.iter_mut().zip([25, 12, 0]) {
                        plane[y * width + x] = tint + if dark { 60 } else { 150 };
                    }
                }
            }
        }
    }

    fn add_noise(&mut self) {
        for plane in &mut self.image.planes {
            // Eight pixels a draw: noise is not what this should spend its time on.
            for pixels in plane.chunks_mut(8) {
                let draw = self.noise.next().to_le_bytes();
                for (pixel, byte) in pixels.iter_mut().zip(draw) {
                    let noise = ((i32::from(byte) - 128) * NOISE) >> 7;
                    *pixel = (i32::from(*pixel) + noise).clamp(0, 255) as u8;
                }
            }
        }
    }
}

fn paint(image: &mut Image, thing: &Thing) {
    let scale = image.height as f64;
    let reach = thing.size * scale;
    let centre = thing.at.map(|c| c * scale);
    let span = |c: f64, end: usize| {
        let low = (c - reach).max(0.0) as usize;
        low..((c + reach).max(0.0) as usize).min(end)
    };
    for y in span(centre[1], image.height) {
        for x in span(centre[0], image.width) {
            let (dx, dy) = (x as f64 - centre[0], y as f64 - centre[1]);
            if thing.round && dx * dx + dy * dy > reach * reach {
                continue;
            }
            for (plane, colour) in image.planes.iter_mut().zip(thing.colour) {
                plane[y * image.width + x] = colour;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_seed_is_a_film() {
        let film = |seed| {
            let mut scene = Scene::new(64, 48, seed);
            (scene.frame().clone(), scene.frame().clone())
        };
        let (first, second) = film(3);
        assert_eq!((first.clone(), second.clone()), film(3));
        assert_ne!(first, second, "it moves");
        assert_ne!(first, film(4).0);
    }
}
