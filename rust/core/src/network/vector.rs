//! The registers that products and sums work in.

/// Some numbers in one register. Only for processors that have such.
pub(super) trait Vector: Copy {
    const LANES: usize;
    /// How many rows of how many of them, with what a product needs besides, fill the registers.
    const TILE: (usize, usize);
    /// # Safety
    /// The processor has such registers; `LANES` numbers are at `from`.
    unsafe fn load(from: *const f32) -> Self;
    /// # Safety
    /// The processor has such registers; there is room for `LANES` numbers at `to`.
    unsafe fn store(self, to: *mut f32);
    /// # Safety
    /// The processor has such registers.
    unsafe fn all(number: f32) -> Self;
    /// `self + a * b`
    /// # Safety
    /// The processor has such registers.
    unsafe fn add_product(self, a: Self, b: Self) -> Self;
    /// Of all its numbers.
    /// # Safety
    /// The processor has such registers.
    #[inline(always)]
    unsafe fn sum(self) -> f32 {
        const MOST: usize = 16;
        assert!(Self::LANES <= MOST);
        let mut numbers = [0.0; MOST];
        // SAFETY: there is room.
        unsafe { self.store(numbers.as_mut_ptr()) };
        let mut count = Self::LANES;
        while count > 1 {
            count /= 2;
            for i in 0..count {
                numbers[i] += numbers[i + count];
            }
        }
        numbers[0]
    }
    /// 0 for each negative number.
    /// # Safety
    /// The processor has such registers.
    unsafe fn relu(self) -> Self;
    /// 0 for each number but where that of `other` is positive.
    /// # Safety
    /// The processor has such registers.
    unsafe fn where_positive(self, other: Self) -> Self;
}

impl<const N: usize> Vector for [f32; N] {
    const LANES: usize = N;
    const TILE: (usize, usize) = (4, 2);

    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: as promised.
        unsafe { *from.cast() }
    }

    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: as promised.
        unsafe { *to.cast() = self }
    }

    #[inline(always)]
    unsafe fn all(number: f32) -> Self {
        [number; N]
    }

    #[inline(always)]
    unsafe fn add_product(self, a: Self, b: Self) -> Self {
        std::array::from_fn(|i| self[i] + a[i] * b[i])
    }

    #[inline(always)]
    unsafe fn relu(self) -> Self {
        self.map(|x| if x < 0.0 { 0.0 } else { x })
    }

    #[inline(always)]
    unsafe fn where_positive(self, other: Self) -> Self {
        std::array::from_fn(|i| if other[i] > 0.0 { self[i] } else { 0.0 })
    }
}

/// A [`Vector`] by intrinsics.
#[cfg(target_arch = "x86_64")]
macro_rules! vector {
    (
        $kind:ident, $lanes:literal, $tile:expr, $load:ident, $store:ident, $all:ident, $add_product:ident,
        $max:ident, |$self:ident, $positive:ident| $where_positive:expr, $compare:ident
    ) => {
        impl Vector for std::arch::x86_64::$kind {
            const LANES: usize = $lanes;
            const TILE: (usize, usize) = $tile;

            #[inline(always)]
            unsafe fn load(from: *const f32) -> Self {
                // SAFETY: as promised.
                unsafe { std::arch::x86_64::$load(from) }
            }

            #[inline(always)]
            unsafe fn store(self, to: *mut f32) {
                // SAFETY: as promised.
                unsafe { std::arch::x86_64::$store(to, self) }
            }

            #[inline(always)]
            unsafe fn all(number: f32) -> Self {
                // SAFETY: as promised.
                unsafe { std::arch::x86_64::$all(number) }
            }

            #[inline(always)]
            unsafe fn add_product(self, a: Self, b: Self) -> Self {
                // SAFETY: as promised.
                unsafe { std::arch::x86_64::$add_product(a, b, self) }
            }

            #[inline(always)]
            unsafe fn relu(self) -> Self {
                // Of two numbers of which one is NaN, the second is taken.
                // SAFETY: as promised.
                unsafe { std::arch::x86_64::$max(Self::all(0.0), self) }
            }

            #[inline(always)]
            unsafe fn where_positive($self, other: Self) -> Self {
                use std::arch::x86_64::*;
                // SAFETY: as promised.
                unsafe {
                    let $positive = $compare::<_CMP_GT_OQ>(other, Self::all(0.0));
                    $where_positive
                }
            }
        }
    };
}
#[cfg(target_arch = "x86_64")]
vector! {
    __m512, 16, (6, 4), _mm512_loadu_ps, _mm512_storeu_ps, _mm512_set1_ps, _mm512_fmadd_ps, _mm512_max_ps,
    |self, positive| _mm512_maskz_mov_ps(positive, self), _mm512_cmp_ps_mask
}
#[cfg(target_arch = "x86_64")]
vector! {
    __m256, 8, (6, 2), _mm256_loadu_ps, _mm256_storeu_ps, _mm256_set1_ps, _mm256_fmadd_ps, _mm256_max_ps,
    |self, positive| _mm256_and_ps(positive, self), _mm256_cmp_ps
}
