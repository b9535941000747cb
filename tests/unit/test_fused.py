"""The network in the Rust core against the same network in torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from adaptgns import fused
from adaptgns._core import network_backward, network_forward
from adaptgns.config import Precision
from adaptgns.network import EncodeProcessDecode
from adaptgns.segment import Graph


def graph_of(rng: np.random.Generator, nodes: int, edges: int, *, hub: int = 0) -> Graph:
    """Any directed multigraph; ``hub`` more edges go to the first node."""
    pairs = rng.integers(0, nodes, (edges + hub, 2))
    pairs[edges:, 1] = 0
    pairs = pairs[np.lexsort((pairs[:, 0], pairs[:, 1]))]
    offsets = np.searchsorted(pairs[:, 1], np.arange(nodes + 1))
    return Graph.from_numpy(np.ascontiguousarray(pairs.T), offsets)


class Case:
    """A network with random parameters, and what it sees."""

    def __init__(
        self,
        nodes: int = 30,
        edges: int = 90,
        *,
        hub: int = 0,
        latent: int = 16,
        hidden_layers: int = 1,
        steps: int = 2,
        with_edges: bool = True,
        variance: bool = True,
    ) -> None:
        torch.manual_seed(0)
        rng = np.random.default_rng(0)
        self.network = EncodeProcessDecode(
            7,
            3,
            2,
            latent=latent,
            hidden_layers=hidden_layers,
            steps=steps,
            edges=with_edges,
            variance=variance,
        )
        for parameter in self.network.parameters():  # LayerNorms begin with ones and zeros
            parameter.data += 0.1 * torch.randn_like(parameter)
        self.graph = graph_of(rng, nodes, edges, hub=hub) if with_edges else None
        self.node_features = torch.randn(nodes, 7)
        self.edge_features = torch.randn(edges + hub, 3) if with_edges else None

    def run(self, dtype: torch.dtype = torch.float32) -> list[Tensor]:
        """Outputs, then gradients of a function of them by features and parameters."""
        self.network.to(dtype).zero_grad()
        features = [
            f.to(dtype, copy=True).requires_grad_()
            for f in (self.node_features, self.edge_features)
            if f is not None
        ]
        prediction = self.network(features[0], (*features, None)[1], self.graph)
        outputs = [part for part in prediction if part is not None]
        torch.stack([(out * out.sin()).mean() for out in outputs]).sum().backward()
        self.network.to(torch.float32)
        leaves = [*features, *self.network.parameters()]
        return [out.detach() for out in outputs] + [
            leaf.grad.to(dtype, copy=True) for leaf in leaves
        ]


CASES = pytest.mark.parametrize(
    "case",
    [
        {},
        {"hidden_layers": 2, "steps": 3},
        {"latent": 20, "nodes": 300, "edges": 1_500},
        {"nodes": 1, "edges": 2},
        {"edges": 0},
        {"hub": 700},
        {"variance": False},
        {"with_edges": False},
        {"latent": 1, "hidden_layers": 0},
    ],
    ids=str,
)


@CASES
def test_equals_torch_in_double_precision(case: dict[str, int]) -> None:
    made = Case(**case)
    ours, theirs = made.run(), made.run(torch.float64)

    assert len(ours) == len(theirs)
    for own, reference in zip(ours, theirs, strict=True):
        assert own.dtype == torch.float32
        error = (own.double() - reference).norm()
        assert error <= 1e-5 * reference.norm() + 1e-7


def test_torch_does_it_in_double_precision_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """The comparison above compares two things."""

    def refuse(*_: object, **__: object) -> None:
        raise RuntimeError("the Rust core was asked")

    monkeypatch.setattr(fused, "network", refuse)
    made = Case()
    made.run(torch.float64)
    with pytest.raises(RuntimeError, match="Rust core"):
        made.run()


def test_any_number_of_threads_gives_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    made = Case(nodes=700, edges=4_000)
    results = []
    for threads in (1, 3):
        monkeypatch.setattr(fused, "thread_count", lambda threads=threads: threads)
        results.append(made.run())
    for one, three in zip(*results, strict=True):
        assert torch.equal(one, three)


@pytest.mark.parametrize("precision", ["float32", "bf16"])
@CASES
def test_inference_equals_training_and_needs_no_edges_by_sender(
    case: dict[str, int], precision: Precision
) -> None:
    """In bf16 it rounds the edges' latents, too."""
    made = Case(**case)
    made.network.precision = precision
    trained = made.run()
    graph = made.graph
    if graph is not None:
        graph = Graph(graph.senders, graph.receivers, graph.receiver_offsets)
    with torch.inference_mode():
        seen = made.network(made.node_features, made.edge_features, graph)
    for output, same in zip((seen.acceleration, seen.variance), trained, strict=False):
        if output is None:
            continue
        if precision == "float32" or graph is None:
            assert torch.equal(output, same)
        else:
            assert float((output - same).norm() / same.norm()) < 0.01


