//! Batcher's bitonic network: sorts rows of senders in vectors. Which are compared depends on their
//! places alone, so there is no branch, and each comparison is of whole vectors.

/// Some senders in one register.
///
/// All that is done with them needs a processor that has such registers.
pub(super) trait Keys: Copy {
    const LANES: usize;

    /// The first `n` at `row`; [`NONE`](crate::graph::order::NONE) for what is behind them, and
    /// for `dropped`.
    ///
    /// # Safety
    /// The processor has such registers, and there is one to be read at `row`.
    unsafe fn load(row: *const i32, n: usize, dropped: i32) -> Self;

    /// Writes as many whole halves as `n` begins.
    ///
    /// # Safety
    /// The processor has such registers, and there is room for these at `out`.
    unsafe fn write(self, n: usize, out: *mut i64);

    /// # Safety
    /// The processor has such registers.
    unsafe fn lesser(self, other: Self) -> Self;

    /// # Safety
    /// The processor has such registers.
    unsafe fn greater(self, other: Self) -> Self;

    /// The last one first.
    ///
    /// # Safety
    /// The processor has such registers.
    unsafe fn reversed(self) -> Self;

    /// In ascending order.
    ///
    /// # Safety
    /// The processor has such registers.
    unsafe fn sorted(self) -> Self;

    /// What rises and then falls, or the other way round, in ascending order.
    ///
    /// # Safety
    /// The processor has such registers.
    unsafe fn ascending(self) -> Self;
}

/// [`Lanes::write_sorted`](super::Lanes::write_sorted) of at most `K` vectors. What is absent or
/// dropped comes last.
///
/// # Safety
/// The processor has such vectors, `n` is at most `K` of them and the length of `row`, which goes on
/// for one behind that, and `out` has room for whole vectors of `n` numbers.
#[inline(always)]
pub(super) unsafe fn write_network<V: Keys, const K: usize>(
    row: &[i32],
    n: usize,
    dropped: i32,
    out: *mut i64,
) {
    debug_assert!(n <= K * V::LANES && n <= row.len());
    // SAFETY: promised by the caller.
    unsafe {
        let mut vectors = [V::load(row.as_ptr(), n.min(V::LANES), dropped).sorted(); K];
        for (k, keys) in vectors.iter_mut().enumerate().skip(1) {
            let left = n.saturating_sub(k * V::LANES).min(V::LANES);
            let first = if left == 0 { 0 } else { k * V::LANES };
            *keys = V::load(row.as_ptr().add(first), left, dropped).sorted();
        }
        let mut size = 1;
        while size < K {
            for pair in vectors.chunks_exact_mut(2 * size) {
                merge(pair);
            }
            size *= 2;
        }
        for (k, &keys) in vectors.iter().enumerate() {
            let first = k * V::LANES;
            if first >= n {
                break;
            }
            keys.write(n - first, out.add(first));
        }
    }
}

/// Merges the sorted halves of `vectors`.
///
/// # Safety
/// The processor has such vectors.
#[inline(always)]
unsafe fn merge<V: Keys>(vectors: &mut [V]) {
    let half = vectors.len() / 2;
    // SAFETY: promised by the caller.
    unsafe {
        vectors[half..].reverse();
        for keys in &mut vectors[half..] {
            *keys = keys.reversed();
        }
        let mut stride = half;
        while stride > 0 {
            for run in vectors.chunks_exact_mut(2 * stride) {
                for v in 0..stride {
                    let (one, other) = (run[v], run[v + stride]);
                    run[v] = one.lesser(other);
                    run[v + stride] = one.greater(other);
                }
            }
            stride /= 2;
        }
        for keys in vectors {
            *keys = keys.ascending();
        }
    }
}
