//! Changes to sound bytes. A file with a checksum is refused unless nearly all of it is right, so
//! the fuzzer's input is a list of edits.

/// Bytes of an edit: an operation, a place (24 bits, little endian) and an argument.
const EDIT: usize = 5;
/// Numbers that arithmetic and comparisons stumble over.
const NUMBERS: [f64; 16] = [
    f64::NAN,
    f64::INFINITY,
    f64::NEG_INFINITY,
    0.0,
    -0.0,
    1.0,
    -1.0,
    0.5,
    1e-40,
    1e-6,
    1e6,
    -1e6,
    1e19,
    -1e30,
    3e38,
    1e300,
];

/// `base` after the edits.
pub fn edited(base: &[u8], edits: &[u8]) -> Vec<u8> {
    let mut bytes = base.to_vec();
    for edit in edits.chunks_exact(EDIT) {
        if bytes.is_empty() {
            break;
        }
        let at = u32::from_le_bytes([edit[1], edit[2], edit[3], 0]) as usize % bytes.len();
        apply(&mut bytes, edit[0], at, edit[4]);
    }
    bytes
}

fn apply(bytes: &mut Vec<u8>, operation: u8, at: usize, argument: u8) {
    let number = NUMBERS[usize::from(argument) % NUMBERS.len()];
    // a list's length is one byte, and its elements are of a few sizes
    let size = [1, 4, 8, 12, 16, 24, 32, 96][usize::from(argument) % 8];
    let end = (at + 1 + size).min(bytes.len());
    match operation % 9 {
        0 => bytes[at] = argument,
        1 => overwrite(bytes, at, &(number as f32).to_le_bytes()),
        2 => overwrite(bytes, at, &number.to_le_bytes()),
        // a list that is one element shorter, or longer
        3 => {
            bytes[at] = bytes[at].wrapping_sub(1);
            bytes.drain(at + 1..end);
        }
        4 => {
            bytes[at] = bytes[at].wrapping_add(1);
            let element = bytes[at + 1..end].to_vec();
            bytes.splice(at + 1..at + 1, element);
        }
        // the largest number of 32 or 64 bits in place of a small one
        5 => {
            let ones: &[u8] = match argument & 1 {
                0 => &[0xff, 0xff, 0xff, 0xff, 0x0f],
                _ => &[0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 1],
            };
            bytes.splice(at..=at, ones.iter().copied());
        }
        6 => bytes.insert(at, argument),
        7 => drop(bytes.drain(at..(at + usize::from(argument)).min(bytes.len()))),
        _ => bytes.truncate(at),
    }
}

fn overwrite(bytes: &mut [u8], at: usize, with: &[u8]) {
    for (to, from) in bytes[at..].iter_mut().zip(with) {
        *to = *from;
    }
}

/// `body` and its checksum: FNV-1a, little endian.
pub fn sealed(mut body: Vec<u8>) -> Vec<u8> {
    let hash = body
        .iter()
        .fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3));
    body.extend(hash.to_le_bytes());
    body
}

/// Content without the seal.
pub fn unsealed(bytes: &[u8]) -> &[u8] {
    &bytes[..bytes.len() - size_of::<u64>()]
}
