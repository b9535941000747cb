"""Losses against torch's own."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from adaptgns.config import Loss
from adaptgns.losses import training_loss
from adaptgns.network import Prediction


@pytest.fixture
def case() -> tuple[Prediction, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    prediction = Prediction(
        torch.randn(7, 3, generator=generator), torch.rand(7, generator=generator) + 0.1
    )
    mobile = torch.tensor([True, True, False, True, False, True, True])
    return prediction, torch.randn(7, 3, generator=generator), mobile


def test_nll_is_torchs_gaussian_nll_summed_over_dimensions(case) -> None:
    prediction, target, mobile = case
    variance = prediction.variance[:, None].expand(-1, 3)
    reference = nn.GaussianNLLLoss(reduction="none")(prediction.acceleration, target, variance)
    expected = reference.sum(1)[mobile].mean()
    torch.testing.assert_close(training_loss("nll", prediction, target, mobile), expected)


def test_mse_is_torchs_over_mobile_particles(case) -> None:
    prediction, target, mobile = case
    expected = nn.MSELoss()(prediction.acceleration[mobile], target[mobile])
    torch.testing.assert_close(training_loss("mse", prediction, target, mobile), expected)


@pytest.mark.parametrize(("kind", "power"), [("nll", 1.0), ("beta-nll", 0.5), ("mse", 0.0)])
def test_a_given_variance_weighs_and_learns_nothing(case, kind: Loss, power: float) -> None:
    prediction, target, mobile = case
    given = torch.linspace(0.1, 2, 7, requires_grad=True)
    own = prediction.variance.clone().requires_grad_()
    acceleration = prediction.acceleration.clone().requires_grad_()
    loss = training_loss(kind, Prediction(acceleration, own), target, mobile, variance=given)
    squared = (acceleration - target).square().sum(1)
    half = 3 if kind == "mse" else 2
    torch.testing.assert_close(loss, (squared / (half * given.detach() ** power))[mobile].mean())
    loss.backward()
    assert own.grad is None
    assert given.grad is None
    assert (acceleration.grad[mobile] != 0).all()


def test_kinematic_particles_carry_no_gradient(case) -> None:
    prediction, target, mobile = case
    acceleration = prediction.acceleration.clone().requires_grad_()
    training_loss("nll", Prediction(acceleration, prediction.variance), target, mobile).backward()
    assert (acceleration.grad[~mobile] == 0).all()
    assert (acceleration.grad[mobile] != 0).all()


def test_nan_surfaces(case) -> None:
    prediction, target, mobile = case
    target[0] = torch.nan
    assert training_loss("nll", prediction, target, mobile).isnan()


def test_nll_without_variance_head_is_refused(case) -> None:
    prediction, target, mobile = case
    with pytest.raises(ValueError, match="nll needs a network with a variance head"):
        training_loss("nll", Prediction(prediction.acceleration, None), target, mobile)


@pytest.mark.parametrize("weight", [1.0, 0.1])
def test_decoupled_is_mse_and_the_likelihood_of_errors_that_learn_nothing(
    case, weight: float
) -> None:
    prediction, target, mobile = case
    acceleration = prediction.acceleration.clone().requires_grad_()
    variance = prediction.variance.clone().requires_grad_()
    own = Prediction(acceleration, variance)
    loss = training_loss("decoupled", own, target, mobile, variance_weight=weight)
    mse = training_loss("mse", prediction, target, mobile)
    nll = training_loss("nll", prediction, target, mobile)
    torch.testing.assert_close(loss, mse + weight * nll)
    loss.backward()
    (by_mse,) = torch.autograd.grad(training_loss("mse", own, target, mobile), acceleration)
    torch.testing.assert_close(acceleration.grad, by_mse)
    (by_nll,) = torch.autograd.grad(training_loss("nll", own, target, mobile), variance)
    torch.testing.assert_close(variance.grad, weight * by_nll)
    # In an unrolled frame the variance is left alone.
    later = training_loss("decoupled", own, target, mobile, variance=prediction.variance)
    torch.testing.assert_close(later, mse)
