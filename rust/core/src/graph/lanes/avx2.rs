//! Vectors of AVX2.

use std::arch::x86_64::{
    __m256i, _MM_HINT_T0, _mm_loadl_epi64, _mm_prefetch, _mm256_andnot_si256, _mm256_blend_epi32,
    _mm256_blendv_epi8, _mm256_castsi256_si128, _mm256_cmpeq_epi32, _mm256_cmpgt_epi32,
    _mm256_cvtepi32_epi64, _mm256_cvtepu8_epi32, _mm256_extracti128_si256, _mm256_loadu_si256,
    _mm256_max_epi32, _mm256_min_epi32, _mm256_permute4x64_epi64, _mm256_permutevar8x32_epi32,
    _mm256_set1_epi32, _mm256_setr_epi32, _mm256_shuffle_epi32, _mm256_storeu_si256,
};

use super::bitonic::{Keys, write_network};
use super::{Lanes, ONES, SHORTER as BLOCK, Scalar, Work};
use crate::graph::order::NONE;

/// Exists only where the processor has AVX2 and POPCNT.
#[derive(Clone, Copy)]
pub struct Avx2(());

/// Does `work` in these instructions.
#[target_feature(enable = "avx2,popcnt")]
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
        let (places, _) = &ONES[usize::from(chosen as u8)];
        // SAFETY: the processor has AVX2, the loads are of blocks, and the caller promised that
        // there is room for one.
        unsafe {
            let places = _mm256_cvtepu8_epi32(_mm_loadl_epi64(places.as_ptr().cast()));
            let values = _mm256_loadu_si256(values.as_ptr().cast());
            _mm256_storeu_si256(end.cast(), _mm256_permutevar8x32_epi32(values, places));
        }
        chosen.count_ones() as usize
    }

    #[inline(always)]
    unsafe fn write_sorted(self, row: &[i32], n: usize, dropped: i32, out: *mut i64) {
        // SAFETY: promised by the caller, and the processor has AVX2.
        unsafe {
            match n.div_ceil(BLOCK) {
                0 | 1 => write_network::<__m256i, 1>(row, n, dropped, out),
                2 => write_network::<__m256i, 2>(row, n, dropped, out),
                3 | 4 => write_network::<__m256i, 4>(row, n, dropped, out),
                _ => write_network::<__m256i, 8>(row, n, dropped, out),
            }
        }
    }

    #[inline(always)]
    fn prefetch<T>(self, place: *const T) {
        // SAFETY: it reads nothing that the program sees, whatever the place.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(place.cast()) }
    }
}

/// One step of the network: compares places `STRIDE` apart; `LARGER` has a bit where the larger of
/// the two stays.
///
/// # Safety
/// The processor has AVX2.
#[inline(always)]
unsafe fn step<const STRIDE: usize, const LARGER: i32>(keys: __m256i) -> __m256i {
    // SAFETY: promised by the caller.
    unsafe {
        let others = match STRIDE {
            1 => _mm256_shuffle_epi32::<0b10_11_00_01>(keys),
            2 => _mm256_shuffle_epi32::<0b01_00_11_10>(keys),
            _ => _mm256_permute4x64_epi64::<0b01_00_11_10>(keys),
        };
        let (smaller, larger) = (keys.lesser(others), keys.greater(others));
        _mm256_blend_epi32::<LARGER>(smaller, larger)
    }
}

impl Keys for __m256i {
    const LANES: usize = BLOCK;

    #[inline(always)]
    unsafe fn load(row: *const i32, n: usize, dropped: i32) -> Self {
        // SAFETY: promised by the caller.
        unsafe {
            let keys = _mm256_loadu_si256(row.cast());
            let places = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
            let present = _mm256_cmpgt_epi32(_mm256_set1_epi32(n as i32), places);
            let dropped = _mm256_cmpeq_epi32(keys, _mm256_set1_epi32(dropped));
            let kept = _mm256_andnot_si256(dropped, present);
            _mm256_blendv_epi8(_mm256_set1_epi32(NONE), keys, kept)
        }
    }

    #[inline(always)]
    unsafe fn write(self, _: usize, out: *mut i64) {
        // SAFETY: promised by the caller.
        unsafe {
            let low = _mm256_castsi256_si128(self);
            _mm256_storeu_si256(out.cast(), _mm256_cvtepi32_epi64(low));
            let high = _mm256_extracti128_si256::<1>(self);
            _mm256_storeu_si256(out.add(BLOCK / 2).cast(), _mm256_cvtepi32_epi64(high));
        }
    }

    #[inline(always)]
    unsafe fn lesser(self, other: Self) -> Self {
        // SAFETY: promised by the caller.
        unsafe { _mm256_min_epi32(self, other) }
    }

    #[inline(always)]
    unsafe fn greater(self, other: Self) -> Self {
        // SAFETY: promised by the caller.
        unsafe { _mm256_max_epi32(self, other) }
    }

    #[inline(always)]
    unsafe fn reversed(self) -> Self {
        // SAFETY: promised by the caller.
        unsafe { _mm256_permutevar8x32_epi32(self, _mm256_setr_epi32(7, 6, 5, 4, 3, 2, 1, 0)) }
    }

    #[inline(always)]
    unsafe fn sorted(self) -> Self {
        // SAFETY: promised by the caller.
        unsafe {
            let keys = step::<1, 0b0110_0110>(self);
            let keys = step::<1, 0b0101_1010>(step::<2, 0b0011_1100>(keys));
            keys.ascending()
        }
    }

    #[inline(always)]
    unsafe fn ascending(self) -> Self {
        // SAFETY: promised by the caller.
        unsafe { step::<1, 0b1010_1010>(step::<2, 0b1100_1100>(step::<4, 0b1111_0000>(self))) }
    }
}
