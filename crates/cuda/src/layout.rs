//! Constants of `device/tables.h`, written by the build script: the header is their only source.

#![allow(dead_code, reason = "the device alone reads some of them")]

include!(concat!(env!("OUT_DIR"), "/layout.rs"));
