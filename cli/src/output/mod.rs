//! What commands print. Data goes to standard output through [`ui::Ui`], everything else to standard error.
//!
//! | module | holds |
//! |---|---|
//! | [`style`] | colours by meaning |
//! | [`table`], [`sheet`] | layouts: rows; fields under headings |
//! | [`columns`] | objects of a kind as rows |
//! | [`objects`] | objects in the format that `-o` asks for |
//! | [`progress`] | spinners while waiting |

pub(crate) mod columns;
pub(crate) mod objects;
pub(crate) mod progress;
pub(crate) mod sheet;
pub(crate) mod style;
pub(crate) mod table;
pub(crate) mod ui;

pub(crate) use muster_api::table::human;
