//! Tables as kubectl prints them: no borders, columns as wide as their widest cell (by display
//! width), no wrapping, so that a line is a row for `grep` and `awk`.

use comfy_table::presets::NOTHING;
use comfy_table::{ColumnConstraint, Width};

pub(crate) use muster_api::table::Cell;

use super::style::{Mood, Styles};

/// Zero-width operators that stand for a mood's begin and end while widths are computed. They mean
/// nothing outside mathematics, and [`Table::push`] drops them from data.
const MARKS: [(char, Mood); 4] = [
    ('\u{2061}', Mood::Good),
    ('\u{2062}', Mood::Warn),
    ('\u{2063}', Mood::Bad),
    ('\u{2064}', Mood::Dim),
];

fn mark(mood: Mood) -> Option<char> {
    MARKS.iter().find(|(_, m)| *m == mood).map(|(c, _)| *c)
}

/// A table that is being filled.
#[derive(Debug, Clone, Default)]
pub(crate) struct Table {
    head: Vec<String>,
    rows: Vec<Vec<Cell>>,
    /// Widths that columns had before, so that a watch does not jump.
    least: Vec<u16>,
}

impl Table {
    /// A table with these heads; none: no head line.
    pub(crate) fn new(head: impl IntoIterator<Item = impl Into<String>>) -> Self {
        Table {
            head: head.into_iter().map(Into::into).collect(),
            rows: Vec::new(),
            least: Vec::new(),
        }
    }

    /// Adds a row.
    pub(crate) fn push(&mut self, row: impl IntoIterator<Item = impl Into<Cell>>) {
        let clean = |cell: Cell| {
            let text: String =
                cell.text().chars().filter(|c| !MARKS.iter().any(|(m, _)| m == c)).collect();
            Cell::new(text, cell.mood())
        };
        self.rows.push(row.into_iter().map(|c| clean(c.into())).collect());
    }

    /// Puts a column in front of all others.
    pub(crate) fn prepend(&mut self, head: &str, cells: impl IntoIterator<Item = String>) {
        self.head.insert(0, head.to_owned());
        for (row, cell) in self.rows.iter_mut().zip(cells) {
            row.insert(0, cell.into());
        }
    }

    /// No head line.
    pub(crate) fn without_head(mut self) -> Self {
        self.head.clear();
        self
    }

    /// Makes no column narrower than it was in `before`.
    pub(crate) fn at_least(&mut self, before: &[u16]) {
        self.least = before.to_vec();
    }

    /// No rows.
    pub(crate) fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// The lines, each with a newline, and the widths they came out with.
    pub(crate) fn render(&self, styles: &Styles) -> (String, Vec<u16>) {
        let mut table = comfy_table::Table::new();
        table.load_style(NOTHING);
        if !self.head.is_empty() {
            table.set_header(&self.head);
        }
        for row in &self.rows {
            table.add_row(row.iter().map(|cell| match mark(cell.mood()) {
                Some(mark) => format!("{mark}{}{mark}", cell.text()),
                None => cell.text().to_owned(),
            }));
        }
        let mut widths = table.column_max_content_widths();
        widths.resize(widths.len().max(self.least.len()), 0);
        for (width, least) in widths.iter_mut().zip(&self.least) {
            *width = (*width).max(*least);
        }
        for (column, width) in table.column_iter_mut().zip(&widths) {
            column.set_padding((0, 3));
            column.set_constraint(ColumnConstraint::Absolute(Width::Fixed(width + 3)));
        }
        let mut text = String::new();
        for (i, line) in table.lines().enumerate() {
            let line = line.trim_end();
            match i == 0 && !self.head.is_empty() {
                true => text.push_str(&styles.head.paint(line)),
                false => text.push_str(&unmark(line, styles)),
            }
            text.push('\n');
        }
        (text, widths)
    }

    /// The lines.
    pub(crate) fn text(&self, styles: &Styles) -> String {
        self.render(styles).0
    }
}

/// Puts the codes of the styles where the marks are.
fn unmark(line: &str, styles: &Styles) -> String {
    let mut text = String::with_capacity(line.len());
    let mut open = false;
    for c in line.chars() {
        match MARKS.iter().find(|(m, _)| *m == c) {
            None => text.push(c),
            Some((_, mood)) => {
                let (on, off) = styles.of(*mood).codes();
                text.push_str(if open { &off } else { &on });
                open = !open;
            }
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_as_wide_as_their_widest_cell() {
        let mut table = Table::new(["NAME", "PHASE"]);
        table.push(["gmapping", "Running"]);
        table.push(["位置", ""]);
        assert_eq!(
            table.text(&Styles::default()),
            "NAME       PHASE\ngmapping   Running\n位置       -\n"
        );
    }

    #[test]
    fn colours_change_no_width() {
        let mut table = Table::new(["A", "B"]);
        table.push([Cell::new("x", Mood::Bad), Cell::from("y")]);
        let mut styles = Styles::default();
        let plain = table.text(&styles);
        styles.colorize();
        let coloured = table.text(&styles);
        assert!(coloured.contains("\u{1b}[31m"), "{coloured:?}");
        assert_eq!(anstream::adapter::strip_str(&coloured).to_string(), plain);
        assert_eq!(plain, "A   B\nx   y\n");
    }

    #[test]
    fn a_long_cell_stays_on_its_line() {
        let mut table = Table::new(["A", "B"]);
        table.push(["word ".repeat(60).as_str(), "two\nlines"]);
        assert_eq!(table.text(&Styles::default()).lines().count(), 2);
    }

    #[test]
    fn later_rows_of_a_watch_keep_the_widths() {
        let mut first = Table::new(["NAME", "PHASE"]);
        first.push(["a-long-name", "Running"]);
        let (_, widths) = first.render(&Styles::default());
        let mut second = Table::new(["NAME", "PHASE"]).without_head();
        second.push(["b", "Failed"]);
        second.at_least(&widths);
        assert_eq!(second.text(&Styles::default()), "b             Failed\n");
    }
}
