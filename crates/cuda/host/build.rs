//! Compiles the text of the device as C: single operations in the order in which they stand, none
//! contracted.

use std::env;

fn main() {
    println!("cargo::rerun-if-changed=../device");
    let mut build = cc::Build::new();
    build.file("../device/step.cu").flag("-xc").std("c11").opt_level(2).warnings(true);
    build.flag("-ffp-contract=off").flag("-fno-math-errno");
    // without the instruction fmaf is a call, which gives the same bits
    #[cfg(target_arch = "x86_64")]
    if std::is_x86_feature_detected!("fma") && env::var("HOST") == env::var("TARGET") {
        build.flag("-mfma");
    }
    build.compile("polypod_cuda_host");
}
