//! Products in bf16 by the tile instructions of processors that have them (AMX).
//!
//! Both factors are packed into tiles of 16 lines of 64 bytes, which the instructions read in pairs
//! of numbers along the inner size: a line of the left factor's is 16 pairs of one row, a line of
//! the right one's a pair of 16 columns.

use std::arch::asm;
use std::arch::x86_64::*;
use std::cell::RefCell;
use std::ops::Range;
use std::sync::atomic::{AtomicU8, Ordering};

use super::bf16::Right;
use super::matrix::{End, Matrix, Start};
use super::rows::{Processor, processor};

/// Rows of the left factor or columns of the right one in a tile.
const SIDE: usize = 16;
/// How far a tile reaches along the inner size.
const DEPTH: usize = 32;
/// Rows of the left factor that are packed at once, and how much of the inner size.
const ROWS: usize = super::BLOCK;
const INNER: usize = 512;

type Line = __m512i;
/// Rows and columns of sums that are made at once: two by two tiles.
type Sums = [[f32; 2 * SIDE]; 2 * SIDE];

/// Strips of [`SIDE`] rows or columns, each of `depth` tiles one after the other.
#[derive(Default)]
pub(super) struct Tiles {
    lines: Vec<Line>,
    depth: usize,
}

/// Some strips of a right factor, and the same part of each.
#[derive(Clone, Copy)]
pub(super) struct Part<'a> {
    tiles: &'a Tiles,
    strip: usize,
    tile: usize,
    rows: usize,
    columns: usize,
}

#[cfg(test)]
thread_local! {
    /// Whether this thread may use tiles where there are some.
    pub(super) static TILES: std::cell::Cell<bool> = const { std::cell::Cell::new(true) };
}

/// Whether the processor has tiles, and vectors for what lies around them, and the system lets this
/// process use them. It is asked for that here, so that nobody asks who needs none.
pub(super) fn available() -> bool {
    const UNKNOWN: u8 = 0;
    const NO: u8 = 1;
    const YES: u8 = 2;
    // No lock, which a process that forked meanwhile would never see opened; twice does no harm.
    static ALLOWED: AtomicU8 = AtomicU8::new(UNKNOWN);
    #[cfg(test)]
    if !TILES.get() {
        return false;
    }
    if processor() < Processor::V4 {
        return false;
    }
    if ALLOWED.load(Ordering::Relaxed) == UNKNOWN {
        let allowed = if exist() && granted() { YES } else { NO };
        ALLOWED.store(allowed, Ordering::Relaxed);
    }
    ALLOWED.load(Ordering::Relaxed) == YES
}

fn exist() -> bool {
    const LEAF: u32 = 7;
    const BF16_AND_TILES: u32 = 1 << 22 | 1 << 24;
    // SAFETY: every processor of 64 bits tells what it has.
    #[allow(unused_unsafe, reason = "safe since Rust 1.94")]
    let (most, has) = unsafe { (__get_cpuid_max(0).0, __cpuid_count(LEAF, 0).edx) };
    is_x86_feature_detected!("avx512bf16") && most >= LEAF && has & BF16_AND_TILES == BF16_AND_TILES
}

#[cfg(target_os = "linux")]
fn granted() -> bool {
    const REQUEST: libc::c_long = 0x1023;
    const TILE_DATA: libc::c_long = 18;
    // SAFETY: grants the process room for tiles, or refuses; touches no memory of its own.
    unsafe { libc::syscall(libc::SYS_arch_prctl, REQUEST, TILE_DATA) == 0 }
}

/// Other systems' way of asking is not known here.
#[cfg(not(target_os = "linux"))]
fn granted() -> bool {
    false
}

impl Tiles {
    /// Of a right factor.
    pub fn of_right(b: Matrix<'_>) -> Self {
        let mut tiles = Self::default();
        // SAFETY: made only where tiles are available, and vectors of that kind with them.
        unsafe { tiles.pack(b.transposed(), false) };
        tiles
    }

