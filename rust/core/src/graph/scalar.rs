//! The two kinds of coordinates.

use std::ops::{Add, Mul, Sub};

#[cfg(target_arch = "x86_64")]
use super::lanes::{LONGEST, SHORTER};

mod sealed {
    pub trait Sealed {}
    impl Sealed for f32 {}
    impl Sealed for f64 {}
}

/// `f32` or `f64`: what positions and uncertainties are given in, and the arithmetic
/// that decides about an edge.
pub trait Scalar:
    sealed::Sealed
    + Copy
    + PartialOrd
    + Default
    + std::fmt::Debug
    + std::fmt::Display
    + Send
    + Sync
    + 'static
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
{
    /// Positive infinity.
    const INFINITY: Self;
    /// Not a number.
    const NAN: Self;
    /// Distance from one to the next larger number.
    const EPSILON: f64;
    /// The name of the kind, for messages.
    const NAME: &'static str;

    /// The nearest number of this kind.
    fn from_f64(value: f64) -> Self;
    /// The same number in double precision.
    fn to_f64(self) -> f64;
    /// Absolute value.
    fn abs(self) -> Self;
    /// The smaller of two numbers that are not NaN.
    fn lesser(self, other: Self) -> Self;
    /// The larger of two numbers; the other one where this is NaN.
    fn greater(self, other: Self) -> Self;
    /// Neither infinite nor NaN.
    fn is_finite(self) -> bool;
    /// Neither zero, subnormal, infinite nor NaN.
    fn is_normal(self) -> bool;
    /// A total order, the usual one for numbers that are not NaN.
    fn total_cmp(&self, other: &Self) -> std::cmp::Ordering;
    /// One bit per place, set where the value is at most its limit, the first place the
    /// lowest bit: in vector instructions, which the compiler does not find by itself.
    ///
    /// # Safety
    /// The processor has AVX2.
    #[cfg(target_arch = "x86_64")]
    #[doc(hidden)]
    unsafe fn at_most_avx2(values: &[Self; SHORTER], limits: &[Self; SHORTER]) -> u16;
    /// One bit per place, as [`Self::at_most_avx2`].
    ///
    /// # Safety
    /// The processor has AVX-512 F.
    #[cfg(target_arch = "x86_64")]
    #[doc(hidden)]
    unsafe fn at_most_avx512(values: &[Self; LONGEST], limits: &[Self; LONGEST]) -> u16;
}

macro_rules! scalar {
    ($kind:ident, $name:literal, avx2($per:literal, $load:ident, $compare:ident, $mask:ident), avx512($per512:literal, $load512:ident, $compare512:ident)) => {
        impl Scalar for $kind {
            const INFINITY: Self = $kind::INFINITY;
            const NAN: Self = $kind::NAN;
            const EPSILON: f64 = $kind::EPSILON as f64;
            const NAME: &'static str = $name;

            #[inline(always)]
            fn from_f64(value: f64) -> Self {
                value as $kind
            }
            #[inline(always)]
            fn to_f64(self) -> f64 {
                f64::from(self)
            }
            #[inline(always)]
            fn abs(self) -> Self {
                self.abs()
            }
            #[inline(always)]
            fn lesser(self, other: Self) -> Self {
                if self < other { self } else { other }
            }
            #[inline(always)]
            fn greater(self, other: Self) -> Self {
                if self > other { self } else { other }
            }
            #[inline(always)]
            fn is_finite(self) -> bool {
                self.is_finite()
            }
            #[inline(always)]
            fn is_normal(self) -> bool {
                self.is_normal()
            }
            #[inline(always)]
            fn total_cmp(&self, other: &Self) -> std::cmp::Ordering {
                self.total_cmp(other)
            }
            #[cfg(target_arch = "x86_64")]
            #[inline(always)]
            unsafe fn at_most_avx2(values: &[Self; SHORTER], limits: &[Self; SHORTER]) -> u16 {
                use std::arch::x86_64::{_CMP_LE_OQ, $compare, $load, $mask};
                let (values, limits) = (values.as_chunks::<$per>(), limits.as_chunks::<$per>());
                let chunks = values.0.iter().zip(limits.0).rev();
                chunks.fold(0, |bits: u32, (values, limits)| {
                    // SAFETY: promised by the caller, and the loads read the chunks.
                    let near = unsafe {
                        let (values, limits) = ($load(values.as_ptr()), $load(limits.as_ptr()));
                        $mask($compare::<_CMP_LE_OQ>(values, limits))
                    };
                    bits << $per | near as u32
                }) as u16
            }
            #[cfg(target_arch = "x86_64")]
            #[inline(always)]
            unsafe fn at_most_avx512(values: &[Self; LONGEST], limits: &[Self; LONGEST]) -> u16 {
                use std::arch::x86_64::{_CMP_LE_OQ, $compare512, $load512};
                let (values, limits) =
                    (values.as_chunks::<$per512>(), limits.as_chunks::<$per512>());
                let chunks = values.0.iter().zip(limits.0).rev();
                chunks.fold(0, |bits: u32, (values, limits)| {
                    // SAFETY: promised by the caller, and the loads read the chunks.
                    let near = unsafe {
                        let (values, limits) =
                            ($load512(values.as_ptr()), $load512(limits.as_ptr()));
                        $compare512::<_CMP_LE_OQ>(values, limits)
                    };
                    bits << $per512 | u32::from(near)
                }) as u16
            }
        }
    };
}

scalar!(
    f32,
    "float32",
    avx2(8, _mm256_loadu_ps, _mm256_cmp_ps, _mm256_movemask_ps),
    avx512(16, _mm512_loadu_ps, _mm512_cmp_ps_mask)
);
scalar!(
    f64,
    "float64",
    avx2(4, _mm256_loadu_pd, _mm256_cmp_pd, _mm256_movemask_pd),
    avx512(8, _mm512_loadu_pd, _mm512_cmp_pd_mask)
);
