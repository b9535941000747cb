//! Whether what a caller hands in fits together, so that nothing behind it can fail.

use super::mlp::{Linear, Mlp};
use super::{Edges, Features, Network, Tape};
use crate::Error;

impl Network<'_> {
    /// How many nodes there are.
    pub(super) fn node_count(&self, features: &Features<'_>) -> usize {
        features.nodes.len() / self.node_encoder.linears[0].inputs()
    }

    pub(super) fn check(&self, features: &Features<'_>) -> Result<(), Error> {
        check_mlp(&self.node_encoder, None)?;
        let width = self.width();
        let inputs = self.node_encoder.linears[0].inputs();
        require(
            features.nodes.len().is_multiple_of(inputs),
            "node_features",
            || {
                format!(
                    "got {} numbers, must be rows of {inputs}",
                    features.nodes.len()
                )
            },
        )?;
        let with_edges = self.edge_encoder.is_some();
        for layer in &self.layers {
            if let Some(edge) = &layer.edge {
                check_mlp(edge, Some(3 * width))?;
                let outputs: Vec<usize> = edge.linears.iter().map(Linear::outputs).collect();
                require(
                    outputs.iter().all(|&own| own == width),
                    "perceptrons",
                    || format!("got maps of {outputs:?} outputs for edges, must be {width}"),
                )?;
            }
            let summands = if with_edges { 2 } else { 1 };
            check_mlp(&layer.node, Some(summands * width))?;
            for mlp in layer.edge.iter().chain([&layer.node]) {
                require(mlp.outputs() == width, "perceptrons", || {
                    format!("got a layer of {} outputs, must be {width}", mlp.outputs())
                })?;
                require(mlp.norm.is_some(), "perceptrons", || {
                    "got a layer without a LayerNorm".into()
                })?;
            }
            require(layer.edge.is_some() == with_edges, "perceptrons", || {
                "got layers with edges and without".into()
            })?;
        }
        for head in &self.heads {
            check_mlp(head, Some(width))?;
        }
        match (&self.edge_encoder, features.edges) {
            (None, None) => Ok(()),
            (Some(encoder), Some((values, edges))) => {
                check_mlp(encoder, None)?;
                require(encoder.outputs() == width, "perceptrons", || {
                    format!("got edge latents of {}, must be {width}", encoder.outputs())
                })?;
                let inputs = encoder.linears[0].inputs();
                require(
                    values.len() == edges.senders.len() * inputs,
                    "edge_features",
                    || {
                        let count = edges.senders.len();
                        format!("got {} numbers for {count} edges of {inputs}", values.len())
                    },
                )?;
                edges.check(self.node_count(features))
            }
            _ => Err(Error::invalid(
                "edge_features",
                "must be there for a network with edges, and only for one",
            )),
        }
    }

    pub(super) fn check_tape(
        &self,
        features: &Features<'_>,
        tape: &Tape,
        gradients: &[&[f32]],
    ) -> Result<(), Error> {
        let count = self.node_count(features);
        let edges = features.edges.map_or(0, |(_, edges)| edges.senders.len());
        let width = self.width();
        let mut layers = self.layers.iter().zip(&tape.layers);
        require(
            tape.nodes.len() == count * width
                && tape.edges.len() == edges * width
                && tape.layers.len() == self.layers.len()
                && tape.heads.len() == self.heads.len()
                && self.node_encoder.fits(&tape.node_encoder, count)
                && (self.edge_encoder.iter()).all(|mlp| mlp.fits(&tape.edge_encoder, edges))
                && layers.all(|(layer, kept)| {
                    layer.node.fits(&kept.node, count)
                        && layer.edge.iter().all(|mlp| mlp.fits(&kept.edge, edges))
                })
                && (self.heads.iter().zip(&tape.heads)).all(|(mlp, kept)| mlp.fits(kept, count)),
            "tape",
            || "comes from another network or other features".into(),
        )?;
        let fit = gradients.len() == self.heads.len()
            && (self.heads.iter().zip(gradients))
                .all(|(head, gradient)| gradient.len() == count * head.outputs());
        require(fit, "gradients", || {
            format!("must be one per head, {count} rows each")
        })?;
        match features.edges {
            Some((_, edges)) => edges.check_senders(count),
            None => Ok(()),
        }
    }
}

