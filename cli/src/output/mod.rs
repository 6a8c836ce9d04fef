//! What commands print. Data goes to standard output through [`ui::Ui`], everything else to standard error.
//!
//! | module | holds |
//! |---|---|
//! | [`style`] | colours by meaning |
//! | [`human`] | ages, amounts, counts |
//! | [`table`], [`sheet`] | layouts: rows; fields under headings |
//! | [`columns`] | the columns of each kind, one file a kind |
//! | [`objects`] | objects in the format that `-o` asks for |
//! | [`progress`] | spinners while waiting |

pub(crate) mod columns;
pub(crate) mod human;
pub(crate) mod objects;
pub(crate) mod progress;
pub(crate) mod sheet;
pub(crate) mod style;
pub(crate) mod table;
pub(crate) mod ui;
