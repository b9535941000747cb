//! Vectors of AVX-512.

use std::arch::x86_64::{
    __m512i, _MM_HINT_T0, _mm_prefetch, _mm256_storeu_si256, _mm512_castsi512_si256,
    _mm512_cvtepi32_epi64, _mm512_extracti64x4_epi64, _mm512_loadu_si512,
    _mm512_mask_cmpneq_epi32_mask, _mm512_mask_loadu_epi32, _mm512_mask_max_epi32,
    _mm512_mask_mov_epi32, _mm512_maskz_compress_epi32, _mm512_max_epi32, _mm512_min_epi32,
    _mm512_permutexvar_epi32, _mm512_set1_epi32, _mm512_setr_epi32, _mm512_shuffle_epi32,
    _mm512_shuffle_i32x4, _mm512_storeu_si512,
};

use super::bitonic::{Keys, write_network};
use super::{LONGEST as BLOCK, Lanes, Scalar, Work};
use crate::graph::order::NONE;

/// Half a block: often enough, and stored in half the time.
const HALF: usize = BLOCK / 2;

/// Exists only where the processor has AVX-512 (F, VL and DQ).
#[derive(Clone, Copy)]
pub struct Avx512(());

/// Does `work` in these instructions.
#[target_feature(enable = "avx512f,avx512vl,avx512dq,bmi2,popcnt")]
pub fn run<W: Work>(work: W) -> W::Output {
    work.run(Avx512(()))
}

impl Lanes<BLOCK> for Avx512 {
    #[inline(always)]
    fn at_most<T: Scalar>(self, values: &[T; BLOCK], limits: &[T; BLOCK]) -> u16 {
        // SAFETY: the processor has AVX-512.
        unsafe { T::at_most_avx512(values, limits) }
    }

    #[inline(always)]
    unsafe fn append(self, chosen: u16, values: &[i32; BLOCK], end: *mut [i32; BLOCK]) -> usize {
        // SAFETY: the processor has AVX-512, and the caller promised that there is room.
        unsafe {
            let values = _mm512_loadu_si512(values.as_ptr().cast());
            let packed = _mm512_maskz_compress_epi32(chosen, values);
            let count = chosen.count_ones() as usize;
            _mm256_storeu_si256(end.cast(), _mm512_castsi512_si256(packed));
            if count > HALF {
                _mm512_storeu_si512(end.cast(), packed);
            }
            count
        }
    }

    #[inline(always)]
    unsafe fn write_sorted(self, row: &[i32], n: usize, dropped: i32, out: *mut i64) {
        // SAFETY: promised by the caller, and the processor has AVX-512, so AVX2 too.
        unsafe {
            if n <= HALF {
                let keys = __m512i::load(row.as_ptr(), n, dropped);
                let keys = _mm512_castsi512_si256(keys).sorted();
                return _mm512_storeu_si512(out.cast(), _mm512_cvtepi32_epi64(keys));
            }
            match n.div_ceil(BLOCK) {
                1 => write_network::<__m512i, 1>(row, n, dropped, out),
                2 => write_network::<__m512i, 2>(row, n, dropped, out),
                _ => write_network::<__m512i, 4>(row, n, dropped, out),
            }
        }
    }

    #[inline(always)]
    fn prefetch<T>(self, place: *const T) {
        // SAFETY: it reads nothing that the program sees, whatever the place.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(place.cast()) }
    }
}

/// Where a step of the network that compares places `stride` apart, in runs of `size` sorted by
/// turns up and down, leaves the larger of the two.
const fn larger(size: usize, stride: usize) -> u16 {
    let mut bits = 0;
    let mut place = 0;
    while place < BLOCK {
        if (place & stride == 0) != (place & size == 0) {
            bits |= 1 << place;
        }
        place += 1;
    }
    bits
}

/// One step of the network.
///
/// # Safety
/// The processor has AVX-512.
#[inline(always)]
unsafe fn step<const SIZE: usize, const STRIDE: usize>(keys: __m512i) -> __m512i {
    // SAFETY: promised by the caller.
    unsafe {
        let others = match STRIDE {
            1 => _mm512_shuffle_epi32::<0b10_11_00_01>(keys),
            2 => _mm512_shuffle_epi32::<0b01_00_11_10>(keys),
            4 => _mm512_shuffle_i32x4::<0b10_11_00_01>(keys, keys),
            _ => _mm512_shuffle_i32x4::<0b01_00_11_10>(keys, keys),
        };
        let smaller = _mm512_min_epi32(keys, others);
        _mm512_mask_max_epi32(smaller, const { larger(SIZE, STRIDE) }, keys, others)
    }
}

impl Keys for __m512i {
    const LANES: usize = BLOCK;

    #[inline(always)]
    unsafe fn load(row: *const i32, n: usize, dropped: i32) -> Self {
        // SAFETY: promised by the caller; what a mask leaves out is not read.
        unsafe {
            let none = _mm512_set1_epi32(NONE);
            let present = ((1_u32 << n) - 1) as u16;
            let keys = _mm512_mask_loadu_epi32(none, present, row);
            let kept = _mm512_mask_cmpneq_epi32_mask(present, keys, _mm512_set1_epi32(dropped));
            _mm512_mask_mov_epi32(none, kept, keys)
        }
    }

    #[inline(always)]
    unsafe fn write(self, n: usize, out: *mut i64) {
        // SAFETY: promised by the caller.
        unsafe {
            let low = _mm512_castsi512_si256(self);
            _mm512_storeu_si512(out.cast(), _mm512_cvtepi32_epi64(low));
            if n > HALF {
                let high = _mm512_extracti64x4_epi64::<1>(self);
                _mm512_storeu_si512(out.add(HALF).cast(), _mm512_cvtepi32_epi64(high));
            }
        }
    }

    #[inline(always)]
    unsafe fn lesser(self, other: Self) -> Self {
        // SAFETY: promised by the caller.
        unsafe { _mm512_min_epi32(self, other) }
    }

    #[inline(always)]
    unsafe fn greater(self, other: Self) -> Self {
        // SAFETY: promised by the caller.
        unsafe { _mm512_max_epi32(self, other) }
    }

    #[inline(always)]
    unsafe fn reversed(self) -> Self {
        // SAFETY: promised by the caller.
        unsafe {
            let places = _mm512_setr_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0);
            _mm512_permutexvar_epi32(places, self)
        }
    }

    #[inline(always)]
    unsafe fn sorted(self) -> Self {
        // SAFETY: promised by the caller.
        unsafe {
            let keys = step::<2, 1>(self);
            let keys = step::<4, 1>(step::<4, 2>(keys));
            step::<8, 1>(step::<8, 2>(step::<8, 4>(keys))).ascending()
        }
    }

    #[inline(always)]
    unsafe fn ascending(self) -> Self {
        // SAFETY: promised by the caller.
        unsafe { step::<16, 1>(step::<16, 2>(step::<16, 4>(step::<16, 8>(self)))) }
    }
}
