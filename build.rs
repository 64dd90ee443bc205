//! Tells cargo which data files are compiled in, so that a new or changed one is noticed.

fn main() {
    println!("cargo::rerun-if-changed=configs");
    println!("cargo::rerun-if-changed=assets/robots");
}
