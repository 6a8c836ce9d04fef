//! Maps as map_server keeps them: a YAML file and an image beside it.
//!
//! ```yaml
//! image: lab.pgm
//! resolution: 0.05               # metres a pixel
//! origin: [-10.0, -8.0, 0.0]     # of the lower left corner in the map frame: metres, radians
//! negate: 0
//! occupied_thresh: 0.65
//! free_thresh: 0.196
//! ```
//!
//! An image becomes a [`Grid`] of cells that are free, occupied or unknown, by map_server's rules. Its rows stand from below, as
//! y grows; an image's stand from above.

use serde::Deserialize;

/// Cells of a map at most: 4 096 × 4 096, 204 m × 204 m at 5 cm.
pub const MOST_CELLS: u64 = 1 << 24;

/// A map_server map's YAML file. What others write into it beside is passed over.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct MapFile {
    /// The image, beside the file.
    pub image: String,
    /// Metres across a pixel.
    pub resolution: f64,
    /// The lower left corner's x and y, metres, and the map's turn, radians.
    pub origin: [f64; 3],
    /// Not 0: white is occupied.
    #[serde(default)]
    pub negate: u8,
    /// Darker than this is occupied: 0 is white, 1 is black.
    pub occupied_thresh: f64,
    /// Brighter than this is free.
    pub free_thresh: f64,
    /// How values between are read.
    #[serde(default)]
    pub mode: Mode,
}

/// How an image's values are read.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// Free, occupied, and unknown between.
    #[default]
    Trinary,
    /// The same here: what is between has been seen too seldom to be either.
    Scale,
    /// The value is the occupancy in percent; above 100 is unknown.
    Raw,
}

/// What is known of a square of floor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cell {
    /// A robot may be there.
    Free,
    /// Something stands there.
    Occupied,
    /// Nobody has looked.
    Unknown,
}

/// An image of grey values, rows from above.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Gray {
    /// Pixels across.
    pub width: u32,
    /// Pixels down.
    pub height: u32,
    /// 0 black to 255 white.
    pub pixels: Vec<u8>,
}

/// A map.
#[derive(Debug, Clone, PartialEq)]
pub struct Grid {
    /// Cells across.
    pub width: u32,
    /// Cells up.
    pub height: u32,
    /// Metres across a cell.
    pub resolution: f64,
    /// Its lower left corner's x and y in the map frame, metres, and its turn, radians.
    pub origin: [f64; 3],
    /// Rows from below, each from the left.
    pub cells: Vec<Cell>,
}

/// Why a file is no map.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MapError {
    /// The YAML file does not read.
    #[error("is no map_server map: {0}")]
    Yaml(String),
    /// A number makes no sense.
    #[error("{field}: {value} is not {wanted}")]
    Number {
        /// `resolution`.
        field: &'static str,
        /// What it says.
        value: f64,
        /// What it should be.
        wanted: &'static str,
    },
    /// Free would be darker than occupied.
    #[error("free_thresh: {free} is above occupied_thresh, {occupied}; 0.196 and 0.65 are usual")]
    Thresholds {
        /// `free_thresh`.
        free: f64,
        /// `occupied_thresh`.
        occupied: f64,
    },
    /// The image is no PGM.
    #[error("at byte {at}: is no PGM image: {reason}")]
    Pgm {
        /// How far it could be read.
        at: usize,
        /// What is wrong there.
        reason: &'static str,
    },
    /// There is too much of it, or nothing.
    #[error("has {width} x {height} pixels; at least 1 and at most 16777216 in all are taken")]
    Size {
        /// Pixels across.
        width: u64,
        /// Pixels down.
        height: u64,
    },
}

impl MapFile {
    /// Reads the YAML file.
    ///
    /// # Errors
    ///
    /// What is wrong, with line and column or the field's name.
    pub fn parse(text: &str) -> Result<MapFile, MapError> {
        let file: MapFile =
            serde_saphyr::from_str(text).map_err(|error| MapError::Yaml(error.to_string()))?;
        let number = |field, value: f64, good: bool, wanted| {
            if good { Ok(()) } else { Err(MapError::Number { field, value, wanted }) }
        };
        let part = |value: f64| (0.0..=1.0).contains(&value);
        let is_size = file.resolution.is_finite() && file.resolution > 0.0;
        number(
            "resolution",
            file.resolution,
            is_size,
            "a length in metres above 0; 0.05 is usual",
        )?;
        for value in file.origin {
            number("origin", value, value.is_finite(), "a finite number")?;
        }
        let (free, occupied) = (file.free_thresh, file.occupied_thresh);
        number("occupied_thresh", occupied, part(occupied), "between 0 and 1; 0.65 is usual")?;
        number("free_thresh", free, part(free), "between 0 and 1; 0.196 is usual")?;
        if free > occupied { Err(MapError::Thresholds { free, occupied }) } else { Ok(file) }
    }

