//! Files of the current thread, for functions that take a path.

use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

thread_local! {
    static FOLDER: PathBuf = {
        static NEXT: AtomicUsize = AtomicUsize::new(0);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let path = std::env::temp_dir().join(format!("polypod-fuzz-{}-{number}", std::process::id()));
        std::fs::create_dir_all(path.join("configs/tasks")).unwrap();
        std::fs::create_dir_all(path.join("configs/robots")).unwrap();
        path
    };
}

/// Removes the folder of the current thread, which then gives no more input to a target.
pub fn remove() {
    drop(std::fs::remove_dir_all(folder()));
}

/// Folder of the current thread, laid out like a library of configs.
pub fn folder() -> PathBuf {
    FOLDER.with(PathBuf::clone)
}

/// Writes a file of the folder, or removes it.
pub fn put(name: &str, bytes: Option<&[u8]>) -> PathBuf {
    let path = folder().join(name);
    match bytes {
        Some(bytes) => std::fs::write(&path, bytes).unwrap(),
        None => drop(std::fs::remove_file(&path)),
    }
    path
}
