//! Operations on blocks of eight numbers, in AVX2 instructions where the processor at hand
//! has them, since the compiler does not find these by itself and must not rely on them.

use super::scalar::Scalar;

/// Numbers to a block.
pub(super) const BLOCK: usize = 8;

/// The instructions that [`Work`] may use.
pub(super) trait Lanes: Copy {
    /// One bit per place, set where the value is at most its limit; the first place is the
    /// lowest bit.
    fn at_most<T: Scalar>(self, values: &[T; BLOCK], limits: &[T; BLOCK]) -> u8;

    /// For each key, how many of `row` are smaller, without `dropped` among them. For a
    /// key that is `dropped`, and the keys behind the first `keep`, it is `other`.
    fn places(
        self,
        keys: &[i32; BLOCK],
        keep: usize,
        row: &[i32],
        dropped: i32,
        other: i32,
    ) -> [i32; BLOCK];

    /// Writes those of `values` whose bit in `chosen` is set to `end`, in order, and
    /// returns how many. What is written behind them does not count.
    ///
    /// # Safety
    /// There is room for a block at `end`.
    unsafe fn append(self, chosen: u8, values: &[i32; BLOCK], end: *mut [i32; BLOCK]) -> usize;
}

/// Something to be compiled for each kind of [`Lanes`]; everything in its loops must be
/// inlined.
pub(super) trait Work {
    type Output;
    fn run<L: Lanes>(self, lanes: L) -> Self::Output;
}

#[cfg(test)]
thread_local! {
    /// Whether this thread does without what its processor has.
    pub(super) static PLAIN: std::cell::Cell<bool> = const { std::cell::Cell::new(false) };
}

/// Does `work` with the best instructions that this processor has.
pub(super) fn widest<W: Work>(work: W) -> W::Output {
    #[cfg(test)]
    if PLAIN.get() {
        return work.run(Portable);
    }
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        #[target_feature(enable = "avx2")]
        fn run<W: Work>(work: W) -> W::Output {
            work.run(avx2::Avx2(()))
        }
        // SAFETY: the processor has them.
        return unsafe { run(work) };
    }
    work.run(Portable)
}

/// For each byte, the places of its ones from the lowest, and how many there are.
static ONES: [([u8; BLOCK], u8); 256] = {
    let mut table = [([0; BLOCK], 0); 256];
    let mut byte = 0;
    while byte < 256 {
        let mut place = 0;
        while place < BLOCK {
            if byte >> place & 1 == 1 {
                let (places, count) = &mut table[byte];
                places[*count as usize] = place as u8;
                *count += 1;
            }
            place += 1;
        }
        byte += 1;
    }
    table
};

/// What every processor has.
#[derive(Clone, Copy)]
struct Portable;

impl Lanes for Portable {
    #[inline(always)]
    fn at_most<T: Scalar>(self, values: &[T; BLOCK], limits: &[T; BLOCK]) -> u8 {
        (0..BLOCK).fold(0, |bits, l| bits | u8::from(values[l] <= limits[l]) << l)
    }

    #[inline(always)]
    fn places(
        self,
        keys: &[i32; BLOCK],
        keep: usize,
        row: &[i32],
        dropped: i32,
        other: i32,
    ) -> [i32; BLOCK] {
        std::array::from_fn(|l| {
            if l < keep && keys[l] != dropped {
                let smaller: i32 = row.iter().map(|&sender| i32::from(keys[l] > sender)).sum();
                smaller - i32::from(keys[l] > dropped)
            } else {
                other
            }
        })
    }

    /// As many are written as there often are, then the others if there are more.
    #[inline(always)]
    unsafe fn append(self, chosen: u8, values: &[i32; BLOCK], end: *mut [i32; BLOCK]) -> usize {
        const OFTEN: usize = BLOCK / 2;
        let (places, count) = &ONES[usize::from(chosen)];
        let count = usize::from(*count);
        // SAFETY: promised by the caller.
        let end = unsafe { &mut *end };
        // SAFETY: the table's places lie inside a block.
        let at = |l: usize| unsafe { *values.get_unchecked(usize::from(places[l])) };
        for l in 0..OFTEN {
            end[l] = at(l);
        }
        if count > OFTEN {
            for l in OFTEN..BLOCK {
                end[l] = at(l);
            }
        }
        count
    }
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use std::arch::x86_64::{
        _mm_loadl_epi64, _mm256_andnot_si256, _mm256_blendv_epi8, _mm256_cmpeq_epi32,
        _mm256_cmpgt_epi32, _mm256_cvtepu8_epi32, _mm256_loadu_si256, _mm256_permutevar8x32_epi32,
        _mm256_set1_epi32, _mm256_setr_epi32, _mm256_storeu_si256, _mm256_sub_epi32,
    };

