//! What a stranger may send: seeds, which are what friends send, with pieces cut out, doubled, exchanged and made extreme.
//!
//! Random bytes do not get past the first line of a parser; a manifest with one value that is too large does. In a test that is a target stands:
//!
//! ```no_run
//! let inputs = muster_hostile::inputs("quantities");
//! muster_hostile::feed(bolero::check!(), inputs, |bytes| {
//!     assert!(String::from_utf8_lossy(bytes).parse::<u8>().is_err());
//! });
//! ```
//!
//! Its seeds are the files of `seeds/NAME`, and those that it names beside. `cargo test` gives each the same inputs every
//! time: what fails then fails because of a change. With [`SECONDS`] bolero's engine makes others for so long. What makes a
//! target fail is shrunk and printed: it belongs among the seeds then. The same targets run under bolero's other engines,
//! which are guided by coverage: `MUSTER_HOSTILE_SECONDS=0 cargo bolero test -e libfuzzer …`.

mod same;

use std::fs;
use std::panic::RefUnwindSafe;
use std::path::{Path, PathBuf};
use std::time::Duration;

use bolero::{
    BorrowedInput, ByteSliceGenerator, DefaultEngine, Driver, TestTarget, ValueGenerator,
};

use same::Same;

/// The variable of the environment that gives each target so many seconds, and inputs that nobody has seen.
pub const SECONDS: &str = "MUSTER_HOSTILE_SECONDS";

/// Without it: so many for each target as most get through in a few seconds in a debug build.
const USUAL: Same = Same { inputs: 20_000, at_most: Duration::from_secs(10) };

/// Edits of a seed.
const EDITS: usize = 6;

/// Longest piece that is cut out, doubled or moved, bytes.
const PIECE: usize = 64;

/// Longest run of one piece, in times.
const RUN: usize = 3_000;

/// Inputs are no longer than this, bytes: limits of size have tests of their own.
const LONGEST: usize = 256 << 10;

/// What readers stumble over.
const WORDS: [&[u8]; 40] = [
    b"",
    b" ",
    b"\n",
    b"\t",
    b"\r\n",
    b"\0",
    b"-",
    b"-1",
    b"0",
    b"1e308",
    b"1e-400",
    b"NaN",
    b"inf",
    b"-0",
    b"9223372036854775808",
    b"18446744073709551616",
    b"0x7f",
    b"1_000",
    b"\xff",
    b"\xc0\x80",
    b"\xef\xbb\xbf",
    "\u{202e}".as_bytes(),
    "é".as_bytes(),
    b"\"",
    b"'",
    b"\\",
    b"{",
    b"}",
    b"[",
    b"]",
    b"<",
    b">",
    b"&",
    b"%",
    b"/",
    b"..",
    b"~",
    b"null",
    b"\xff\xff\xff\xff",
    b"\x80\x80\x80\x80\x10",
];

/// Seeds, and what may come of them.
#[derive(Debug, Clone)]
pub struct Inputs(Vec<Vec<u8>>);

/// The seeds of a target: the files of `seeds/NAME` beside this crate.
///
/// # Panics
///
/// When there are none.
#[must_use]
pub fn inputs(name: &str) -> Inputs {
    Inputs(Vec::new()).and_those_in(&Path::new(env!("CARGO_MANIFEST_DIR")).join("seeds").join(name))
}

/// Gives inputs to a target: always the same ones, or for as long as the environment says ([`SECONDS`]).
///
/// # Panics
///
/// When the target does, or the environment says something that is no number.
pub fn feed<F>(
    target: TestTarget<ByteSliceGenerator, DefaultEngine, BorrowedInput>,
    inputs: Inputs,
    test: F,
) where
    F: FnMut(&Vec<u8>) + RefUnwindSafe,
{
    match std::env::var(SECONDS) {
        Ok(text) => {
            let time = Duration::from_secs(text.parse().expect("a number of seconds"));
            target.with_generator(inputs).with_test_time(time).for_each(test);
        }
        Err(_) => TestTarget::new(USUAL).with_generator(inputs).for_each(test),
    }
}

