//! How messages with values of ConfigMaps and Secrets are shown in logs: by name and size; and tickets and tasks' tokens: by
//! whose they are.

use std::fmt;

use super::agent::v1::{File, Ticket, Variable};
use super::framework::v1::Direct;
use super::gate::v1::{Register, Seat};
use super::sensor::v1::Open;

impl fmt::Debug for Variable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Variable").field("name", &self.name).finish_non_exhaustive()
    }
}

impl fmt::Debug for File {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("File")
            .field("directory", &self.directory)
            .field("path", &self.path)
            .field("bytes", &self.data.len())
            .field("mode", &self.mode)
            .field("secret", &self.secret)
            .finish_non_exhaustive()
    }
}

impl fmt::Debug for Register {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Register").finish_non_exhaustive()
    }
}

impl fmt::Debug for Seat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Seat").field("task", &self.task).finish_non_exhaustive()
    }
}

impl fmt::Debug for Open {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Open")
            .field("version", &self.version)
            .field("queue", &self.queue)
            .field("inline", &self.inline)
            .finish_non_exhaustive()
    }
}

impl fmt::Debug for Ticket {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let revoked = self.secret.is_empty();
        f.debug_struct("Ticket")
            .field("executor", &self.executor)
            .field("revoked", &revoked)
            .finish_non_exhaustive()
    }
}

impl fmt::Debug for Direct {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Direct")
            .field("executor", &self.executor)
            .field("address", &self.address)
            .field("withdrawn", &self.ticket.is_empty())
            .finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_not_shown() {
        let variable = Variable { name: "TOKEN".to_owned(), value: "hunter2".to_owned() };
        let file = File { data: "hunter2".into(), path: "key".to_owned(), ..File::default() };
        let seat = Seat { task: "t".to_owned(), token: "hunter2".to_owned() };
        let register = Register { token: "hunter2".to_owned() };
        let ticket = Ticket { executor: "e-1".to_owned(), secret: b"hunter2".to_vec() };
        let direct = Direct { ticket: b"hunter2".as_slice().into(), ..Direct::default() };
        let open = Open { token: "hunter2".to_owned(), ..Open::default() };
        let shown =
            format!("{variable:?} {file:?} {ticket:?} {direct:?} {seat:?} {register:?} {open:?}");
        assert!(shown.contains("TOKEN") && shown.contains("key"), "{shown}");
        assert!(!shown.contains("hunter2") && !shown.contains("104, 117"), "{shown}");
    }
}
