//! Operations on blocks of eight numbers, in AVX2 instructions where the processor at hand
//! has them, since the compiler does not find these by itself and must not rely on them.

/// Numbers to a block.
pub(super) const BLOCK: usize = 8;

/// The instructions that [`Work`] may use.
pub(super) trait Lanes: Copy {
    /// For each key, how many of `others` are smaller.
    fn count_smaller(self, keys: &[i32; BLOCK], others: &[i32]) -> [i32; BLOCK];

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

/// Does `work` with the best instructions that this processor has.
pub(super) fn widest<W: Work>(work: W) -> W::Output {
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
    fn count_smaller(self, keys: &[i32; BLOCK], others: &[i32]) -> [i32; BLOCK] {
        keys.map(|key| others.iter().map(|&other| i32::from(key > other)).sum())
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
        _mm_loadl_epi64, _mm256_cmpgt_epi32, _mm256_cvtepu8_epi32, _mm256_loadu_si256,
        _mm256_permutevar8x32_epi32, _mm256_set1_epi32, _mm256_setzero_si256, _mm256_storeu_si256,
        _mm256_sub_epi32,
    };

    use super::{BLOCK, Lanes, ONES};

    /// Exists only where the processor has AVX2.
    #[derive(Clone, Copy)]
    pub struct Avx2(pub(super) ());

    impl Lanes for Avx2 {
        #[inline(always)]
        fn count_smaller(self, keys: &[i32; BLOCK], others: &[i32]) -> [i32; BLOCK] {
            let mut counts = [0; BLOCK];
            // SAFETY: the processor has AVX2, and the load and the store are of blocks.
            unsafe {
                let keys = _mm256_loadu_si256(keys.as_ptr().cast());
                let mut smaller = _mm256_setzero_si256();
                for &other in others {
                    // A comparison that holds is -1.
                    let is_smaller = _mm256_cmpgt_epi32(keys, _mm256_set1_epi32(other));
                    smaller = _mm256_sub_epi32(smaller, is_smaller);
                }
                _mm256_storeu_si256(counts.as_mut_ptr().cast(), smaller);
            }
            counts
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

    /// What each kind makes of every byte, and of keys among others.
    struct Everything;

    impl Work for Everything {
        type Output = (Vec<Vec<i32>>, [i32; BLOCK]);

        fn run<L: Lanes>(self, lanes: L) -> Self::Output {
            let values = [7, -3, 12, 0, 5, 1, i32::MAX, i32::MIN];
            let chosen = (0..=u8::MAX).map(|byte| {
                let mut end = [-1; BLOCK];
                // SAFETY: `end` is a block.
                let n = unsafe { lanes.append(byte, &values, &mut end) };
                end[..n].to_vec()
            });
            (chosen.collect(), lanes.count_smaller(&values, &values[..5]))
        }
    }

    #[test]
    fn portable_and_widest_do_what_they_say() {
        let values = [7, -3, 12, 0, 5, 1, i32::MAX, i32::MIN];
        let chosen = (0..=u8::MAX).map(|byte| {
            let places = (0..BLOCK).filter(|place| byte >> place & 1 == 1);
            places.map(|place| values[place]).collect()
        });
        let expected = (chosen.collect(), [3, 0, 4, 1, 2, 2, 5, 0]);
        assert_eq!(Everything.run(Portable), expected);
        assert_eq!(widest(Everything), expected);
    }
}
