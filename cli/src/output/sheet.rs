//! The text that `describe` prints: fields under headings, values in one column.

use super::human;
use super::style::{Mood, Styles};
use super::table::{Cell, Table};

/// A line or block of a sheet.
#[derive(Debug)]
enum Item {
    Field {
        name: String,
        value: Cell,
    },
    /// Further lines of the last field's value.
    More(Cell),
    Heading(String),
    Table(Table),
    Line(Cell),
}

/// What is known of one object, in order.
#[derive(Debug, Default)]
pub(crate) struct Sheet {
    items: Vec<Item>,
}

/// Values begin here, so that sections line up with each other.
const VALUE_COLUMN: usize = 16;

impl Sheet {
    /// A named value.
    pub(crate) fn field(&mut self, name: &str, value: impl Into<Cell>) -> &mut Self {
        self.items.push(Item::Field { name: format!("{name}:"), value: value.into() });
        self
    }

    /// A named value, when there is one.
    pub(crate) fn maybe(&mut self, name: &str, value: Option<impl Into<Cell>>) -> &mut Self {
        if let Some(value) = value {
            self.field(name, value);
        }
        self
    }

    /// A named list, one a line; nothing when it is empty.
    pub(crate) fn list(
        &mut self,
        name: &str,
        values: impl IntoIterator<Item = String>,
    ) -> &mut Self {
        for (i, value) in values.into_iter().enumerate() {
            if i == 0 {
                self.field(name, value);
            } else {
                self.items.push(Item::More(value.into()));
            }
        }
        self
    }

    /// A heading; what follows belongs to it.
    pub(crate) fn heading(&mut self, text: &str) -> &mut Self {
        self.items.push(Item::Heading(text.to_owned()));
        self
    }

    /// A heading with a table, or with `none` when it has no rows.
    pub(crate) fn table(&mut self, heading: &str, table: Table) -> &mut Self {
        self.heading(heading);
        let item = if table.is_empty() {
            Item::Line(Cell::new("none", Mood::Dim))
        } else {
            Item::Table(table)
        };
        self.items.push(item);
        self
    }

    /// The text, with a newline at its end.
    pub(crate) fn text(&self, styles: &Styles) -> String {
        let mut text = String::new();
        let mut indent = "";
        let paint = |cell: &Cell| styles.of(cell.mood()).paint(cell.text());
        for item in &self.items {
            match item {
                Item::Heading(heading) => {
                    text.push_str(&format!("\n{}\n", styles.head.paint(heading)));
                    indent = "  ";
                }
                Item::Field { name, value } => {
                    let width = VALUE_COLUMN - indent.len();
                    text.push_str(&format!("{indent}{name:width$} {}\n", paint(value)));
                }
                Item::More(value) => {
                    text.push_str(&format!("{:VALUE_COLUMN$} {}\n", "", paint(value)));
                }
                Item::Line(line) => text.push_str(&format!("{indent}{}\n", paint(line))),
                Item::Table(table) => {
                    for line in table.text(styles).lines() {
                        text.push_str(&format!("{indent}{line}\n"));
                    }
                }
            }
        }
        text
    }
}

/// Labels or annotations, one a line.
pub(crate) fn pairs<'a>(
    pairs: impl IntoIterator<Item = (&'a String, &'a String)>,
) -> impl Iterator<Item = String> {
    pairs.into_iter().map(|(k, v)| human::plain(&format!("{k}={v}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_stand_in_one_column_and_sections_are_indented() {
        let mut sheet = Sheet::default();
        sheet.field("Name", "t").list("Labels", ["a=b".to_owned(), "c=d".to_owned()]);
        sheet.heading("Placement").field("On", "Robot").maybe("At", None::<&str>);
        sheet.table("Events", Table::new(["REASON"]));
        assert_eq!(
            sheet.text(&Styles::default()),
            "Name:            t\nLabels:          a=b\n                 c=d\n\nPlacement\n  On:            Robot\n\nEvents\n  none\n"
        );
    }
}
