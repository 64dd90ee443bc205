//! Compiles the text of the device as C: single operations in the order in which they stand, none
//! contracted.

use std::env;

fn main() {
    println!("cargo::rerun-if-changed=../device");
    println!("cargo::rerun-if-changed=src/threads.c");
    println!("cargo::rerun-if-changed=src/update_threads.c");
    compile("../device/step.cu", "c11", "polypod_cuda_host");
    compile("../device/env.cu", "c11", "polypod_cuda_env");
    compile("../device/learn.cu", "c11", "polypod_cuda_learn");
    // coroutines need ucontext.h
    if env::var("CARGO_CFG_TARGET_OS").as_deref() == Ok("linux") {
        compile("src/threads.c", "gnu11", "polypod_cuda_threads");
        compile("src/update_threads.c", "gnu11", "polypod_cuda_update_threads");
    }
}

fn compile(file: &str, standard: &str, library: &str) {
    let mut build = cc::Build::new();
    build.file(file).flag("-xc").std(standard).opt_level(2).warnings(true);
    build.flag("-ffp-contract=off").flag("-fno-math-errno");
    // a jump to another stack is no overflow
    build.flag("-U_FORTIFY_SOURCE");
    // without the instruction fmaf is a call, which gives the same bits
    #[cfg(target_arch = "x86_64")]
    if std::is_x86_feature_detected!("fma") && env::var("HOST") == env::var("TARGET") {
        build.flag("-mfma");
    }
    build.compile(library);
}
