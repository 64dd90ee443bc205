//! Files that polypod reads and writes: limits, headers and checksums.

pub mod files;
pub(crate) mod hash;
pub(crate) mod sealed;
