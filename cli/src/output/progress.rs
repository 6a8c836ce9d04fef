//! What is going on while a command waits: spinners on a terminal, a line a change elsewhere. Always
//! on standard error.

use std::collections::BTreeMap;
use std::io::Write as _;
use std::time::Duration;

use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};

use super::human;

/// How often spinners turn.
const TICK: Duration = Duration::from_millis(120);

/// Rows of things that are waited for, by key.
#[derive(Debug)]
pub(crate) struct Progress {
    bars: MultiProgress,
    live: bool,
    rows: BTreeMap<String, Row>,
}

#[derive(Debug)]
struct Row {
    bar: ProgressBar,
    text: String,
}

impl Progress {
    /// `live`: standard error is a terminal.
    pub(crate) fn new(live: bool) -> Self {
        let target = if live { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
        Progress { bars: MultiProgress::with_draw_target(target), live, rows: BTreeMap::new() }
    }

    /// Says what `key` is doing now.
    pub(crate) fn show(&mut self, key: &str, text: &str) {
        let text = human::plain(text);
        let bars = &self.bars;
        let row = self.rows.entry(key.to_owned()).or_insert_with(|| {
            let bar = bars.add(ProgressBar::new_spinner());
            let style = ProgressStyle::with_template("{spinner} {msg}")
                .unwrap_or_else(|_| ProgressStyle::default_spinner());
            bar.set_style(style);
            bar.enable_steady_tick(TICK);
            Row { bar, text: String::new() }
        });
        if row.text == text {
            return;
        }
        row.bar.set_message(text.clone());
        if !self.live {
            say(&text);
        }
        row.text = text;
    }

    /// `key` is settled; on a terminal its row stays, with `icon` instead of the spinner.
    pub(crate) fn settle(&mut self, key: &str, icon: &str, text: &str) {
        self.show(key, text);
        if let Some(row) = self.rows.get(key) {
            // A template of a literal and the message always parses.
            if let Ok(style) = ProgressStyle::with_template(&format!("{icon} {{msg}}")) {
                row.bar.set_style(style);
            }
            row.bar.disable_steady_tick();
            row.bar.tick();
        }
    }

    /// `key` moves again after it was settled.
    pub(crate) fn unsettle(&mut self, key: &str) {
        if let Some(row) = self.rows.get(key)
            && let Ok(style) = ProgressStyle::with_template("{spinner} {msg}")
        {
            row.bar.set_style(style);
            row.bar.enable_steady_tick(TICK);
        }
    }

    /// Removes `key`.
    pub(crate) fn drop_row(&mut self, key: &str) {
        if let Some(row) = self.rows.remove(key) {
            row.bar.finish_and_clear();
        }
    }

    /// Ends; rows that are left stay on the terminal when `keep` is set.
    pub(crate) fn end(mut self, keep: bool) {
        for row in std::mem::take(&mut self.rows).into_values() {
            if keep { row.bar.abandon() } else { row.bar.finish_and_clear() }
        }
    }
}

/// A line on standard error. That nobody reads it is no reason to stop.
pub(crate) fn say(line: &str) {
    let _ = writeln!(std::io::stderr().lock(), "{line}");
}
