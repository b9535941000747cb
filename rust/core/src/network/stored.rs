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

    pub fn len(&self) -> usize {
        self.length
    }

    /// All of them.
    pub fn all(&mut self) -> StoredMut<'_> {
        if self.packed {
            StoredMut::Packed(self.memory.packed(self.length), Buffer::default())
        } else {
            StoredMut::Whole(&mut self.memory)
        }
    }

    /// The memory of numbers that are not packed.
    pub fn into_whole(self) -> Buffer {
        assert!(!self.packed);
        self.memory
    }
}

/// Some numbers that are stored; where they are packed, with room to work on a block of them.
pub(super) enum StoredMut<'s> {
    Whole(&'s mut [f32]),
    Packed(&'s mut [u16], Buffer),
}

impl<'s> StoredMut<'s> {
    /// Cut into parts of `lengths` of their `rows` rows.
    pub fn parts(self, lengths: &[usize], rows: usize) -> Vec<Self> {
        match self {
            Self::Whole(numbers) => (split(numbers, lengths, rows).into_iter())
                .map(Self::Whole)
                .collect(),
            Self::Packed(packed, _) => (split(packed, lengths, rows).into_iter())
                .map(|part| Self::Packed(part, Buffer::default()))
                .collect(),
        }
    }

    pub fn len(&self) -> usize {
        match self {
            Self::Whole(numbers) => numbers.len(),
            Self::Packed(packed, _) => packed.len(),
        }
    }

    /// Some of them, to be worked on.
    pub fn block(&mut self, range: Range<usize>) -> Block<'_> {
        match self {
            Self::Whole(numbers) => Block {
                numbers: &mut numbers[range],
                packed: None,
            },
            Self::Packed(packed, room) => {
                if room.len() < range.len() {
                    *room = Buffer::any(range.len());
                }
                Block {
                    numbers: &mut room[..range.len()],
                    packed: Some(&mut packed[range]),
                }
            }
        }
    }
}

/// Numbers to work on, of any value where they are stored elsewhere.
pub(super) struct Block<'b> {
    pub numbers: &'b mut [f32],
    packed: Option<&'b mut [u16]>,
}

impl Block<'_> {
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
