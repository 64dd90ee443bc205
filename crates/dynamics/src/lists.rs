//! [`Lists`]: lists of different lengths in one table.

use std::ops::Index;

/// Lists of different lengths, one after the other in one allocation, as a device keeps them.
#[derive(Clone, Debug)]
pub(super) struct Lists<T> {
    items: Vec<T>,
    /// End of each list, after a leading zero, at which the first one starts.
    bounds: Vec<usize>,
}

impl<T> Default for Lists<T> {
    fn default() -> Self {
        Self { items: Vec::new(), bounds: vec![0] }
    }
}

impl<T> Lists<T> {
    /// Appends a list.
    pub(super) fn push(&mut self, list: impl IntoIterator<Item = T>) {
        self.items.extend(list);
        self.bounds.push(self.items.len());
    }

    /// Number of lists.
    pub(super) fn len(&self) -> usize {
        self.bounds.len() - 1
    }

    /// Forgets all lists from number `len` on.
    pub(super) fn truncate(&mut self, len: usize) {
        self.bounds.truncate(len + 1);
        self.items.truncate(self.bounds[self.len()]);
    }

    /// The lists in their order.
    #[inline(always)]
    pub(super) fn iter(&self) -> impl DoubleEndedIterator<Item = &[T]> {
        self.bounds.windows(2).map(|ends| &self.items[ends[0]..ends[1]])
    }
}

impl<T> Index<usize> for Lists<T> {
    type Output = [T];

    #[inline(always)]
    fn index(&self, list: usize) -> &[T] {
        &self.items[self.bounds[list]..self.bounds[list + 1]]
    }
}

impl<T, L: IntoIterator<Item = T>> FromIterator<L> for Lists<T> {
    fn from_iter<I: IntoIterator<Item = L>>(lists: I) -> Self {
        let mut all = Self::default();
        lists.into_iter().for_each(|list| all.push(list));
        all
    }
}
