//! Files: read up to a limit, written whole or not at all.

use std::fs;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

/// Largest config, URDF, dump or manifest that is read, bytes. All real ones are below 2 MiB; a
/// larger file is a mistake, or endless.
pub const MAX_BYTES: u64 = 64 << 20;

/// Reads a file of up to [`MAX_BYTES`].
///
/// # Errors
/// It cannot be read, or is larger ([`io::ErrorKind::FileTooLarge`]).
pub fn read(path: &Path) -> io::Result<Vec<u8>> {
    read_up_to(path, MAX_BYTES)
}

/// Reads a file of up to `most` bytes.
///
/// # Errors
/// It cannot be read, or is larger ([`io::ErrorKind::FileTooLarge`]).
pub fn read_up_to(path: &Path, most: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    fs::File::open(path)?.take(most + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > most {
        let problem = format!("it is larger than {} MiB", most >> 20);
        return Err(io::Error::new(io::ErrorKind::FileTooLarge, problem));
    }
    Ok(bytes)
}

/// Reads a text of up to [`MAX_BYTES`].
///
/// # Errors
/// It cannot be read, is larger ([`io::ErrorKind::FileTooLarge`]) or is not UTF-8
/// ([`io::ErrorKind::InvalidData`]).
pub fn read_text(path: &Path) -> io::Result<String> {
    let not_text = |_| io::Error::new(io::ErrorKind::InvalidData, "it is not UTF-8");
    String::from_utf8(read(path)?).map_err(not_text)
}

/// Writes a file. A regular file is replaced by the whole new one or left as it was, and is on the
/// disk when this returns. Symbolic links are followed. Into a device or a pipe the bytes are
/// written as they are.
///
/// # Errors
/// It cannot be written.
pub fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    match fs::metadata(path) {
        Ok(there) if there.is_file() => replace(&path.canonicalize()?, bytes, Some(there.permissions())),
        Ok(_) => fs::OpenOptions::new().write(true).open(path)?.write_all(bytes),
        Err(error) if error.kind() == io::ErrorKind::NotFound => replace(&end_of_links(path)?, bytes, None),
        Err(error) => Err(error),
    }
}

/// The end of a path's symbolic links, where there may be no file.
fn end_of_links(path: &Path) -> io::Result<PathBuf> {
    /// Number of links that Linux follows.
    const MOST_LINKS: usize = 40;
    let mut target = path.to_path_buf();
    for _ in 0..MOST_LINKS {
        match fs::read_link(&target) {
            Ok(link) => target = folder_of(&target).join(link),
            Err(_) => return Ok(target),
        }
    }
    Err(io::Error::other("it is a circle of symbolic links"))
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Writes a temporary file next to `target` and renames it.
fn replace(target: &Path, bytes: &[u8], permissions: Option<fs::Permissions>) -> io::Result<()> {
    let Some(name) = target.file_name() else {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "it names no file"));
    };
    let folder = folder_of(target);
    let temporary = folder.join(format!(".{}.{}.tmp", name.to_string_lossy(), std::process::id()));
    // left by a killed process of the same number
    let _ = fs::remove_file(&temporary);
    let write = || {
        let mut out = fs::File::create_new(&temporary)?;
        if let Some(permissions) = permissions {
            out.set_permissions(permissions)?;
        }
        out.write_all(bytes)?;
        out.sync_all()?;
        fs::rename(&temporary, target)
    };
    write().inspect_err(|_| {
        // a remaining temporary file is of no use
        let _ = fs::remove_file(&temporary);
    })?;
    sync_folder(folder)
}

/// Writes the new name of a file to the disk, where folders can be synchronised.
fn sync_folder(folder: &Path) -> io::Result<()> {
    if !cfg!(unix) {
        return Ok(());
    }
    match fs::File::open(folder)?.sync_all() {
        Err(error) if matches!(error.kind(), io::ErrorKind::InvalidInput | io::ErrorKind::Unsupported) => Ok(()),
        result => result,
    }
}
