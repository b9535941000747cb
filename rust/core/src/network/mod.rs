//! The encode-process-decode graph network (Sanchez-Gonzalez et al. 2020) in float32 on the CPU,
//! forward and backward.
//!
//! Rows (nodes or edges) go through all layers of a perceptron block by block, while the block
//! lies in the cache. The first map of an edge's perceptron acts on [receiver, sender, edge]; its
//! node parts are multiplied once per node and gathered. Edges are sorted by receiver, so that a
//! part of the work owns whole receivers and sums their messages without atomics. Parts depend on
//! the graph alone, and their sums are taken in order: results are the same for any number of
//! threads.
//!
//! The backward pass needs every layer's edges. It takes them from the last layer's by undoing one
//! residual after the other, so a step keeps no edges but the last.

mod buffer;
mod check;
mod matrix;
mod mlp;
mod rows;

use std::ops::Range;

pub use mlp::{Linear, Mlp, Norm};

use crate::threads::{self, Threads};
use buffer::Buffer;
use matrix::{Matrix, Start, product};
use mlp::{Input, Kept, KeptMut, split};

/// Rows that go through a perceptron at once.
const BLOCK: usize = 64;
/// The fewest nodes and edges worth a part of their own.
const NODES: usize = 64;
const EDGES: usize = 256;
/// The most parts; each has its own sum of the gradients of the parameters.
const PARTS: usize = 64;

/// One message-passing step, or with no `edge` one residual perceptron per node.
pub struct Layer<'a> {
    /// From [receiver, sender, edge] to what is added to the edge and sent to the receiver.
    pub edge: Option<Mlp<'a>>,
    /// From [sum of messages, node] to what is added to the node.
    pub node: Mlp<'a>,
}

/// The network's parameters. All rows between the encoders and the heads have one width.
pub struct Network<'a> {
    /// Of the nodes' features.
    pub node_encoder: Mlp<'a>,
    /// Of the edges' features; absent without edges.
    pub edge_encoder: Option<Mlp<'a>>,
    /// Step after step.
    pub layers: Vec<Layer<'a>>,
    /// What is read from the last step's nodes.
    pub heads: Vec<Mlp<'a>>,
}

/// Edges sorted by receiver. `senders` and `receivers` hold a node per edge; those into node i
/// are `offsets[i]..offsets[i + 1]`. `by_sender` lists the edges sorted by sender, and
/// `sender_offsets` delimits each sender's; both may be empty if nothing goes backward.
#[derive(Clone, Copy)]
pub struct Edges<'a> {
    #[allow(missing_docs)]
    pub senders: &'a [i64],
    #[allow(missing_docs)]
    pub receivers: &'a [i64],
    #[allow(missing_docs)]
    pub offsets: &'a [i64],
    #[allow(missing_docs)]
    pub by_sender: &'a [i64],
    #[allow(missing_docs)]
    pub sender_offsets: &'a [i64],
}

/// What the network sees: features `[N, :]` of the nodes, and the edges with theirs `[E, :]`.
#[derive(Clone, Copy)]
pub struct Features<'a> {
    /// One row per node.
    pub nodes: &'a [f32],
    /// One row per edge, and which nodes they join; absent without edges.
    pub edges: Option<(&'a [f32], Edges<'a>)>,
}

/// What the backward pass needs of the forward pass.
pub struct Tape {
    node_encoder: Kept,
    edge_encoder: Kept,
    layers: Vec<LayerTape>,
    heads: Vec<Kept>,
    nodes: Buffer,
    edges: Buffer,
}

struct LayerTape {
    edge: Kept,
    node: Kept,
    incoming: Buffer,
    /// The nodes before the layer.
    nodes: Buffer,
}

/// Gradients of a number by all that it came from.
pub struct Gradients {
    /// By the parameters, in order: node encoder, edge encoder, each layer's edge and node
    /// perceptron, heads; within each, weights and biases in order, scale, shift.
    pub parameters: Vec<f32>,
    /// By the nodes' features.
    pub nodes: Vec<f32>,
    /// By the edges' features; empty without edges.
    pub edges: Vec<f32>,
}

/// Nodes and the edges into them.
struct Part {
    nodes: Range<usize>,
    edges: Range<usize>,
}

