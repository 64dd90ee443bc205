//! PTX of the text of the device: the package's, where it was built with NVRTC, or else what the
//! NVRTC of torch's wheel makes of the text on the user's machine.
//!
//! The package holds PTX of the text that steps all morphologies, for usual numbers of threads. A
//! build needs no compiler of NVIDIA's: without one the package has the text alone.
#![allow(unsafe_code, reason = "the border to NVRTC, which has an interface of C")]

use std::collections::BTreeMap;
use std::ffi::{CStr, CString, c_char, c_int, c_void};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::PathBuf;
use std::sync::{Mutex, OnceLock, PoisonError};

use libloading::{Library, Symbol};

use crate::DEVICE_TEXT;
use crate::device::DeviceError;
use crate::layout::{FEW_ROBOTS, MORE_ROBOTS, THREADS_OF_FEW, THREADS_OF_MORE, WARP};

/// Environment variable that names the library.
const VARIABLE: &str = "POLYPOD_NVRTC";
/// Options that keep each operation as it is written, for the oldest generation of cards.
/// `tools/ptx.py` compiles with the same ones and reads the result.
const OPTIONS: [&CStr; 5] =
    [c"--gpu-architecture=compute_80", c"--fmad=false", c"--ftz=false", c"--prec-div=true", c"--prec-sqrt=true"];
/// Environment variable: threads that step a robot together, a power of two.
const THREADS_VARIABLE: &str = "POLYPOD_CUDA_THREADS";
/// Option that makes it the text of the one morphology whose tables [`HEADER`] holds.
const FOR_ONE: &CStr = c"-DPOLYPOD_TABLES";
/// Names of the programs.
const STEP: &str = "step.cu";
const ENV: &str = "env.cu";
const LEARN: &str = "learn.cu";
/// Name of the header in `device/tables.h`.
const HEADER: &str = "morphology.h";
/// The oldest version of PTX that knows the architecture: a driver refuses a newer one than its
/// own.
const VERSION: &str = ".version 7.0";
/// A hint that older versions lack; it changes no result.
const HINT: &str = ".pragma \"used_bytes_mask";
/// Last line of a file in the cache: a file without it is cut short.
const LAST: &str = "// end\n";
/// Names of a library of the system.
const NAMES: [&str; 5] = ["libnvrtc.so.13", "libnvrtc.so.12", "libnvrtc.so", "nvrtc64_130_0.dll", "nvrtc64_120_0.dll"];

/// Folder of shipped PTX within a folder of Python packages; `tools/ptx.py` writes it.
const SHIPPED: &str = "polypod/kernels";
/// First line of shipped PTX: the hash of the text that it was made of.
const MADE_OF: &str = concat!("// ", env!("POLYPOD_DEVICE_TEXT"), "\n");

static FOLDERS: OnceLock<Vec<PathBuf>> = OnceLock::new();

/// Threads that step each of some robots together, with own kernels or without. Few robots do not
/// fill a card.
pub(crate) fn threads_of_robot(robots: usize, own: bool) -> usize {
    let asked = std::env::var(THREADS_VARIABLE).ok().and_then(|threads| threads.parse().ok());
    let asked = asked.filter(|threads| [1, 2, 4, 8, 16].contains(threads));
    asked.unwrap_or(match robots {
        ..=FEW_ROBOTS => THREADS_OF_FEW,
        ..=MORE_ROBOTS if own => THREADS_OF_MORE,
        _ => 1,
    })
}

/// Folders of Python packages, in which the wheels of NVIDIA have `nvidia/*/lib/libnvrtc.so.*` and
/// polypod's has PTX. The first call counts.
pub fn search_packages(folders: Vec<PathBuf>) {
    FOLDERS.get_or_init(|| folders);
}

/// Files and names that may be the library, the best first.
fn candidates() -> Vec<PathBuf> {
    if let Some(path) = std::env::var_os(VARIABLE) {
        return vec![path.into()];
    }
    let entries = |folder: PathBuf| std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    let mut found = Vec::new();
    for folder in FOLDERS.get().into_iter().flatten() {
        for part in entries(folder.join("nvidia")) {
            found.extend(entries(part.join("lib")).filter(|file| {
                let name = file.file_name().map(|name| name.to_string_lossy());
                name.is_some_and(|name| name.starts_with("libnvrtc.so."))
            }));
        }
    }
    found.sort();
    found.reverse();
    found.extend(NAMES.map(PathBuf::from));
    found
}

