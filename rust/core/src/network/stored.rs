//! Numbers that lie in memory in float32 or, packed, in bf16 and half of it.

use std::ops::Range;

use super::bf16::{pack, unpack};
use super::buffer::Buffer;

#[derive(Default)]
pub(super) struct Stored {
    memory: Buffer,
    packed: bool,
    length: usize,
}

impl Stored {
    /// `length` numbers of any value.
    pub fn any(length: usize, packed: bool) -> Self {
        Self {
            memory: Buffer::any(if packed { length.div_ceil(2) } else { length }),
            packed,
            length,
        }
    }

    /// Whether they are so many, and lie so.
    pub fn are(&self, length: usize, packed: bool) -> bool {
        (self.length, self.packed) == (length, packed)
    }

    /// All of them.
    pub fn all(&mut self) -> StoredMut<'_> {
        if self.packed {
            StoredMut::Packed(self.memory.packed(self.length), Buffer::default())
        } else {
            StoredMut::Numbers(&mut self.memory)
        }
    }

    /// The memory of numbers that are not packed.
    pub fn into_whole(self) -> Buffer {
        assert!(!self.packed);
        self.memory
    }
}

/// Some numbers that are stored, or that are not: what comes to be worked on, block after block, is
/// soon overwritten by the next. Where they don't lie in float32, with room for a block.
pub(super) enum StoredMut<'s> {
    Numbers(&'s mut [f32]),
    Packed(&'s mut [u16], Buffer),
    Passing(usize, Buffer),
}

impl<'s> StoredMut<'s> {
    /// So many that are not stored.
    pub fn passing(length: usize) -> Self {
        Self::Passing(length, Buffer::default())
    }

    /// Cut into parts of `lengths` of their `rows` rows.
    pub fn parts(self, lengths: &[usize], rows: usize) -> Vec<Self> {
        match self {
            Self::Numbers(numbers) => (split(numbers, lengths, rows).into_iter())
                .map(Self::Numbers)
                .collect(),
            Self::Packed(packed, _) => (split(packed, lengths, rows).into_iter())
                .map(|part| Self::Packed(part, Buffer::default()))
                .collect(),
            Self::Passing(length, _) => {
                let width = length.checked_div(rows).unwrap_or(0);
                (lengths.iter())
                    .map(|length| Self::passing(length * width))
                    .collect()
            }
        }
    }

    pub fn len(&self) -> usize {
        match self {
            Self::Numbers(numbers) => numbers.len(),
            Self::Packed(packed, _) => packed.len(),
            Self::Passing(length, _) => *length,
        }
    }

    /// Some of them, to be worked on.
    pub fn block(&mut self, range: Range<usize>) -> Held<'_> {
        fn some(room: &mut Buffer, count: usize) -> &mut [f32] {
            if room.len() < count {
                *room = Buffer::any(count);
            }
            &mut room[..count]
        }
        let (numbers, packed) = match self {
            Self::Numbers(numbers) => (&mut numbers[range], None),
            Self::Packed(packed, room) => (some(room, range.len()), Some(&mut packed[range])),
            Self::Passing(_, room) => (some(room, range.len()), None),
        };
        Held { numbers, packed }
    }

    /// The rows `first` to `first + count` of `rows`, to be worked on.
    pub fn rows(&mut self, first: usize, count: usize, rows: usize) -> Held<'_> {
        let width = self.len().checked_div(rows).unwrap_or(0);
        self.block(first * width..(first + count) * width)
    }
}

/// Numbers to work on, of any value where they are stored elsewhere.
pub(super) struct Held<'h> {
    pub numbers: &'h mut [f32],
    packed: Option<&'h mut [u16]>,
}

impl Held<'_> {
    /// Gives them the values that are stored.
    pub fn take(&mut self) {
        if let Some(packed) = &self.packed {
            unpack(packed, self.numbers);
        }
    }

    /// Stores their values.
    pub fn put(&mut self) {
        if let Some(packed) = &mut self.packed {
            pack(self.numbers, packed);
        }
    }
}

/// Cuts the data of `rows` rows into parts of `lengths` rows.
pub(super) fn split<'d, T>(
    mut data: &'d mut [T],
    lengths: &[usize],
    rows: usize,
) -> Vec<&'d mut [T]> {
    let width = data.len().checked_div(rows).unwrap_or(0);
    lengths
        .iter()
        .map(|length| data.split_off_mut(..length * width).expect("as many rows"))
        .collect()
}