    /// Some rows and columns; `None` unless they begin and end with tiles, or where all `inner` rows
    /// end.
    pub fn part(
        &self,
        rows: Range<usize>,
        columns: Range<usize>,
        inner: usize,
    ) -> Option<Part<'_>> {
        assert!(
            rows.end <= inner && columns.end.div_ceil(SIDE) * self.depth * SIDE <= self.lines.len()
        );
        let whole = rows.start.is_multiple_of(DEPTH)
            && (rows.end.is_multiple_of(DEPTH) || rows.end == inner)
            && columns.start.is_multiple_of(SIDE);
        whole.then_some(Part {
            tiles: self,
            strip: columns.start / SIDE,
            tile: rows.start / DEPTH,
            rows: rows.len(),
            columns: columns.len(),
        })
    }

    /// Becomes the tiles of `numbers` `[rows or columns, inner size]`, of a left factor or of a
    /// right one.
    ///
    /// # Safety
    /// The processor has these vectors.
    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    unsafe fn pack(&mut self, numbers: Matrix<'_>, left: bool) {
        let (outer, inner) = numbers.size();
        let (outer_stride, inner_stride) = numbers.strides();
        self.depth = inner.div_ceil(DEPTH);
        self.lines.clear();
        self.lines.reserve(outer.div_ceil(SIDE) * self.depth * SIDE);
        for strip in (0..outer).step_by(SIDE) {
            for tile in (0..inner).step_by(DEPTH) {
                let from = &numbers.numbers()[strip * outer_stride + tile * inner_stride..];
                let (outer, inner) = (SIDE.min(outer - strip), DEPTH.min(inner - tile));
                let along = inner_stride == 1;
                let lines = if along {
                    pairs_along(from, outer_stride, outer, inner)
                } else {
                    assert_eq!(outer_stride, 1);
                    pairs_across(from, inner_stride, inner, outer)
                };
                let lines = if along == left {
                    lines
                } else {
                    transposed(lines)
                };
                self.lines.extend_from_slice(&lines);
            }
        }
    }
}

/// The first `count` numbers of `from`, then zeros.
#[target_feature(enable = "avx512f")]
fn load(from: &[f32], count: usize) -> __m512 {
    let mask = ((1u32 << count.min(SIDE)) - 1) as __mmask16;
    assert!(count.min(SIDE) <= from.len());
    // SAFETY: what the mask lets through is there.
    unsafe { _mm512_maskz_loadu_ps(mask, from.as_ptr()) }
}

/// Line by line, one of `count` rows, `stride` apart, of `inner` numbers.
#[target_feature(enable = "avx512f,avx512bf16")]
fn pairs_along(from: &[f32], stride: usize, count: usize, inner: usize) -> [Line; SIDE] {
    std::array::from_fn(|i| {
        if i >= count {
            return _mm512_setzero_si512();
        }
        let row = &from[i * stride..];
        let low = load(row, inner);
        let high = load(
            row.get(SIDE..).unwrap_or_default(),
            inner.saturating_sub(SIDE),
        );
        bits(_mm512_cvtne2ps_pbh(high, low))
    })
}

/// Line by line, two of `inner` rows, `stride` apart, of `count` numbers: pairs of what lies below
/// each other.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn pairs_across(from: &[f32], stride: usize, inner: usize, count: usize) -> [Line; SIDE] {
    let order: [u16; DEPTH] = std::array::from_fn(|i| (i / 2 + i % 2 * SIDE) as u16);
    // SAFETY: as many bytes, any of which are a vector.
    let order: Line = unsafe { std::mem::transmute(order) };
    std::array::from_fn(|i| {
        let row = |k: usize| {
            if k < inner {
                load(&from[k * stride..], count)
            } else {
                _mm512_setzero_ps()
            }
        };
        let both = _mm512_cvtne2ps_pbh(row(2 * i + 1), row(2 * i));
        _mm512_permutexvar_epi16(order, bits(both))
    })
}

#[target_feature(enable = "avx512f,avx512bf16")]
fn bits(numbers: __m512bh) -> Line {
    // SAFETY: as many bytes, any of which are a vector.
    unsafe { std::mem::transmute(numbers) }
}

/// Pair `j` of line `i` becomes pair `i` of line `j`: halves of the square change places, then
/// halves of these, and so on.
#[target_feature(enable = "avx512f")]
fn transposed(mut lines: [Line; SIDE]) -> [Line; SIDE] {
    for half in [8, 4, 2, 1] {
        let order = |second: usize| -> Line {
            let order: [u32; SIDE] = std::array::from_fn(|j| {
                let from = if j & half == 0 {
                    j + second * half
                } else {
                    j - half + second * half
                };
                (from + if j & half == 0 { 0 } else { SIDE }) as u32
            });
            // SAFETY: as many bytes, any of which are a vector.
            unsafe { std::mem::transmute(order) }
        };
        let (first, second) = (order(0), order(1));
        for i in (0..SIDE).filter(|i| i & half == 0) {
            let (above, below) = (lines[i], lines[i + half]);
            lines[i] = _mm512_permutex2var_epi32(above, first, below);
            lines[i + half] = _mm512_permutex2var_epi32(above, second, below);
        }
    }
    lines
}

