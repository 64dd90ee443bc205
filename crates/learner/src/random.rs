//! Random numbers that depend on their purpose, and on no earlier ones.

/// Scrambles the bits of a number (the finaliser of SplitMix64).
fn spread(mut x: u64) -> u64 {
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// A stream of random numbers.
pub(crate) struct Stream(u64);

/// Increment of SplitMix64.
const STEP: u64 = 0x9e37_79b9_7f4a_7c15;

impl Stream {
    /// The stream of a seed and three numbers of its purpose.
    pub(crate) fn new(seed: u64, [a, b, c]: [u64; 3]) -> Self {
        let mixed = [a, b, c]
            .iter()
            .fold(spread(seed.wrapping_add(STEP)), |state, &x| spread(state ^ x.wrapping_add(STEP).wrapping_mul(STEP)));
        Self(mixed)
    }

    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(STEP);
        spread(self.0)
    }

    /// A whole number below `bound`.
    pub(crate) fn below(&mut self, bound: u32) -> u32 {
        (((self.next() >> 32) * u64::from(bound)) >> 32) as u32
    }

    /// Two independent numbers of mean 0 and deviation 1 (Box and Muller).
    pub(crate) fn normal_pair(&mut self) -> [f32; 2] {
        const UNIT: f32 = 1.0 / 16_777_216.0;
        let bits = self.next();
        // in (0, 1], whose logarithm is finite
        let u = ((bits >> 40) + 1) as f32 * UNIT;
        let v = (bits & 0xff_ffff) as f32 * UNIT;
        let radius = (-2.0 * libm::logf(u)).sqrt();
        let (s, c) = libm::sincosf(v * std::f32::consts::TAU);
        [radius * c, radius * s]
    }
}

/// Purpose of a stream.
pub(crate) enum Purpose {
    Noise = 1,
    Order = 2,
}

impl Purpose {
    /// The stream of an env at a control step, or of a part in an iteration.
    pub(crate) fn stream(self, seed: u64, time: u64, place: usize) -> Stream {
        Stream::new(seed, [self as u64, time, place as u64])
    }
}

/// The numbers below `count` in a random order.
pub(crate) fn shuffled(count: usize, mut stream: Stream) -> Vec<u32> {
    let mut order: Vec<u32> = (0..count as u32).collect();
    for i in (1..count).rev() {
        order.swap(i, stream.below(i as u32 + 1) as usize);
    }
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_numbers_have_their_moments() {
        let mut stream = Purpose::Noise.stream(3, 5, 7);
        let (mut sums, count) = ([0.0; 4], 200_000);
        for x in (0..count / 2).flat_map(|_| stream.normal_pair()) {
            let x = f64::from(x);
            sums.iter_mut().enumerate().for_each(|(k, sum)| *sum += x.powi(k as i32 + 1) / f64::from(count));
        }
        let expected = [0.0, 1.0, 0.0, 3.0];
        assert!(sums.iter().zip(expected).all(|(sum, expected)| (sum - expected).abs() < 0.05), "{sums:?}");
    }

    #[test]
    fn orders_hold_each_number_once_and_differ() {
        let order = |place| shuffled(1000, Purpose::Order.stream(1, 2, place));
        let mut sorted = order(0);
        assert_ne!(sorted, order(1));
        assert_eq!(order(0), order(0));
        sorted.sort_unstable();
        assert!(sorted.iter().enumerate().all(|(i, &x)| i == x as usize));
    }
}
