//! A file is replaced by a whole one or left as it was; links are followed, devices and pipes stay
//! what they are.

use std::fs;
use std::path::{Path, PathBuf};

use polypod::files::{MAX_BYTES, read, read_text, write};

fn folder(test: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("files").join(test);
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).unwrap();
    folder
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        folder.read_dir().unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn a_regular_file_is_replaced_and_nothing_is_left_beside_it() {
    let folder = folder("regular");
    let file = folder.join("result.json");
    for text in ["first", "second, and longer", "3"] {
        write(&file, text.as_bytes()).unwrap();
        assert_eq!(fs::read_to_string(&file).unwrap(), text);
        assert_eq!(names(&folder), ["result.json"]);
    }
    let error = write(&folder.join("missing/result.json"), b"x").unwrap_err();
    assert_eq!(error.kind(), std::io::ErrorKind::NotFound);
    assert!(write(&folder, b"x").is_err(), "a folder is no file");
    assert_eq!(names(&folder), ["result.json"]);
}

#[cfg(unix)]
#[test]
fn links_stay_links() {
    use std::os::unix::fs::{PermissionsExt, symlink};

    let folder = folder("links");
    fs::create_dir(folder.join("there")).unwrap();
    fs::write(folder.join("there/old"), "old").unwrap();
    fs::set_permissions(folder.join("there/old"), fs::Permissions::from_mode(0o640)).unwrap();
    for (link, target) in [("to_old", "there/old"), ("to_new", "there/new"), ("to_to_new", "to_new")] {
        symlink(target, folder.join(link)).unwrap();
        write(&folder.join(link), link.as_bytes()).unwrap();
        assert_eq!(fs::read_link(folder.join(link)).unwrap(), Path::new(target));
        assert_eq!(fs::read_to_string(folder.join(link)).unwrap(), link);
    }
    assert_eq!(names(&folder.join("there")), ["new", "old"]);
    assert_eq!(fs::metadata(folder.join("there/old")).unwrap().permissions().mode() & 0o777, 0o640);
    symlink("circle", folder.join("circle")).unwrap();
    assert!(write(&folder.join("circle"), b"x").is_err());
}

#[cfg(target_os = "linux")]
#[test]
fn pipes_are_written_into() {
    use std::os::unix::fs::{FileTypeExt, symlink};

    // no device: a fault here must not replace one of the machine that runs the test
    let folder = folder("pipes");
    let pipe = folder.join("pipe");
    assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    symlink("pipe", folder.join("link")).unwrap();
    for to in ["pipe", "link"] {
        let from = pipe.clone();
        let reader = std::thread::spawn(move || fs::read(from).unwrap());
        write(&folder.join(to), b"through the pipe").unwrap();
        assert_eq!(reader.join().unwrap(), b"through the pipe");
    }
    assert!(fs::symlink_metadata(&pipe).unwrap().file_type().is_fifo());
}

#[test]
fn reading_ends_at_the_limit() {
    let file = folder("limit").join("sparse");
    let sparse = fs::File::create(&file).unwrap();
    sparse.set_len(MAX_BYTES).unwrap();
    assert_eq!(read(&file).unwrap().len() as u64, MAX_BYTES);
    sparse.set_len(MAX_BYTES + 1).unwrap();
    assert_eq!(read(&file).unwrap_err().kind(), std::io::ErrorKind::FileTooLarge);
    fs::write(&file, [b'a', 0xff]).unwrap();
    assert_eq!(read_text(&file).unwrap_err().kind(), std::io::ErrorKind::InvalidData);
}
