//! Perceptrons over blocks of rows: all layers of a block while it lies in the cache.

use std::ops::Range;
use std::sync::OnceLock;

#[cfg(target_arch = "x86_64")]
use super::amx::{self, Tiles};
use super::bf16::{self, Right};
use super::buffer::Buffer;
use super::matrix::{End, Matrix, Start, product};
use super::rows;
use super::stored::{Held, Stored, StoredMut};

/// What the factors of a map's products are rounded to; sums are in float32.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Precision {
    /// Nothing.
    Float32,
    /// 8 bits of significand.
    Bf16,
}

/// A linear map: `weight` row-major `[outputs, inputs]` and `bias` `[outputs]`.
pub struct Linear<'a> {
    pub(super) weight: &'a [f32],
    bias: &'a [f32],
    precision: Precision,
    forward: Copies,
    backward: Copies,
}

/// What a weight is copied to for products, once it is asked for.
#[derive(Default)]
struct Copies {
    numbers: OnceLock<Buffer>,
    #[cfg(target_arch = "x86_64")]
    tiles: OnceLock<Tiles>,
}

/// Numbers behind each row of a copied weight, so that a column's do not all fall into the same
/// few sets of the cache.
const GAP: usize = 16;

impl<'a> Linear<'a> {
    /// One row of `weight` and one number of `bias` per output.
    pub fn new(weight: &'a [f32], bias: &'a [f32], precision: Precision) -> Self {
        Self {
            weight,
            bias,
            precision,
            forward: Copies::default(),
            backward: Copies::default(),
        }
    }

    pub(super) fn inputs(&self) -> usize {
        self.weight.len() / self.bias.len()
    }

    pub(super) fn outputs(&self) -> usize {
        self.bias.len()
    }

    /// `[inputs, outputs]`, what rows are multiplied with on their way forward.
    pub(super) fn forward(&self) -> Factor<'_> {
        Factor {
            weight: Matrix::new(self.weight, self.inputs()).transposed(),
            precision: self.precision,
            copies: &self.forward,
            rows: 0..self.inputs(),
            columns: 0..self.outputs(),
        }
    }

    /// `[outputs, inputs]`, what gradients are multiplied with on their way back.
    pub(super) fn backward(&self) -> Factor<'_> {
        Factor {
            weight: Matrix::new(self.weight, self.inputs()),
            precision: self.precision,
            copies: &self.backward,
            rows: 0..self.outputs(),
            columns: 0..self.inputs(),
        }
    }

    /// Adds to rows of `out`, `stride` apart, the product of `outer` and `inner`, of rows that met
    /// the map and gradients of what came out.
    pub(super) fn add_product(
        &self,
        out: &mut [f32],
        stride: usize,
        outer: Matrix<'_>,
        inner: Matrix<'_>,
    ) {
        match self.precision {
            Precision::Float32 => product(out, stride, Start::There, outer, inner, End::Whole),
            Precision::Bf16 => {
                let inner = Right::Fresh(inner);
                bf16::product(out, stride, Start::There, outer, inner, End::Whole);
            }
        }
    }
}

/// Some rows and columns of a weight, as the right factor of products.
pub(super) struct Factor<'l> {
    weight: Matrix<'l>,
    precision: Precision,
    copies: &'l Copies,
    rows: Range<usize>,
    columns: Range<usize>,
}

