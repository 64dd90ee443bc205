//! Config files: those on disk, in folders laid out like this repository, and those compiled in.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use include_dir::{Dir, File, include_dir};

use super::error::{ConfigError, ConfigErrorKind};
use crate::files;

static CONFIGS: Dir<'_> = include_dir!("$CARGO_MANIFEST_DIR/configs");

/// A config file, read but not parsed; one that cannot be read is an error where its text is used.
#[derive(Clone, Debug)]
pub(super) struct Document {
    /// Path as shown to people; a built-in file's path within the repository.
    pub file: String,
    pub text: Result<String, ConfigError>,
    /// Identity of the file, however its path is written.
    pub id: PathBuf,
    pub stem: String,
    /// The folder of a file on disk and the root it lies under, if it does.
    pub dir: Option<PathBuf>,
    pub root: Option<PathBuf>,
}

/// The sorts of config.
#[derive(Clone, Copy)]
pub(super) enum DocumentKind {
    Robot,
    Task,
    Train,
}

impl DocumentKind {
    pub(super) fn noun(self) -> &'static str {
        match self {
            Self::Robot => "robot",
            Self::Task => "task",
            Self::Train => "training config",
        }
    }

    /// Folder below `configs/`.
    pub(super) fn folder(self) -> &'static str {
        match self {
            Self::Robot => "robots",
            Self::Task => "tasks",
            Self::Train => "train",
        }
    }
}

impl Document {
    /// Text of the file, or the reason why it cannot be read.
    pub(super) fn text(&self) -> Result<&str, ConfigError> {
        self.text.as_deref().map_err(Clone::clone)
    }

    /// Reads a file; its root is the given one, or the folder above its `configs`.
    pub(super) fn read(path: &Path, root: Option<&Path>) -> Self {
        let file = path.display().to_string();
        let text = files::read_text(path).map_err(|error| unreadable(&file, format!("cannot be read: {error}")));
        let dir = path.parent().map_or_else(PathBuf::new, Path::to_path_buf);
        let above_configs = || {
            let configs = path.ancestors().find(|p| p.file_name() == Some(OsStr::new("configs")))?;
            configs.parent().map(Path::to_path_buf)
        };
        let root = root.map(Path::to_path_buf).or_else(above_configs);
        Self {
            id: path.canonicalize().unwrap_or_else(|_| path.to_path_buf()),
            file,
            text,
            stem: stem_of(path),
            dir: Some(dir),
            root,
        }
    }
}

/// All configs of a kind: root by root, the built-in ones last; by file name within each.
///
/// # Errors
/// A root that is no folder, an unreadable folder.
pub(super) fn documents(kind: DocumentKind, roots: &[PathBuf]) -> Result<Vec<Document>, ConfigError> {
    let mut documents = Vec::new();
    for root in roots {
        for file in toml_files(root, kind)? {
            documents.push(Document::read(&file, Some(root)));
        }
    }
    documents.extend(built_in(kind).map(read_built_in));
    Ok(documents)
}

/// Entries of [`documents`] whose stem is `name`; other files are not read.
///
/// # Errors
/// As [`documents`].
pub(super) fn documents_named(kind: DocumentKind, roots: &[PathBuf], name: &str) -> Result<Vec<Document>, ConfigError> {
    let mut documents = Vec::new();
    // a name is no path
    let is_plain = Path::new(name).components().count() == 1 && !name.contains(['/', '\\', '\0']);
    for root in roots {
        let folder = folder_of(root, kind)?;
        let path = folder.join(format!("{name}.toml"));
        if is_plain && stem_of(&path) == name && path.is_file() {
            documents.push(Document::read(&path, Some(root)));
        }
    }
    documents.extend(built_in(kind).filter(|file| stem_of(file.path()) == name).map(read_built_in));
    Ok(documents)
}

fn built_in(kind: DocumentKind) -> impl Iterator<Item = &'static File<'static>> {
    CONFIGS.get_dir(kind.folder()).into_iter().flat_map(Dir::files).filter(|file| is_toml(file.path()))
}

fn read_built_in(file: &'static File<'static>) -> Document {
    let shown = format!("configs/{}", file.path().display());
    let text = file.contents_utf8().ok_or_else(|| unreadable(&shown, "not UTF-8".into()));
    Document {
        id: PathBuf::from(&shown),
        file: shown,
        text: text.map(str::to_owned),
        stem: stem_of(file.path()),
        dir: None,
        root: None,
    }
}

/// The folder of a kind in a root, which may be absent.
fn folder_of(root: &Path, kind: DocumentKind) -> Result<PathBuf, ConfigError> {
    if root.is_dir() {
        return Ok(root.join("configs").join(kind.folder()));
    }
    Err(unreadable(&root.display().to_string(), "there is no such folder".into()))
}

/// The configs of a kind in one root, which may have none.
fn toml_files(root: &Path, kind: DocumentKind) -> Result<Vec<PathBuf>, ConfigError> {
    let folder = folder_of(root, kind)?;
    if !folder.is_dir() {
        return Ok(Vec::new());
    }
    let failed =
        |error: std::io::Error| unreadable(&folder.display().to_string(), format!("cannot be listed: {error}"));
    let mut files = Vec::new();
    for file in folder.read_dir().map_err(failed)? {
        files.push(file.map_err(failed)?.path());
    }
    files.retain(|file| is_toml(file));
    files.sort();
    Ok(files)
}

/// Whether a path or a config's name ends in `.toml`.
pub(super) fn is_toml(path: &Path) -> bool {
    path.extension() == Some(OsStr::new("toml"))
}

pub(super) fn unreadable(file: &str, problem: String) -> ConfigError {
    ConfigError::invalid(file, "file", problem, "check the path and its permissions")
        .of_kind(ConfigErrorKind::Unreadable)
}

pub(super) fn stem_of(path: &Path) -> String {
    path.file_stem().map_or_else(String::new, |stem| stem.to_string_lossy().into_owned())
}
