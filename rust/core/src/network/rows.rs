//! Elementwise work on blocks of rows, compiled for the widest vectors of the processor at hand.

/// Compiles each function for several kinds of processor and calls the best there is. A function
/// has one body for all of them, or, as `kinds`, one for each: `v4` with AVX-512, `v3` with AVX2 and FMA, `plain`.
macro_rules! vectorized {
    ($($(#[$doc:meta])* fn $name:ident($($argument:ident: $kind:ty),* $(,)?) $body:block)*) => {
        $(vectorized! {
            $(#[$doc])* kinds $name($($argument: $kind),*)
            [v4 => $body, v3 => $body, plain => $body,]
        })*
    };
    (
        $(#[$doc:meta])*
        kinds $name:ident($($argument:ident: $kind:ty),* $(,)?)
        [v4 => $wide:expr, v3 => $middle:expr, plain => $narrow:expr,]
    ) => {
        $(#[$doc])*
        pub(super) fn $name($($argument: $kind),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
                fn v4($($argument: $kind),*) { $wide }
                #[target_feature(enable = "avx2,fma")]
                fn v3($($argument: $kind),*) { $middle }
                match $crate::network::rows::processor() {
                    // SAFETY: the processor has them.
                    $crate::network::rows::Processor::V4 => return unsafe { v4($($argument),*) },
                    // SAFETY: the processor has them.
                    $crate::network::rows::Processor::V3 => return unsafe { v3($($argument),*) },
                    $crate::network::rows::Processor::Plain => {}
                }
            }
            $narrow
        }
    };
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

/// Sum of `f` of each pair of numbers, in an order that does not hinder vectors.
#[inline(always)]
fn sum(a: &[f32], b: &[f32], f: impl Fn(f32, f32) -> f32) -> f32 {
    const LANES: usize = 16;
    let mut lanes = [0.0f32; LANES];
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    for (a, b) in a.iter().zip(b) {
        for i in 0..LANES {
            lanes[i] += f(a[i], b[i]);
        }
    }
    for i in 0..a_rest.len() {
        lanes[i] += f(a_rest[i], b_rest[i]);
    }
    lanes.iter().sum()
}

vectorized! {
    /// Negative numbers become 0; NaN stays.
    fn relu(rows: &mut [f32]) {
        for x in rows {
            *x = if *x < 0.0 { 0.0 } else { *x };
        }
    }

    /// Where `activation` is not positive, `gradient` becomes 0.
    fn relu_backward(gradient: &mut [f32], activation: &[f32]) {
        for (g, &h) in gradient.iter_mut().zip(activation) {
            *g = if h > 0.0 { *g } else { 0.0 };
        }
    }

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
            let mean = sum(row, row, |x, _| x) / width as f32;
            let variance = sum(row, row, |x, _| (x - mean) * (x - mean)) / width as f32;
            *inverse = 1.0 / (variance + EPSILON).sqrt();
            for x in row {
                *x = (*x - mean) * *inverse;
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
            let mean = sum(gradient, row, |g, _| g) / width as f32;
            let along = sum(gradient, row, |g, x| g * x) / width as f32;
            for (g, &x) in gradient.iter_mut().zip(row) {
                *g = inverse * (*g - mean - x * along);
            }
        }
    }
}