impl Factor<'_> {
    /// The rows from `first` to `first + count`.
    pub fn rows(self, first: usize, count: usize) -> Self {
        let rows = first..first + count;
        Self { rows, ..self }
    }

    /// The columns from `first` to `first + count`.
    fn columns(self, first: usize, count: usize) -> Self {
        let columns = first..first + count;
        Self { columns, ..self }
    }

    /// `out`, of rows `stride` apart, becomes `start` plus the product of `a` and this, and then
    /// what `end` says.
    pub fn product(
        &self,
        out: &mut [f32],
        stride: usize,
        start: Start<'_>,
        a: Matrix<'_>,
        end: End<'_>,
    ) {
        match self.precision {
            Precision::Float32 => product(out, stride, start, a, self.numbers(), end),
            Precision::Bf16 => bf16::product(out, stride, start, a, self.rounded(), end),
        }
    }

    /// Makes the copy that products with the whole weight take, which the first of them would make
    /// else, while others wait.
    pub fn copy(&self) {
        match self.precision {
            Precision::Float32 => _ = self.numbers(),
            Precision::Bf16 => _ = self.rounded(),
        }
    }

    fn rounded(&self) -> Right<'_> {
        #[cfg(target_arch = "x86_64")]
        if amx::available() {
            let tiles = (self.copies.tiles).get_or_init(|| Tiles::of_right(self.weight));
            if let Some(part) = tiles.part(
                self.rows.clone(),
                self.columns.clone(),
                self.weight.size().0,
            ) {
                return Right::Tiles(part);
            }
        }
        Right::Rounded(self.numbers())
    }

    /// Copied with a gap behind each row, and rounded to what they are multiplied in.
    fn numbers(&self) -> Matrix<'_> {
        let (rows, columns) = self.weight.size();
        let stride = columns + GAP;
        let data = self.copies.numbers.get_or_init(|| {
            let mut data = Buffer::any(rows * stride);
            self.weight.copy_to(&mut data, stride);
            if self.precision == Precision::Bf16 {
                bf16::round(&mut data);
            }
            data
        });
        Matrix::new(data, stride)
            .rows(self.rows.start, self.rows.len())
            .columns(self.columns.start, self.columns.len())
    }
}

/// The scale and the shift of a LayerNorm.
#[derive(Clone, Copy)]
pub struct Norm<'a> {
    /// Factor of each normalized number.
    pub scale: &'a [f32],
    /// What is added to it.
    pub shift: &'a [f32],
}

/// Linear maps with ReLU between them, and perhaps a LayerNorm at the end.
pub struct Mlp<'a> {
    /// The maps, at least one.
    pub linears: Vec<Linear<'a>>,
    /// The LayerNorm.
    pub norm: Option<Norm<'a>>,
}

/// A part of a perceptron's input: contiguous rows that meet the weight's columns from `column`.
#[derive(Clone, Copy)]
pub(super) struct Input<'a> {
    pub rows: &'a [f32],
    pub width: usize,
    pub column: usize,
}

/// What the backward pass needs of a number of rows.
#[derive(Default)]
pub(super) struct Kept {
    /// After each ReLU, rounded as the products round them that they are factors of.
    hidden: Vec<Stored>,
    /// Before the LayerNorm's scale and shift; empty without one.
    normalized: Buffer,
    inverse_std: Buffer,
}

/// The same of a part of the rows, or, where nothing goes backward, of what passes.
pub(super) struct KeptPart<'k> {
    hidden: Vec<StoredMut<'k>>,
    normalized: StoredMut<'k>,
    inverse_std: StoredMut<'k>,
    rows: usize,
}

/// The same of a block of a part's rows.
pub(super) struct KeptBlock<'k> {
    hidden: Vec<Held<'k>>,
    normalized: &'k mut [f32],
    inverse_std: &'k mut [f32],
}

impl<'a> Mlp<'a> {
    /// How many numbers come out per row.
    pub fn outputs(&self) -> usize {
        self.linears.last().map_or(0, Linear::outputs)
    }

    /// Whether `kept` is what a forward pass of `rows` rows keeps.
    pub(super) fn fits(&self, kept: &Kept, rows: usize) -> bool {
        let mut hidden = self.hidden();
        let normed = if self.norm.is_some() { rows } else { 0 };
        (kept.hidden.iter()).all(|kept| {
            (hidden.next()).is_some_and(|(width, packed)| kept.are(rows * width, packed))
        }) && hidden.next().is_none()
            && kept.normalized.len() == normed * self.outputs()
            && kept.inverse_std.len() == normed
    }

    /// What its products are rounded to.
    pub(super) fn precision(&self) -> Precision {
        self.linears[0].precision
    }

    /// How wide the rows between its maps are, and whether products round them to bf16.
    fn hidden(&self) -> impl Iterator<Item = (usize, bool)> {
        (self.linears.iter().skip(1)).map(|next| (next.inputs(), next.precision == Precision::Bf16))
    }