impl Network<'_> {
    /// How wide the rows between encoders and heads are.
    fn width(&self) -> usize {
        self.node_encoder.outputs()
    }

    /// The heads' outputs `[N, :]` each, and with `keep` what [`Self::backward`] needs.
    pub fn forward(
        &self,
        features: Features<'_>,
        keep: bool,
        threads: Threads,
    ) -> Result<(Vec<Vec<f32>>, Option<Tape>), crate::Error> {
        self.check(&features)?;
        let width = self.width();
        let count = self.node_count(&features);
        let rows = |mlp: &Mlp<'_>, rows| keep.then(|| mlp.kept(rows));

        let mut node_encoder = rows(&self.node_encoder, count);
        let mut nodes = Buffer::any(count * width);
        let encoder_inputs = [whole_input(&self.node_encoder, features.nodes)];
        let lengths = lengths(count);
        let pass = Pass {
            lengths: &lengths,
            rows: count,
            threads,
        };
        pass.forward(
            &self.node_encoder,
            &encoder_inputs,
            &mut node_encoder,
            &mut nodes,
        );

        let mut edges = Buffer::default();
        let mut edge_encoder = None;
        let mut parts = Vec::new();
        if let (Some((values, graph)), Some(encoder)) = (features.edges, &self.edge_encoder) {
            let edge_count = graph.senders.len();
            parts = graph.parts();
            edges = Buffer::any(edge_count * width);
            edge_encoder = rows(encoder, edge_count);
            let lengths: Vec<usize> = parts.iter().map(|part| part.edges.len()).collect();
            let pass = Pass {
                lengths: &lengths,
                rows: edge_count,
                threads,
            };
            pass.forward(
                encoder,
                &[whole_input(encoder, values)],
                &mut edge_encoder,
                &mut edges,
            );
        }

        let mut layers = Vec::new();
        for layer in &self.layers {
            let mut node = rows(&layer.node, count);
            let before = keep.then(|| Buffer::copy(&nodes));
            let mut incoming = Buffer::default();
            let mut edge = None;
            if let (Some((_, graph)), Some(mlp)) = (features.edges, &layer.edge) {
                edge = rows(mlp, graph.senders.len());
                let projected = pass.project(mlp, &nodes, width);
                incoming = Buffer::zeros(count * width);
                update_edges(
                    mlp,
                    graph,
                    &parts,
                    &projected,
                    &mut edge,
                    &mut edges,
                    &mut incoming,
                    threads,
                );
            }
            pass.update_nodes(&layer.node, &incoming, &mut nodes, &mut node);
            if let (Some(node), Some(nodes)) = (node, before) {
                let edge = edge.unwrap_or_default();
                layers.push(LayerTape {
                    edge,
                    node,
                    incoming,
                    nodes,
                });
            }
        }

        let mut heads = Vec::new();
        let outputs = (self.heads.iter())
            .map(|head| {
                let mut kept = rows(head, count);
                let mut out = vec![0.0; count * head.outputs()];
                pass.forward(head, &[whole_input(head, &nodes)], &mut kept, &mut out);
                heads.extend(kept);
                out
            })
            .collect();
        let tape = node_encoder.map(|node_encoder| Tape {
            node_encoder,
            edge_encoder: edge_encoder.unwrap_or_default(),
            layers,
            heads,
            nodes,
            edges,
        });
        Ok((outputs, tape))
    }

    /// The gradients that follow from those of the heads' outputs, after a forward pass over the
    /// same parameters and `features` that kept `tape`.
    pub fn backward(
        &self,
        features: Features<'_>,
        tape: &mut Tape,
        heads: &[&[f32]],
        threads: Threads,
    ) -> Result<Gradients, crate::Error> {
        self.check(&features)?;
        self.check_tape(&features, tape, heads)?;
        let width = self.width();
        let count = self.node_count(&features);
        let lengths = lengths(count);
        let pass = Pass {
            lengths: &lengths,
            rows: count,
            threads,
        };
        // From the back: the order of the parameters, turned round.
        let mut parameters: Vec<Buffer> = Vec::new();

        let mut to_nodes = Buffer::zeros(count * width);
        for ((head, kept), gradient) in self.heads.iter().zip(&mut tape.heads).zip(heads).rev() {
            let inputs = [whole_input(head, &tape.nodes)];
            let mut targets = [(&mut to_nodes[..], 0)];
            parameters.push(pass.backward(head, &inputs, kept, gradient, &mut targets));
        }

        let mut edges = Buffer::copy(&tape.edges);
        let mut to_edges = Buffer::zeros(edges.len());
        let parts = features.edges.map(|(_, graph)| graph.parts());
        for (layer, tape) in self.layers.iter().zip(&mut tape.layers).rev() {
            let gradient = Buffer::copy(&to_nodes);
            let mut to_incoming = Buffer::zeros(tape.incoming.len());
            let column = layer.node.linears[0].inputs() - width;
            let own = Input {
                rows: &tape.nodes,
                width,
                column,
            };
            let summed = Input {
                rows: &tape.incoming,
                width,
                column: 0,
            };
            let (inputs, mut targets) = if layer.edge.is_some() {
                (
                    vec![summed, own],
                    vec![(&mut to_incoming[..], 0), (&mut to_nodes[..], column)],
                )
            } else {
                (vec![own], vec![(&mut to_nodes[..], column)])
            };
            parameters.push(pass.backward(
                &layer.node,
                &inputs,
                &mut tape.node,
                &gradient,
                &mut targets,
            ));
            if let (Some((_, graph)), Some(mlp), Some(parts)) =
                (features.edges, &layer.edge, &parts)
            {
                let mut to_receivers = Buffer::zeros(count * width);
                let mut to_first = Buffer::any(graph.senders.len() * width);
                let mut of_edges = edges_backward(
                    mlp,
                    graph,
                    parts,
                    &mut tape.edge,
                    &mut edges,
                    &mut to_edges,
                    &to_incoming,
                    &mut to_receivers,
                    &mut to_first,
                    threads,
                );
                let of_nodes = pass.project_backward(
                    mlp,
                    graph,
                    &tape.nodes,
                    &to_receivers,
                    &to_first,
                    &mut to_nodes,
                );
                rows::add(&mut of_edges, &of_nodes);
                parameters.push(of_edges);
            }
        }

        let mut by_edges = Vec::new();
        if let (Some((values, _)), Some(encoder), Some(parts)) =
            (features.edges, &self.edge_encoder, &parts)
        {
            let lengths: Vec<usize> = parts.iter().map(|part| part.edges.len()).collect();
            let edge_count = lengths.iter().sum();
            by_edges = vec![0.0; values.len()];
            parameters.push(
                Pass {
                    lengths: &lengths,
                    rows: edge_count,
                    threads,
                }
                .backward(
                    encoder,
                    &[whole_input(encoder, values)],
                    &mut tape.edge_encoder,
                    &to_edges,
                    &mut [(&mut by_edges[..], 0)],
                ),
            );
        }
        let mut by_nodes = vec![0.0; features.nodes.len()];
        parameters.push(pass.backward(
            &self.node_encoder,
            &[whole_input(&self.node_encoder, features.nodes)],
            &mut tape.node_encoder,
            &to_nodes,
            &mut [(&mut by_nodes[..], 0)],
        ));
        parameters.reverse();
        Ok(Gradients {
            parameters: parameters
                .iter()
                .flat_map(|part| part.iter().copied())
                .collect(),
            nodes: by_nodes,
            edges: by_edges,
        })
    }
}

