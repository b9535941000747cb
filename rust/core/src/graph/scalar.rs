//! The two kinds of coordinates.

use std::ops::{Add, Mul, Sub};

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
    /// The larger of two numbers that are not NaN.
    fn greater(self, other: Self) -> Self;
    /// Neither infinite nor NaN.
    fn is_finite(self) -> bool;
    /// Neither zero, subnormal, infinite nor NaN.
    fn is_normal(self) -> bool;
    /// A total order, the usual one for numbers that are not NaN.
    fn total_cmp(&self, other: &Self) -> std::cmp::Ordering;
}

macro_rules! scalar {
    ($kind:ident, $name:literal) => {
        impl Scalar for $kind {
            const INFINITY: Self = $kind::INFINITY;
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
        }
    };
}

scalar!(f32, "float32");
scalar!(f64, "float64");
