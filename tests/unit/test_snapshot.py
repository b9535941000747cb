"""The picture of a rollout that training shows at every validation."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from adaptgns import palette
from adaptgns.config import TrainConfig
from adaptgns.data.metadata import Metadata, read_metadata
from adaptgns.data.trajectories import open_split
from adaptgns.fit import Trainer
from adaptgns.snapshot import snapshot

N = 30


def cloud(centre: float, steps: int = 8) -> np.ndarray:
    offsets = np.random.default_rng(0).uniform(-0.05, 0.05, (N, 2))
    return np.broadcast_to(centre + offsets, (steps, N, 2)).astype(np.float32)


def has(image: np.ndarray, colour: str) -> np.ndarray:
    """``[height, width]`` where the image has just this colour."""
    wanted = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
    found: np.ndarray = (image == wanted).all(axis=-1)
    return found


def halves(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The panels alone, without the labels left of them."""
    middle, left = len(image) // 2, 40
    return image[:middle, left:], image[middle:, left:]


def test_truth_is_above_and_prediction_below_where_they_are(metadata: Metadata) -> None:
    mobile = np.arange(N) >= 5
    image = snapshot(metadata, cloud(0.3), cloud(0.7), None, mobile)
    above, below = halves(image)
    assert not has(above, palette.PREDICTED).any()
    assert not has(below, palette.TRUE).any()
    assert has(above, palette.KINEMATIC).any()
    assert has(below, palette.KINEMATIC).any()
    high = [
        np.argwhere(has(half, colour))[:, 0].mean() / len(half)
        for half, colour in ((above, palette.TRUE), (below, palette.PREDICTED))
    ]
    assert high[0] > 0.6
    assert high[1] < 0.4


def test_sigma_colours_the_prediction_of_each_moment(metadata: Metadata) -> None:
    mobile = np.ones(N, dtype=bool)
    sigma = np.ones((8, N), dtype=np.float32)
    sigma[7] = 10.0  # at the last of steps 2, 4, 6 and 8
    sigma[0] = 1000.0  # not shown, and no end of the scale
    image = snapshot(metadata, cloud(0.3), cloud(0.7), sigma, mobile)
    _, below = halves(image)
    dark, bright = (
        np.argwhere(
            (np.abs(below - np.array(palette.SIGMA_MAP(x, bytes=True)[:3], int)) < 4).all(-1)
        )
        for x in (0.0, 0.998)
    )
    width = below.shape[1]
    assert len(dark) > len(bright) > 0
    assert dark[:, 1].max() < 0.77 * width < bright[:, 1].min()


def test_what_cannot_be_shown_is_counted(metadata: Metadata) -> None:
    mobile = np.ones(N, dtype=bool)
    plain = snapshot(metadata, cloud(0.3), cloud(0.7), None, mobile)
    wrong = cloud(0.7).copy()
    wrong[-1, :3], wrong[-1, 3] = np.nan, 7.0
    counted = snapshot(metadata, cloud(0.3), wrong, None, mobile)
    text = [has(image[-30:], palette.TEXT).sum() for image in (plain, counted)]
    assert text[0] == 0 < text[1]
    # Nothing finite at all, of a rollout that ended after its first step.
    nothing = np.full((1, N, 2), np.inf, dtype=np.float32)
    sigma = np.full((1, N), np.nan, dtype=np.float32)
    _, below = halves(snapshot(metadata, cloud(0.3), nothing, sigma, mobile))
    assert not has(below, palette.PREDICTED).any()


@pytest.mark.parametrize("loss", ["nll", "mse"])
def test_tensorboard_shows_a_rollout_at_every_validation(
    drops: Path, tmp_path: Path, small_config: TrainConfig, loss: str
) -> None:
    run = Trainer(
        replace(small_config, loss=loss),
        read_metadata(drops),
        tmp_path,
        train=open_split(drops, "train"),
        valid=open_split(drops, "valid"),
    )
    run.run(Console(quiet=True))
    events = EventAccumulator(str(tmp_path / "tensorboard"), size_guidance={"images": 0})
    events.Reload()
    shown = events.Images("valid_rollout")
    assert [image.step for image in shown] == [6, 12]
    with Image.open(io.BytesIO(shown[-1].encoded_image_string)) as last:
        pixels = np.asarray(last.convert("RGB")).astype(int)
    above, below = halves(pixels)
    assert has(above, palette.TRUE).any()
    assert has(below, palette.PREDICTED).any() == (loss == "mse")
