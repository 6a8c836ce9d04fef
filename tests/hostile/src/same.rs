//! An engine of bolero's for every day: the same inputs in the same order, on every machine and in every run.
//!
//! bolero's own has a seed for one input, and takes those of a run from the kernel.

use std::fmt::Debug;
use std::time::{Duration, Instant};

use bolero_engine::driver::Options;
use bolero_engine::input::Bytes;
use bolero_engine::{Engine, Failure, Test, panic};

/// Choices of one input: of which seed, and its edits. Bytes; what is chosen after them is the least.
const CHOICES: usize = 128;

/// So many inputs, and none any more after a time.
#[derive(Debug)]
pub(crate) struct Same {
    pub(crate) inputs: u64,
    pub(crate) at_most: Duration,
}

/// SplitMix64's function (Steele, Lea, Flood: Fast splittable pseudorandom number generators, 2014).
fn mixed(number: u64) -> u64 {
    let mut mixed = number;
    mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    mixed ^ (mixed >> 31)
}

/// What the input of this seed is made by.
fn choices(seed: u64) -> Vec<u8> {
    const STEP: u64 = 0x9e37_79b9_7f4a_7c15;
    // Sequences that begin at neighbours of the step would be parts of each other.
    let begin = mixed(mixed(seed.wrapping_add(STEP)));
    let words = (1..=CHOICES as u64 / 8).map(|at| mixed(begin.wrapping_add(at.wrapping_mul(STEP))));
    words.flat_map(u64::to_le_bytes).collect()
}

impl<T: Test> Engine<T> for Same
where
    T::Value: Debug,
{
    type Output = ();

    fn run(self, mut test: T, options: Options) {
        panic::set_hook();
        // Of a panic only what is left of it after shrinking is told.
        let forwards = panic::forward_panic(false);
        let begun = Instant::now();
        let mut tried = 0;
        while tried < self.inputs && begun.elapsed() < self.at_most {
            let choices = choices(tried);
            if let Err(error) = test.test(&mut Bytes::new(&choices, &options)) {
                let shrunken = test.shrink(choices.clone(), None, &options);
                let failure = shrunken.unwrap_or_else(|| {
                    let input = test.generate_value(&mut Bytes::new(&choices, &options));
                    Failure { error, input, seed: None }
                });
                panic::forward_panic(true);
                panic!("seed {tried}: {failure:#}");
            }
            tried += 1;
        }
        panic::forward_panic(forwards);
        // Whoever measures targets reads it with --no-capture.
        eprintln!("{tried} of {} inputs in {:?}", self.inputs, begun.elapsed());
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use bolero::TestTarget;

    use super::*;

    fn hundred() -> Same {
        Same { inputs: 100, at_most: Duration::MAX }
    }

    #[test]
    fn a_run_is_the_run_before() {
        let run = || {
            let made = Mutex::new(Vec::new());
            let inputs = crate::inputs("quantities");
            TestTarget::new(hundred())
                .with_generator(inputs)
                .for_each(|bytes: &Vec<u8>| made.lock().unwrap().push(bytes.clone()));
            made.into_inner().unwrap()
        };
        let once = run();
        assert_eq!(once.len(), 100);
        assert_eq!(once, run());
    }

    #[test]
    #[should_panic(expected = "seed ")]
    fn what_fails_is_told_with_its_seed() {
        let inputs = crate::inputs("quantities");
        TestTarget::new(hundred())
            .with_generator(inputs)
            .for_each(|bytes: &Vec<u8>| assert!(bytes.is_empty(), "{bytes:?}"));
    }
}