impl Edges<'_> {
    fn check(&self, nodes: usize) -> Result<(), Error> {
        let count = self.senders.len();
        let inside = |&node: &i64| (0..nodes as i64).contains(&node);
        require(self.senders.iter().all(inside), "senders", || {
            format!("must be nodes, 0 to {nodes} exclusive")
        })?;
        require(self.receivers.len() == count, "receivers", || {
            format!("got {} of {count} edges", self.receivers.len())
        })?;
        check_offsets("offsets", self.offsets, nodes, count)?;
        let sorted = self.offsets.windows(2).enumerate().all(|(node, pair)| {
            (self.receivers[pair[0] as usize..pair[1] as usize].iter())
                .all(|&receiver| receiver == node as i64)
        });
        require(sorted, "receivers", || {
            "must be sorted, as the offsets say".into()
        })
    }

    fn check_senders(&self, nodes: usize) -> Result<(), Error> {
        let count = self.senders.len();
        check_offsets("sender_offsets", self.sender_offsets, nodes, count)?;
        let inside = |&edge: &i64| (0..count as i64).contains(&edge);
        require(
            self.by_sender.len() == count && self.by_sender.iter().all(inside),
            "by_sender",
            || format!("must list the {count} edges"),
        )?;
        // Each of a sender's edges once, in order.
        let sorted = self
            .sender_offsets
            .windows(2)
            .enumerate()
            .all(|(node, pair)| {
                let own = &self.by_sender[pair[0] as usize..pair[1] as usize];
                own.is_sorted_by(|one, next| one < next)
                    && own
                        .iter()
                        .all(|&edge| self.senders[edge as usize] == node as i64)
            });
        require(sorted, "by_sender", || {
            "must be the edges in the order of their senders".into()
        })
    }
}

fn check_offsets(
    name: &'static str,
    offsets: &[i64],
    nodes: usize,
    edges: usize,
) -> Result<(), Error> {
    let fit = offsets.len() == nodes + 1
        && offsets.is_sorted()
        && offsets[0] == 0
        && offsets[nodes] == edges as i64;
    require(fit, name, || {
        format!("must rise from 0 to {edges} in {} numbers", nodes + 1)
    })
}

/// Whether the maps fit one behind the other, and the first one `inputs` where they are given.
fn check_mlp(mlp: &Mlp<'_>, inputs: Option<usize>) -> Result<(), Error> {
    require(!mlp.linears.is_empty(), "perceptrons", || {
        "got a perceptron with no map".into()
    })?;
    let mut width = inputs;
    for linear in &mlp.linears {
        let (weights, outputs) = (linear.weight.len(), linear.outputs());
        require(
            outputs > 0 && weights > 0 && weights.is_multiple_of(outputs),
            "perceptrons",
            || format!("got {weights} weights for {outputs} biases"),
        )?;
        require(
            width.is_none_or(|width| width == linear.inputs()),
            "perceptrons",
            || {
                format!(
                    "got a map of {} inputs behind {width:?} outputs",
                    linear.inputs()
                )
            },
        )?;
        width = Some(outputs);
    }
    let normed = mlp
        .norm
        .is_none_or(|norm| norm.scale.len() == mlp.outputs() && norm.shift.len() == mlp.outputs());
    require(normed, "perceptrons", || {
        "got a LayerNorm of another width".into()
    })
}

fn require(
    holds: bool,
    argument: &'static str,
    problem: impl FnOnce() -> String,
) -> Result<(), Error> {
    if holds {
        Ok(())
    } else {
        Err(Error::invalid(argument, problem()))
    }
}