def test_a_tape_is_kept_for_gradients_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = []

    def spy(*arguments: object, keep: bool, **others: object) -> object:
        kept.append(keep)
        return network_forward(*arguments, keep=keep, **others)

    monkeypatch.setattr(fused, "network_forward", spy)
    made = Case()
    for context in (torch.enable_grad(), torch.no_grad(), torch.inference_mode()):
        with context:
            made.network(made.node_features, made.edge_features, made.graph)
    made.network.requires_grad_(False)
    made.network(made.node_features, made.edge_features, made.graph)
    assert kept == [True, False, False, False]


def test_a_graph_changed_before_the_way_back_is_told() -> None:
    made = Case()
    assert made.graph is not None
    out = made.network(made.node_features, made.edge_features, made.graph).acceleration.sum()
    made.graph.senders[0] += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        out.backward()


@pytest.mark.parametrize("with_edges", [True, False])
def test_a_variance_alone_teaches_the_rest_nothing(with_edges: bool) -> None:
    made = Case(with_edges=with_edges)
    taught = []
    for dtype in (torch.float32, torch.float64):
        made.network.to(dtype).zero_grad()
        made.network.variance_alone = True
        given = [
            None if f is None else f.to(dtype) for f in (made.node_features, made.edge_features)
        ]
        made.network(*given, made.graph).variance.sum().backward()
        taught.append({name: p.grad for name, p in made.network.named_parameters()})
    for name, gradient in taught[0].items():
        if name.startswith("variance_head"):
            assert gradient.any()
            torch.testing.assert_close(gradient.double(), taught[1][name], rtol=1e-4, atol=1e-6)
        else:
            assert gradient is None or not gradient.any()


@pytest.mark.parametrize("precision", ["float32", "bf16"])
def test_gradients_can_be_taken_twice_of_one_pass(precision: Precision) -> None:
    made = Case()
    made.network.precision = precision
    out = made.network(made.node_features, made.edge_features, made.graph).acceleration.sum()
    parameters = list(made.network.decoder.parameters()) + list(made.network.layers[0].parameters())
    first = torch.autograd.grad(out, parameters, retain_graph=True)
    second = torch.autograd.grad(out, parameters)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_nothing_gives_nothing() -> None:
    network = Case().network
    graph = Graph.from_edges(torch.zeros(2, 0, dtype=torch.long), torch.zeros(1, dtype=torch.long))
    prediction = network(torch.zeros(0, 7), torch.zeros(0, 3), graph)
    prediction.acceleration.sum().backward()
    assert prediction.acceleration.shape == (0, 2)
    assert all(not parameter.grad.any() for parameter in network.decoder.parameters())


def test_nan_surfaces() -> None:
    made = Case()
    made.node_features[3] = torch.nan
    assert made.run()[0].isnan().any()


def linear(outputs: int, inputs: int) -> list[np.ndarray]:
    return [np.zeros((outputs, inputs), np.float32), np.zeros(outputs, np.float32)]


def norm(width: int) -> list[np.ndarray]:
    return [np.ones(width, np.float32), np.zeros(width, np.float32)]


GOOD = [
    [*linear(4, 3), *norm(4)],  # node encoder
    [*linear(4, 2), *norm(4)],  # edge encoder
    [*linear(4, 12), *norm(4)],  # edge
    [*linear(4, 8), *norm(4)],  # node
    linear(2, 4),  # head
]
NODES = np.zeros((2, 3), np.float32)
INDEX = [np.array([1]), np.array([0]), np.array([0, 1, 1])]
EDGES = (np.zeros((1, 2), np.float32), INDEX)


