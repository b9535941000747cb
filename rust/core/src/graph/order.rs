//! Puts the senders of one receiver in ascending order.

use std::mem::MaybeUninit;

/// Longest row that is sorted in vector instructions.
pub(super) const SHORT: usize = 64;

/// Stands for no sender: larger than any.
pub(super) const NONE: i32 = i32::MAX;

/// Writes `row` in ascending order to `out`, without `dropped`.
#[cold]
pub(super) fn write_sorted_long(row: &[i32], dropped: i32, out: &mut [MaybeUninit<i64>]) {
    let mut row = row.to_vec();
    row.sort_unstable();
    let kept = row.iter().filter(|&&sender| sender != dropped);
    for (slot, &sender) in out.iter_mut().zip(kept) {
        slot.write(i64::from(sender));
    }
}

/// [`Lanes::write_sorted`](super::lanes::Lanes::write_sorted) where each sender's place is the number
/// of smaller ones, which `ranks` tells for each of its first argument among its second. That is
/// quadratic, but several comparisons go to an instruction, and no branch depends on their outcome.
///
/// # Safety
/// The senders are distinct, `dropped` is one of them or [`NONE`], `row` goes on for a block behind
/// them, and in `out` there is room for whole blocks of them.
#[inline(always)]
pub(super) unsafe fn write_ranked<const BLOCK: usize>(
    row: &[i32],
    n: usize,
    dropped: i32,
    out: *mut i64,
    ranks: impl Fn(&[i32; BLOCK], &[i32]) -> [i32; BLOCK],
) {
    let kept = n - usize::from(dropped != NONE);
    for start in (0..n).step_by(BLOCK) {
        let keys = row[start..].first_chunk().expect("room");
        let ranks = ranks(keys, &row[..n]);
        for l in 0..BLOCK {
            let place = if start + l < n && keys[l] != dropped {
                ranks[l] as usize - usize::from(keys[l] > dropped)
            } else {
                kept
            };
            debug_assert!(place <= kept);
            // SAFETY: of distinct senders fewer than n are smaller, and a dropped one goes behind
            // the others, where there is room.
            unsafe { out.add(place).write(i64::from(keys[l])) };
        }
    }
}