/// The library. It stays loaded: a thread that compiles may outlive its caller.
fn library() -> Option<&'static Library> {
    static LIBRARY: OnceLock<Library> = OnceLock::new();
    if let Some(found) = LIBRARY.get() {
        return Some(found);
    }
    // SAFETY: the library has no initialisers that depend on this process
    let found = candidates().into_iter().find_map(|path| unsafe { Library::new(path) }.ok())?;
    Some(LIBRARY.get_or_init(|| found))
}

/// Whether the library is there.
pub(crate) fn is_present() -> bool {
    library().is_some()
}

/// Whether the package has all PTX that one text for all morphologies takes.
pub fn are_kernels_shipped() -> bool {
    [STEP, ENV]
        .into_iter()
        .all(|program| [THREADS_OF_FEW, 1].into_iter().all(|threads| shipped(program, threads).is_some()))
}

/// PTX that the package has of a program, where as many threads step a robot: made of this very
/// text.
fn shipped(program: &str, threads: usize) -> Option<String> {
    let name = format!("{}-{threads}.ptx", program.trim_end_matches(".cu"));
    let files = FOLDERS.get()?.iter().map(|folder| folder.join(SHIPPED).join(&name));
    files.into_iter().find_map(|file| Kept { made_of: MADE_OF.into(), file }.read())
}

type Program = *mut c_void;

/// A program in NVRTC, destroyed at the end.
struct Compilation<'a> {
    library: &'a Library,
    program: Program,
}

fn failed(what: impl Into<String>) -> DeviceError {
    DeviceError::Compiler(what.into())
}

impl Compilation<'_> {
    fn function<F>(&self, name: &CStr) -> Result<Symbol<'_, F>, DeviceError> {
        // SAFETY: the callers give the types of NVRTC's header
        unsafe { self.library.get(name.to_bytes_with_nul()) }.map_err(|error| failed(error.to_string()))
    }

    /// A text of the program: its PTX or the log.
    fn text(&self, size: &CStr, get: &CStr) -> Result<String, DeviceError> {
        let size_of = self.function::<unsafe extern "C" fn(Program, *mut usize) -> c_int>(size)?;
        let get = self.function::<unsafe extern "C" fn(Program, *mut c_char) -> c_int>(get)?;
        let mut size = 0;
        // SAFETY: the program lives, and the size is written before it is read
        let code = unsafe { size_of(self.program, &raw mut size) };
        let mut text = vec![0u8; size.max(1)];
        // SAFETY: the buffer has the size that NVRTC asks for
        if code != 0 || unsafe { get(self.program, text.as_mut_ptr().cast()) } != 0 {
            return Err(failed("it returns no text"));
        }
        let text = CStr::from_bytes_until_nul(&text).map_err(|error| failed(error.to_string()))?;
        Ok(text.to_string_lossy().into_owned())
    }
}

impl Drop for Compilation<'_> {
    fn drop(&mut self) {
        if let Ok(destroy) = self.function::<unsafe extern "C" fn(*mut Program) -> c_int>(c"nvrtcDestroyProgram") {
            // SAFETY: nobody uses the program after this
            unsafe { destroy(&raw mut self.program) };
        }
    }
}

/// PTX of the text of the device for all morphologies, or for the one whose tables are the
/// `header`, with that many threads for each robot. A process reads or compiles that for all
/// morphologies once. PTX that is compiled stays in the user's cache, where later processes find
/// it.
///
/// # Errors
/// NVRTC is not there, or it refuses the text.
pub fn compile(header: Option<&str>, threads: usize) -> Result<String, DeviceError> {
    static COMMON: Mutex<BTreeMap<usize, String>> = Mutex::new(BTreeMap::new());
    if header.is_some() {
        return compile_or_find(STEP, header, threads);
    }
    let mut common = COMMON.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(ptx) = common.get(&threads) {
        return Ok(ptx.clone());
    }
    let ptx = compile_or_find(STEP, None, threads)?;
    common.insert(threads, ptx.clone());
    Ok(ptx)
}

