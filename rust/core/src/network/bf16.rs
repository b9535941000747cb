//! Products of numbers rounded to bf16, summed in float32.
//!
//! The product of two bf16 numbers is exact in float32, so that a processor without instructions for
//! them gets the same from those of float32, but for the order of the sums, and for numbers below
//! 2^-126, which the instructions take for 0.

use super::buffer::Buffer;
use super::matrix::{self, End, Matrix, Start};
use super::rows::vectorized;

/// `x`, rounded to the nearest bf16 number, ties to even; NaN stays.
#[inline(always)]
fn rounded(x: f32) -> f32 {
    let bits = x.to_bits();
    let nearest = bits.wrapping_add(0x7fff + (bits >> 16 & 1));
    let quiet = bits | 0x40_0000;
    f32::from_bits(if x.is_nan() { quiet } else { nearest } & 0xffff_0000)
}

vectorized! {
    /// All of `numbers`, rounded to bf16.
    fn round(numbers: &mut [f32]) {
        for x in numbers {
            *x = rounded(*x);
        }
    }

    /// `numbers`, rounded to bf16.
    fn pack(numbers: &[f32], out: &mut [u16]) {
        for (o, &x) in out.iter_mut().zip(numbers) {
            *o = (rounded(x).to_bits() >> 16) as u16;
        }
    }

    /// What [`pack`] has packed.
    fn unpack(packed: &[u16], out: &mut [f32]) {
        for (o, &x) in out.iter_mut().zip(packed) {
            *o = f32::from_bits(u32::from(x) << 16);
        }
    }
}

/// The right factor of a product.
#[derive(Clone, Copy)]
pub(super) enum Right<'a> {
    /// Numbers to be rounded.
    Fresh(Matrix<'a>),
    /// Numbers that are rounded.
    Rounded(Matrix<'a>),
    /// Whole tiles of a weight.
    #[cfg(target_arch = "x86_64")]
    Tiles(super::amx::Part<'a>),
}

/// [`matrix::product`] of `a`, rounded to bf16, and `b`.
pub(super) fn product(
    out: &mut [f32],
    stride: usize,
    start: Start<'_>,
    a: Matrix<'_>,
    b: Right<'_>,
    end: End<'_>,
) {
    #[cfg(target_arch = "x86_64")]
    if super::amx::available() {
        return super::amx::product(out, stride, start, a, b, end);
    }
    let copy = |of: Matrix<'_>| {
        let mut copy = Buffer::copy(of.numbers());
        round(&mut copy);
        copy
    };
    let left = copy(a);
    let a = a.with(&left);
    match b {
        Right::Rounded(b) => matrix::product(out, stride, start, a, b, end),
        Right::Fresh(b) => {
            let right = copy(b);
            matrix::product(out, stride, start, a, b.with(&right), end);
        }
        #[cfg(target_arch = "x86_64")]
        Right::Tiles(_) => unreachable!("made only where there are instructions for them"),
    }
}
