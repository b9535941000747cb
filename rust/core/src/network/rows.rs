//! Elementwise work on blocks of rows, compiled for the widest vectors of the processor at hand.

use super::vector::Vector;

/// Compiles each function for several kinds of processor and calls the best there is. In its body,
/// `Lanes` are the [`super::vector::Vector`] of that kind.
macro_rules! vectorized {
    ($($(#[$doc:meta])* fn $name:ident($($argument:ident: $kind:ty),* $(,)?) $body:block)*) => {$(
        $(#[$doc])*
        pub(super) fn $name($($argument: $kind),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
                fn v4($($argument: $kind),*) {
                    #[allow(dead_code, reason = "not every body names it")]
                    type Lanes = std::arch::x86_64::__m512;
                    $body
                }
                #[target_feature(enable = "avx2,fma")]
                fn v3($($argument: $kind),*) {
                    #[allow(dead_code, reason = "not every body names it")]
                    type Lanes = std::arch::x86_64::__m256;
                    $body
                }
                match $crate::network::rows::processor() {
                    // SAFETY: the processor has them.
                    $crate::network::rows::Processor::V4 => return unsafe { v4($($argument),*) },
                    // SAFETY: the processor has them.
                    $crate::network::rows::Processor::V3 => return unsafe { v3($($argument),*) },
                    $crate::network::rows::Processor::Plain => {}
                }
            }
            #[allow(dead_code, reason = "not every body names it")]
            type Lanes = [f32; 4];
            $body
        }
    )*};
}
pub(super) use vectorized;

/// What a processor has, the least first: nothing that needs asking, AVX2 with FMA, AVX-512.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Processor {
    Plain,
    V3,
    V4,
}

#[cfg(test)]
thread_local! {
    /// The most that this thread uses of its processor.
    pub(super) static MOST: std::cell::Cell<Processor> = const { std::cell::Cell::new(Processor::V4) };
}

/// The processor at hand.
#[cfg(target_arch = "x86_64")]
pub(super) fn processor() -> Processor {
    let v3 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
    let v4 = v3
        && is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512vl")
        && is_x86_feature_detected!("avx512bw")
        && is_x86_feature_detected!("avx512dq");
    let most = if v4 {
        Processor::V4
    } else if v3 {
        Processor::V3
    } else {
        Processor::Plain
    };
    #[cfg(test)]
    return most.min(MOST.get());
    #[cfg(not(test))]
    most
}

/// What is added to the variance under a LayerNorm's root, torch's default.
const EPSILON: f32 = 1e-5;

/// The sum of the numbers of `a`, or of their products with those of `b`, as many.
///
/// # Safety
/// The processor has such vectors.
#[inline(always)]
unsafe fn sum<V: Vector>(a: &[f32], b: Option<&[f32]>) -> f32 {
    const WIDEST: usize = 16;
    assert!(V::LANES <= WIDEST && b.is_none_or(|b| a.len() == b.len()));
    let pairs = a.len() - a.len() % (2 * V::LANES);
    let whole = a.len() - a.len() % V::LANES;
    // SAFETY: `whole` numbers lie in both slices, and in a padded one as many as a vector has.
    unsafe {
        let add = |sum: V, first: usize| {
            let factor = b.map_or(V::all(1.0), |b| V::load(b.as_ptr().add(first)));
            sum.add_product(V::load(a.as_ptr().add(first)), factor)
        };
        // Two sums, since an addition waits for the one before it.
        let (mut even, mut odd) = (V::all(0.0), V::all(0.0));
        for first in (0..pairs).step_by(2 * V::LANES) {
            even = add(even, first);
            odd = add(odd, first + V::LANES);
        }
        if pairs < whole {
            even = add(even, pairs);
        }
        if whole < a.len() {
            let padded = |of: &[f32]| {
                let mut padded = [0.0; WIDEST];
                padded[..of.len() - whole].copy_from_slice(&of[whole..]);
                V::load(padded.as_ptr())
            };
            odd = odd.add_product(padded(a), b.map_or(V::all(1.0), padded));
        }
        even.add_product(odd, V::all(1.0)).sum()
    }
}