    /// What a grey value says.
    #[must_use]
    pub fn cell(&self, value: u8) -> Cell {
        let occupancy = match (self.mode, self.negate) {
            (Mode::Raw, _) if value > 100 => return Cell::Unknown,
            (Mode::Raw, _) => f64::from(value) / 100.0,
            (_, 0) => f64::from(255 - value) / 255.0,
            (_, _) => f64::from(value) / 255.0,
        };
        match occupancy {
            p if p > self.occupied_thresh => Cell::Occupied,
            p if p < self.free_thresh => Cell::Free,
            _ => Cell::Unknown,
        }
    }

    /// The map that this file makes of its image.
    #[must_use]
    pub fn grid(&self, image: &Gray) -> Grid {
        let rows = image.pixels.chunks(image.width.max(1) as usize).rev();
        Grid {
            width: image.width,
            height: image.height,
            resolution: self.resolution,
            origin: self.origin,
            cells: rows.flatten().map(|value| self.cell(*value)).collect(),
        }
    }
}

impl Grid {
    /// The cell at a place in the map frame; none: it is beyond the map.
    #[must_use]
    pub fn cell_at(&self, x: f64, y: f64) -> Option<usize> {
        let (east, north) = (x - self.origin[0], y - self.origin[1]);
        let (sin, cos) = self.origin[2].sin_cos();
        let across = ((cos * east + sin * north) / self.resolution).floor();
        let up = ((cos * north - sin * east) / self.resolution).floor();
        let inside = (0.0..f64::from(self.width)).contains(&across)
            && (0.0..f64::from(self.height)).contains(&up);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "inside the map"
        )]
        inside.then(|| up as usize * self.width as usize + across as usize)
    }

    /// What is known of a place; none: it is beyond the map.
    #[must_use]
    pub fn at(&self, x: f64, y: f64) -> Option<Cell> {
        self.cells.get(self.cell_at(x, y)?).copied()
    }
}

impl Gray {
    /// An image of this size.
    ///
    /// # Errors
    ///
    /// It is none, or too large.
    pub fn new(width: u32, height: u32, pixels: Vec<u8>) -> Result<Gray, MapError> {
        check_size(u64::from(width), u64::from(height))?;
        if pixels.len() as u64 == u64::from(width) * u64::from(height) {
            return Ok(Gray { width, height, pixels });
        }
        Err(MapError::Size { width: width.into(), height: height.into() })
    }

    /// Reads a PGM image, plain (P2) or raw (P5), of 8 bits.
    ///
    /// # Errors
    ///
    /// The byte from which on it is none.
    pub fn pgm(bytes: &[u8]) -> Result<Gray, MapError> {
        let mut reader = Pgm { bytes, at: 2 };
        let plain = match bytes.get(..2) {
            Some(b"P5") => false,
            Some(b"P2") => true,
            _ => return Err(MapError::Pgm { at: 0, reason: "it does not begin with P5 or P2" }),
        };
        let (width, height) = (reader.number()?, reader.number()?);
        let (width, height) = (u64::from(width), u64::from(height));
        check_size(width, height)?;
        let white = reader.number()?;
        if !(1..=255).contains(&white) {
            return reader.fail("white is not 1 to 255: images of 8 bits are taken");
        }
        let count = usize::try_from(width * height).unwrap_or(usize::MAX);
        let scaled =
            |value: u32| u8::try_from((value.min(white) * 255 + white / 2) / white).unwrap_or(255);
        let pixels: Vec<u8> = if plain {
            (0..count).map(|_| reader.number().map(scaled)).collect::<Result<_, _>>()?
        } else {
            // One blank between the head and the pixels.
            let rest = bytes.get(reader.at + 1..).unwrap_or_default();
            let Some(raw) = rest.get(..count) else {
                reader.at = bytes.len();
                return reader.fail("it ends before its last pixel");
            };
            raw.iter().map(|value| scaled(u32::from(*value))).collect()
        };
        let side = |length: u64| u32::try_from(length).unwrap_or(u32::MAX);
        Gray::new(side(width), side(height), pixels)
    }
}

