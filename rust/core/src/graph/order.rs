//! Puts the senders of one receiver in ascending order.

/// Longest row that is sorted by ranks; the buffers handed in have this much room
/// past their contents.
pub(super) const RANKED: usize = 32;

/// Writes the `n` distinct senders at the front of `found` in ascending order to the
/// front of `sorted`, without `dropped` (`-1` to drop none), which counts among the `n`
/// if it is given. Both buffers have room for `n + RANKED`.
#[inline(always)]
pub(super) fn sort_row(found: &mut [i32], n: usize, dropped: i32, sorted: &mut [i32]) {
    match n {
        0..=8 => rank::<8>(found, n, dropped, sorted),
        9..=16 => rank::<16>(found, n, dropped, sorted),
        17..=24 => rank::<24>(found, n, dropped, sorted),
        25..=RANKED => rank::<RANKED>(found, n, dropped, sorted),
        _ => {
            let found = &mut found[..n];
            found.sort_unstable();
            let kept = found.iter().filter(|&&sender| sender != dropped);
            for (slot, &sender) in sorted.iter_mut().zip(kept) {
                *slot = sender;
            }
        }
    }
}

/// Each sender's place is the number of smaller ones. Quadratic, but without a branch
/// that could be mispredicted, and several comparisons to an instruction.
#[inline(always)]
fn rank<const W: usize>(found: &[i32], n: usize, dropped: i32, sorted: &mut [i32]) {
    let found: &[i32; W] = found.first_chunk().expect("room for a block");
    let sorted: &mut [i32; RANKED] = sorted.first_chunk_mut().expect("room for a block");
    // What is dropped or lies past the end comes last, where nothing is counted.
    let keys: [i32; W] = std::array::from_fn(|l| {
        let absent = (l >= n) | (found[l] == dropped);
        if absent { i32::MAX } else { found[l] }
    });
    let mut places = [0_u32; W];
    for other in keys {
        for (place, &key) in places.iter_mut().zip(&keys) {
            *place += u32::from(key > other);
        }
    }
    for (&place, &key) in places.iter().zip(&keys) {
        sorted[place as usize % RANKED] = key;
    }
}
