//! What stops the robot on the robot: files and pins. Their news comes from the kernel; they are also looked at every so often,
//! because a file system may have no news to give.

use std::os::fd::OwnedFd;
use std::path::Path;
use std::time::Duration;

use rustix::fs::inotify;
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::sync::mpsc;
use tokio::time::MissedTickBehavior;

use super::hall::Input;
use super::settings::Hook;

/// Without news. A button on a file system that gives none is still seen within this.
const EVERY: Duration = Duration::from_millis(50);

/// Looks at one hook, and says what it demands: at first, and whenever that changes. Ends with the gate.
pub(super) async fn follow(hook: Hook, inputs: mpsc::Sender<Input>) {
    let mut ticks = tokio::time::interval(EVERY);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut told = None;
    let mut news = News::open(&hook);
    loop {
        // On this thread: the files are of memory, and a blocking thread would cost more than the look.
        let demands = hook.demands(&std::fs::read_to_string(hook.path()));
        if told != Some(demands) {
            told = Some(demands);
            if inputs.send(Input::Hook(hook.name.clone(), demands)).await.is_err() {
                return;
            }
        }
        // Cancel safe: a tick, and a readiness that is asked for anew.
        tokio::select! {
            _ = ticks.tick() => {
                if news.is_none() {
                    news = News::open(&hook);
                }
            }
            over = News::wait(news.as_ref()) => if over {
                news = None;
            }
        }
    }
}

/// Where news of a hook comes from.
#[derive(Debug)]
enum News {
    /// The directory of a file, through which the file comes and goes.
    Files(AsyncFd<OwnedFd>),
    /// A pin's value file, whose edges are exceptional.
    Pin(AsyncFd<OwnedFd>),
}

impl News {
    fn open(hook: &Hook) -> Option<News> {
        if hook.gpio.is_some() {
            let file = std::fs::File::open(hook.path()).ok()?;
            // A regular file has no edges, and cannot be waited for.
            let fd = registered(file.into(), Interest::PRIORITY)?;
            return Some(News::Pin(fd));
        }
        let dir = hook.path().parent().filter(|dir| *dir != Path::new(""))?;
        let fd =
            inotify::init(inotify::CreateFlags::NONBLOCK | inotify::CreateFlags::CLOEXEC).ok()?;
        let what = inotify::WatchFlags::CLOSE_WRITE
            | inotify::WatchFlags::MODIFY
            | inotify::WatchFlags::MOVED_TO
            | inotify::WatchFlags::MOVED_FROM
            | inotify::WatchFlags::CREATE
            | inotify::WatchFlags::DELETE
            | inotify::WatchFlags::DELETE_SELF
            | inotify::WatchFlags::MOVE_SELF;
        inotify::add_watch(&fd, dir, what).ok()?;
        registered(fd, Interest::READABLE).map(News::Files)
    }

    /// Until there is something new. True: this source is over.
    async fn wait(news: Option<&News>) -> bool {
        match news {
            None => std::future::pending().await,
            Some(News::Pin(fd)) => match fd.ready(Interest::PRIORITY).await {
                Ok(mut ready) => {
                    ready.clear_ready();
                    false
                }
                Err(_) => true,
            },
            Some(News::Files(fd)) => {
                let Ok(mut ready) = fd.readable().await else { return true };
                let mut space = [std::mem::MaybeUninit::uninit(); 4096];
                let mut reader = inotify::Reader::new(fd.get_ref(), &mut space);
                let mut gone = false;
                loop {
                    match reader.next() {
                        Ok(event) => {
                            let over = inotify::ReadFlags::DELETE_SELF
                                | inotify::ReadFlags::MOVE_SELF
                                | inotify::ReadFlags::IGNORED;
                            gone |= event.events().intersects(over);
                        }
                        Err(rustix::io::Errno::AGAIN) => break,
                        Err(_) => return true,
                    }
                }
                ready.clear_ready();
                gone
            }
        }
    }
}

fn registered(fd: OwnedFd, interest: Interest) -> Option<AsyncFd<OwnedFd>> {
    // SAFETY: the descriptor is open, and is owned by what is made of it here, which neither replaces nor closes it before
    // its own end.
    unsafe { AsyncFd::register_with_interest(fd, interest) }.ok()
}
