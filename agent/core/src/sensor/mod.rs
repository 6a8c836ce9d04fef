//! Sensors: one reader of each source for any number of tasks, decided without touching any.
//!
//! | file | holds |
//! |---|---|
//! | [`fan`] | which reader gets which frame, and whose frames are dropped |
//! | [`source`] | when a source is read, ended, and tried again |
//!
//! What it promises:
//!
//! - A source is read while some task wants it, by one reader at a time.
//! - What a reader gets, and what it loses, does not depend on what other readers do, unless memory runs out: then whoever has
//!   the oldest frame gives it up.
//! - A reader is told of every frame between two of its own that it did not get.

pub mod fan;
pub mod source;