impl Edges<'_> {
    /// Parts of whole receivers with about as many edges each.
    fn parts(&self) -> Vec<Part> {
        let least = EDGES.max(self.senders.len().div_ceil(PARTS));
        let mut parts = Vec::new();
        let (mut node, mut edge) = (0, 0);
        for (next, &end) in self.offsets.iter().enumerate().skip(1) {
            let end = end as usize;
            if end - edge >= least || next == self.offsets.len() - 1 {
                parts.push(Part {
                    nodes: node..next,
                    edges: edge..end,
                });
                (node, edge) = (next, end);
            }
        }
        parts
    }
}

/// How many nodes each part has: whole tiles of the products.
fn lengths(count: usize) -> Vec<usize> {
    let size = NODES.max(count.div_ceil(PARTS)).next_multiple_of(8);
    (0..count)
        .step_by(size)
        .map(|start| size.min(count - start))
        .collect()
}

fn whole_input<'r>(mlp: &Mlp<'_>, rows: &'r [f32]) -> Input<'r> {
    Input {
        rows,
        width: mlp.linears[0].inputs(),
        column: 0,
    }
}

/// Where the starts of parts of these lengths are.
fn starts(lengths: &[usize]) -> impl Iterator<Item = usize> {
    lengths.iter().scan(0, |next, length| {
        let start = *next;
        *next += length;
        Some(start)
    })
}