impl Inputs {
    /// The files of another directory, too.
    ///
    /// # Panics
    ///
    /// When there are none.
    #[must_use]
    pub fn and_those_in(mut self, dir: &Path) -> Inputs {
        let entries =
            fs::read_dir(dir).unwrap_or_else(|error| panic!("{}: {error}", dir.display()));
        let mut files: Vec<PathBuf> =
            entries.map(|entry| entry.expect("it is listed").path()).collect();
        // The same choices are the same input on every machine.
        files.sort();
        let before = self.0.len();
        self.0.extend(
            files
                .iter()
                .filter(|file| file.is_file())
                .map(|file| fs::read(file).expect("it is readable")),
        );
        assert!(self.0.len() > before, "{} has no seeds", dir.display());
        self
    }

    /// These, too.
    #[must_use]
    pub fn and(mut self, seeds: impl IntoIterator<Item = Vec<u8>>) -> Inputs {
        self.0.extend(seeds);
        self
    }

    fn any<D: Driver>(&self, driver: &mut D) -> Option<&[u8]> {
        let at = (0..self.0.len()).generate(driver)?;
        Some(&self.0[at])
    }

    fn edit<D: Driver>(&self, bytes: &mut Vec<u8>, driver: &mut D) -> Option<()> {
        let at = (0..=bytes.len()).generate(driver)?;
        let end = (at + (0..=PIECE).generate(driver)?).min(bytes.len());
        match (0..8_u8).generate(driver)? {
            0 => drop(bytes.drain(at..end)),
            1 => bytes.truncate(at),
            2 => bytes.extend_from_within(at..end),
            3 => {
                let times = (1..=RUN).generate(driver)?;
                let piece = bytes[at..end.min(at + 8)].repeat(times);
                insert(bytes, at, &piece);
            }
            4 => {
                let word = WORDS[(0..WORDS.len()).generate(driver)?];
                bytes.splice(at..end, word.iter().copied());
            }
            5 => insert(bytes, at, WORDS[(0..WORDS.len()).generate(driver)?]),
            6 => {
                let other = self.any(driver)?;
                let from = (0..=other.len()).generate(driver)?;
                let to = (from + (0..=PIECE).generate(driver)?).min(other.len());
                bytes.splice(at..end, other[from..to].iter().copied());
            }
            _ => {
                if let Some(byte) = bytes.get_mut(at) {
                    *byte = (0..=u8::MAX).generate(driver)?;
                }
            }
        }
        bytes.truncate(LONGEST);
        Some(())
    }
}

fn insert(bytes: &mut Vec<u8>, at: usize, piece: &[u8]) {
    bytes.splice(at..at, piece.iter().copied());
}

impl ValueGenerator for Inputs {
    type Output = Vec<u8>;

    fn generate<D: Driver>(&self, driver: &mut D) -> Option<Vec<u8>> {
        let mut bytes = self.any(driver)?.to_vec();
        // None at all is the seed as it is.
        for _ in 0..(0..=EDITS).generate(driver)? {
            self.edit(&mut bytes, driver)?;
        }
        Some(bytes)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::sync::Mutex;

    use super::*;

    #[test]
    fn inputs_are_seeds_and_what_is_near_them() {
        let seeds = || Inputs(Vec::new()).and([b"cpu: 500m".to_vec(), b"memory: 1Gi".to_vec()]);
        let made = Mutex::new(BTreeSet::new());
        let many = Same { inputs: 2_000, at_most: Duration::MAX };
        TestTarget::new(many).with_generator(seeds()).for_each(|bytes: &Vec<u8>| {
            assert!(bytes.len() <= LONGEST);
            made.lock().unwrap().insert(bytes.clone());
        });
        let made = made.into_inner().unwrap();
        assert!(seeds().0.iter().all(|seed| made.contains(seed)), "seeds as they are");
        assert!(made.len() > 1_000, "{}", made.len());
        let near = |bytes: &&Vec<u8>| bytes.starts_with(b"cpu: ") || bytes.starts_with(b"memory: ");
        assert!(made.iter().filter(near).count() > made.len() / 4);
    }
}
