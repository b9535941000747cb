//! Puts the senders of one receiver in ascending order.

use std::mem::MaybeUninit;

use super::lanes::{BLOCK, Lanes};

/// Longest row that is sorted by ranks.
const RANKED: usize = 64;

/// Stands for no sender: larger than any.
pub(super) const NONE: i32 = i32::MAX;

/// Writes the first `n` of `row`, which are distinct, in ascending order to the front of
/// `out`, without `dropped`, which is one of them or [`NONE`]. `row` goes on for a block
/// behind its contents, and in `out` one place behind them may be overwritten.
///
/// In a short row each sender's place is the number of smaller ones. That is quadratic,
/// but several comparisons go to an instruction, and no branch depends on their outcome.
///
/// # Safety
/// The senders are distinct, and `dropped` is one of them or [`NONE`].
#[inline(always)]
pub(super) unsafe fn write_sorted<L: Lanes>(
    lanes: L,
    row: &[i32],
    n: usize,
    dropped: i32,
    out: &mut [MaybeUninit<i64>],
) {
    let kept = n - usize::from(dropped != NONE);
    if n > RANKED || out.len() <= kept {
        return write_sorted_long(&row[..n], dropped, out);
    }
    for start in (0..n).step_by(BLOCK) {
        let keys = row[start..].first_chunk().expect("room");
        let places = lanes.places(keys, n - start, &row[..n], dropped, kept as i32);
        for (&key, &place) in keys.iter().zip(&places) {
            debug_assert!((0..=kept).contains(&(place as usize)));
            // SAFETY: of distinct senders at most `kept` are smaller, and there are more places.
            unsafe { out.get_unchecked_mut(place as usize) }.write(i64::from(key));
        }
    }
}

#[cold]
fn write_sorted_long(row: &[i32], dropped: i32, out: &mut [MaybeUninit<i64>]) {
    let mut row = row.to_vec();
    row.sort_unstable();
    let kept = row.iter().filter(|&&sender| sender != dropped);
    for (slot, &sender) in out.iter_mut().zip(kept) {
        slot.write(i64::from(sender));
    }
}
