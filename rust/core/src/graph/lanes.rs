//! Operations on blocks of numbers, in AVX-512 or AVX2 instructions where the processor at
//! hand has them, since the compiler does not find these by itself and must not rely on them.
//! A block is as long as their vectors.

use super::order::write_ranked;
use super::scalar::Scalar;

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "x86_64")]
mod bitonic;

/// Numbers to the longest block.
pub(super) const LONGEST: usize = 16;

/// The instructions that [`Work`] may use, on blocks of `BLOCK` numbers.
pub(super) trait Lanes<const BLOCK: usize>: Copy {
    /// One bit per place, set where the value is at most its limit; the first place is the
    /// lowest bit.
    fn at_most<T: Scalar>(self, values: &[T; BLOCK], limits: &[T; BLOCK]) -> u16;

    /// Writes those of `values` whose bit in `chosen` is set to `end`, in order, and
    /// returns how many. What is written behind them does not count.
    ///
    /// # Safety
    /// There is room for a block at `end`.
    unsafe fn append(self, chosen: u16, values: &[i32; BLOCK], end: *mut [i32; BLOCK]) -> usize;

    /// Writes the first `n` of `row` in ascending order to `out`, without `dropped`. What is
    /// written behind them does not count.
    ///
    /// # Safety
    /// They are distinct, smaller than [`NONE`](super::order::NONE) and at most
    /// [`SHORT`](super::order::SHORT); `dropped` is one of them or `NONE`; `row` goes on for a block
    /// behind them, and `out` has room for whole blocks of them, of the longest, and for one at least.
    unsafe fn write_sorted(self, row: &[i32], n: usize, dropped: i32, out: *mut i64);

    /// Tells that what lies at `place` will be read soon.
    fn prefetch<T>(self, place: *const T);
}

/// Something to be compiled for each kind of [`Lanes`]; everything in its loops must be
/// inlined.
pub(super) trait Work {
    type Output;
    fn run<const BLOCK: usize, L: Lanes<BLOCK>>(self, lanes: L) -> Self::Output;
}

/// What a processor may have, from the least on.
#[cfg(any(test, target_arch = "x86_64"))]
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub(super) enum Kind {
    Portable,
    Avx2,
    Avx512,
}

#[cfg(test)]
thread_local! {
    /// What this thread does without, although its processor may have it: all beyond this.
    pub(super) static MOST: std::cell::Cell<Kind> = const { std::cell::Cell::new(Kind::Avx512) };
}

/// The best that this processor has.
#[cfg(any(test, target_arch = "x86_64"))]
fn kind() -> Kind {
    #[cfg(target_arch = "x86_64")]
    let has = if is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512vl")
        && is_x86_feature_detected!("avx512dq")
        && is_x86_feature_detected!("bmi2")
        && is_x86_feature_detected!("popcnt")
    {
        Kind::Avx512
    } else if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("popcnt") {
        Kind::Avx2
    } else {
        Kind::Portable
    };
    #[cfg(not(target_arch = "x86_64"))]
    let has = Kind::Portable;
    #[cfg(test)]
    let has = has.min(MOST.get());
    has
}

/// Does `work` with the best instructions that this processor has.
pub(super) fn widest<W: Work>(work: W) -> W::Output {
    #[cfg(target_arch = "x86_64")]
    match kind() {
        // SAFETY: the processor has them.
        Kind::Avx512 => return unsafe { avx512::run(work) },
        // SAFETY: as above.
        Kind::Avx2 => return unsafe { avx2::run(work) },
        Kind::Portable => {}
    }
    work.run(Portable)
}

/// Numbers to a block where vectors are not longer.
pub(super) const SHORTER: usize = 8;

/// For each byte, the places of its ones from the lowest, and how many there are.
static ONES: [([u8; SHORTER], u8); 256] = {
    let mut table = [([0; SHORTER], 0); 256];
    let mut byte = 0;
    while byte < 256 {
        let mut place = 0;
        while place < SHORTER {
            if byte >> place & 1 == 1 {
                let (places, count) = &mut table[byte];
                places[*count as usize] = place as u8;
                *count += 1;
            }
            place += 1;
        }
        byte += 1;
    }
    table
};

