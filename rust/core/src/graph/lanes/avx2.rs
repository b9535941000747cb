//! Vectors of AVX2.

use std::arch::x86_64::{
    _MM_HINT_T0, _mm_loadl_epi64, _mm_prefetch, _mm256_cmpgt_epi32, _mm256_cvtepu8_epi32,
    _mm256_loadu_si256, _mm256_permutevar8x32_epi32, _mm256_set1_epi32, _mm256_setzero_si256,
    _mm256_storeu_si256, _mm256_sub_epi32,
};

use super::{Lanes, ONES, SHORTER as BLOCK, Scalar, Work, write_ranked};

/// Exists only where the processor has AVX2.
#[derive(Clone, Copy)]
pub struct Avx2(());

/// Does `work` in these instructions.
#[target_feature(enable = "avx2")]
pub fn run<W: Work>(work: W) -> W::Output {
    work.run(Avx2(()))
}

impl Lanes<BLOCK> for Avx2 {
    #[inline(always)]
    fn at_most<T: Scalar>(self, values: &[T; BLOCK], limits: &[T; BLOCK]) -> u16 {
        // SAFETY: the processor has AVX2.
        unsafe { T::at_most_avx2(values, limits) }
    }

    #[inline(always)]
    unsafe fn append(self, chosen: u16, values: &[i32; BLOCK], end: *mut [i32; BLOCK]) -> usize {
        let (places, count) = &ONES[usize::from(chosen as u8)];
        // SAFETY: the processor has AVX2, the loads are of blocks, and the caller promised that
        // there is room for one.
        unsafe {
            let places = _mm256_cvtepu8_epi32(_mm_loadl_epi64(places.as_ptr().cast()));
            let values = _mm256_loadu_si256(values.as_ptr().cast());
            _mm256_storeu_si256(end.cast(), _mm256_permutevar8x32_epi32(values, places));
        }
        usize::from(*count)
    }

    #[inline(always)]
    unsafe fn write_sorted(self, row: &[i32], n: usize, dropped: i32, out: *mut i64) {
        // SAFETY: promised by the caller; the processor has AVX2, and the load and the store are
        // of blocks.
        unsafe {
            write_ranked::<BLOCK>(row, n, dropped, out, |keys, row| {
                let keys = _mm256_loadu_si256(keys.as_ptr().cast());
                let mut ranks = _mm256_setzero_si256();
                for &other in row {
                    // A comparison that holds is -1.
                    let larger = _mm256_cmpgt_epi32(keys, _mm256_set1_epi32(other));
                    ranks = _mm256_sub_epi32(ranks, larger);
                }
                let mut places = [0; BLOCK];
                _mm256_storeu_si256(places.as_mut_ptr().cast(), ranks);
                places
            });
        }
    }

    #[inline(always)]
    fn prefetch<T>(self, place: *const T) {
        // SAFETY: it reads nothing that the program sees, whatever the place.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(place.cast()) }
    }
}