    /// How wide its rows are, the first map's inputs apart.
    pub(super) fn widest(&self) -> usize {
        let hidden = self.hidden().map(|(width, _)| width);
        hidden.fold(self.outputs(), usize::max)
    }

    /// How many numbers its parameters have: weights and biases in order, then scale and shift.
    pub fn parameters(&self) -> usize {
        let linears: usize = (self.linears.iter())
            .map(|linear| linear.weight.len() + linear.bias.len())
            .sum();
        linears + self.norm.map_or(0, |norm| 2 * norm.scale.len())
    }

    /// Room for what a pass over `rows` rows keeps.
    pub(super) fn kept(&self, rows: usize) -> Kept {
        let normed = if self.norm.is_some() { rows } else { 0 };
        Kept {
            hidden: (self.hidden())
                .map(|(width, packed)| Stored::any(rows * width, packed))
                .collect(),
            normalized: Buffer::any(normed * self.outputs()),
            inverse_std: Buffer::any(normed),
        }
    }

    /// Bytes of what a pass keeps of a row.
    pub(super) fn kept_bytes(&self) -> usize {
        let hidden =
            (self.hidden()).map(|(width, packed)| if packed { 2 * width } else { 4 * width });
        let normed = if self.norm.is_some() {
            self.outputs() + 1
        } else {
            0
        };
        hidden.sum::<usize>() + 4 * normed
    }

    /// The same of a part of `rows` rows that pass.
    pub(super) fn passing(&self, rows: usize) -> KeptPart<'static> {
        let normed = if self.norm.is_some() { rows } else { 0 };
        KeptPart {
            hidden: (self.hidden())
                .map(|(width, _)| StoredMut::passing(rows * width))
                .collect(),
            normalized: StoredMut::passing(normed * self.outputs()),
            inverse_std: StoredMut::passing(normed),
            rows,
        }
    }

    /// The perceptron of a block of rows, in `out` `[rows, outputs]`. `begin` is given the place of
    /// the first map's outputs, and its bias, and says what the map is added to.
    pub(super) fn forward(
        &self,
        inputs: &[Input<'_>],
        begin: impl for<'b> FnOnce(&mut [f32], &'b [f32]) -> Start<'b>,
        kept: &mut KeptBlock<'_>,
        out: &mut [f32],
    ) {
        let last = self.linears.len() - 1;
        let mut begin = Some(begin);
        for (i, linear) in self.linears.iter().enumerate() {
            let (before, after) = kept.hidden.split_at_mut(i);
            let target = match after.first_mut() {
                Some(hidden) => &mut *hidden.numbers,
                None if self.norm.is_some() => &mut *kept.normalized,
                None => &mut *out,
            };
            let outputs = linear.outputs();
            let end = if i < last { End::Relu } else { End::Whole };
            if let Some(begin) = begin.take() {
                let mut start = begin(target, linear.bias);
                for (number, input) in inputs.iter().enumerate() {
                    let rows = Matrix::new(input.rows, input.width);
                    let weight = linear.forward().rows(input.column, input.width);
                    let whole = number + 1 == inputs.len();
                    let end = if whole { end } else { End::Whole };
                    weight.product(target, outputs, start, rows, end);
                    start = Start::There;
                }
            } else {
                let rows = Matrix::new(before[i - 1].numbers, linear.inputs());
                let start = Start::Row(linear.bias);
                (linear.forward()).product(target, outputs, start, rows, end);
            }
            if let Some(hidden) = after.first_mut() {
                hidden.put();
            }
        }
        if let Some(norm) = self.norm {
            rows::normalize(kept.normalized, norm.scale.len(), kept.inverse_std);
            rows::rescale(out, kept.normalized, norm.scale, norm.shift);
        }
    }

    /// What [`Self::forward`] gave for the rows that were `normalized`.
    pub(super) fn outputs_again(&self, normalized: &[f32], out: &mut [f32]) {
        let norm = self.norm.expect("only what a LayerNorm gave is kept");
        rows::rescale(out, normalized, norm.scale, norm.shift);
    }

    /// From the gradient of the outputs of a block of `rows` rows to that of its first map's
    /// outputs, which lies in one of the two buffers that come, both with room for the widest rows,
    /// the gradient in the first; adds those of the parameters to `parameters`.
    pub(super) fn backward<'g>(
        &self,
        inputs: &[Input<'_>],
        kept: &mut KeptBlock<'_>,
        rows: usize,
        buffers: [&'g mut [f32]; 2],
        mut parameters: &mut [f32],
    ) -> &'g [f32] {
        let [mut gradient, mut spare] = buffers;
        if let Some(norm) = self.norm {
            let width = norm.scale.len();
            let (linears, of_norm) = parameters.split_at_mut(parameters.len() - 2 * width);
            let (to_scale, to_shift) = of_norm.split_at_mut(width);
            rows::normalize_backward(
                &mut gradient[..rows * width],
                kept.normalized,
                kept.inverse_std,
                norm.scale,
                to_scale,
                to_shift,
            );
            parameters = linears;
        }
        for (i, linear) in self.linears.iter().enumerate().rev() {
            let own = parameters.len() - linear.weight.len() - linear.bias.len();
            let (others, of_linear) = parameters.split_at_mut(own);
            let (to_weight, to_bias) = of_linear.split_at_mut(linear.weight.len());
            parameters = others;
            let columns = linear.inputs();
            let after = &gradient[..rows * linear.outputs()];
            rows::add_sum(to_bias, after);
            let outer = Matrix::new(after, linear.outputs());
            if i == 0 {
                for input in inputs {
                    let inner = Matrix::new(input.rows, input.width);
                    let target = &mut to_weight[input.column..];
                    linear.add_product(target, columns, outer.transposed(), inner);
                }
                break;
            }
            let activation = &mut kept.hidden[i - 1];
            activation.take();
            let activation = &*activation.numbers;
            let inner = Matrix::new(activation, columns);
            linear.add_product(to_weight, columns, outer.transposed(), inner);
            let before = &mut spare[..rows * columns];
            let end = End::WherePositive(activation);
            (linear.backward()).product(before, columns, Start::Zero, outer, end);
            (gradient, spare) = (spare, gradient);
        }
        &gradient[..rows * self.linears[0].outputs()]
    }

    /// Adds the gradient of the first map's inputs, columns `column` to `column + width`, to `out`
    /// `[rows, width]`.
    pub(super) fn add_input_gradient(
        &self,
        gradient: &[f32],
        column: usize,
        width: usize,
        out: &mut [f32],
    ) {
        let first = &self.linears[0];
        let weight = first.backward().columns(column, width);
        let outer = Matrix::new(gradient, first.outputs());
        weight.product(out, width, Start::There, outer, End::Whole);
    }
}