/// PTX of the control steps of envs around their physics, where as many threads step a robot there.
///
/// # Errors
/// As [`compile`].
pub(crate) fn compile_envs(threads: usize) -> Result<String, DeviceError> {
    compile_or_find(ENV, None, threads)
}

/// PTX of the update of the native learner.
///
/// # Errors
/// As [`compile`].
pub(crate) fn compile_update() -> Result<String, DeviceError> {
    compile_or_find(LEARN, None, 1)
}

fn compile_or_find(program: &str, header: Option<&str>, threads: usize) -> Result<String, DeviceError> {
    if let Some(ptx) = header.is_none().then(|| shipped(program, threads)).flatten() {
        return Ok(ptx);
    }
    let kept = library().and_then(|library| Kept::new(library, program, header, threads));
    if let Some(ptx) = kept.as_ref().and_then(Kept::read) {
        return Ok(ptx);
    }
    let ptx = compile_text(program, header, threads)?;
    if let Some(kept) = kept {
        kept.write(&ptx);
    }
    Ok(ptx)
}

/// PTX in the user's cache, or the package's. A file says in front of it what the PTX was made of,
/// so that none is taken for another.
struct Kept {
    made_of: String,
    file: PathBuf,
}

impl Kept {
    /// The file of a text; absent where the user has no cache.
    fn new(library: &Library, program: &str, header: Option<&str>, threads: usize) -> Option<Self> {
        let variable = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
        let cache = variable("XDG_CACHE_HOME")
            .or_else(|| variable("LOCALAPPDATA"))
            .or_else(|| variable("HOME").map(|home| home.join(".cache")))?;
        let (mut major, mut minor) = (0, 0);
        // SAFETY: NVRTC has this function in all versions
        let version: Symbol<'_, unsafe extern "C" fn(*mut c_int, *mut c_int) -> c_int> =
            unsafe { library.get(b"nvrtcVersion\0") }.ok()?;
        // SAFETY: both numbers live
        if unsafe { version(&raw mut major, &raw mut minor) } != 0 {
            return None;
        }
        let mut made_of = format!("NVRTC {major}.{minor}\n");
        for option in OPTIONS {
            made_of += &option.to_string_lossy();
            made_of.push('\n');
        }
        made_of += &format!("{program} with {threads} threads\n");
        for (name, text) in DEVICE_TEXT.into_iter().chain(header.map(|header| (HEADER, header))) {
            made_of += &format!("{name} {}\n{text}", text.len());
        }
        let mut hasher = DefaultHasher::new();
        made_of.hash(&mut hasher);
        let file = cache.join("polypod").join(format!("step-{:016x}.ptx", hasher.finish()));
        Some(Self { made_of, file })
    }

    fn read(&self) -> Option<String> {
        let text = std::fs::read_to_string(&self.file).ok()?;
        text.strip_prefix(&self.made_of).filter(|ptx| ptx.contains(LAST)).map(str::to_owned)
    }

    /// Writes the file, or leaves it: a cache that is full or read-only costs time alone.
    fn write(&self, ptx: &str) {
        let Some(folder) = self.file.parent() else { return };
        let of_this_process = self.file.with_extension(format!("{}.tmp", std::process::id()));
        let written = std::fs::create_dir_all(folder)
            .and_then(|()| std::fs::write(&of_this_process, format!("{}{ptx}{LAST}", self.made_of)))
            .and_then(|()| std::fs::rename(&of_this_process, &self.file));
        if written.is_err() {
            let _ = std::fs::remove_file(&of_this_process);
        }
    }
}