/// Consecutive blocks of `rows`: first row and count.
fn blocks(rows: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..rows)
        .step_by(BLOCK)
        .map(move |first| (first, BLOCK.min(rows - first)))
}

impl<'r> Input<'r> {
    fn block(&self, first: usize, count: usize) -> Input<'r> {
        Input {
            rows: &self.rows[first * self.width..(first + count) * self.width],
            ..*self
        }
    }
}

/// Where a part's forward pass leaves what the backward pass needs: for all of its rows, or, where
/// nothing goes backward, for one block after the other in the same place.
enum Place<'k> {
    Rows(KeptMut<'k>, usize),
    Block(Kept),
}

impl Place<'_> {
    /// One place per part.
    fn of<'k>(
        kept: &'k mut Option<Kept>,
        mlp: &Mlp<'_>,
        lengths: &[usize],
        rows: usize,
    ) -> Vec<Place<'k>> {
        match kept {
            Some(kept) => (kept.parts(lengths, rows).into_iter().zip(lengths))
                .map(|(part, &length)| Place::Rows(part, length))
                .collect(),
            None => lengths
                .iter()
                .map(|_| Place::Block(mlp.kept(BLOCK)))
                .collect(),
        }
    }

    fn block(&mut self, first: usize, count: usize) -> KeptMut<'_> {
        match self {
            Place::Rows(kept, rows) => kept.block(first, count, *rows),
            Place::Block(kept) => kept.block(0, count, BLOCK),
        }
    }
}

/// Row after row of nodes or edges, part by part.
struct Pass<'p> {
    lengths: &'p [usize],
    rows: usize,
    threads: Threads,
}

