//! polypod without Python: the command line of `polypod-sim`, and policies as ONNX files.

#![forbid(unsafe_code)]
#![warn(missing_docs)]

pub mod cli;
pub mod policy;
