//! Network namespaces without names: one lives as long as its thread, and the processes that were started from it.

use std::any::Any;
use std::process::Command;
use std::sync::mpsc;
use std::thread::JoinHandle;

use rustix::thread::UnshareFlags;

type Job = Box<dyn FnOnce() + Send>;

/// A network namespace of its own. What runs in it, and what that starts, has its interfaces.
#[derive(Debug)]
pub struct Namespace {
    jobs: Option<mpsc::Sender<Job>>,
    thread: Option<JoinHandle<()>>,
}

impl Namespace {
    /// A new one, with nothing in it but its loopback. It takes root.
    ///
    /// # Panics
    ///
    /// When the kernel refuses it.
    #[must_use]
    pub fn new(name: &str) -> Namespace {
        let (jobs, inbox) = mpsc::channel::<Job>();
        let thread = std::thread::Builder::new().name(name.to_owned()).spawn(move || {
            // SAFETY: of what may be unshared only the table of descriptors must not be, under others' feet.
            #[expect(unsafe_code, reason = "the call is unsafe for another flag's sake")]
            let alone = unsafe { rustix::thread::unshare_unsafe(UnshareFlags::NEWNET) };
            alone.expect("root may have a network namespace");
            ip("link set lo up");
            for job in inbox {
                job();
            }
        });
        let thread = Some(thread.expect("a thread"));
        Namespace { jobs: Some(jobs), thread }
    }

    /// Does something in it: threads and processes that are started there belong to it.
    ///
    /// # Panics
    ///
    /// When `job` does.
    pub fn run<T: Send + 'static>(&self, job: impl FnOnce() -> T + Send + 'static) -> T {
        let (tell, told) = mpsc::sync_channel::<Result<T, Box<dyn Any + Send>>>(1);
        let job = move || {
            let done = std::panic::catch_unwind(std::panic::AssertUnwindSafe(job));
            let _ = tell.send(done);
        };
        let jobs = self.jobs.as_ref().expect("it is taken when this is dropped");
        jobs.send(Box::new(job)).expect("its thread lives as long");
        match told.recv().expect("its thread answers") {
            Ok(done) => done,
            Err(panic) => std::panic::resume_unwind(panic),
        }
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        drop(self.jobs.take());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// `ip …` in the namespace of the calling thread.
///
/// # Panics
///
/// When it fails.
pub fn ip(arguments: &str) {
    let done = Command::new("ip").args(arguments.split(' ')).output();
    let done = done.expect("iproute2 is installed (tests/run does)");
    assert!(done.status.success(), "ip {arguments}: {}", String::from_utf8_lossy(&done.stderr));
}
