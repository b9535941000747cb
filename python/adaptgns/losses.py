"""Training losses, each a mean over the particles that carry one."""

from __future__ import annotations

from torch import Tensor

from adaptgns.config import Loss
from adaptgns.network import Prediction

BETA = 0.5


def training_loss(
    kind: Loss,
    prediction: Prediction,
    target: Tensor,
    mobile: Tensor,
    *,
    variance: Tensor | None = None,
    variance_weight: float = 1.0,
) -> Tensor:
    """The loss ``kind`` of normalized ``target`` accelerations ``[N, d]``; a scalar.

    ``mobile`` ``[N]`` marks the non-kinematic particles; the others count nothing. NaN surfaces.

    - ``mse``: mean over particles and dimensions of the squared error.
    - ``nll``: mean over particles of |a' - a|^2 / (2 s^2) + (d/2) log s^2, the Gaussian negative
      log-likelihood up to a constant, with one variance s^2 per particle (Nix & Weigend 1994).
    - ``beta-nll``: the same, each particle's term weighted by s^(2 BETA) without gradient, so that
      particles with a large variance are not given up (Seitzer et al. 2022).

    With ``variance`` ``[N]`` the errors are weighed by it, without gradient, instead of by that of
    the ``prediction``, which learns nothing: in an unrolled step the error of the positions has
    grown past that of one step, which the variance stands for.
    """
    squared_error = (prediction.acceleration - target).square().sum(1)[mobile]  # [M]
    dim = target.shape[1]
    if kind == "mse":
        return squared_error.mean() / dim
    if prediction.variance is None:
        raise ValueError(f"loss: {kind} needs a network with a variance head; this one has none")
    if kind == "decoupled":
        loss = squared_error.mean() / dim
        if variance is None:
            likelihood = variance_loss(prediction.variance[mobile], squared_error, dim)
            loss = loss + variance_weight * likelihood
        return loss
    weight = (prediction.variance if variance is None else variance.detach())[mobile]
    likelihood = squared_error / (2 * weight)
    if variance is None:
        likelihood = likelihood + dim / 2 * weight.log()
    if kind == "beta-nll":
        likelihood = likelihood * weight.detach() ** BETA
    return likelihood.mean()


def variance_loss(variance: Tensor, squared_error: Tensor, dim: int) -> Tensor:
    """Mean over M particles of e / (2 s^2) + (dim/2) log s^2 for their ``variance`` s^2 ``[M]`` and
    ``squared_error`` e ``[M]``, which is summed over ``dim`` dimensions and learns nothing."""
    return (squared_error.detach() / (2 * variance) + dim / 2 * variance.log()).mean()
