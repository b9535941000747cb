//! The graph network on the CPU: arrays in, arrays out.

use adaptgns_core::Error;
use adaptgns_core::network::{Edges, Features, Layer, Linear, Mlp, Network, Norm, Precision, Tape};
use adaptgns_core::threads::Threads;
use numpy::prelude::*;
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArrayDyn, PyReadonlyArrayDyn};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;

use crate::arguments;
use crate::errors::to_python;

type Reals<'py> = PyReadonlyArrayDyn<'py, f32>;
type Integers<'py> = PyReadonlyArrayDyn<'py, i64>;

/// What the backward pass needs of a forward pass.
#[pyclass(module = "adaptgns._core", frozen)]
struct NetworkTape(std::sync::Mutex<Tape>);

/// Borrowed arguments of both passes.
struct Arguments<'py> {
    perceptrons: Vec<Vec<Reals<'py>>>,
    nodes: Reals<'py>,
    edges: Option<(Reals<'py>, Vec<Integers<'py>>)>,
    heads: usize,
    bf16: bool,
    threads: Threads,
}

impl<'py> Arguments<'py> {
    fn new(
        perceptrons: &Bound<'py, PyAny>,
        nodes: &Bound<'py, PyAny>,
        edges: Option<(Bound<'py, PyAny>, Vec<Bound<'py, PyAny>>)>,
        heads: usize,
        bf16: bool,
        threads: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Self> {
        let perceptrons = perceptrons
            .try_iter()?
            .map(|arrays| {
                let arrays = arrays?.try_iter()?;
                arrays.map(|array| reals("perceptrons", &array?)).collect()
            })
            .collect::<PyResult<_>>()?;
        let edges = edges
            .map(|(features, indices)| {
                let indices = (indices.iter())
                    .map(|array| arguments::offsets("edges", array))
                    .collect::<PyResult<Vec<_>>>()?;
                if !matches!(indices.len(), 3 | 5) {
                    return Err(PyTypeError::new_err(format!(
                        "edges: got {} arrays, must be 3, or 5 for a backward pass",
                        indices.len()
                    )));
                }
                Ok((reals("edge_features", &features)?, indices))
            })
            .transpose()?;
        Ok(Self {
            perceptrons,
            nodes: reals("node_features", nodes)?,
            edges,
            heads,
            bf16,
            threads: arguments::threads(threads)?,
        })
    }

    fn features(&self) -> PyResult<Features<'_>> {
        check_rows("node_features", &self.nodes, self.perceptrons.first())?;
        if let Some((values, _)) = &self.edges {
            check_rows("edge_features", values, self.perceptrons.get(1))?;
        }
        let edges = match &self.edges {
            None => None,
            Some((values, indices)) => {
                let index = |i: usize| match indices.get(i) {
                    Some(array) => array.as_slice(),
                    None => Ok(&[][..]),
                };
                let edges = Edges {
                    senders: index(0)?,
                    receivers: index(1)?,
                    offsets: index(2)?,
                    by_sender: index(3)?,
                    sender_offsets: index(4)?,
                };
                Some((values.as_slice()?, edges))
            }
        };
        Ok(Features {
            nodes: self.nodes.as_slice()?,
            edges,
        })
    }

    /// Encoders, steps and heads in the order in which the parameters come.
    fn network(&self) -> PyResult<Network<'_>> {
        let first_head = self.perceptrons.len().saturating_sub(self.heads);
        let mut perceptrons = (self.perceptrons.iter().enumerate())
            .map(|(number, arrays)| {
                let rounded = self.bf16 && number < first_head;
                let precision = if rounded {
                    Precision::Bf16
                } else {
                    Precision::Float32
                };
                perceptron(arrays, precision)
            })
            .collect::<PyResult<Vec<_>>>()?;
        let encoders = 1 + usize::from(self.edges.is_some());
        if perceptrons.len() < encoders.saturating_add(self.heads) {
            return Err(invalid(format!(
                "got {}, must be at least {encoders} encoders and {} heads",
                perceptrons.len(),
                self.heads
            )));
        }
        let heads = perceptrons.split_off(perceptrons.len() - self.heads);
        let mut perceptrons = perceptrons.into_iter();
        let node_encoder = perceptrons.next().expect("counted above");
        let edge_encoder = self.edges.as_ref().and_then(|_| perceptrons.next());
        let mut layers = Vec::new();
        while let Some(first) = perceptrons.next() {
            layers.push(if edge_encoder.is_none() {
                Layer {
                    edge: None,
                    node: first,
                }
            } else if let Some(node) = perceptrons.next() {
                Layer {
                    edge: Some(first),
                    node,
                }
            } else {
                return Err(invalid(
                    "got an edge perceptron without its node perceptron".into(),
                ));
            });
        }
        Ok(Network {
            node_encoder,
            edge_encoder,
            layers,
            heads,
        })
    }
}

fn invalid(problem: String) -> PyErr {
    to_python(Error::InvalidArgument {
        argument: "perceptrons",
        problem,
    })
}

fn reals<'py>(argument: &str, value: &Bound<'py, PyAny>) -> PyResult<Reals<'py>> {
    match value.cast::<PyArrayDyn<f32>>() {
        Ok(array) if array.is_c_contiguous() => Ok(array.try_readonly()?),
        _ => Err(PyTypeError::new_err(format!(
            "{argument}: must be contiguous numpy arrays of float32"
        ))),
    }
}

