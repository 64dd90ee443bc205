//! The update of the native learner with the text of the device, on the host.

use polypod_cuda::DeviceError;
use polypod_cuda::update::{
    Chains, Inputs, Launch, Machine, Plain, Product, Rows, Step, Surrogate, Total, Value, WeightGradient,
};

unsafe extern "C" {
    fn polypod_learn_rows(job: *const Rows);
    fn polypod_learn_inputs(jobs: *const [Inputs; 2]);
    fn polypod_learn_product(jobs: *const [Product; 2]);
    fn polypod_learn_surrogate(job: *const Surrogate);
    fn polypod_learn_value(job: *const Value);
    fn polypod_learn_chains(job: *const Chains);
    fn polypod_learn_weights(jobs: *const [WeightGradient; 2]);
    fn polypod_learn_total(jobs: *const [Total; 2]);
    fn polypod_learn_step(jobs: *const [Step; 2]);
}

/// Aligned memory.
#[derive(Clone, Copy)]
#[repr(C, align(256))]
struct Piece([u8; 256]);

/// The host in a card's place.
#[derive(Default)]
pub struct UpdateHost {
    room: Vec<Piece>,
    /// Launches that it makes before it is lost; None: it is never lost.
    left: Option<usize>,
}

impl UpdateHost {
    /// A host that is lost after some launches.
    pub fn lost_after(launches: usize) -> Self {
        Self { left: Some(launches), ..Self::default() }
    }

    /// The memory of some bytes.
    fn place(&mut self, at: u64, bytes: usize) -> *mut u8 {
        let start = self.room.as_mut_ptr().expose_provenance();
        let offset = usize::try_from(at).unwrap_or(0).wrapping_sub(start);
        assert!(offset + bytes <= size_of_val(&self.room[..]), "{bytes} bytes at {offset} lie outside of the memory");
        // SAFETY: the place lies within the memory
        unsafe { self.room.as_mut_ptr().cast::<u8>().add(offset) }
    }
}

impl Machine for UpdateHost {
    fn name(&self) -> &str {
        "host"
    }

    fn reserve(&mut self, bytes: u64) -> Result<u64, DeviceError> {
        let pieces = usize::try_from(bytes).unwrap_or(usize::MAX).div_ceil(size_of::<Piece>());
        // numbers that nobody wrote are NaN
        self.room = vec![Piece([0xff; 256]); pieces];
        Ok(self.room.as_mut_ptr().expose_provenance() as u64)
    }

    fn write<T: Plain>(&mut self, to: u64, from: &[T]) -> Result<(), DeviceError> {
        let bytes = size_of_val(from);
        let to = self.place(to, bytes);
        // SAFETY: the place has that many bytes, and both are apart
        unsafe { std::ptr::copy_nonoverlapping(from.as_ptr().cast::<u8>(), to, bytes) };
        Ok(())
    }

    fn read<T: Plain>(&mut self, from: u64, to: &mut [T]) -> Result<(), DeviceError> {
        let bytes = size_of_val(to);
        let from = self.place(from, bytes);
        // SAFETY: the place has that many bytes, all of which are numbers
        unsafe { std::ptr::copy_nonoverlapping(from, to.as_mut_ptr().cast::<u8>(), bytes) };
        Ok(())
    }

    fn launch(&mut self, launch: &Launch) -> Result<(), DeviceError> {
        match &mut self.left {
            Some(0) => return Err(DeviceError::Call { call: "launch", text: "the device is lost".into() }),
            Some(left) => *left -= 1,
            None => {}
        }
        // SAFETY: the arrays have the sizes of the jobs, which bound every index of the text; it
        // keeps no pointer
        unsafe {
            match launch {
                Launch::Rows(job) => polypod_learn_rows(job),
                Launch::Inputs(jobs) => polypod_learn_inputs(jobs),
                Launch::Product(jobs) => polypod_learn_product(jobs),
                Launch::Surrogate(job) => polypod_learn_surrogate(job),
                Launch::Value(job) => polypod_learn_value(job),
                Launch::Chains(job) => polypod_learn_chains(job),
                Launch::WeightGradient(jobs) => polypod_learn_weights(jobs),
                Launch::Total(jobs) => polypod_learn_total(jobs),
                Launch::Step(jobs) => polypod_learn_step(jobs),
            }
        }
        Ok(())
    }
}