impl Pass<'_> {
    /// `out` becomes the perceptron of the rows of `inputs`.
    fn forward(
        &self,
        mlp: &Mlp<'_>,
        inputs: &[Input<'_>],
        kept: &mut Option<Kept>,
        out: &mut [f32],
    ) {
        let width = mlp.outputs();
        let items: Vec<_> = starts(self.lengths)
            .zip(Place::of(kept, mlp, self.lengths, self.rows))
            .zip(split(out, self.lengths, self.rows))
            .collect();
        threads::map(self.threads, items, |((start, mut place), out)| {
            for ((first, count), out) in
                blocks(out.len() / width).zip(out.chunks_mut(BLOCK * width))
            {
                let inputs: Vec<_> = inputs
                    .iter()
                    .map(|input| input.block(start + first, count))
                    .collect();
                mlp.forward(
                    &inputs,
                    |_, bias| Start::Row(bias),
                    &mut place.block(first, count),
                    out,
                );
            }
        });
    }

    /// Adds to `nodes` what the perceptron of [`incoming`, node] says.
    fn update_nodes(
        &self,
        mlp: &Mlp<'_>,
        incoming: &[f32],
        nodes: &mut [f32],
        kept: &mut Option<Kept>,
    ) {
        let width = mlp.outputs();
        let items: Vec<_> = starts(self.lengths)
            .zip(Place::of(kept, mlp, self.lengths, self.rows))
            .zip(split(nodes, self.lengths, self.rows))
            .collect();
        threads::map(self.threads, items, |((start, mut place), nodes)| {
            let mut update = Buffer::any(BLOCK * width);
            for ((first, count), nodes) in
                blocks(nodes.len() / width).zip(nodes.chunks_mut(BLOCK * width))
            {
                let update = &mut update[..count * width];
                let column = mlp.linears[0].inputs() - width;
                let own = Input {
                    rows: nodes,
                    width,
                    column,
                };
                let mut kept = place.block(first, count);
                if incoming.is_empty() {
                    mlp.forward(&[own], |_, bias| Start::Row(bias), &mut kept, update);
                } else {
                    let summed = Input {
                        rows: incoming,
                        width,
                        column: 0,
                    };
                    let summed = summed.block(start + first, count);
                    mlp.forward(
                        &[summed, own],
                        |_, bias| Start::Row(bias),
                        &mut kept,
                        update,
                    );
                }
                rows::add(nodes, update);
            }
        });
    }

    /// The node parts of the first map of an edge perceptron: `[N, 2 width]`, what a node gives to
    /// the edges it receives, then what it gives to those it sends.
    fn project(&self, mlp: &Mlp<'_>, nodes: &[f32], width: usize) -> Buffer {
        let mut out = Buffer::any(2 * nodes.len());
        let first = mlp.linears[0].forward();
        let items: Vec<_> = starts(self.lengths)
            .zip(split(&mut out, self.lengths, self.rows))
            .collect();
        threads::map(self.threads, items, |(start, out)| {
            let count = out.len() / (2 * width);
            let nodes = Matrix::new(&nodes[start * width..(start + count) * width], width);
            for end in 0..2 {
                let weight = first.rows(end * width, width);
                let out = out.get_mut(end * width..).unwrap_or_default();
                product(out, 2 * width, Start::Zero, nodes, weight);
            }
        });
        out
    }

    /// Gradients of the parameters by those of the outputs; adds those of the inputs to `targets`,
    /// each with its first column.
    fn backward(
        &self,
        mlp: &Mlp<'_>,
        inputs: &[Input<'_>],
        kept: &mut Kept,
        outputs: &[f32],
        targets: &mut [(&mut [f32], usize)],
    ) -> Buffer {
        let width = mlp.outputs();
        let widest = mlp.hidden_widths().fold(width, usize::max);
        let mut of_parts: Vec<Vec<(&mut [f32], usize)>> =
            self.lengths.iter().map(|_| Vec::new()).collect();
        for (target, column) in targets {
            for (part, rows) in of_parts
                .iter_mut()
                .zip(split(target, self.lengths, self.rows))
            {
                part.push((rows, *column));
            }
        }
        let items: Vec<_> = starts(self.lengths)
            .zip(self.lengths)
            .zip(kept.parts(self.lengths, self.rows))
            .zip(of_parts)
            .collect();
        let sums = threads::map(
            self.threads,
            items,
            |(((start, &length), mut kept), mut targets)| {
                let mut sum = Buffer::zeros(mlp.parameters());
                let (mut here, mut there) =
                    (Buffer::any(BLOCK * widest), Buffer::any(BLOCK * widest));
                for (first, count) in blocks(length) {
                    let row = start + first;
                    let gradient = &mut here[..count * width];
                    gradient.copy_from_slice(&outputs[row * width..(row + count) * width]);
                    let inputs: Vec<_> =
                        inputs.iter().map(|input| input.block(row, count)).collect();
                    let kept = kept.block(first, count, length);
                    let before =
                        mlp.backward(&inputs, &kept, count, [&mut here, &mut there], &mut sum);
                    for ((target, column), input) in targets.iter_mut().zip(&inputs) {
                        let target =
                            &mut target[first * input.width..(first + count) * input.width];
                        mlp.add_input_gradient(before, *column, input.width, target);
                    }
                }
                sum
            },
        );
        total(sums)
    }

    /// Gradients of an edge perceptron's parameters (0 but for the node parts of its first map) by
    /// those of its first map's outputs, `to_receivers` `[N, width]` summed at the receivers and
    /// `to_first` `[E, width]`; adds those of the nodes to `to_nodes`.
    fn project_backward(
        &self,
        mlp: &Mlp<'_>,
        graph: Edges<'_>,
        nodes: &[f32],
        to_receivers: &[f32],
        to_first: &[f32],
        to_nodes: &mut [f32],
    ) -> Buffer {
        let width = mlp.outputs();
        let columns = mlp.linears[0].inputs();
        let items: Vec<_> = starts(self.lengths)
            .zip(split(to_nodes, self.lengths, self.rows))
            .collect();
        let sums = threads::map(self.threads, items, |(start, to_nodes)| {
            let mut sum = Buffer::zeros(mlp.parameters());
            let count = to_nodes.len() / width;
            let mut to_senders = Buffer::zeros(to_nodes.len());
            rows::add_listed(
                &mut to_senders,
                width,
                to_first,
                graph.by_sender,
                &graph.sender_offsets[start..=start + count],
            );
            let range = start * width..(start + count) * width;
            let inner = Matrix::new(&nodes[range.clone()], width);
            for (end, gradient) in [&to_receivers[range], &to_senders[..]]
                .into_iter()
                .enumerate()
            {
                let outer = Matrix::new(gradient, width).transposed();
                product(&mut sum[end * width..], columns, Start::There, outer, inner);
                mlp.add_input_gradient(gradient, end * width, width, to_nodes);
            }
            sum
        });
        total(sums)
    }
}

/// Adds its message to every edge, and the sum of a receiver's messages to `incoming`.
#[expect(clippy::too_many_arguments, reason = "three buffers change together")]
fn update_edges(
    mlp: &Mlp<'_>,
    graph: Edges<'_>,
    parts: &[Part],
    projected: &[f32],
    kept: &mut Option<Kept>,
    edges: &mut [f32],
    incoming: &mut [f32],
    threads: Threads,
) {
    let width = mlp.outputs();
    let (lengths, nodes) = part_lengths(parts);
    let count = graph.senders.len();
    let items: Vec<_> = parts
        .iter()
        .zip(Place::of(kept, mlp, &lengths, count))
        .zip(split(edges, &lengths, count))
        .zip(split(incoming, &nodes, graph.offsets.len() - 1))
        .collect();
    threads::map(threads, items, |(((part, mut place), edges), incoming)| {
        let mut messages = Buffer::any(BLOCK * width);
        for ((first, count), edges) in blocks(part.edges.len()).zip(edges.chunks_mut(BLOCK * width))
        {
            let here = part.edges.start + first..part.edges.start + first + count;
            let (senders, receivers) = (&graph.senders[here.clone()], &graph.receivers[here]);
            let messages = &mut messages[..count * width];
            let own = Input {
                rows: edges,
                width,
                column: 2 * width,
            };
            mlp.forward(
                &[own],
                |rows, bias| {
                    rows::gather_ends(rows, bias, projected, receivers, senders);
                    Start::There
                },
                &mut place.block(first, count),
                messages,
            );
            rows::add(edges, messages);
            rows::add_at(incoming, width, messages, receivers, part.nodes.start);
        }
    });
}

/// The way back through [`update_edges`]: `edges` become those before it, `to_edges` the gradients
/// of these; `to_first` becomes that of the first map's outputs, `to_receivers` its sums at the
/// receivers. The gradients of the parameters, without the node parts of the first map.
#[expect(clippy::too_many_arguments, reason = "four buffers change together")]
fn edges_backward(
    mlp: &Mlp<'_>,
    graph: Edges<'_>,
    parts: &[Part],
    kept: &mut Kept,
    edges: &mut [f32],
    to_edges: &mut [f32],
    to_incoming: &[f32],
    to_receivers: &mut [f32],
    to_first: &mut [f32],
    threads: Threads,
) -> Buffer {
    let width = mlp.outputs();
    let (lengths, nodes) = part_lengths(parts);
    let count = graph.senders.len();
    let items: Vec<_> = parts
        .iter()
        .zip(kept.parts(&lengths, count))
        .zip(split(edges, &lengths, count))
        .zip(split(to_edges, &lengths, count))
        .zip(split(to_first, &lengths, count))
        .zip(split(to_receivers, &nodes, graph.offsets.len() - 1))
        .collect();
    let sums = threads::map(threads, items, |item| {
        let (((((part, mut kept), edges), to_edges), to_first), to_receivers) = item;
        let mut sum = Buffer::zeros(mlp.parameters());
        let (mut here, mut there) = (Buffer::any(BLOCK * width), Buffer::any(BLOCK * width));
        for (first, count) in blocks(part.edges.len()) {
            let row = part.edges.start + first;
            let receivers = &graph.receivers[row..row + count];
            let range = first * width..(first + count) * width;
            let (edges, to_edges) = (&mut edges[range.clone()], &mut to_edges[range.clone()]);
            let kept = kept.block(first, count, part.edges.len());
            let message = &mut there[..count * width];
            mlp.outputs_again(&kept, message);
            rows::subtract(edges, message);
            here[..count * width].copy_from_slice(to_edges);
            rows::add_from(&mut here[..count * width], width, to_incoming, receivers);
            let own = Input {
                rows: edges,
                width,
                column: 2 * width,
            };
            let before = mlp.backward(&[own], &kept, count, [&mut here, &mut there], &mut sum);
            mlp.add_input_gradient(before, 2 * width, width, to_edges);
            to_first[range].copy_from_slice(before);
            rows::add_at(to_receivers, width, before, receivers, part.nodes.start);
        }
        sum
    });
    total(sums)
}

/// How many edges and how many nodes each part has.
fn part_lengths(parts: &[Part]) -> (Vec<usize>, Vec<usize>) {
    parts
        .iter()
        .map(|part| (part.edges.len(), part.nodes.len()))
        .unzip()
}

/// The sum of the parts' sums, in order.
fn total(sums: Vec<Buffer>) -> Buffer {
    let mut sums = sums.into_iter();
    let mut total = sums.next().unwrap_or_default();
    for sum in sums {
        rows::add(&mut total, &sum);
    }
    total
}
