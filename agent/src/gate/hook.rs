//! What stops the robot on the robot: files and pins. Their news comes from the kernel; they are also looked at every so often,
//! because a file system may have no news to give.

use std::os::fd::{AsFd, OwnedFd};
use std::path::Path;
use std::time::Duration;

use muster_agent_core::gate::Tier;
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
    let mut edge = false;
    loop {
        // On this thread: the files are of memory, and a blocking thread would cost more than the look.
        let demands = hook.demands(&std::fs::read_to_string(hook.path()));
        for demands in seen(told, demands, edge, hook.tier) {
            told = Some(demands);
            if inputs.send(Input::Hook(hook.name.clone(), demands)).await.is_err() {
                return;
            }
        }
        edge = false;
        // Cancel safe: a tick, and a readiness that is asked for anew.
        tokio::select! {
            _ = ticks.tick() => {
                if news.is_none() {
                    news = News::open(&hook);
                }
            }
            new = News::wait(news.as_ref()) => match new {
                New::Over => news = None,
                New::Edge => edge = true,
                New::File => {}
            }
        }
    }
}

/// What is to be told when `demands` was read. A pin that changed and looks as before was pressed, and is not any more.
fn seen(
    told: Option<Tier>,
    demands: Tier,
    edge: bool,
    pressed: Tier,
) -> impl Iterator<Item = Tier> {
    let pulse = edge && demands == Tier::None && told == Some(Tier::None);
    let pulse = pulse.then_some(pressed);
    let change = (told != Some(demands) || pulse.is_some()).then_some(demands);
    pulse.into_iter().chain(change)
}

/// What is new of a hook.
#[derive(Debug, Clone, Copy)]
enum New {
    /// Something about its file.
    File,
    /// The pin has changed.
    Edge,
    /// Nothing will be, from here.
    Over,
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
            ask_for_edges(hook.path(), hook.active_low);
            let file = std::fs::File::open(hook.path()).ok()?;
            // What it says now is no edge.
            read_pin(&file).ok()?;
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

    /// Until there is something new.
    async fn wait(news: Option<&News>) -> New {
        match news {
            None => std::future::pending().await,
            Some(News::Pin(fd)) => match fd.ready(Interest::PRIORITY).await {
                Ok(mut ready) => {
                    // Before it is read: an edge that comes meanwhile is one more.
                    ready.clear_ready();
                    // One that is not exported any more is looked for again.
                    read_pin(fd.get_ref()).map_or(New::Over, |()| New::Edge)
                }
                Err(_) => New::Over,
            },
            Some(News::Files(fd)) => {
                let Ok(mut ready) = fd.readable().await else { return New::Over };
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
                        Err(_) => return New::Over,
                    }
                }
                ready.clear_ready();
                if gone { New::Over } else { New::File }
            }
        }
    }
}

/// The kernel has news of a pin only when it was told which.
fn ask_for_edges(value: &Path, active_low: bool) {
    let edge = value.with_file_name("edge");
    let Ok(now) = std::fs::read_to_string(&edge) else { return };
    let pressing = if active_low { "falling" } else { "rising" };
    let heard = match now.trim() {
        "none" => std::fs::write(&edge, "both"),
        // Somebody asked for one: he knows better, if it is the one.
        "both" => Ok(()),
        one if one == pressing => Ok(()),
        one => Err(std::io::Error::other(format!("it is {one}"))),
    };
    if let Err(error) = heard {
        tracing::warn!(path = %edge.display(), %error, "a short press of this button may be missed");
    }
}

/// Takes its news: the kernel tells of a pin that has changed since it was read.
fn read_pin(file: impl AsFd) -> rustix::io::Result<()> {
    // What it says is looked at with the others.
    rustix::io::pread(file, &mut [0_u8; 8], 0).map(drop)
}

fn registered(fd: OwnedFd, interest: Interest) -> Option<AsyncFd<OwnedFd>> {
    // SAFETY: the descriptor is open, and is owned by what is made of it here, which neither replaces nor closes it before
    // its own end.
    unsafe { AsyncFd::register_with_interest(fd, interest) }.ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_press_that_is_over_when_it_is_looked_at_counts() {
        let told = |told, demands, edge| seen(told, demands, edge, Tier::Cut).collect::<Vec<_>>();
        assert_eq!(told(None, Tier::None, false), [Tier::None]);
        assert_eq!(told(Some(Tier::None), Tier::Cut, true), [Tier::Cut]);
        assert_eq!(told(Some(Tier::Cut), Tier::Cut, true), []);
        assert_eq!(told(Some(Tier::Cut), Tier::None, true), [Tier::None]);
        assert_eq!(told(Some(Tier::None), Tier::None, true), [Tier::Cut, Tier::None]);
        assert_eq!(told(Some(Tier::None), Tier::None, false), []);
    }

    #[test]
    fn a_pin_is_asked_for_both_edges() {
        let dir = tempfile::tempdir().unwrap();
        let edge = dir.path().join("edge");
        std::fs::write(&edge, "none\n").unwrap();
        ask_for_edges(&dir.path().join("value"), true);
        assert_eq!(std::fs::read_to_string(&edge).unwrap(), "both");
        std::fs::write(&edge, "falling\n").unwrap();
        ask_for_edges(&dir.path().join("value"), true);
        assert_eq!(std::fs::read_to_string(&edge).unwrap(), "falling\n");
    }
}
