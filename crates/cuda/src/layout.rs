//! Constants of `device/tables.h`, written by the build script: the header is their only source.

#![allow(dead_code, reason = "the device alone reads some of them")]
#![allow(missing_docs, reason = "the header says what they are")]

include!(concat!(env!("OUT_DIR"), "/layout.rs"));
