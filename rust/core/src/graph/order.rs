//! Puts the senders of one receiver in ascending order.

use std::mem::MaybeUninit;

/// Longest row that is sorted by ranks.
const RANKED: usize = 64;

/// Senders that are ranked together.
const KEYS: usize = 8;

/// Writes the first `n` of `row`, which are distinct, in ascending order to the front of
/// `out`, without `dropped` if that is among them. One place behind them may be
/// overwritten, and `row` has room for [`KEYS`] more behind its contents.
///
/// In a short row each sender's place is the number of smaller ones. That is quadratic,
/// but several comparisons go to an instruction, and no branch depends on their outcome
/// or, but for whole blocks, on `n`.
#[inline(always)]
pub(super) fn write_sorted(row: &[i32], n: usize, dropped: i32, out: &mut [MaybeUninit<i64>]) {
    if n > RANKED {
        return write_sorted_long(&row[..n], dropped, out);
    }
    // Whatever is not to be written comes last.
    let mut keys = [i32::MAX; RANKED];
    for start in (0..n).step_by(KEYS) {
        let found: &[i32; KEYS] = row[start..].first_chunk().expect("room");
        for l in 0..KEYS {
            let absent = (l as i32 >= (n - start) as i32) | (found[l] == dropped);
            keys[start + l] = if absent { i32::MAX } else { found[l] };
        }
    }
    for start in (0..n).step_by(KEYS) {
        let block: &[i32; KEYS] = keys[start..].first_chunk().expect("room");
        let mut places = [0; KEYS];
        for &other in &keys[..n] {
            for l in 0..KEYS {
                places[l] += i32::from(block[l] > other);
            }
        }
        for l in 0..KEYS {
            if let Some(slot) = out.get_mut(places[l] as usize) {
                slot.write(i64::from(block[l]));
            }
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