/// What every processor has.
#[derive(Clone, Copy)]
struct Portable;

impl Lanes<SHORTER> for Portable {
    #[inline(always)]
    fn at_most<T: Scalar>(self, values: &[T; SHORTER], limits: &[T; SHORTER]) -> u16 {
        (0..SHORTER).fold(0, |bits, l| bits | u16::from(values[l] <= limits[l]) << l)
    }

    /// As many are written as there often are, then the others if there are more.
    #[inline(always)]
    unsafe fn append(
        self,
        chosen: u16,
        values: &[i32; SHORTER],
        end: *mut [i32; SHORTER],
    ) -> usize {
        const OFTEN: usize = SHORTER / 2;
        let (places, count) = &ONES[usize::from(chosen as u8)];
        let count = usize::from(*count);
        // SAFETY: promised by the caller.
        let end = unsafe { &mut *end };
        // SAFETY: the table's places lie inside a block.
        let at = |l: usize| unsafe { *values.get_unchecked(usize::from(places[l])) };
        for l in 0..OFTEN {
            end[l] = at(l);
        }
        if count > OFTEN {
            for l in OFTEN..SHORTER {
                end[l] = at(l);
            }
        }
        count
    }

    #[inline(always)]
    unsafe fn write_sorted(self, row: &[i32], n: usize, dropped: i32, out: *mut i64) {
        // SAFETY: promised by the caller.
        unsafe {
            write_ranked::<SHORTER>(row, n, dropped, out, |keys, row| {
                keys.map(|key| row.iter().map(|&other| i32::from(key > other)).sum())
            });
        }
    }

    #[inline(always)]
    fn prefetch<T>(self, _: *const T) {}
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::graph::order::{NONE, SHORT};

    const VALUES: [i32; LONGEST] = [7, -3, 12, 0, 5, 1, 90, -70, 8, -30, 13, 20, 50, 11, 91, -7];

    /// Whether everything comes out right: chosen values, comparisons, and sorted rows.
    struct Everything;

    impl Work for Everything {
        type Output = ();

        fn run<const BLOCK: usize, L: Lanes<BLOCK>>(self, lanes: L) {
            let values = VALUES.first_chunk::<BLOCK>().expect("a block");
            for chosen in 0..=(u32::MAX >> (32 - BLOCK)) as u16 {
                let mut end = [-1; BLOCK];
                // SAFETY: `end` is a block.
                let n = unsafe { lanes.append(chosen, values, &mut end) };
                let places = (0..BLOCK).filter(|place| chosen >> place & 1 == 1);
                let expected: Vec<i32> = places.map(|place| values[place]).collect();
                assert_eq!(end[..n], expected, "{chosen:b}");
            }
            let mut numbers = values.map(f64::from);
            numbers[1] = f64::NAN;
            numbers[3] = f64::INFINITY;
            let limits = [8.0; BLOCK];
            let near = (0..BLOCK)
                .map(|l| u16::from(numbers[l] <= limits[l]) << l)
                .sum();
            assert_eq!(lanes.at_most(&numbers, &limits), near);
            let single = |numbers: [f64; BLOCK]| numbers.map(|x| x as f32);
            assert_eq!(lanes.at_most(&single(numbers), &single(limits)), near);
            for n in 1..=SHORT {
                let row: Vec<i32> = (0..(n + LONGEST) as i32).map(|i| 37 * i % 101).collect();
                for dropped in [NONE, row[n / 2]] {
                    let mut out = vec![0; n.next_multiple_of(LONGEST)];
                    // SAFETY: the numbers are distinct, the row goes on, and there is room.
                    unsafe { lanes.write_sorted(&row, n, dropped, out.as_mut_ptr()) };
                    let mut expected = row[..n].to_vec();
                    expected.retain(|&number| number != dropped);
                    expected.sort_unstable();
                    assert!(
                        out.iter().zip(&expected).all(|(&a, &b)| a == i64::from(b)),
                        "{n}"
                    );
                }
            }
        }
    }

    #[test]
    fn all_kinds_do_what_they_say() {
        for kind in [Kind::Portable, Kind::Avx2, Kind::Avx512] {
            MOST.set(kind);
            widest(Everything);
        }
    }
}