fn check_size(width: u64, height: u64) -> Result<(), MapError> {
    let cells = width.saturating_mul(height);
    if (1..=MOST_CELLS).contains(&cells) { Ok(()) } else { Err(MapError::Size { width, height }) }
}

/// The head of a PGM image: numbers with blanks and comments between.
struct Pgm<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl Pgm<'_> {
    fn fail<T>(&self, reason: &'static str) -> Result<T, MapError> {
        Err(MapError::Pgm { at: self.at, reason })
    }

    fn number(&mut self) -> Result<u32, MapError> {
        let mut comment = false;
        while let Some(byte) = self.bytes.get(self.at) {
            comment = (comment && *byte != b'\n') || *byte == b'#';
            if !comment && !byte.is_ascii_whitespace() {
                break;
            }
            self.at += 1;
        }
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let digits = rest.iter().take_while(|byte| byte.is_ascii_digit()).count();
        let text = std::str::from_utf8(&rest[..digits]).unwrap_or_default();
        let Ok(number) = text.parse() else { return self.fail("there should be a number") };
        self.at += digits;
        Ok(number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FILE: &str = "image: lab.pgm\nresolution: 0.05\norigin: [-1.0, -2.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n";

    #[test]
    fn an_image_becomes_a_grid_by_map_server_s_rules() {
        let file = MapFile::parse(FILE).expect("a map");
        // As map_saver writes it: 254 free, 205 unknown, 0 occupied.
        let image = b"P5\n# CREATOR: map_saver 0.050 m/pix\n2 2\n255\n\x00\xcd\xfe\x00";
        let grid = file.grid(&Gray::pgm(image).expect("an image"));
        use Cell::{Free, Occupied, Unknown};
        assert_eq!(grid.cells, [Free, Occupied, Occupied, Unknown], "rows from below");
        assert_eq!((grid.width, grid.height, grid.origin[1]), (2, 2, -2.0));
        assert_eq!((grid.at(-0.97, -1.97), grid.at(-0.93, -1.97)), (Some(Free), Some(Occupied)));
        assert_eq!((grid.at(-1.01, -1.97), grid.at(-0.97, -1.89)), (None, None));
        let turned = Grid { origin: [0.0, 0.0, std::f64::consts::FRAC_PI_2], ..grid.clone() };
        assert_eq!((turned.at(-0.03, 0.07), turned.at(0.03, 0.03)), (Some(Occupied), None));
        let plain = Gray::pgm(b"P2 2 2 # a comment\n 5  0 4\n5 0").expect("an image");
        assert_eq!(plain.pixels, [0, 204, 255, 0]);
        assert_eq!(file.grid(&plain), grid);
        let negated = MapFile { negate: 1, ..file.clone() };
        assert_eq!((negated.cell(255), negated.cell(0)), (Occupied, Free));
        let raw = MapFile { mode: Mode::Raw, ..file };
        assert_eq!(
            (raw.cell(100), raw.cell(0), raw.cell(40), raw.cell(255)),
            (Occupied, Free, Unknown, Unknown)
        );
    }

    #[test]
    fn what_is_no_map_is_refused_with_its_place() {
        let yaml = |from: &str, to: &str| {
            MapFile::parse(&FILE.replace(from, to)).expect_err(to).to_string()
        };
        assert!(
            yaml("resolution: 0.05", "resolution: 0").starts_with("resolution: 0 is not a length")
        );
        assert!(yaml("0.196", "0.9").starts_with("free_thresh: 0.9 is above"));
        assert!(yaml("image: lab.pgm\n", "").contains("image"));
        let pgm = |bytes: &[u8]| Gray::pgm(bytes).expect_err("no image").to_string();
        assert_eq!(pgm(b"\x89PNG"), "at byte 0: is no PGM image: it does not begin with P5 or P2");
        assert_eq!(
            pgm(b"P5 2 2 255\n\0\0"),
            "at byte 13: is no PGM image: it ends before its last pixel"
        );
        assert_eq!(pgm(b"P5 2 x"), "at byte 5: is no PGM image: there should be a number");
        assert_eq!(
            pgm(b"P5 2 2 65535\n"),
            "at byte 12: is no PGM image: white is not 1 to 255: images of 8 bits are taken"
        );
        assert!(pgm(b"P5 9999999 9999999 255\n").starts_with("has 9999999 x 9999999 pixels"));
        assert!(pgm(b"P5 0 2 255\n").starts_with("has 0 x 2"));
    }
}
