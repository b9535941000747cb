"""The named sets of defaults that a training run starts from."""

from __future__ import annotations

from adaptgns.config import ModelConfig, Preset, TrainConfig

PRESETS: dict[Preset, TrainConfig] = {
    # Seconds: that everything works.
    "smoke": TrainConfig(
        preset="smoke",
        model=ModelConfig(latent=16, hidden_layers=1, steps=2),
        steps=60,
        lr=1e-3,
        schedule="cosine",
        validate_every=30,
        validate_trajectories=1,
        validate_horizon=20,
        checkpoint_every=20,
        test_trajectories=2,
        test_horizon=30,
    ),
    # About five minutes of training on two cores; docs/recipe.md says how it was found.
    "laptop": TrainConfig(
        preset="laptop",
        model=ModelConfig(latent=64, hidden_layers=1, steps=5, relative_motion=True, walls=True),
        loss="beta-nll",
        steps=12_000,
        unroll=3,
        batch=6,
        batch_particles=1_200,
        lr=2e-3,
        schedule="cosine",
        warmup=200,
        clip=1.0,
        noise=1.5e-4,
        drift=3e-5,
        position_correction=0.1,
        compression=0.1,
        mirror=True,
        validate_every=1_500,
        validate_horizon=100,
        test_trajectories=10,
    ),
    # The paper's sizes (and geoelements/gns's schedule).
    "paper": TrainConfig(preset="paper", steps=2_000_000, validate_every=20_000, test_horizon=None),
}