impl Kept {
    /// One part after the other of its `rows` rows.
    pub fn parts(&mut self, lengths: &[usize], rows: usize) -> Vec<KeptPart<'_>> {
        let mut hidden: Vec<_> = (self.hidden.iter_mut())
            .map(|hidden| hidden.all().parts(lengths, rows).into_iter())
            .collect();
        let normalized = StoredMut::Numbers(&mut self.normalized).parts(lengths, rows);
        let inverse_std = StoredMut::Numbers(&mut self.inverse_std).parts(lengths, rows);
        (normalized.into_iter().zip(inverse_std).zip(lengths))
            .map(|((normalized, inverse_std), &length)| KeptPart {
                hidden: hidden.iter_mut().filter_map(Iterator::next).collect(),
                normalized,
                inverse_std,
                rows: length,
            })
            .collect()
    }
}

impl KeptPart<'_> {
    /// The rows `first` to `first + count`.
    pub fn block(&mut self, first: usize, count: usize) -> KeptBlock<'_> {
        let rows = self.rows;
        KeptBlock {
            hidden: (self.hidden.iter_mut())
                .map(|hidden| hidden.rows(first, count, rows))
                .collect(),
            normalized: self.normalized.rows(first, count, rows).numbers,
            inverse_std: self.inverse_std.rows(first, count, rows).numbers,
        }
    }

    /// Of the rows `first` to `first + count`, what was normalized.
    pub fn normalized(&mut self, first: usize, count: usize) -> &[f32] {
        self.normalized.rows(first, count, self.rows).numbers
    }
}
