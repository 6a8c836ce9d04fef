//! Exit codes: a public contract, for scripts. One code a class of outcome.

/// Everything that was asked for is done.
pub(crate) const OK: u8 = 0;
/// Something failed that has no class of its own. `muster plan`: there are changes to apply.
pub(crate) const FAILURE: u8 = 1;
/// The command line is wrong; clap uses the same code.
pub(crate) const USAGE: u8 = 2;
/// The object does not exist.
pub(crate) const NOT_FOUND: u8 = 3;
/// The object exists already, or was changed meanwhile.
pub(crate) const CONFLICT: u8 = 4;
/// A manifest or a value was refused; nothing of it was stored.
pub(crate) const INVALID: u8 = 5;
/// The controller does not answer, or there is no kubeconfig that names one.
pub(crate) const UNREACHABLE: u8 = 6;
/// The controller does not accept the credential, or the credential may not do this.
pub(crate) const DENIED: u8 = 7;
/// What was waited for has not come in time.
pub(crate) const TIMEOUT: u8 = 8;
/// `muster apply --wait`: stored, but a task has no node and says why.
pub(crate) const NOT_PLACED: u8 = 9;
/// `muster apply --wait`, `muster wait`: a task failed, or ended as something else than was waited for.
pub(crate) const TASK_ENDED: u8 = 10;
/// `muster plan`: no plan could be made (1 says that there are changes).
pub(crate) const PLAN_ERROR: u8 = 255;
