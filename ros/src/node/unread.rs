//! What a subscriber has not read yet. TCP tells the sender what the other machine's kernel has acknowledged; what lies in that
//! kernel is known only of a reader on this machine, and in this network: our own kernel is asked for its socket
//! (`sock_diag(7)`).

use std::io;
use std::net::SocketAddr;
use std::os::fd::{AsRawFd as _, FromRawFd as _, OwnedFd};

use tokio::net::TcpStream;

/// `SOCK_DIAG_BY_FAMILY`, the question and its answer.
const BY_FAMILY: u16 = 20;
/// `struct nlmsghdr`.
const HEADER: usize = 16;
/// In the answer: the socket's state.
const STATE: usize = HEADER + 1;
/// `TCP_LISTEN`: our kernel knows no such connection, and names who would take one.
const LISTEN: u8 = 10;
/// In the answer: what is before the socket's queues, with the header.
const BEFORE_QUEUES: usize = HEADER + 4 + 48 + 4;

/// Whether the program at the other end has read everything that our kernel was given; one elsewhere: whether its kernel has
/// acknowledged it. What our kernel does not tell counts as read.
pub(super) fn is_read(stream: &TcpStream) -> bool {
    let mut unsent: libc::c_int = 0;
    // SAFETY: the descriptor is open, and the request writes one int.
    let told = unsafe { libc::ioctl(stream.as_raw_fd(), libc::TIOCOUTQ, &mut unsent) } == 0;
    let ends = || stream.local_addr().ok().zip(stream.peer_addr().ok());
    let unread = || ends().and_then(|ends| unread(ends).ok()).unwrap_or(0);
    (!told || unsent == 0) && unread() == 0
}

/// Bytes that lie in the socket at the other end. An error: it is not on this machine, or not in this network.
fn unread((ours, theirs): (SocketAddr, SocketAddr)) -> io::Result<u32> {
    let asked = question(theirs, ours);
    // SAFETY: numbers only; the descriptor is this function's own from here on.
    let socket = unsafe {
        let kind = libc::SOCK_RAW | libc::SOCK_CLOEXEC;
        match libc::socket(libc::AF_NETLINK, kind, libc::NETLINK_SOCK_DIAG) {
            -1 => return Err(io::Error::last_os_error()),
            fd => OwnedFd::from_raw_fd(fd),
        }
    };
    let mut answer = [0_u8; 512];
    // SAFETY: both buffers live, and their lengths are theirs. The answer is there when the question has been taken.
    let length = unsafe {
        let (fd, flags) = (socket.as_raw_fd(), libc::MSG_DONTWAIT);
        if libc::send(fd, asked.as_ptr().cast(), asked.len(), 0) == -1 {
            return Err(io::Error::last_os_error());
        }
        libc::recv(fd, answer.as_mut_ptr().cast(), answer.len(), flags)
    };
    let length = usize::try_from(length).map_err(|_| io::Error::last_os_error())?;
    let kind = u16::from_ne_bytes([answer[4], answer[5]]);
    let queue = answer[..length].get(BEFORE_QUEUES..BEFORE_QUEUES + 4);
    let found = kind == BY_FAMILY && answer[STATE] != LISTEN;
    match queue.and_then(|queue| queue.try_into().ok()).filter(|_| found) {
        Some(queue) => Ok(u32::from_ne_bytes(queue)),
        None => Err(io::ErrorKind::NotFound.into()),
    }
}

/// Asks for the one socket between these addresses: `struct inet_diag_req_v2` behind a header.
fn question(from: SocketAddr, to: SocketAddr) -> Vec<u8> {
    let family = if from.is_ipv4() { libc::AF_INET } else { libc::AF_INET6 };
    let mut asked = Vec::with_capacity(HEADER + 56);
    asked.extend(72_u32.to_ne_bytes());
    asked.extend(BY_FAMILY.to_ne_bytes());
    let (flags, sequence, sender) = (libc::NLM_F_REQUEST as u16, 1_u32, 0_u32);
    asked.extend(flags.to_ne_bytes());
    asked.extend(sequence.to_ne_bytes());
    asked.extend(sender.to_ne_bytes());
    asked.extend([family as u8, libc::IPPROTO_TCP as u8, 0, 0]);
    // In whatever state it is.
    asked.extend(u32::MAX.to_ne_bytes());
    asked.extend(from.port().to_be_bytes());
    asked.extend(to.port().to_be_bytes());
    for end in [from, to] {
        match end {
            SocketAddr::V4(end) => asked.extend([&end.ip().octets()[..], &[0; 12]].concat()),
            SocketAddr::V6(end) => asked.extend(end.ip().octets()),
        }
    }
    // Any interface, no cookie.
    asked.extend(0_u32.to_ne_bytes());
    asked.extend([0xff; 8]);
    asked
}

#[cfg(test)]
mod tests {
    use std::io::{Read as _, Write as _};
    use std::net::{TcpListener, TcpStream};

    use super::*;

    #[test]
    fn what_lies_unread_on_this_machine_is_known() {
        for any in ["127.0.0.1:0", "[::1]:0"] {
            let Ok(listener) = TcpListener::bind(any) else {
                assert!(any.contains('['), "a machine without IPv4");
                continue;
            };
            let mut reader = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
            let (mut writer, _) = listener.accept().unwrap();
            let ends = (writer.local_addr().unwrap(), writer.peer_addr().unwrap());
            assert_eq!(unread(ends).unwrap(), 0);
            writer.write_all(&[7; 100]).unwrap();
            assert_eq!(unread(ends).unwrap(), 100);
            reader.read_exact(&mut [0; 60]).unwrap();
            assert_eq!(unread(ends).unwrap(), 40);
            reader.read_exact(&mut [0; 40]).unwrap();
            assert_eq!(unread(ends).unwrap(), 0);
            assert!(unread((ends.0, ends.0)).is_err(), "there is only who listens");
        }
    }
}
