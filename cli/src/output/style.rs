//! Colours by meaning. Plain unless [`Styles::colorize`] was called; nothing else decides about colour.

use std::fmt::Display;

use anstyle::{AnsiColor, Style};
pub(crate) use muster_api::table::Mood;

/// One style; plain by default.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Paint(Style);

/// One style a meaning.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Styles {
    pub(crate) good: Paint,
    pub(crate) warn: Paint,
    pub(crate) bad: Paint,
    pub(crate) dim: Paint,
    pub(crate) head: Paint,
}

impl Paint {
    /// The text with the style around it.
    pub(crate) fn paint(&self, text: impl Display) -> String {
        format!("{}{text}{}", self.0.render(), self.0.render_reset())
    }

    /// What switches the style on, and off again.
    pub(crate) fn codes(&self) -> (String, String) {
        (self.0.render().to_string(), self.0.render_reset().to_string())
    }
}

impl Styles {
    /// Fills the colours in.
    pub(crate) fn colorize(&mut self) {
        let colour = |c: AnsiColor| Paint(Style::new().fg_color(Some(c.into())));
        *self = Styles {
            good: colour(AnsiColor::Green),
            warn: colour(AnsiColor::Yellow),
            bad: Paint(Style::new().fg_color(Some(AnsiColor::Red.into())).bold()),
            dim: Paint(Style::new().dimmed()),
            head: Paint(Style::new().bold()),
        };
    }

    /// The style of a mood.
    pub(crate) fn of(&self, mood: Mood) -> Paint {
        match mood {
            Mood::Plain => Paint::default(),
            Mood::Good => self.good,
            Mood::Warn => self.warn,
            Mood::Bad => self.bad,
            Mood::Dim => self.dim,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plain_until_colorized() {
        let mut styles = Styles::default();
        assert_eq!(styles.bad.paint("x"), "x");
        styles.colorize();
        assert!(styles.bad.paint("x").starts_with('\u{1b}'));
        assert_eq!(styles.of(Mood::Plain).paint("x"), "x");
    }
}
