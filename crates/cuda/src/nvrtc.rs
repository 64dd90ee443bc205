//! Compiles the text of the device for the user's card, with the NVRTC that torch's wheel brings.
//!
//! The text is shipped instead of its PTX: it is a quarter of the size, and a build needs no
//! compiler of NVIDIA's. A GPU that trains has torch, and with it NVRTC.
#![allow(unsafe_code, reason = "the border to NVRTC, which has an interface of C")]

use std::collections::BTreeMap;
use std::ffi::{CStr, CString, c_char, c_int, c_void};
use std::path::PathBuf;
use std::sync::{Mutex, OnceLock, PoisonError};

use libloading::{Library, Symbol};

use crate::DEVICE_TEXT;
use crate::device::DeviceError;

/// Environment variable that names the library.
const VARIABLE: &str = "POLYPOD_NVRTC";
/// Options that keep each operation as it is written, for the oldest generation of cards.
/// `tools/ptx.py` compiles with the same ones and reads the result.
const OPTIONS: [&CStr; 5] =
    [c"--gpu-architecture=compute_80", c"--fmad=false", c"--ftz=false", c"--prec-div=true", c"--prec-sqrt=true"];
/// Option that makes it the text of the one morphology whose tables [`HEADER`] holds.
const FOR_ONE: &CStr = c"-DPOLYPOD_TABLES";
/// Name of the header in `device/tables.h`.
const HEADER: &str = "morphology.h";
/// The oldest version of PTX that knows the architecture: a driver refuses a newer one than its
/// own.
const VERSION: &str = ".version 7.0";
/// A hint that older versions lack; it changes no result.
const HINT: &str = ".pragma \"used_bytes_mask";
/// Names of a library of the system.
const NAMES: [&str; 5] = ["libnvrtc.so.13", "libnvrtc.so.12", "libnvrtc.so", "nvrtc64_130_0.dll", "nvrtc64_120_0.dll"];

static FOLDERS: OnceLock<Vec<PathBuf>> = OnceLock::new();

/// Folders of Python packages, in which the wheels of NVIDIA have `nvidia/*/lib/libnvrtc.so.*`.
/// The first call counts.
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
pub fn is_present() -> bool {
    library().is_some()
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
/// `header`. A process compiles each once.
///
/// # Errors
/// NVRTC is not there, or it refuses the text.
pub fn compile(header: Option<&str>) -> Result<String, DeviceError> {
    static KNOWN: Mutex<BTreeMap<Option<String>, String>> = Mutex::new(BTreeMap::new());
    let known = || KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
    let header_of = header.map(str::to_owned);
    if let Some(ptx) = known().get(&header_of) {
        return Ok(ptx.clone());
    }
    let ptx = compile_text(header)?;
    known().insert(header_of, ptx.clone());
    Ok(ptx)
}

fn compile_text(header: Option<&str>) -> Result<String, DeviceError> {
    let library = library().ok_or(DeviceError::NoCompiler)?;
    let mut compilation = Compilation { library, program: std::ptr::null_mut() };
    let texts = DEVICE_TEXT.into_iter().chain(header.map(|header| (HEADER, header)));
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
    let options: Vec<_> = OPTIONS.into_iter().chain(own).map(CStr::as_ptr).collect();
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
