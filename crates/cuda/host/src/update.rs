//! The update of the native learner with the text of the device, on the host.

use polypod_cuda::DeviceError;
use polypod_cuda::update::{
    Chains, Inputs, Launch, Machine, Plain, Product, Rows, Step, Surrogate, Total, Value, WeightGradient,
};

/// Declares a function of each kernel, and [`run`] with them.
macro_rules! kernels {
    ($run:ident: $($name:ident($variant:ident, $job:ty)),*) => {
        unsafe extern "C" {
            $(fn $name(job: *const $job);)*
        }

        /// # Safety
        /// The arrays have the sizes of the jobs.
        unsafe fn $run(launch: &Launch) {
            match launch {
                // SAFETY: the caller's promise; the text keeps no pointer
                $(Launch::$variant(job) => unsafe { $name(job) }),*
            }
        }
    };
}

kernels!(run:
    polypod_learn_rows(Rows, Rows),
    polypod_learn_inputs(Inputs, [Inputs; 2]),
    polypod_learn_product(Product, [Product; 2]),
    polypod_learn_surrogate(Surrogate, Surrogate),
    polypod_learn_value(Value, Value),
    polypod_learn_chains(Chains, Chains),
    polypod_learn_weights(WeightGradient, [WeightGradient; 2]),
    polypod_learn_total(Total, [Total; 2]),
    polypod_learn_step(Step, [Step; 2])
);

#[cfg(target_os = "linux")]
kernels!(run_by_threads:
    polypod_learn_rows_by_threads(Rows, Rows),
    polypod_learn_inputs_by_threads(Inputs, [Inputs; 2]),
    polypod_learn_product_by_threads(Product, [Product; 2]),
    polypod_learn_surrogate_by_threads(Surrogate, Surrogate),
    polypod_learn_value_by_threads(Value, Value),
    polypod_learn_chains_by_threads(Chains, Chains),
    polypod_learn_weights_by_threads(WeightGradient, [WeightGradient; 2]),
    polypod_learn_total_by_threads(Total, [Total; 2]),
    polypod_learn_step_by_threads(Step, [Step; 2])
);

/// Other machines have no coroutines.
#[cfg(not(target_os = "linux"))]
use run as run_by_threads;

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
    by_threads: bool,
}

impl UpdateHost {
    /// A host that is lost after some launches.
    pub fn lost_after(launches: usize) -> Self {
        Self { left: Some(launches), ..Self::default() }
    }

    /// A host that runs the threads of a block as coroutines, which go on in random order from
    /// where they met.
    pub fn by_threads() -> Self {
        Self { by_threads: true, ..Self::default() }
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
        // SAFETY: the arrays have the sizes of the jobs, which bound every index of the text
        unsafe { if self.by_threads { run_by_threads(launch) } else { run(launch) } };
        Ok(())
    }
}
