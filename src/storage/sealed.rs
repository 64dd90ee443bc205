//! Files and bytes that polypod writes for itself: a header, a value and a checksum.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::hash::fnv1a;

/// Length of the checksum at the end: FNV-1a, little endian.
const CHECKSUM: usize = size_of::<u64>();

/// Kind of the bytes, and their simulation.
#[derive(Serialize, Deserialize, PartialEq, Eq, Clone, Debug)]
pub(crate) struct Header {
    /// Kind of file, such as "polypod snapshot".
    pub(crate) kind: String,
    /// Version of the layout of this kind.
    pub(crate) format: u32,
    /// Version of polypod.
    pub(crate) version: String,
    /// Robots, in words.
    pub(crate) robots: String,
    /// Hash of all that decides the result of a step, except the state.
    pub(crate) fingerprint: u64,
    pub(crate) num_envs: u64,
}

impl Header {
    /// Header of a file that this version of polypod writes.
    pub(crate) fn new(kind: &str, format: u32, robots: String, fingerprint: u64, num_envs: usize) -> Self {
        let version = env!("CARGO_PKG_VERSION").to_string();
        Self { kind: kind.into(), format, version, robots, fingerprint, num_envs: num_envs as u64 }
    }
}

/// Header, value and checksum as bytes.
pub(crate) fn seal(header: &Header, value: &impl Serialize) -> postcard::Result<Vec<u8>> {
    let mut bytes = postcard::to_stdvec(&(header, value))?;
    bytes.extend(fnv1a(&bytes).to_le_bytes());
    Ok(bytes)
}

/// The header alone, if the bytes are of the kind.
pub(crate) fn header(bytes: &[u8], kind: &str) -> Option<Header> {
    let (header, _) = postcard::take_from_bytes::<Header>(bytes).ok()?;
    (header.kind == kind).then_some(header)
}

/// The value, if the checksum is right and the value can be read.
pub(crate) fn open<T: DeserializeOwned>(bytes: &[u8]) -> Option<T> {
    let (data, sum) = bytes.split_last_chunk::<CHECKSUM>()?;
    if fnv1a(data).to_le_bytes() != *sum {
        return None;
    }
    postcard::from_bytes::<(Header, T)>(data).ok().map(|(_, value)| value)
}

/// The value of bytes that have this header.
///
/// # Errors
/// The bytes are of another kind or simulation, or damaged.
pub(crate) fn open_as<T: DeserializeOwned>(bytes: &[u8], ours: &Header) -> Result<T, String> {
    let Some(theirs) = header(bytes, &ours.kind) else {
        return Err(format!("not a {}; pass what snapshot() gave", ours.kind));
    };
    if theirs != *ours {
        return Err(format!(
            "it is of another simulation ({theirs:?}) than this one ({ours:?}); restore it where it was taken"
        ));
    }
    open(bytes).ok_or_else(|| "it is damaged: its checksum does not fit; take it again".into())
}
