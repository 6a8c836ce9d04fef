//! Random worlds, the same for the same seed, for what [`crate::offload`] decides. `muster simulate offload` prints what
//! they show; the tests hold it against what is promised.
//!
//! | module | simulates |
//! |---|---|
//! | [`instance`], [`sweep`] | single decisions of every size, beside their proven optimum and Algorithm 1 |
//! | [`exact`] | the optimum, by another method than the solver's |
//! | [`trace`] | links that come and go |
//! | [`world`] | an application on scales: parts start, serve and end, links break, the robot acts alone |
//! | [`course`] | AnyScale's test bed: 115 m, faster while amcl is away |
//! | [`numbers`] | randomness from a seed |

pub mod course;
pub mod exact;
pub mod instance;
pub mod numbers;
pub mod sweep;
#[cfg(test)]
pub(crate) mod tests;
pub mod trace;
pub mod world;
