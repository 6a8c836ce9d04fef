//! The controller as its clients see it: real TLS on a free port, a real store in a temporary directory.

mod access;
mod objects;
mod removal;
mod support;
mod watching;
