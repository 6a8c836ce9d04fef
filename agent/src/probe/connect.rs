//! A connection in a task's own network.
//!
//! A socket belongs to the network namespace of the thread that makes it, for ever. So a thread of its own enters the
//! task's namespace, makes the socket and ends; everything else happens where the agent is.

use std::io;
use std::net::SocketAddr;
use std::os::fd::{AsFd, OwnedFd};

use rustix::net::{AddressFamily, SocketFlags, SocketType};
use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};
use tokio::net::{TcpSocket, TcpStream};

use crate::runtime::{Launch, Reached, Runtime, RuntimeError};

/// Why there is no connection.
#[derive(Debug, thiserror::Error)]
pub(super) enum ConnectError {
    /// The task's network cannot be entered: says nothing about the task.
    #[error("the task's network cannot be entered")]
    Network(#[source] RuntimeError),
    /// Nobody takes the connection.
    #[error("no connection")]
    Connect(#[source] io::Error),
}

/// The thread's stack: it makes three system calls.
const STACK: usize = 64 << 10;

pub(super) async fn connect(
    runtime: &dyn Runtime,
    launch: &Launch,
    at: SocketAddr,
) -> Result<TcpStream, ConnectError> {
    match runtime.network(launch).await.map_err(ConnectError::Network)? {
        Reached::Here => TcpStream::connect(at).await.map_err(ConnectError::Connect),
        Reached::Inside(namespace) => {
            let socket = socket_in(namespace, at).await.map_err(ConnectError::Network)?;
            socket.connect(at).await.map_err(ConnectError::Connect)
        }
    }
}

async fn socket_in(namespace: OwnedFd, at: SocketAddr) -> Result<TcpSocket, RuntimeError> {
    let failed = |error: io::Error| RuntimeError::new("enter a container's network", error);
    let (made, socket) = tokio::sync::oneshot::channel();
    std::thread::Builder::new()
        .name("netns".to_owned())
        .stack_size(STACK)
        // Nobody may wait any more: then the socket is closed again.
        .spawn(move || made.send(make(&namespace, at)))
        .map_err(failed)?;
    let socket = socket.await.map_err(|error| failed(io::Error::other(error)))?.map_err(failed)?;
    Ok(TcpSocket::from_std_stream(std::net::TcpStream::from(socket)))
}

fn make(namespace: &OwnedFd, at: SocketAddr) -> io::Result<OwnedFd> {
    move_into_link_name_space(namespace.as_fd(), Some(LinkNameSpaceType::Network))?;
    let family = if at.is_ipv4() { AddressFamily::INET } else { AddressFamily::INET6 };
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    Ok(rustix::net::socket_with(family, SocketType::STREAM, flags, None)?)
}
