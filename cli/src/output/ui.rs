//! The two streams of a command and what is known of their readers.

use std::io::{self, IsTerminal as _, Write};

use anstream::{AutoStream, ColorChoice};

use super::progress::{Progress, say};
use super::style::Styles;
use crate::error::CliError;

/// When to use colours.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Color {
    /// On terminals, unless NO_COLOR is set
    #[default]
    Auto,
    /// In any case
    Always,
    /// Never
    Never,
}

/// The streams of a command.
pub(crate) struct Ui {
    out: Box<dyn Write + Send>,
    /// For standard output.
    pub(crate) styles: Styles,
    /// For standard error.
    err_styles: Styles,
    live: bool,
    /// Standard output is a terminal, where a picture can be drawn over the last one.
    redraws: bool,
}

impl Ui {
    /// The process's own streams.
    pub(crate) fn of_process(color: Color) -> Self {
        let styles = |choice: ColorChoice| {
            let mut styles = Styles::default();
            let colour = match color {
                Color::Auto => choice != ColorChoice::Never,
                Color::Always => true,
                Color::Never => false,
            };
            if colour {
                styles.colorize();
            }
            styles
        };
        let moves_cursor = std::env::var_os("TERM").is_none_or(|t| t != "dumb");
        Ui {
            styles: styles(AutoStream::choice(&io::stdout())),
            err_styles: styles(AutoStream::choice(&io::stderr())),
            live: moves_cursor && io::stderr().is_terminal(),
            redraws: moves_cursor && io::stdout().is_terminal(),
            out: Box::new(io::stdout()),
        }
    }

    /// Output into `out`, plain; for tests.
    #[cfg(test)]
    pub(crate) fn plain(out: Box<dyn Write + Send>) -> Self {
        Ui {
            out,
            styles: Styles::default(),
            err_styles: Styles::default(),
            live: false,
            redraws: false,
        }
    }

    /// Data.
    pub(crate) fn print(&mut self, text: &str) -> Result<(), CliError> {
        self.print_bytes(text.as_bytes())
    }

    /// Data of any kind, at once.
    pub(crate) fn print_bytes(&mut self, bytes: &[u8]) -> Result<(), CliError> {
        let written = self.out.write_all(bytes).and_then(|()| self.out.flush());
        written.map_err(|error| match error.kind() {
            io::ErrorKind::BrokenPipe => CliError::BrokenPipe,
            _ => CliError::Output(error),
        })
    }

    /// Whether [`Ui::redraw`] shows one picture instead of the next under the last.
    pub(crate) fn redraws(&self) -> bool {
        self.redraws
    }

    /// Data instead of what is on the terminal. In one piece, so that it does not flicker.
    pub(crate) fn redraw(&mut self, text: &str) -> Result<(), CliError> {
        const HOME_AND_CLEAR: &str = "\u{1b}[H\u{1b}[2J";
        self.print(&format!("{HOME_AND_CLEAR}{text}"))
    }

    /// A line of data.
    pub(crate) fn line(&mut self, text: &str) -> Result<(), CliError> {
        self.print(&format!("{text}\n"))
    }

    /// A note beside the data.
    pub(crate) fn note(&self, text: &str) {
        say(text);
    }

    /// A warning.
    pub(crate) fn warn(&self, text: &str) {
        say(&format!("{} {text}", self.err_styles.warn.paint("warning:")));
    }

    /// An error after which the command may go on with the rest.
    pub(crate) fn report(&self, error: &CliError) {
        if !matches!(error, CliError::BrokenPipe) {
            say(error.render(&self.err_styles).trim_end());
        }
    }

    /// A display of what is waited for.
    pub(crate) fn progress(&self) -> Progress {
        Progress::new(self.live)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Gone;

    impl Write for Gone {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(io::ErrorKind::BrokenPipe.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_reader_that_left_is_told_apart() {
        let error = Ui::plain(Box::new(Gone)).line("x").expect_err("nobody reads");
        assert!(matches!(error, CliError::BrokenPipe));
    }
}