fn compile_text(main: &str, header: Option<&str>, threads: usize) -> Result<String, DeviceError> {
    let library = library().ok_or(DeviceError::NoCompiler)?;
    let mut compilation = Compilation { library, program: std::ptr::null_mut() };
    let first = DEVICE_TEXT.into_iter().filter(|(name, _)| *name == main);
    let texts = first.chain(DEVICE_TEXT).chain(header.map(|header| (HEADER, header)));
    let (mut names, mut contents) = (Vec::new(), Vec::new());
    for (name, text) in texts {
        let (Ok(name), Ok(text)) = (CString::new(name), CString::new(text)) else {
            return Err(failed("a text holds a zero"));
        };
        names.push(name);
        contents.push(text);
    }
    let pointers = |all: &[CString]| all.iter().map(|text| text.as_ptr()).collect::<Vec<_>>();
    let (name_pointers, text_pointers) = (pointers(&names), pointers(&contents));
    type Create = unsafe extern "C" fn(
        *mut Program,
        *const c_char,
        *const c_char,
        c_int,
        *const *const c_char,
        *const *const c_char,
    ) -> c_int;
    let mut program = std::ptr::null_mut();
    let headers = names.len() as c_int - 1;
    // SAFETY: the first text is the program, the others are its headers; all live until the end
    let created = unsafe {
        let create = compilation.function::<Create>(c"nvrtcCreateProgram")?;
        let (headers_at, names_at) = (text_pointers[1..].as_ptr(), name_pointers[1..].as_ptr());
        create(&raw mut program, text_pointers[0], name_pointers[0], headers, headers_at, names_at)
    };
    compilation.program = program;
    if created != 0 {
        return Err(failed(format!("error {created} of nvrtcCreateProgram")));
    }
    let own = header.map(|_| FOR_ONE);
    // one thread steps an env, whose robot's columns are where more threads step it
    let defined = if main == ENV {
        vec!["-DLANES=1".to_owned(), format!("-DTILE={}", WARP / threads)]
    } else {
        vec![format!("-DLANES={threads}")]
    };
    let Ok(defined) = defined.into_iter().map(CString::new).collect::<Result<Vec<_>, _>>() else {
        return Err(failed("an option holds a zero"));
    };
    let options = OPTIONS.into_iter().chain(own).chain(defined.iter().map(|option| &**option));
    let options: Vec<_> = options.map(CStr::as_ptr).collect();
    type Compile = unsafe extern "C" fn(Program, c_int, *const *const c_char) -> c_int;
    let compile = compilation.function::<Compile>(c"nvrtcCompileProgram")?;
    // SAFETY: the options are texts that end with a zero
    if unsafe { compile(compilation.program, options.len() as c_int, options.as_ptr()) } != 0 {
        let log = compilation.text(c"nvrtcGetProgramLogSize", c"nvrtcGetProgramLog")?;
        return Err(failed(log.lines().next().unwrap_or("no reason given")));
    }
    let ptx = compilation.text(c"nvrtcGetPTXSize", c"nvrtcGetPTX")?;
    let lines = ptx.lines().filter(|line| !line.trim_start().starts_with(HINT));
    Ok(lines.map(|line| if line.starts_with(".version ") { VERSION } else { line }.to_owned() + "\n").collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cache_returns_whole_files_made_of_the_same_text() {
        let folder = std::env::temp_dir().join(format!("polypod-ptx-{}", std::process::id()));
        let kept = |made_of: &str| Kept { made_of: made_of.into(), file: folder.join("a").join("step.ptx") };
        let one = kept("one\n");
        assert_eq!(one.read(), None);
        one.write(".version 7.0\n");
        assert_eq!(one.read().as_deref(), Some(".version 7.0\n// end\n"));
        // another text with the same file name compiles again, and replaces it
        let other = kept("other\n");
        assert_eq!(other.read(), None);
        other.write(".version 7.1\n");
        assert_eq!((one.read(), other.read().is_some()), (None, true));
        let whole = std::fs::read_to_string(&one.file).unwrap();
        std::fs::write(&one.file, &whole[..whole.len() - 3]).unwrap();
        assert_eq!(other.read(), None);
        assert_eq!(std::fs::read_dir(folder.join("a")).unwrap().count(), 1);
        std::fs::remove_dir_all(&folder).unwrap();
        // a folder that cannot be written costs nothing
        Kept { made_of: String::new(), file: PathBuf::from("/proc/none/step.ptx") }.write("");
    }
}
