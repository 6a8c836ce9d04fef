//! One allocation for values that are mostly the same: the robots of a fleet have the same sensors,
//! and the tasks of a queue are copies of a few templates.

use std::sync::Arc;

/// How many different values are remembered. Each new value is compared with all of them, so the
/// memory is short; a fleet of more models shares less and is still right.
const KEPT: usize = 16;

/// The values that came last.
#[derive(Debug, Clone)]
pub struct Recent<T> {
    values: Vec<Arc<T>>,
    /// What the next value that is new takes the place of.
    next: usize,
}

impl<T> Default for Recent<T> {
    fn default() -> Self {
        Recent { values: Vec::new(), next: 0 }
    }
}

impl<T: PartialEq> Recent<T> {
    /// The same value, shared with those before it that equal it.
    pub fn share(&mut self, value: T) -> Arc<T> {
        if let Some(known) = self.values.iter().find(|v| ***v == value) {
            return Arc::clone(known);
        }
        let value = Arc::new(value);
        if self.values.len() < KEPT {
            self.values.push(Arc::clone(&value));
        } else {
            self.values[self.next] = Arc::clone(&value);
            self.next = (self.next + 1) % KEPT;
        }
        value
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_values_are_one_and_old_ones_are_forgotten() {
        let mut recent = Recent::default();
        let first = recent.share("a".to_owned());
        assert!(Arc::ptr_eq(&first, &recent.share("a".to_owned())));
        for i in 0..KEPT {
            recent.share(i.to_string());
        }
        assert_eq!(Arc::strong_count(&first), 1);
        assert_eq!(*recent.share("a".to_owned()), "a");
        assert_eq!(recent.values.len(), KEPT);
    }
}