@pytest.mark.parametrize(
    ("change", "kind", "message"),
    [
        ({"node_features": np.zeros((2, 3))}, TypeError, "node_features: .* float32"),
        ({"node_features": np.zeros(5, np.float32)}, ValueError, "node_features: .* rows of 3"),
        ({"edges": (np.zeros((2, 2), np.float32), INDEX)}, ValueError, "edge_features: .* 1 edges"),
        (
            {"node_features": np.zeros((1, 6), np.float32)},
            ValueError,
            "node_features: .* rows of 3",
        ),
        ({"edges": (np.zeros((2, 1), np.float32), INDEX)}, ValueError, "edge_features: .*of 2"),
        (
            {"perceptrons": [[np.zeros((3, 4), np.float32), np.zeros(4, np.float32)], *GOOD[1:]]},
            ValueError,
            r"got a weight of shape \[3, 4\] for 4 biases",
        ),
        (
            {"perceptrons": [*GOOD[:4], [np.zeros((4, 2), np.float32), np.zeros(2, np.float32)]]},
            ValueError,
            r"got a weight of shape \[4, 2\] for 2 biases",
        ),
        ({"edges": None}, ValueError, "perceptrons"),
        ({"edges": (EDGES[0], INDEX[:2])}, TypeError, "edges: got 2 arrays, must be 3"),
        ({"edges": (EDGES[0], [np.array([2]), *INDEX[1:]])}, ValueError, "senders: must be nodes"),
        ({"edges": (EDGES[0], [*INDEX[:2], np.array([0, 0, 1])])}, ValueError, "receivers: .*sort"),
        ({"edges": (EDGES[0], [*INDEX[:2], np.array([0, 2, 1])])}, ValueError, "offsets: .* rise"),
        ({"perceptrons": GOOD[:2]}, ValueError, "perceptrons: got 2, must be at least 2"),
        ({"perceptrons": GOOD[:3] + GOOD[4:]}, ValueError, "without its node perceptron"),
        ({"perceptrons": [*GOOD[:3], [], *GOOD[4:]]}, ValueError, "a perceptron with no map"),
        ({"perceptrons": [*GOOD[:4], linear(2, 5)]}, ValueError, "a map of 5 inputs"),
        ({"perceptrons": [*GOOD[:4], linear(2, 4)[:1]]}, TypeError, "pairs of arrays"),
        (
            {"perceptrons": [*GOOD[:2], [*linear(3, 12), *linear(4, 3), *norm(4)], *GOOD[3:]]},
            ValueError,
            r"got maps of \[3, 4\] outputs for edges, must be 4",
        ),
        ({"perceptrons": [GOOD[0] + norm(4), *GOOD[1:]]}, ValueError, "behind scale and shift"),
        ({"threads": 0}, ValueError, "threads: got 0"),
    ],
)
def test_what_does_not_fit_is_refused(change: dict, kind: type[Exception], message: str) -> None:
    arguments = {
        "perceptrons": GOOD,
        "node_features": NODES,
        "edges": EDGES,
        "heads": 1,
        "keep": False,
    }
    network_forward(**arguments)
    with pytest.raises(kind, match=message):
        network_forward(**(arguments | change))


def test_what_does_not_fit_in_memory_is_told_before_it_begins() -> None:
    wide = linear(1_000_000, 1)
    rows = np.zeros((10_000_000, 1), np.float32)
    with pytest.raises(MemoryError, match=r"takes at least 40000000000000 bytes .* holds"):
        network_forward([wide], rows, None, heads=0, keep=False)


def test_a_tape_goes_with_its_own_pass() -> None:
    _, tape = network_forward(GOOD, NODES, EDGES, heads=1, keep=True)
    ones = np.ones((2, 2), np.float32)
    with pytest.raises(ValueError, match="sender_offsets: must rise from 0 to 1 in 3 numbers"):
        network_backward(GOOD, NODES, EDGES, tape, [ones])
    backward = (EDGES[0], [*INDEX, np.array([0]), np.array([0, 0, 1])])
    network_backward(GOOD, NODES, backward, tape, [ones])
    with pytest.raises(ValueError, match=r"gradients: must be one per head, 2 rows each"):
        network_backward(GOOD, NODES, backward, tape, [ones[:1]])
    with pytest.raises(ValueError, match="tape: comes from another network"):
        network_backward(
            GOOD,
            np.zeros((3, 3), np.float32),
            (EDGES[0], [*INDEX[:2], np.array([0, 1, 1, 1]), np.array([0]), np.array([0, 0, 1, 1])]),
            tape,
            [ones],
        )
    for by_sender in ([1, 0], [0, 0], [0, 2]):
        two = (
            np.zeros((2, 2), np.float32),
            [np.array([0, 1]), np.array([1, 1]), np.array([0, 0, 2])],
        )
        _, other = network_forward(GOOD, NODES, two, heads=1, keep=True)
        wrong = (two[0], [*two[1], np.array(by_sender), np.array([0, 1, 2])])
        with pytest.raises(ValueError, match="by_sender: must"):
            network_backward(GOOD, NODES, wrong, other, [ones])
    deeper = [*GOOD[:4], [*linear(4, 4), *linear(2, 4)]]
    with pytest.raises(ValueError, match="tape: comes from another network"):
        network_backward(deeper, NODES, backward, tape, [ones])