/// What a thread packs its factors into.
#[derive(Default)]
struct Packed {
    left: Tiles,
    right: Tiles,
}

thread_local! {
    static PACKED: RefCell<Packed> = RefCell::default();
}

/// [`super::bf16::product`] by tiles, where they are available.
pub(super) fn product(
    out: &mut [f32],
    stride: usize,
    start: Start<'_>,
    a: Matrix<'_>,
    b: Right<'_>,
    end: End<'_>,
) {
    let (rows, inner) = a.size();
    let (inner_of_b, columns) = match b {
        Right::Fresh(b) | Right::Rounded(b) => b.size(),
        Right::Tiles(part) => (part.rows, part.columns),
    };
    assert_eq!(inner, inner_of_b, "inner sizes");
    assert!(available() && inner > 0 && columns <= stride);
    if rows == 0 || columns == 0 {
        return;
    }
    PACKED.with_borrow_mut(|Packed { left, right }| {
        for deep in (0..inner).step_by(INNER) {
            let depth = INNER.min(inner - deep);
            let start = if deep == 0 { start } else { Start::There };
            let end = if deep + depth == inner {
                end
            } else {
                End::Whole
            };
            let part = match b {
                Right::Tiles(part) => Part {
                    tile: part.tile + deep / DEPTH,
                    ..part
                },
                Right::Fresh(b) | Right::Rounded(b) => {
                    // SAFETY: available.
                    unsafe { right.pack(b.rows(deep, depth).transposed(), false) };
                    Part {
                        tiles: right,
                        strip: 0,
                        tile: 0,
                        rows: depth,
                        columns,
                    }
                }
            };
            for first in (0..rows).step_by(ROWS) {
                let count = ROWS.min(rows - first);
                // SAFETY: available.
                unsafe { left.pack(a.rows(first, count).columns(deep, depth), true) };
                let block = Block {
                    out: &mut *out,
                    stride,
                    start,
                    end,
                    first,
                    count,
                };
                // SAFETY: available.
                unsafe { block.fill(left, part) };
            }
        }
    });
}

/// Rows `first..first + count` of a product.
struct Block<'b> {
    out: &'b mut [f32],
    stride: usize,
    start: Start<'b>,
    end: End<'b>,
    first: usize,
    count: usize,
}

impl Block<'_> {
    /// Makes them what they are to be.
    ///
    /// # Safety
    /// Tiles are available.
    #[target_feature(enable = "avx512f")]
    unsafe fn fill(mut self, left: &Tiles, right: Part<'_>) {
        let mut sums: Sums = [[0.0; 2 * SIDE]; 2 * SIDE];
        let strips = |tiles: &Tiles| tiles.lines.len() / (tiles.depth * SIDE);
        let (left_strips, right_strips) = (strips(left), strips(right.tiles));
        // Beyond the last strip it is taken again; nothing looks at those sums.
        let of_left = |strip: usize| strip.min(left_strips - 1) * left.depth;
        let of_right = |strip: usize| {
            (right.strip + strip).min(right_strips - 1) * right.tiles.depth + right.tile
        };
        let pair = |tiles: &Tiles, at: [usize; 2]| {
            at.map(|at| {
                assert!((at + left.depth) * SIDE <= tiles.lines.len());
                tiles.lines[at * SIDE..].as_ptr()
            })
        };
        // SAFETY: tiles are available; as asserted, there are as many in each strip.
        unsafe { configure() };
        for column in (0..right.columns).step_by(2 * SIDE) {
            let strip = column / SIDE;
            let of_b = pair(right.tiles, [of_right(strip), of_right(strip + 1)]);
            for row in (0..self.count).step_by(2 * SIDE) {
                let strip = row / SIDE;
                let of_a = pair(left, [of_left(strip), of_left(strip + 1)]);
                // SAFETY: as above, and configured.
                unsafe { multiply(of_a, of_b, left.depth, &mut sums) };
                self.put(&sums, row, column, right.columns);
            }
        }
        // SAFETY: gives back what was configured.
        unsafe { asm!("tilerelease", options(nomem, nostack, preserves_flags)) };
    }

    /// Puts sums into the rows from `row` and the columns from `column`, of so many.
    #[target_feature(enable = "avx512f")]
    fn put(&mut self, sums: &Sums, row: usize, column: usize, columns: usize) {
        for (i, sums) in sums.iter().enumerate().take(self.count - row) {
            let place = (self.first + row + i) * self.stride;
            let ends = (column..columns).step_by(SIDE);
            for (sums, column) in sums.as_chunks::<SIDE>().0.iter().zip(ends) {
                let count = SIDE.min(columns - column);
                let mask = ((1u32 << count) - 1) as __mmask16;
                let here = place + column;
                let mut sum = load(sums, SIDE);
                match self.start {
                    Start::Zero => {}
                    Start::There => sum = _mm512_add_ps(load(&self.out[here..], count), sum),
                    Start::Row(row) => sum = _mm512_add_ps(load(&row[column..], count), sum),
                }
                match self.end {
                    End::Whole => {}
                    // Of two numbers of which one is NaN, the second is taken.
                    End::Relu => sum = _mm512_max_ps(_mm512_setzero_ps(), sum),
                    End::WherePositive(like) => {
                        let like = load(&like[here..], count);
                        let positive = _mm512_cmp_ps_mask::<_CMP_GT_OQ>(like, _mm512_setzero_ps());
                        sum = _mm512_maskz_mov_ps(positive, sum);
                    }
                }
                let out = &mut self.out[here..here + count];
                // SAFETY: the mask lets through as many as there is room for.
                unsafe { _mm512_mask_storeu_ps(out.as_mut_ptr(), mask, sum) };
            }
        }
    }
}

