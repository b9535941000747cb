//! The encode-process-decode graph network (Sanchez-Gonzalez et al. 2020) on the CPU, in float32 or
//! with products in bf16, forward and backward.
//!
//! Rows (nodes or edges) go through all layers of a perceptron block by block, while the block
//! lies in the cache. The first map of an edge's perceptron acts on [receiver, sender, edge]; its
//! node parts are multiplied once per node and gathered. Edges are sorted by receiver, so that a
//! part of the work owns whole receivers and sums their messages without atomics. Parts depend on
//! the graph alone, and their sums are taken in order: results are the same for any number of
//! threads.
//!
//! The backward pass needs every layer's nodes, edges and sums of messages. It takes them from the
//! last layer's by undoing one residual after the other, so a step keeps none but the last. What
//! rounding that adds is below that of the passes themselves, unless LayerNorms scale by a thousand.

#[cfg(target_arch = "x86_64")]
mod amx;
mod bf16;
mod buffer;
mod check;
mod matrix;
mod mlp;
mod rows;
mod stored;
mod vector;

use std::ops::Range;

pub use mlp::{Linear, Mlp, Norm, Precision};

use crate::threads::{self, Team, Threads};
use buffer::Buffer;
use matrix::{End, Matrix, Start};
use mlp::{Factor, Input, Kept, KeptPart};
use stored::{Stored, StoredMut, split};

/// Rows that go through a perceptron at once: whole tiles, of six rows in float32 and of 32 in
/// bf16.
const BLOCK: usize = 96;
/// The fewest nodes and edges worth a part of their own.
const NODES: usize = 64;
const EDGES: usize = 256;
/// The most parts that work is shared out to; each has its own sum of the gradients of the
/// parameters.
const PARTS: usize = 64;
/// As many parts or more are a multiple of these, so that few threads have as many each.
const EVEN: usize = 4;

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

