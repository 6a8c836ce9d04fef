//! How messages with values of ConfigMaps and Secrets, and with tasks' tokens, are shown in logs: by name and size.

use std::fmt;

use super::agent::v1::{File, Variable};
use super::gate::v1::{Register, Seat};

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_not_shown() {
        let variable = Variable { name: "TOKEN".to_owned(), value: "hunter2".to_owned() };
        let file = File { data: "hunter2".into(), path: "key".to_owned(), ..File::default() };
        let seat = Seat { task: "t".to_owned(), token: "hunter2".to_owned() };
        let register = Register { token: "hunter2".to_owned() };
        let shown = format!("{variable:?} {file:?} {seat:?} {register:?}");
        assert!(shown.contains("TOKEN") && shown.contains("key"), "{shown}");
        assert!(!shown.contains("hunter2"), "{shown}");
    }
}