/// Eight tiles of 16 lines of 64 bytes.
///
/// # Safety
/// Tiles are available.
unsafe fn configure() {
    #[repr(C, align(64))]
    struct Configuration([u8; 64]);
    const CONFIGURATION: Configuration = {
        let mut bytes = [0; 64];
        bytes[0] = 1; // the palette
        let mut tile = 0;
        while tile < 8 {
            bytes[16 + 2 * tile] = 64; // bytes of a line
            bytes[48 + tile] = 16; // lines
            tile += 1;
        }
        Configuration(bytes)
    };
    static HERE: Configuration = CONFIGURATION;
    // SAFETY: the processor has the instruction, and reads what is there.
    unsafe {
        asm!("ldtilecfg [{}]", in(reg) &raw const HERE, options(readonly, nostack, preserves_flags));
    }
}

/// The product of two strips of each factor, of `depth` tiles.
///
/// # Safety
/// Tiles are available and configured; each pointer has as many tiles.
#[inline]
unsafe fn multiply(a: [*const Line; 2], b: [*const Line; 2], depth: usize, sums: &mut Sums) {
    // SAFETY: reads and writes no more than that; what compiled code there is uses no tiles.
    unsafe {
        asm!(
            "tilezero tmm0",
            "tilezero tmm1",
            "tilezero tmm2",
            "tilezero tmm3",
            "2:",
            "tileloadd tmm4, [{above} + {line}*1]",
            "tileloadd tmm6, [{left} + {line}*1]",
            "tileloadd tmm5, [{below} + {line}*1]",
            "tileloadd tmm7, [{right} + {line}*1]",
            "tdpbf16ps tmm0, tmm4, tmm6",
            "tdpbf16ps tmm1, tmm4, tmm7",
            "tdpbf16ps tmm2, tmm5, tmm6",
            "tdpbf16ps tmm3, tmm5, tmm7",
            "add {above}, 1024",
            "add {below}, 1024",
            "add {left}, 1024",
            "add {right}, 1024",
            "dec {depth}",
            "jnz 2b",
            "tilestored [{sums} + {row}*1], tmm0",
            "tilestored [{sums} + {row}*1 + 64], tmm1",
            "add {sums}, 2048",
            "tilestored [{sums} + {row}*1], tmm2",
            "tilestored [{sums} + {row}*1 + 64], tmm3",
            above = inout(reg) a[0] => _,
            below = inout(reg) a[1] => _,
            left = inout(reg) b[0] => _,
            right = inout(reg) b[1] => _,
            depth = inout(reg) depth => _,
            sums = inout(reg) sums.as_mut_ptr() => _,
            line = in(reg) 64usize,
            row = in(reg) 128usize,
            out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
            out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
            options(nostack),
        );
    }
}