/// Edges sorted by receiver.
#[derive(Clone, Copy)]
pub struct Edges<'a> {
    /// The node that each edge comes from.
    pub senders: &'a [i64],
    /// The node that each edge goes to.
    pub receivers: &'a [i64],
    /// Node `i` receives the edges `offsets[i]..offsets[i + 1]`.
    pub offsets: &'a [i64],
    /// The edges sorted by sender; may be empty if nothing goes backward.
    pub by_sender: &'a [i64],
    /// Node `i` sends the edges that `by_sender` lists from `sender_offsets[i]` to
    /// `sender_offsets[i + 1]`; may be empty if nothing goes backward.
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

    /// How many numbers its parameters have.
    fn parameters(&self) -> usize {
        let of_layer = |layer: &Layer<'_>| {
            layer.edge.as_ref().map_or(0, Mlp::parameters) + layer.node.parameters()
        };
        self.node_encoder.parameters()
            + self.edge_encoder.as_ref().map_or(0, Mlp::parameters)
            + self.layers.iter().map(of_layer).sum::<usize>()
            + self.heads.iter().map(Mlp::parameters).sum::<usize>()
    }

    /// Bytes that a forward pass takes at least: the latents, and with `keep` what goes backward.
    fn least_bytes(&self, features: &Features<'_>, keep: bool) -> usize {
        let (nodes, width) = (self.node_count(features), self.width());
        let edges = features.edges.map_or(0, |(_, graph)| graph.senders.len());
        let (mut of_node, mut of_edge) = (4 * width, 2 * width);
        if keep {
            let layers = self.layers.iter();
            let on_nodes = layers.clone().map(|layer| &layer.node).chain(&self.heads);
            let on_edges = layers.filter_map(|layer| layer.edge.as_ref());
            of_node += [&self.node_encoder]
                .into_iter()
                .chain(on_nodes)
                .map(Mlp::kept_bytes)
                .sum::<usize>();
            of_edge += self
                .edge_encoder
                .iter()
                .chain(on_edges)
                .map(Mlp::kept_bytes)
                .sum::<usize>();
        }
        nodes
            .saturating_mul(of_node)
            .saturating_add(edges.saturating_mul(of_edge))
    }

    /// `threads`, as far as there are parts for them.
    fn useful(&self, features: &Features<'_>, threads: Threads) -> Threads {
        let edges = features.edges.map_or(0, |(_, graph)| graph.senders.len());
        let parts = part_count(edges, EDGES).max(part_count(self.node_count(features), NODES));
        threads.at_most(parts)
    }

    /// The heads' outputs `[N, :]` each, and with `keep` what [`Self::backward`] needs. A layer's
    /// copies of its weights go with it.
    ///
    /// # Errors
    ///
    /// If the features do not fit the network, or the pass not into memory.
    pub fn forward(
        self,
        features: Features<'_>,
        keep: bool,
        threads: Threads,
    ) -> Result<(Vec<Vec<f32>>, Option<Tape>), crate::Error> {
        self.check(&features)?;
        buffer::check_room(self.least_bytes(&features, keep))?;
        Ok(threads::team(self.useful(&features, threads), |team| {
            self.pass_forward(features, keep, team)
        }))
    }

    fn pass_forward(
        self,
        features: Features<'_>,
        keep: bool,
        team: &Team,
    ) -> (Vec<Vec<f32>>, Option<Tape>) {
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
            team,
        };
        pass.forward(
            &self.node_encoder,
            &encoder_inputs,
            &mut node_encoder,
            StoredMut::Numbers(&mut nodes),
        );

        let mut edges = Stored::default();
        let mut edge_encoder = None;
        let mut parts = Vec::new();
        if let (Some((values, graph)), Some(encoder)) = (features.edges, &self.edge_encoder) {
            let edge_count = graph.senders.len();
            parts = graph.parts();
            let rounded = encoder.precision() == Precision::Bf16;
            edges = Stored::any(edge_count * width, rounded && !keep);
            edge_encoder = rows(encoder, edge_count);
            let lengths: Vec<usize> = parts.iter().map(|part| part.edges.len()).collect();
            let pass = Pass {
                lengths: &lengths,
                rows: edge_count,
                team,
            };
            let inputs = [whole_input(encoder, values)];
            pass.forward(encoder, &inputs, &mut edge_encoder, edges.all());
        }

        let mut layers = Vec::new();
        for layer in self.layers {
            copy_weights(team, &layer, Linear::forward);
            let mut node = rows(&layer.node, count);
            let mut incoming = Buffer::default();
            let mut edge = None;
            if let (Some((_, graph)), Some(mlp)) = (features.edges, &layer.edge) {
                edge = rows(mlp, graph.senders.len());
                let projected = pass.project(mlp, &nodes, width);
                incoming = Buffer::zeros(count * width);
                let edge_pass = EdgePass {
                    mlp,
                    graph,
                    parts: &parts,
                    team,
                };
                edge_pass.forward(&projected, &mut edge, edges.all(), &mut incoming);
            }
            pass.update_nodes(&layer.node, &incoming, &mut nodes, &mut node);
            if let Some(node) = node {
                layers.push(LayerTape {
                    edge: edge.unwrap_or_default(),
                    node,
                });
            }
        }

        let mut heads = Vec::new();
        let outputs = (self.heads.iter())
            .map(|head| {
                let mut kept = rows(head, count);
                let mut out = vec![0.0; count * head.outputs()];
                let inputs = [whole_input(head, &nodes)];
                pass.forward(head, &inputs, &mut kept, StoredMut::Numbers(&mut out));
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
            edges: edges.into_whole(),
        });
        (outputs, tape)
    }

    /// The gradients that follow from those of the heads' outputs, after a forward pass over the
    /// same parameters and `features` that kept `tape`. With `alone`, the gradients of the heads
    /// behind the first end at the nodes' latents.
    ///
    /// # Errors
    ///
    /// If the features or the tape do not fit the network, or the gradients the heads.
    pub fn backward(
        self,
        features: Features<'_>,
        tape: &mut Tape,
        heads: &[&[f32]],
        alone: bool,
        threads: Threads,
    ) -> Result<Gradients, crate::Error> {
        self.check(&features)?;
        self.check_tape(&features, tape, heads)?;
        Ok(threads::team(self.useful(&features, threads), |team| {
            self.pass_backward(features, tape, heads, alone, team)
        }))
    }

    fn pass_backward(
        self,
        features: Features<'_>,
        tape: &mut Tape,
        heads: &[&[f32]],
        alone: bool,
        team: &Team,
    ) -> Gradients {
        let width = self.width();
        let count = self.node_count(&features);
        let lengths = lengths(count);
        let pass = Pass {
            lengths: &lengths,
            rows: count,
            team,
        };
        let mut parameters = vec![0.0; self.parameters()];
        let mut left = &mut parameters[..];
        // From the back.
        let mut put = |own: Buffer| {
            let from = left.len() - own.len();
            let place = left.split_off_mut(from..).expect("room for all parameters");
            place.copy_from_slice(&own);
        };

        let mut to_nodes = Buffer::zeros(count * width);
        let own = self.heads.iter().zip(&mut tape.heads).zip(heads);
        for (number, ((head, kept), gradient)) in own.enumerate().rev() {
            if alone && number == 0 {
                to_nodes.fill(0.0);
            }
            let inputs = [whole_input(head, &tape.nodes)];
            let mut targets = [(&mut to_nodes[..], 0)];
            put(pass.backward(head, &inputs, kept, gradient, &mut targets));
        }

        let mut nodes = Buffer::copy(&tape.nodes);
        let mut edges = Buffer::copy(&tape.edges);
        let mut to_edges = Buffer::zeros(edges.len());
        let parts = features.edges.map(|(_, graph)| graph.parts());
        for (layer, tape) in self.layers.into_iter().zip(&mut tape.layers).rev() {
            copy_weights(team, &layer, Linear::backward);
            pass.undo(&layer.node, &mut tape.node, &mut nodes);
            let edge_pass = match (features.edges, &layer.edge, &parts) {
                (Some((_, graph)), Some(mlp), Some(parts)) => Some(EdgePass {
                    mlp,
                    graph,
                    parts,
                    team,
                }),
                _ => None,
            };
            let incoming = (edge_pass.as_ref())
                .map(|edge_pass| edge_pass.undo(&mut tape.edge, &mut edges, count));
            let gradient = Buffer::copy(&to_nodes);
            let mut to_incoming = Buffer::zeros(incoming.as_ref().map_or(0, |rows| rows.len()));
            let column = layer.node.linears[0].inputs() - width;
            let own = Input {
                rows: &nodes,
                width,
                column,
            };
            let (inputs, mut targets) = if let Some(rows) = &incoming {
                let summed = Input {
                    rows,
                    width,
                    column: 0,
                };
                (
                    vec![summed, own],
                    vec![(&mut to_incoming[..], 0), (&mut to_nodes[..], column)],
                )
            } else {
                (vec![own], vec![(&mut to_nodes[..], column)])
            };
            put(pass.backward(
                &layer.node,
                &inputs,
                &mut tape.node,
                &gradient,
                &mut targets,
            ));
            if let Some(edge_pass) = edge_pass {
                let mut to_receivers = Buffer::zeros(count * width);
                let mut to_first = Buffer::any(edges.len());
                let mut of_edges = edge_pass.backward(
                    &mut tape.edge,
                    &edges,
                    &mut to_edges,
                    &to_incoming,
                    &mut to_receivers,
                    &mut to_first,
                );
                let of_nodes = pass.project_backward(
                    edge_pass.mlp,
                    edge_pass.graph,
                    &nodes,
                    &to_receivers,
                    &to_first,
                    &mut to_nodes,
                );
                rows::add(&mut of_edges, &of_nodes);
                put(of_edges);
            }
        }

        let mut by_edges = Vec::new();
        if let (Some((values, _)), Some(encoder), Some(parts)) =
            (features.edges, &self.edge_encoder, &parts)
        {
            let lengths: Vec<usize> = parts.iter().map(|part| part.edges.len()).collect();
            let edge_count = lengths.iter().sum();
            by_edges = vec![0.0; values.len()];
            put(Pass {
                lengths: &lengths,
                rows: edge_count,
                team,
            }
            .backward(
                encoder,
                &[whole_input(encoder, values)],
                &mut tape.edge_encoder,
                &to_edges,
                &mut [(&mut by_edges[..], 0)],
            ));
        }
        let mut by_nodes = vec![0.0; features.nodes.len()];
        put(pass.backward(
            &self.node_encoder,
            &[whole_input(&self.node_encoder, features.nodes)],
            &mut tape.node_encoder,
            &to_nodes,
            &mut [(&mut by_nodes[..], 0)],
        ));
        Gradients {
            parameters,
            nodes: by_nodes,
            edges: by_edges,
        }
    }
}