/// Rows as wide as the first map of their encoder takes them.
fn check_rows(argument: &str, rows: &Reals<'_>, encoder: Option<&Vec<Reals<'_>>>) -> PyResult<()> {
    let weight = encoder.and_then(|arrays| arrays.first());
    let wanted = weight.and_then(|weight| weight.shape().get(1).copied());
    match (rows.shape(), wanted) {
        (&[_, width], Some(wanted)) if width == wanted => Ok(()),
        (_, None) => Ok(()), // which the network's own check tells
        (shape, Some(wanted)) => Err(PyValueError::new_err(format!(
            "{argument}: got the shape {shape:?}, must be rows of {wanted}"
        ))),
    }
}

/// Weights and biases in turn, then perhaps scale and shift.
fn perceptron<'a>(arrays: &'a [Reals<'_>], precision: Precision) -> PyResult<Mlp<'a>> {
    let (pairs, rest) = arrays.as_chunks::<2>();
    let mut mlp = Mlp {
        linears: Vec::new(),
        norm: None,
    };
    for [first, second] in pairs {
        let (first_slice, second_slice) = (first.as_slice()?, second.as_slice()?);
        if mlp.norm.is_some() {
            return Err(invalid(
                "got arrays behind scale and shift, which come last".into(),
            ));
        }
        if first.ndim() == 2 {
            if first.shape()[0] != second_slice.len() {
                return Err(invalid(format!(
                    "got a weight of shape {:?} for {} biases",
                    first.shape(),
                    second_slice.len()
                )));
            }
            mlp.linears
                .push(Linear::new(first_slice, second_slice, precision));
        } else {
            mlp.norm = Some(Norm {
                scale: first_slice,
                shift: second_slice,
            });
        }
    }
    if rest.is_empty() {
        Ok(mlp)
    } else {
        Err(PyTypeError::new_err(
            "perceptrons: must be pairs of arrays, weight and bias, at last scale and shift",
        ))
    }
}

type Heads<'py> = Vec<Bound<'py, PyArray2<f32>>>;

/// Heads' outputs, and with `keep` the tape; `_core.pyi` has the whole contract.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "keyword arguments in Python")]
#[pyo3(signature = (perceptrons, node_features, edges, *, heads, keep, bf16 = false, threads = None))]
fn network_forward<'py>(
    py: Python<'py>,
    perceptrons: &Bound<'py, PyAny>,
    node_features: &Bound<'py, PyAny>,
    edges: Option<(Bound<'py, PyAny>, Vec<Bound<'py, PyAny>>)>,
    heads: usize,
    keep: bool,
    bf16: bool,
    threads: Option<&Bound<'py, PyAny>>,
) -> PyResult<(Heads<'py>, Option<NetworkTape>)> {
    let arguments = Arguments::new(perceptrons, node_features, edges, heads, bf16, threads)?;
    let (network, features) = (arguments.network()?, arguments.features()?);
    let threads = arguments.threads;
    let widths: Vec<usize> = network.heads.iter().map(Mlp::outputs).collect();
    let (outputs, tape) = py
        .detach(|| network.forward(features, keep, threads))
        .map_err(to_python)?;
    let outputs = (outputs.into_iter().zip(widths))
        .map(|(flat, width)| {
            let rows = flat.len() / width;
            flat.into_pyarray(py).reshape([rows, width])
        })
        .collect::<PyResult<_>>()?;
    Ok((outputs, tape.map(|tape| NetworkTape(tape.into()))))
}

type PythonGradients<'py> = (
    Bound<'py, PyArray1<f32>>,
    Bound<'py, PyArray1<f32>>,
    Bound<'py, PyArray1<f32>>,
);

/// Gradients by the parameters and the features; `_core.pyi` has the whole contract.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "keyword arguments in Python")]
#[pyo3(signature = (perceptrons, node_features, edges, tape, gradients, *, alone = false, bf16 = false, threads = None))]
fn network_backward<'py>(
    py: Python<'py>,
    perceptrons: &Bound<'py, PyAny>,
    node_features: &Bound<'py, PyAny>,
    edges: Option<(Bound<'py, PyAny>, Vec<Bound<'py, PyAny>>)>,
    tape: &NetworkTape,
    gradients: Vec<Bound<'py, PyAny>>,
    alone: bool,
    bf16: bool,
    threads: Option<&Bound<'py, PyAny>>,
) -> PyResult<PythonGradients<'py>> {
    let heads = gradients.len();
    let arguments = Arguments::new(perceptrons, node_features, edges, heads, bf16, threads)?;
    let (network, features) = (arguments.network()?, arguments.features()?);
    let gradients = (gradients.iter())
        .map(|array| reals("gradients", array))
        .collect::<PyResult<Vec<_>>>()?;
    let gradients = (gradients.iter())
        .map(|array| Ok(array.as_slice()?))
        .collect::<PyResult<Vec<&[f32]>>>()?;
    let threads = arguments.threads;
    let result = py
        .detach(|| {
            let mut tape = tape
                .0
                .lock()
                .unwrap_or_else(std::sync::PoisonError::into_inner);
            network.backward(features, &mut tape, &gradients, alone, threads)
        })
        .map_err(to_python)?;
    Ok((
        result.parameters.into_pyarray(py),
        result.nodes.into_pyarray(py),
        result.edges.into_pyarray(py),
    ))
}

pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<NetworkTape>()?;
    module.add_function(wrap_pyfunction!(network_forward, module)?)?;
    module.add_function(wrap_pyfunction!(network_backward, module)?)
}
