//! What happened, a line an event: the same for the same seed and steps. Its digest tells two runs apart.

use std::fmt::{self, Write as _};

/// The log of a run.
#[derive(Debug, Default)]
pub(crate) struct Log {
    line: String,
    digest: u64,
    aloud: bool,
    pub(crate) step: u64,
}

impl Log {
    /// `aloud`: every line is printed.
    pub(crate) fn new(aloud: bool) -> Log {
        Log { aloud, ..Log::default() }
    }

    /// A line. `now`: milliseconds since the run began.
    pub(crate) fn say(&mut self, now: u64, words: fmt::Arguments<'_>) {
        self.line.clear();
        // A String takes everything.
        let _ = write!(self.line, "{:>8}.{:03} #{:<5} {words}", now / 1000, now % 1000, self.step);
        for byte in self.line.bytes() {
            self.digest = (self.digest ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01B3);
        }
        if self.aloud {
            println!("{}", self.line);
        }
    }

    pub(crate) fn digest(&self) -> u64 {
        self.digest
    }
}