impl Edges<'_> {
    /// Parts of whole receivers with about as many edges each.
    fn parts(&self) -> Vec<Part> {
        let count = self.senders.len();
        let size = count.div_ceil(part_count(count, EDGES)).max(1);
        let mut parts = Vec::new();
        let (mut node, mut edge) = (0, 0);
        for (next, &end) in self.offsets.iter().enumerate().skip(1) {
            let end = end as usize;
            if end / size > edge / size || next == self.offsets.len() - 1 {
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

/// Among how many parts `count` rows are shared out, of which `least` are worth one.
fn part_count(count: usize, least: usize) -> usize {
    let parts = (count / least).clamp(1, PARTS);
    if parts < EVEN {
        parts
    } else {
        parts / EVEN * EVEN
    }
}

/// How many nodes each part has.
fn lengths(count: usize) -> Vec<usize> {
    let size = count.div_ceil(part_count(count, NODES)).max(1);
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

/// What each part keeps of its rows, or of what passes where nothing goes backward.
fn kept_parts<'k>(
    mlp: &Mlp<'_>,
    kept: &'k mut Option<Kept>,
    lengths: &[usize],
    rows: usize,
) -> Vec<KeptPart<'k>> {
    match kept {
        Some(kept) => kept.parts(lengths, rows),
        None => lengths.iter().map(|&length| mlp.passing(length)).collect(),
    }
}

/// Row after row of nodes or edges, part by part.
struct Pass<'p> {
    lengths: &'p [usize],
    rows: usize,
    team: &'p Team,
}

impl Pass<'_> {
    /// `out` becomes the perceptron of the rows of `inputs`.
    fn forward(
        &self,
        mlp: &Mlp<'_>,
        inputs: &[Input<'_>],
        kept: &mut Option<Kept>,
        out: StoredMut<'_>,
    ) {
        let width = mlp.outputs();
        let items: Vec<_> = starts(self.lengths)
            .zip(kept_parts(mlp, kept, self.lengths, self.rows))
            .zip(out.parts(self.lengths, self.rows))
            .collect();
        self.team.map(items, |((start, mut kept), mut out)| {
            for (first, count) in blocks(out.len() / width) {
                let inputs: Vec<_> = inputs
                    .iter()
                    .map(|input| input.block(start + first, count))
                    .collect();
                let mut out = out.block(first * width..(first + count) * width);
                mlp.forward(
                    &inputs,
                    |_, bias| Start::Row(bias),
                    &mut kept.block(first, count),
                    out.numbers,
                );
                out.put();
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
            .zip(kept_parts(mlp, kept, self.lengths, self.rows))
            .zip(split(nodes, self.lengths, self.rows))
            .collect();
        self.team.map(items, |((start, mut kept), nodes)| {
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
                let mut kept = kept.block(first, count);
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

    /// Takes from `nodes` what [`Self::update_nodes`] has added.
    fn undo(&self, mlp: &Mlp<'_>, kept: &mut Kept, nodes: &mut [f32]) {
        let width = mlp.outputs();
        let items: Vec<_> = (kept.parts(self.lengths, self.rows).into_iter())
            .zip(split(nodes, self.lengths, self.rows))
            .collect();
        self.team.map(items, |(mut kept, nodes)| {
            let mut update = Buffer::any(BLOCK * width);
            let rows = nodes.len() / width;
            for ((first, count), nodes) in blocks(rows).zip(nodes.chunks_mut(BLOCK * width)) {
                let update = &mut update[..nodes.len()];
                mlp.outputs_again(kept.normalized(first, count), update);
                rows::subtract(nodes, update);
            }
        });
    }

    /// The node parts of the first map of an edge perceptron: `[N, 2 width]`, what a node gives to
    /// the edges it receives, then what it gives to those it sends.
    fn project(&self, mlp: &Mlp<'_>, nodes: &[f32], width: usize) -> Buffer {
        let mut out = Buffer::any(2 * nodes.len());
        let first = &mlp.linears[0];
        let items: Vec<_> = starts(self.lengths)
            .zip(split(&mut out, self.lengths, self.rows))
            .collect();
        self.team.map(items, |(start, out)| {
            let count = out.len() / (2 * width);
            let nodes = Matrix::new(&nodes[start * width..(start + count) * width], width);
            for end in 0..2 {
                let weight = first.forward().rows(end * width, width);
                let out = out.get_mut(end * width..).unwrap_or_default();
                weight.product(out, 2 * width, Start::Zero, nodes, End::Whole);
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
        let widest = mlp.widest();
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
        total(
            self.team,
            mlp,
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
                    let mut kept = kept.block(first, count);
                    let buffers = [&mut here[..], &mut there[..]];
                    let before = mlp.backward(&inputs, &mut kept, count, buffers, &mut sum);
                    for ((target, column), input) in targets.iter_mut().zip(&inputs) {
                        let target =
                            &mut target[first * input.width..(first + count) * input.width];
                        mlp.add_input_gradient(before, *column, input.width, target);
                    }
                }
                sum
            },
        )
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
        total(self.team, mlp, items, |(start, to_nodes)| {
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
                mlp.linears[0].add_product(&mut sum[end * width..], columns, outer, inner);
                mlp.add_input_gradient(gradient, end * width, width, to_nodes);
            }
            sum
        })
    }
}

/// Copies the weights of `layer` for the products of a `way`, on all threads: one that waits for
/// another's copy sleeps for longer than that takes. (In bf16 parts of weights whose widths are no
/// multiple of a tile's are copied later.)
fn copy_weights<'n>(team: &Team, layer: &Layer<'n>, way: for<'l> fn(&'l Linear<'n>) -> Factor<'l>) {
    let mlps = layer.edge.iter().chain([&layer.node]);
    let linears = mlps.flat_map(|mlp| &mlp.linears).collect();
    team.map(linears, |linear| way(linear).copy());
}

/// An edge perceptron over all edges, part by part.
struct EdgePass<'p> {
    mlp: &'p Mlp<'p>,
    graph: Edges<'p>,
    parts: &'p [Part],
    team: &'p Team,
}

impl EdgePass<'_> {
    /// How many edges and how many nodes each part has.
    fn part_lengths(&self) -> (Vec<usize>, Vec<usize>) {
        (self.parts.iter())
            .map(|part| (part.edges.len(), part.nodes.len()))
            .unzip()
    }

    /// Adds its message to every edge, and the sum of a receiver's messages to `incoming`.
    fn forward(
        &self,
        projected: &[f32],
        kept: &mut Option<Kept>,
        edges: StoredMut<'_>,
        incoming: &mut [f32],
    ) {
        let &Self {
            mlp, graph, team, ..
        } = self;
        let width = mlp.outputs();
        let (lengths, nodes) = self.part_lengths();
        let count = graph.senders.len();
        let items: Vec<_> = (self.parts.iter())
            .zip(kept_parts(mlp, kept, &lengths, count))
            .zip(edges.parts(&lengths, count))
            .zip(split(incoming, &nodes, graph.offsets.len() - 1))
            .collect();
        team.map(items, |(((part, mut kept), mut edges), incoming)| {
            let mut messages = Buffer::any(BLOCK * width);
            for (first, count) in blocks(part.edges.len()) {
                let mut edges = edges.block(first * width..(first + count) * width);
                edges.take();
                let here = part.edges.start + first..part.edges.start + first + count;
                let (senders, receivers) = (&graph.senders[here.clone()], &graph.receivers[here]);
                let messages = &mut messages[..count * width];
                let own = Input {
                    rows: edges.numbers,
                    width,
                    column: 2 * width,
                };
                mlp.forward(
                    &[own],
                    |rows, bias| {
                        rows::gather_ends(rows, bias, projected, receivers, senders);
                        Start::There
                    },
                    &mut kept.block(first, count),
                    messages,
                );
                rows::add(edges.numbers, messages);
                edges.put();
                rows::add_at(incoming, width, messages, receivers, part.nodes.start);
            }
        });
    }

    /// Takes from `edges` what [`Self::forward`] has added; its sums at the `nodes` receivers.
    fn undo(&self, kept: &mut Kept, edges: &mut [f32], nodes: usize) -> Buffer {
        let &Self {
            mlp, graph, team, ..
        } = self;
        let width = mlp.outputs();
        let mut incoming = Buffer::zeros(nodes * width);
        let (lengths, of_nodes) = self.part_lengths();
        let count = graph.senders.len();
        let items: Vec<_> = (self.parts.iter())
            .zip(kept.parts(&lengths, count))
            .zip(split(edges, &lengths, count))
            .zip(split(&mut incoming, &of_nodes, nodes))
            .collect();
        team.map(items, |(((part, mut kept), edges), incoming)| {
            let mut messages = Buffer::any(BLOCK * width);
            for ((first, count), edges) in
                blocks(part.edges.len()).zip(edges.chunks_mut(BLOCK * width))
            {
                let messages = &mut messages[..edges.len()];
                mlp.outputs_again(kept.normalized(first, count), messages);
                rows::subtract(edges, messages);
                let row = part.edges.start + first;
                let receivers = &graph.receivers[row..row + count];
                rows::add_at(incoming, width, messages, receivers, part.nodes.start);
            }
        });
        incoming
    }

    /// The way back through [`Self::forward`] from the `edges` before it: `to_edges` become the
    /// gradients of these; `to_first` becomes that of the first map's outputs, `to_receivers` its
    /// sums at the receivers. The gradients of the parameters, without the node parts of the first
    /// map.
    fn backward(
        &self,
        kept: &mut Kept,
        edges: &[f32],
        to_edges: &mut [f32],
        to_incoming: &[f32],
        to_receivers: &mut [f32],
        to_first: &mut [f32],
    ) -> Buffer {
        let &Self {
            mlp, graph, team, ..
        } = self;
        let width = mlp.outputs();
        let (lengths, nodes) = self.part_lengths();
        let count = graph.senders.len();
        let items: Vec<_> = (self.parts.iter())
            .zip(kept.parts(&lengths, count))
            .zip(split(to_edges, &lengths, count))
            .zip(split(to_first, &lengths, count))
            .zip(split(to_receivers, &nodes, graph.offsets.len() - 1))
            .collect();
        total(team, mlp, items, |item| {
            let ((((part, mut kept), to_edges), to_first), to_receivers) = item;
            let mut sum = Buffer::zeros(mlp.parameters());
            let (mut here, mut there) = (Buffer::any(BLOCK * width), Buffer::any(BLOCK * width));
            for (first, count) in blocks(part.edges.len()) {
                let row = part.edges.start + first;
                let receivers = &graph.receivers[row..row + count];
                let range = first * width..(first + count) * width;
                let to_edges = &mut to_edges[range.clone()];
                let mut kept = kept.block(first, count);
                here[..count * width].copy_from_slice(to_edges);
                rows::add_from(&mut here[..count * width], width, to_incoming, receivers);
                let own = Input {
                    rows: &edges[row * width..(row + count) * width],
                    width,
                    column: 2 * width,
                };
                let buffers = [&mut here[..], &mut there[..]];
                let before = mlp.backward(&[own], &mut kept, count, buffers, &mut sum);
                mlp.add_input_gradient(before, 2 * width, width, to_edges);
                to_first[range].copy_from_slice(before);
                rows::add_at(to_receivers, width, before, receivers, part.nodes.start);
            }
            sum
        })
    }
}

/// The parts' sums, as `of_part` gives them, added up in order; of no parts, 0 for each parameter of
/// `mlp`.
fn total<I: Send>(
    team: &Team,
    mlp: &Mlp<'_>,
    parts: Vec<I>,
    of_part: impl Fn(I) -> Buffer + Sync,
) -> Buffer {
    let sum = team.reduce(parts, of_part, |mut total, sum| {
        rows::add(&mut total, &sum);
        total
    });
    sum.unwrap_or_else(|| Buffer::zeros(mlp.parameters()))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::bf16::Right;
    use super::rows::{MOST, Processor};
    use super::*;

    #[test]
    fn parts_are_of_whole_receivers_with_edges() {
        let hub = |at: usize| {
            (0..2_000).map(move |i| {
                if i == at {
                    60_000
                } else {
                    i64::from(i % 9 == 0)
                }
            })
        };
        let cases: [Vec<i64>; 6] = [
            vec![],
            vec![0; 300],
            vec![6; 5_000],
            hub(0).collect(),
            hub(1_000).collect(),
            (0..300).map(|i| if i < 256 { 4 } else { 0 }).collect(),
        ];
        for degrees in cases {
            let ends = degrees.iter().scan(0, |end, degree| {
                *end += degree;
                Some(*end)
            });
            let offsets: Vec<i64> = [0].into_iter().chain(ends).collect();
            let senders = vec![0; offsets[degrees.len()] as usize];
            let edges = Edges {
                senders: &senders,
                receivers: &senders,
                offsets: &offsets,
                by_sender: &[],
                sender_offsets: &[],
            };
            let parts = edges.parts();
            assert!(parts.len() <= PARTS + 1);
            let (mut node, mut edge) = (0, 0);
            for (i, part) in parts.iter().enumerate() {
                assert_eq!((part.nodes.start, part.edges.start), (node, edge));
                assert_eq!(part.edges.end, offsets[part.nodes.end] as usize);
                assert!(!part.edges.is_empty() || i + 1 == parts.len());
                (node, edge) = (part.nodes.end, part.edges.end);
            }
            assert_eq!((node, edge), (degrees.len(), senders.len()));
        }
    }

    /// Numbers from -1 to 1 that follow from the seed.
    fn numbers(seed: u64, count: usize) -> Vec<f32> {
        let mut state = seed.wrapping_mul(2).wrapping_add(1);
        (0..count)
            .map(|_| {
                state = state
                    .wrapping_mul(6_364_136_223_846_793_005)
                    .wrapping_add(1);
                (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0
            })
            .collect()
    }

    /// Kinds of processors, and whether they have tiles.
    const PROCESSORS: [(Processor, bool); 4] = [
        (Processor::Plain, false),
        (Processor::V3, false),
        (Processor::V4, false),
        (Processor::V4, true),
    ];

    /// Lets this thread use no more of its processor than that.
    fn be((most, tiles): (Processor, bool)) {
        MOST.set(most);
        #[cfg(target_arch = "x86_64")]
        amx::TILES.set(tiles);
    }

    fn be_whole() {
        be(PROCESSORS[3]);
    }

    type Product = fn(&mut [f32], usize, Start<'_>, Matrix<'_>, Matrix<'_>, End<'_>);

    /// A product and all that it is made of.
    #[derive(Debug)]
    struct Case {
        rows: usize,
        inner: usize,
        columns: usize,
        gap: usize,
        transposed: bool,
        start: usize,
        end: usize,
        seed: u64,
    }

    fn cases(rows: usize, inner: usize, columns: usize) -> impl Strategy<Value = Case> {
        let sizes = (0..rows, 0..inner, 1..columns, 0usize..3);
        let how = (any::<bool>(), 0usize..3, 0usize..3, any::<u64>());
        (sizes, how).prop_map(
            |((rows, inner, columns, gap), (transposed, start, end, seed))| Case {
                rows,
                inner,
                columns,
                gap,
                transposed,
                start,
                end,
                seed,
            },
        )
    }

    impl Case {
        /// What `product` gives is what it should, of factors that `round` has gone over, to
        /// `error`.
        fn check(
            &self,
            product: Product,
            round: fn(&mut [f32]),
            error: f64,
        ) -> Result<(), TestCaseError> {
            let &Self {
                rows,
                inner,
                columns,
                transposed,
                seed,
                ..
            } = self;
            let mut left = numbers(seed, rows * inner);
            let mut right = numbers(seed ^ 1, inner * columns);
            let row = numbers(seed ^ 2, columns);
            let stride = columns + self.gap;
            let before = numbers(seed ^ 3, rows * stride);
            let mut out = before.clone();
            let a = if transposed {
                Matrix::new(&left, rows.max(1)).transposed()
            } else {
                Matrix::new(&left, inner.max(1))
            };
            let start = [Start::There, Start::Zero, Start::Row(&row)][self.start];
            let like = numbers(seed ^ 4, rows * stride);
            let end = [End::Whole, End::Relu, End::WherePositive(&like)][self.end];
            if rows > 0 && inner > 0 {
                product(
                    &mut out,
                    stride,
                    start,
                    a,
                    Matrix::new(&right, columns),
                    end,
                );
            }
            round(&mut left);
            round(&mut right);
            for i in 0..rows {
                for j in 0..stride {
                    let was = f64::from(before[i * stride + j]);
                    let mut expected = was;
                    if inner > 0 && j < columns {
                        expected = match start {
                            Start::There => was,
                            Start::Zero => 0.0,
                            Start::Row(row) => f64::from(row[j]),
                        };
                        for k in 0..inner {
                            let place = if transposed {
                                k * rows + i
                            } else {
                                i * inner + k
                            };
                            expected += f64::from(left[place]) * f64::from(right[k * columns + j]);
                        }
                        expected = match end {
                            End::Whole => expected,
                            End::Relu => expected.max(0.0),
                            End::WherePositive(like) if like[i * stride + j] > 0.0 => expected,
                            End::WherePositive(_) => 0.0,
                        };
                    }
                    prop_assert!((f64::from(out[i * stride + j]) - expected).abs() < error);
                }
            }
            Ok(())
        }
    }

    proptest! {
        #[test]
        fn copies_lie_as_they_should(
            rows in 1usize..40, columns in 1usize..40, gap in 0usize..3, transposed: bool,
        ) {
            let data = numbers(1, rows * columns);
            let matrix = Matrix::new(&data, columns);
            let matrix = if transposed { matrix.transposed() } else { matrix };
            let (rows, columns) = matrix.size();
            let stride = columns + gap;
            let mut out = vec![2.0; rows * stride - gap];
            matrix.copy_to(&mut out, stride);
            for (i, row) in out.chunks(stride).enumerate() {
                for (j, &x) in row.iter().enumerate() {
                    let place = if transposed { j * rows + i } else { i * columns + j };
                    prop_assert_eq!(x, if j < columns { data[place] } else { 2.0 });
                }
            }
        }

        #[test]
        fn products_are_sums_of_products(case in cases(21, 9, 130), kind in 0usize..3) {
            be(PROCESSORS[kind]);
            case.check(matrix::product, |_| {}, 1e-5)?;
            be_whole();
        }

        #[test]
        fn products_in_bf16_are_those_of_rounded_numbers(
            case in cases(140, 90, 130), kind in 0usize..4,
        ) {
            be(PROCESSORS[kind]);
            case.check(
                |out, stride, start, a, b, end| {
                    bf16::product(out, stride, start, a, Right::Fresh(b), end);
                },
                bf16::round,
                2e-5,
            )?;
            be_whole();
        }
    }

    /// More of the inner size than is packed at once.
    #[test]
    fn long_sums_in_bf16() {
        let case = |transposed| Case {
            rows: 35,
            inner: 1_100,
            columns: 20,
            gap: 1,
            transposed,
            start: 2,
            end: 1,
            seed: 5,
        };
        for kind in PROCESSORS {
            be(kind);
            for transposed in [false, true] {
                let product = |out: &mut _,
                               stride,
                               start: Start<'_>,
                               a: Matrix<'_>,
                               b: Matrix<'_>,
                               end: End<'_>| {
                    bf16::product(out, stride, start, a, Right::Fresh(b), end);
                };
                case(transposed).check(product, bf16::round, 3e-4).unwrap();
            }
        }
        be_whole();
    }

    /// Some rows and columns of a weight, whether they begin with tiles or not.
    #[test]
    fn parts_of_weights_in_bf16() {
        let (inputs, outputs) = (96, 40);
        let mut weight = numbers(1, inputs * outputs);
        let (bias, mut rows) = (vec![0.0; outputs], numbers(2, 5 * inputs));
        for kind in PROCESSORS {
            be(kind);
            let linear = Linear::new(&weight, &bias, Precision::Bf16);
            for (first, count) in [(0, 96), (32, 64), (64, 32), (32, 32), (20, 30), (64, 20)] {
                let mut out = vec![0.0; 5 * outputs];
                let part = Matrix::new(&rows, inputs).columns(first, count);
                let factor = linear.forward().rows(first, count);
                factor.product(&mut out, outputs, Start::Zero, part, End::Whole);
                for i in 0..5 {
                    for o in 0..outputs {
                        let product = |k| {
                            let mut pair = [rows[i * inputs + k], weight[o * inputs + k]];
                            bf16::round(&mut pair);
                            f64::from(pair[0]) * f64::from(pair[1])
                        };
                        let expected: f64 = (first..first + count).map(product).sum();
                        let off = (f64::from(out[i * outputs + o]) - expected).abs();
                        assert!(off < 2e-5, "{kind:?}, rows {first} to {}", first + count);
                    }
                }
            }
        }
        be_whole();
        // Not only of numbers that are rounded.
        assert!(
            weight
                .iter()
                .chain(&rows)
                .any(|x| x.to_bits() & 0xffff != 0)
        );
        bf16::round(&mut weight);
        bf16::round(&mut rows);
        assert!(
            weight
                .iter()
                .chain(&rows)
                .all(|x| x.to_bits() & 0xffff == 0)
        );
    }

    #[test]
    fn rounding_is_to_the_nearest_and_keeps_what_is_not_a_number() {
        let mut values = [
            1.0,
            1.0 + 1.0 / 256.0,
            1.0 + 3.0 / 256.0,
            -1.005,
            f32::INFINITY,
            f32::MAX,
        ];
        bf16::round(&mut values);
        assert_eq!(
            values,
            [
                1.0,
                1.0,
                1.015_625,
                -1.007_812_5,
                f32::INFINITY,
                f32::INFINITY
            ]
        );
        let mut nan = [
            f32::NAN,
            -f32::NAN,
            f32::from_bits(0x7fff_ffff),
            f32::from_bits(0x7f80_0001),
        ];
        bf16::round(&mut nan);
        assert!(nan.iter().all(|x| x.is_nan()), "{nan:?}");
    }

    #[test]
    fn nan_stays_and_is_not_positive() {
        for most in PROCESSORS {
            be(most);
            for columns in [1, 8, 16, 32] {
                let (nan, one) = (vec![f32::NAN; columns], [1.0]);
                let (nans, ones) = (Matrix::new(&nan, columns), Matrix::new(&one, 1));
                let products: [Product; 2] = [matrix::product, |out, stride, start, a, b, end| {
                    bf16::product(out, stride, start, a, Right::Fresh(b), end);
                }];
                for product in products {
                    let mut out = vec![0.0; columns];
                    product(&mut out, columns, Start::Zero, ones, nans, End::Relu);
                    assert!(out.iter().all(|x| x.is_nan()), "{most:?}, {columns}");
                    let end = End::WherePositive(&nan);
                    product(&mut out, columns, Start::Row(&[1.0; 32]), ones, nans, end);
                    assert!(out.iter().all(|&x| x == 0.0), "{most:?}, {columns}");
                }
            }
            be_whole();
        }
    }

    /// Of a network of two steps on a ring of `nodes`, the outputs, the gradients of their sum, and
    /// the outputs of a pass that keeps nothing.
    fn ring(nodes: usize, width: usize, precision: Precision, threads: Threads) -> [Vec<f32>; 3] {
        let ends: Vec<i64> = (0..nodes as i64).collect();
        let senders: Vec<i64> = ends.iter().map(|i| (i + 1) % nodes as i64).collect();
        let offsets: Vec<i64> = (0..=nodes as i64).collect();
        let by_sender: Vec<i64> = ends
            .iter()
            .map(|i| (i + nodes as i64 - 1) % nodes as i64)
            .collect();
        let sizes = [
            [3, width, width],
            [2, width, width],
            [3 * width, width, width],
            [2 * width, width, width],
            [3 * width, width, width],
            [2 * width, width, width],
            [width, width, 2],
        ];
        let data: Vec<Vec<Vec<f32>>> = (sizes.iter().enumerate())
            .map(|(i, sizes)| {
                let seed = 100 * i as u64;
                let [first, middle, last] = *sizes;
                vec![
                    numbers(seed, first * middle),
                    numbers(seed + 1, middle),
                    numbers(seed + 2, middle * last),
                    numbers(seed + 3, last),
                    numbers(seed + 4, last),
                    numbers(seed + 5, last),
                ]
            })
            .collect();
        let network = || {
            let mut mlps = data.iter().enumerate().map(|(i, data)| Mlp {
                linears: vec![
                    Linear::new(&data[0], &data[1], precision),
                    Linear::new(&data[2], &data[3], precision),
                ],
                norm: (i < 6).then(|| Norm {
                    scale: &data[4],
                    shift: &data[5],
                }),
            });
            let mut next = || mlps.next().expect("as many as sizes");
            Network {
                node_encoder: next(),
                edge_encoder: Some(next()),
                layers: (0..2)
                    .map(|_| Layer {
                        edge: Some(next()),
                        node: next(),
                    })
                    .collect(),
                heads: vec![next()],
            }
        };
        let (node_features, edge_features) = (numbers(7, nodes * 3), numbers(8, nodes * 2));
        let features = Features {
            nodes: &node_features,
            edges: Some((
                &edge_features,
                Edges {
                    senders: &senders,
                    receivers: &ends,
                    offsets: &offsets,
                    by_sender: &by_sender,
                    sender_offsets: &offsets,
                },
            )),
        };
        let (out, tape) = network().forward(features, true, threads).unwrap();
        let ones = vec![1.0; out[0].len()];
        let mut tape = tape.unwrap();
        let gradients = network()
            .backward(features, &mut tape, &[&ones], false, threads)
            .unwrap();
        let all = [gradients.parameters, gradients.nodes, gradients.edges].concat();
        let (alone, _) = network().forward(features, false, threads).unwrap();
        [out.concat(), all, alone.concat()]
    }

    #[test]
    fn any_number_of_threads_gives_the_same_bits() {
        let one = Threads::AtMost(std::num::NonZeroUsize::MIN);
        for precision in [Precision::Float32, Precision::Bf16] {
            let run = |threads| ring(1_000, 32, precision, threads);
            assert!(run(one) == run(Threads::All), "{precision:?}");
        }
    }

    /// Of the sums of squares, how much two results differ.
    fn difference(one: &[f32], other: &[f32]) -> f32 {
        let norm = |values: &mut dyn Iterator<Item = f32>| values.map(|x| x * x).sum::<f32>();
        let off = norm(&mut one.iter().zip(other).map(|(a, b)| a - b));
        off / norm(&mut one.iter().copied())
    }

    #[test]
    fn every_kind_of_processor_gives_the_same() {
        let one = Threads::AtMost(std::num::NonZeroUsize::MIN);
        // What is rounded to bf16 may fall on either side of where sums end.
        for (precision, error) in [(Precision::Float32, 1e-8), (Precision::Bf16, 1e-4)] {
            for width in [20, 32] {
                let best = ring(300, width, precision, one);
                for most in PROCESSORS {
                    be(most);
                    let other = ring(300, width, precision, one);
                    be_whole();
                    for (best, other) in best.iter().zip(&other) {
                        assert!(difference(best, other) < error, "{most:?}, {width}");
                    }
                }
            }
        }
    }

    #[test]
    fn bf16_is_float32_but_for_its_rounding() {
        let one = Threads::AtMost(std::num::NonZeroUsize::MIN);
        let [exact, rounded] =
            [Precision::Float32, Precision::Bf16].map(|precision| ring(300, 32, precision, one));
        for (exact, rounded) in exact.iter().zip(&rounded) {
            let off = difference(exact, rounded);
            assert!(1e-8 < off && off < 1e-3, "{off}");
        }
        // Latents of edges are rounded where nothing goes backward.
        assert!(exact[0] == exact[2] && rounded[0] != rounded[2]);
    }

    #[test]
    fn packed_numbers_are_rounded_ones() {
        let values = numbers(3, 55);
        for packed in [false, true] {
            let mut stored = Stored::any(55, packed);
            let mut all = stored.all();
            let mut block = all.block(0..55);
            block.numbers.copy_from_slice(&values);
            block.put();
            let mut parts = stored.all().parts(&[4, 7], 11).into_iter();
            for place in [0..20, 20..55] {
                let mut part = parts.next().unwrap();
                assert_eq!(part.len(), place.len());
                let mut rows = part.rows(1, 3, place.len() / 5);
                rows.take();
                let put = &values[place][5..20];
                let mut expected = put.to_vec();
                if packed {
                    bf16::round(&mut expected);
                    assert!(expected != put);
                }
                assert!(rows.numbers == expected);
            }
        }
    }

    /// Of a perceptron of three maps in bf16, with what is kept in memory or with what passes.
    #[test]
    fn what_is_kept_in_bf16_is_what_products_take() {
        let (rows, width) = (37, 33);
        let data: Vec<_> = (0..8).map(|seed| numbers(seed, rows * width)).collect();
        let row = |seed: usize| &data[seed][..width];
        for kind in PROCESSORS {
            be(kind);
            let linear = |seed: usize| {
                let weight = &data[seed][..width * width];
                Linear::new(weight, row(seed + 1), Precision::Bf16)
            };
            let mlp = Mlp {
                linears: (0..3).map(linear).collect(),
                norm: Some(Norm {
                    scale: row(4),
                    shift: row(5),
                }),
            };
            let input = Input {
                rows: &data[6],
                width,
                column: 0,
            };
            let pass = |part: &mut KeptPart<'_>| {
                let mut out = vec![0.0; rows * width];
                mlp.forward(
                    &[input],
                    |_, bias| Start::Row(bias),
                    &mut part.block(0, rows),
                    &mut out,
                );
                let mut gradient = data[7].clone();
                let mut spare = vec![0.0; rows * width];
                let mut sum = vec![0.0; mlp.parameters()];
                let buffers = [&mut gradient[..], &mut spare[..]];
                let mut kept = part.block(0, rows);
                let first = mlp.backward(&[input], &mut kept, rows, buffers, &mut sum);
                [out, first.to_vec(), sum]
            };
            let mut kept = mlp.kept(rows);
            let kept = pass(&mut kept.parts(&[rows], rows)[0]);
            assert!(kept == pass(&mut mlp.passing(rows)), "{kind:?}");
            assert!(kept.iter().all(|of| of.iter().any(|&x| x != 0.0)));
        }
        be_whole();
    }
}