vectorized! {
    /// `out += values`
    fn add(out: &mut [f32], values: &[f32]) {
        for (o, &v) in out.iter_mut().zip(values) {
            *o += v;
        }
    }

    /// `out += ` the sum of all `rows`, each as long as `out`.
    fn add_sum(out: &mut [f32], rows: &[f32]) {
        for row in rows.chunks_exact(out.len()) {
            for (o, &v) in out.iter_mut().zip(row) {
                *o += v;
            }
        }
    }

    /// `out -= values`
    fn subtract(out: &mut [f32], values: &[f32]) {
        for (o, &v) in out.iter_mut().zip(values) {
            *o -= v;
        }
    }

    /// Each edge's row becomes `start`, the first half of its receiver's row of `ends` and the
    /// second half of its sender's together.
    fn gather_ends(
        out: &mut [f32],
        start: &[f32],
        ends: &[f32],
        receivers: &[i64],
        senders: &[i64],
    ) {
        let width = start.len();
        let nodes = receivers.iter().zip(senders);
        for (row, (&receiver, &sender)) in out.chunks_exact_mut(width).zip(nodes) {
            let receiver = &ends[2 * width * receiver as usize..][..width];
            let sender = &ends[2 * width * sender as usize + width..][..width];
            for (((x, &b), &r), &s) in row.iter_mut().zip(start).zip(receiver).zip(sender) {
                *x = b + r + s;
            }
        }
    }

    /// Adds each edge's row of `values` to its receiver's row of `out`, which starts with the row
    /// of node `first`.
    fn add_at(out: &mut [f32], width: usize, values: &[f32], receivers: &[i64], first: usize) {
        for (row, &receiver) in values.chunks_exact(width).zip(receivers) {
            let out = &mut out[width * (receiver as usize - first)..][..width];
            for (o, &v) in out.iter_mut().zip(row) {
                *o += v;
            }
        }
    }

    /// Adds to each edge's row of `out` its receiver's row of `values`.
    fn add_from(out: &mut [f32], width: usize, values: &[f32], receivers: &[i64]) {
        for (row, &receiver) in out.chunks_exact_mut(width).zip(receivers) {
            let values = &values[width * receiver as usize..][..width];
            for (o, &v) in row.iter_mut().zip(values) {
                *o += v;
            }
        }
    }

    /// Adds to row i of `out` the rows `list[offsets[i]..offsets[i + 1]]` of `values`.
    fn add_listed(out: &mut [f32], width: usize, values: &[f32], list: &[i64], offsets: &[i64]) {
        for (i, out) in out.chunks_exact_mut(width).enumerate() {
            for &row in &list[offsets[i] as usize..offsets[i + 1] as usize] {
                let values = &values[width * row as usize..][..width];
                for (o, &v) in out.iter_mut().zip(values) {
                    *o += v;
                }
            }
        }
    }

    /// Takes the mean of each row of `width` off and divides by its standard deviation, whose
    /// inverse is kept.
    fn normalize(rows: &mut [f32], width: usize, inverse_std: &mut [f32]) {
        for (row, inverse) in rows.chunks_exact_mut(width).zip(inverse_std) {
            // SAFETY: `Lanes` are of the processor at hand.
            let mean = unsafe { sum::<Lanes>(row, None) } / width as f32;
            for x in &mut *row {
                *x -= mean;
            }
            // SAFETY: as above.
            let variance = unsafe { sum::<Lanes>(row, Some(row)) } / width as f32;
            *inverse = 1.0 / (variance + EPSILON).sqrt();
            for x in row {
                *x *= *inverse;
            }
        }
    }

    /// `out = scale * normalized + shift` of each row.
    fn rescale(out: &mut [f32], normalized: &[f32], scale: &[f32], shift: &[f32]) {
        let width = scale.len();
        for (out, row) in out.chunks_exact_mut(width).zip(normalized.chunks_exact(width)) {
            for (((o, &x), &a), &b) in out.iter_mut().zip(row).zip(scale).zip(shift) {
                *o = a * x + b;
            }
        }
    }

    /// From the gradient of [`rescale`]d rows to that of the rows before [`normalize`], in place;
    /// adds those of scale and shift to `to_scale` and `to_shift`.
    fn normalize_backward(
        gradient: &mut [f32],
        normalized: &[f32],
        inverse_std: &[f32],
        scale: &[f32],
        to_scale: &mut [f32],
        to_shift: &mut [f32],
    ) {
        let width = scale.len();
        let (to_scale, to_shift) = (&mut to_scale[..width], &mut to_shift[..width]);
        let rows = gradient.chunks_exact_mut(width).zip(normalized.chunks_exact(width));
        for ((gradient, row), &inverse) in rows.zip(inverse_std) {
            for (i, (g, &x)) in gradient.iter_mut().zip(row).enumerate() {
                to_scale[i] += *g * x;
                to_shift[i] += *g;
                *g *= scale[i];
            }
            // SAFETY: `Lanes` are of the processor at hand.
            let mean = unsafe { sum::<Lanes>(gradient, None) } / width as f32;
            // SAFETY: as above.
            let along = unsafe { sum::<Lanes>(gradient, Some(row)) } / width as f32;
            for (g, &x) in gradient.iter_mut().zip(row) {
                *g = inverse * (*g - mean - x * along);
            }
        }
    }
}