    use super::{BLOCK, Lanes, ONES, Scalar};

    /// Exists only where the processor has AVX2.
    #[derive(Clone, Copy)]
    pub struct Avx2(pub(super) ());

    impl Lanes for Avx2 {
        #[inline(always)]
        fn at_most<T: Scalar>(self, values: &[T; BLOCK], limits: &[T; BLOCK]) -> u8 {
            // SAFETY: the processor has AVX2.
            unsafe { T::at_most_avx2(values, limits) }
        }

        #[inline(always)]
        fn places(
            self,
            keys: &[i32; BLOCK],
            keep: usize,
            row: &[i32],
            dropped: i32,
            other: i32,
        ) -> [i32; BLOCK] {
            let mut places = [0; BLOCK];
            // SAFETY: the processor has AVX2, and the load and the store are of blocks.
            unsafe {
                let keys = _mm256_loadu_si256(keys.as_ptr().cast());
                let dropped = _mm256_set1_epi32(dropped);
                // A comparison that holds is -1.
                let mut smaller = _mm256_cmpgt_epi32(keys, dropped);
                for &sender in row {
                    let is_smaller = _mm256_cmpgt_epi32(keys, _mm256_set1_epi32(sender));
                    smaller = _mm256_sub_epi32(smaller, is_smaller);
                }
                let lane = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
                let kept = _mm256_andnot_si256(
                    _mm256_cmpeq_epi32(keys, dropped),
                    _mm256_cmpgt_epi32(_mm256_set1_epi32(keep.min(BLOCK) as i32), lane),
                );
                let chosen = _mm256_blendv_epi8(_mm256_set1_epi32(other), smaller, kept);
                _mm256_storeu_si256(places.as_mut_ptr().cast(), chosen);
            }
            places
        }

        #[inline(always)]
        unsafe fn append(self, chosen: u8, values: &[i32; BLOCK], end: *mut [i32; BLOCK]) -> usize {
            let (places, count) = &ONES[usize::from(chosen)];
            // SAFETY: the processor has AVX2, the loads are of blocks, and the caller
            // promised that there is room for one.
            unsafe {
                let places = _mm256_cvtepu8_epi32(_mm_loadl_epi64(places.as_ptr().cast()));
                let values = _mm256_loadu_si256(values.as_ptr().cast());
                _mm256_storeu_si256(end.cast(), _mm256_permutevar8x32_epi32(values, places));
            }
            usize::from(*count)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const VALUES: [i32; BLOCK] = [7, -3, 12, 0, 5, 1, i32::MAX, i32::MIN];

    /// What each kind makes of every byte, of limits, and of a row from whose block of
    /// `VALUES` one is dropped.
    struct Everything;

    impl Work for Everything {
        type Output = (Vec<Vec<i32>>, [u8; 2], [[i32; BLOCK]; 2]);

        fn run<L: Lanes>(self, lanes: L) -> Self::Output {
            let chosen = (0..=u8::MAX).map(|byte| {
                let mut end = [-1; BLOCK];
                // SAFETY: `end` is a block.
                let n = unsafe { lanes.append(byte, &VALUES, &mut end) };
                end[..n].to_vec()
            });
            let values = [0.0, 1.0, 2.0, f64::NAN, 3.0, -1.0, 1.5, f64::INFINITY];
            let near = [
                lanes.at_most(&values, &[1.5; BLOCK]),
                lanes.at_most(&values.map(|v| v as f32), &[1.5; BLOCK]),
            ];
            let places = [
                lanes.places(&VALUES, 8, &VALUES, 5, 7),
                lanes.places(&VALUES, 3, &VALUES[..3], i32::MAX, 3),
            ];
            (chosen.collect(), near, places)
        }
    }

    #[test]
    fn portable_and_widest_do_what_they_say() {
        let chosen = (0..=u8::MAX).map(|byte| {
            let places = (0..BLOCK).filter(|place| byte >> place & 1 == 1);
            places.map(|place| VALUES[place]).collect()
        });
        let expected = (
            chosen.collect(),
            [0b0110_0011; 2],
            [[4, 1, 5, 2, 7, 3, 6, 0], [1, 0, 2, 3, 3, 3, 3, 3]],
        );
        assert_eq!(Everything.run(Portable), expected);
        assert_eq!(widest(Everything), expected);
    }
}
