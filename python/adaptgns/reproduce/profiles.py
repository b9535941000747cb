"""What is trained and rolled out, at which size: the models of the paper, and the profiles."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from adaptgns.atomic import six_digits
from adaptgns.config import HISTORY, AdaptiveConfig, Loss, PolicyName, RuledPolicy, TrainConfig
from adaptgns.data.generation import SplitPlan
from adaptgns.presets import PRESETS

ProfileName = Literal["smoke", "laptop", "full", "paper"]

ADAPTIVE = AdaptiveConfig()
"""The paper's rule: tau 70, factor 1.267."""
DENSER = 0.019 / 0.015
"""Radius of the paper's denser graph over that of its sparse one."""
MIDDLE = 0.0176 / 0.015
"""The same for the one that matches the adaptive graph's edges on its sand."""
PRIORS: tuple[PolicyName, ...] = ("acceleration", "divergence")


@dataclass(frozen=True)
class Chosen:
    """A rule of the adaptive graph that a sweep chooses on validation, with the first seed."""

    weights: str
    """Name of the model that it is chosen for, whose training is used"""
    budget: str
    """Name of the model whose fixed graph has as many edges there as the rule may have"""
    folder: str
    """Name of the sweep's folder"""
    policy: RuledPolicy = "adaptive"
    """Which particles see farther"""


@dataclass(frozen=True)
class Model:
    """One way of training, run with every seed."""

    name: str
    plain: str
    """Its title, but for how it is trained: :attr:`length`"""
    loss: Loss
    edges: bool = True
    radius: float | Literal["matched"] = 1.0
    """Times the radius of the data; matched: that whose graph has as many edges as the adaptive one
    of the model ``matches`` in rollouts of the validation split with the first seed, by a line in
    the radius's square."""
    matches: str = "nll"
    """Name of the model that a matched radius is matched to"""
    graph: Literal["base", "adaptive", "two-sided"] = "base"
    variance_weight: float = 0.0
    variance_ahead: bool = False
    variance_layers: int = 1
    share: float = 1.0
    """Of the profile's training steps"""
    seeds: int | None = None
    """How many of the profile's seeds, from the first; None: all"""
    sets: tuple[str, ...] | None = None
    """The embedded data sets that it is trained on; None: all, and any"""
    timed_as: str | None = None
    """Name of the model whose steps take as long, being of the same network"""
    policies: tuple[PolicyName, ...] = ("fixed",)
    chosen: Chosen | None = None
    """Of a model that is another one's training under a rule of its own"""
    whole_test: bool = False
    """Whether it is rolled out over all test trajectories, where the profile has fewer"""

    @property
    def length(self) -> str:
        """What sets its training apart from that of others of its kind; as a rule nothing."""
        share = "" if self.share == 1 else f"{100 * self.share:.0f} % of the steps"
        return ", ".join(filter(None, (share, "one seed" if self.seeds == 1 else "")))

    @property
    def title(self) -> str:
        """Names it in tables and figures."""
        return ", ".join(filter(None, (self.plain, self.length)))

    @property
    def prominent(self) -> bool:
        """Whether it belongs where there is no room for all."""
        return self.name in PROMINENT

    @property
    def depends(self) -> bool:
        """Whether it comes after the other models."""
        return self.chosen is not None or self.radius == "matched"

    def config(self, base: TrainConfig, seed: int, radius: float) -> TrainConfig:
        """Of its training, by the profile's ``base``; ``radius`` is that of the data."""
        factor = 1.0 if self.radius == "matched" else self.radius
        return replace(
            base,
            loss=self.loss,
            seed=seed,
            graph=self.graph,
            adaptive=ADAPTIVE,
            variance_weight=self.variance_weight,
            variance_ahead=self.variance_ahead,
            unroll=max(2, base.unroll) if self.loss == "decoupled" else base.unroll,
            steps=max(1, round(self.share * base.steps)),
            model=replace(
                base.model,
                edges=self.edges,
                variance_layers=self.variance_layers,
                radius=None if factor == 1.0 else six_digits(factor * radius),
            ),
        )


MLP = Model("mlp", "MLP", "mse", edges=False)
MSE = Model("mse", "GNS, MSE", "mse", policies=("fixed", "knn"))
NLL = Model(
    "nll",
    "GNS, NLL",
    "nll",
    policies=("fixed", "adaptive", "random", "two-pass", "knn", "two-sided", *PRIORS),
)
TUNED = Model(
    "tuned",
    "GNS, NLL, chosen rule",
    "nll",
    policies=("adaptive", "random"),
    chosen=Chosen(weights="nll", budget="mse", folder="sweep"),
)
TUNED_DIVERGENCE = Model(
    "tuned-divergence",
    "GNS, NLL, chosen rule of the divergence",
    "nll",
    policies=("divergence",),
    chosen=Chosen("nll", "mse", folder="sweep-divergence", policy="divergence"),
)
EARLY = tuple(
    replace(
        NLL,
        name=f"nll-{percent}",
        share=percent / 100,
        timed_as="nll",
        policies=("fixed", "adaptive", "random"),
    )
    for percent in (10, 30)
)


def longer(percent: int, *tuned: Model, seeds: int = 1) -> tuple[Model, ...]:
    """MSE, NLL and its chosen rules ``tuned``, trained for so many percent of the steps with the
    first ``seeds``; the rules may have as many edges as the fixed graph of MSE."""

    def of(model: Model, **settings: Any) -> Model:
        return replace(
            model,
            name=f"{model.name}-{percent}",
            share=percent / 100,
            seeds=seeds,
            whole_test=True,
            **settings,
        )

    def within_edges(model: Model) -> Model:
        assert model.chosen is not None
        chosen = replace(
            model.chosen,
            weights=f"{NLL.name}-{percent}",
            budget=f"{MSE.name}-{percent}",
            folder=f"{model.chosen.folder}-{percent}",
        )
        return of(model, chosen=chosen)

    return (
        of(MSE, timed_as=MSE.name, policies=("fixed", "divergence")),
        of(NLL, timed_as=NLL.name, policies=(*NLL.policies, "base-sigma")),
        *map(within_edges, tuned),
    )


def on_water(models: Iterable[Model]) -> tuple[Model, ...]:
    """``models``, on that set alone."""
    return tuple(replace(model, sets=("waterdrop",)) for model in models)


LONG_NLL = f"{NLL.name}-400"
"""Name of the model whose first seed comes with the package"""
LONG = longer(400, TUNED, TUNED_DIVERGENCE, seeds=2)
LONGEST = on_water(longer(800, TUNED))
ADAPTIVE_NLL = replace(
    NLL,
    name="nll-adaptive",
    plain="AdaptGNS, trained on adaptive graphs",
    graph="adaptive",
    policies=("fixed", "adaptive", "random"),
)
LONG_NARROW = replace(
    ADAPTIVE_NLL,
    name="nll-narrow-400",
    plain="AdaptGNS, trained on adaptive graphs, r 0.01425",
    radius=0.95,  # meant to have no more edges than fixed graphs of the data's radius
    share=4.0,
    seeds=1,
    whole_test=True,
    policies=("fixed", "adaptive", "random", "base-sigma"),
)
TWO_SIDED_NLL = replace(
    NLL,
    name="nll-two-sided",
    plain="AdaptGNS, trained on two-sided graphs",
    graph="two-sided",
    policies=("fixed", "two-sided"),
)
DECOUPLED = Model(
    "decoupled",
    "GNS, decoupled",
    "decoupled",
    policies=("fixed", "adaptive", "random", "two-sided"),
)
SHAPED = replace(
    DECOUPLED,
    name="decoupled-weight",
    plain="GNS, decoupled, latents shaped with weight 0.1",
    variance_weight=0.1,
)
DECOUPLED_VARIANTS = (
    replace(
        DECOUPLED,
        name="decoupled-deep",
        plain="GNS, decoupled, variance head of three layers",
        variance_layers=3,
    ),
    replace(
        SHAPED,
        name="decoupled-ahead",
        plain="GNS, decoupled, sigma of the next step",
        variance_ahead=True,
    ),
)
DENSER_MSE = replace(
    MSE, name="mse-denser", plain="GNS, MSE, r 0.019", radius=DENSER, policies=("fixed",)
)
MIDDLE_NLL = replace(
    NLL, name="nll-middle", plain="GNS, NLL, r 0.0176", radius=MIDDLE, policies=("fixed",)
)
MATCHED_MSE = replace(
    MSE, name="mse-matched", plain="GNS, MSE, matched r", radius="matched", policies=("fixed",)
)
BETA_NLL = replace(
    NLL,
    name="beta-nll",
    plain="GNS, beta-NLL",
    loss="beta-nll",
    policies=("fixed", "adaptive", "random"),
)
MATCHED_DECOUPLED = replace(
    MATCHED_MSE,
    name="mse-matched-decoupled",
    plain="GNS, MSE, r matched to decoupled's edges",
    matches=SHAPED.name,
)
PAPER_MODELS = (
    replace(MSE, policies=(*MSE.policies, *PRIORS)),
    NLL,
    MLP,
    DECOUPLED,
    SHAPED,
    *DECOUPLED_VARIANTS,
    TWO_SIDED_NLL,
    *EARLY,
    DENSER_MSE,
    MIDDLE_NLL,
    ADAPTIVE_NLL,
    BETA_NLL,
    MATCHED_MSE,
    TUNED,
    TUNED_DIVERGENCE,
)

PROMINENT = {
    model.name for model in (MSE, NLL, MLP, ADAPTIVE_NLL, TUNED, *LONG, LONG_NARROW, *LONGEST)
}


def one_seed(model: Model) -> Model:
    """``model`` with the first seed alone, and without two-sided graphs."""
    policies = tuple(policy for policy in model.policies if policy != "two-sided")
    return replace(model, seeds=1, policies=policies)


ONE_SEED = tuple(map(one_seed, (*DECOUPLED_VARIANTS, BETA_NLL, MATCHED_DECOUPLED)))


@dataclass(frozen=True)
class Sweep:
    """The rules among which one is chosen on validation."""

    tau: tuple[float, ...] = (50.0, 70.0, 90.0)
    factor: tuple[float, ...] = (1.1, 1.267, 1.5)
    radius: tuple[float, ...] = (0.85, 0.925, 1.0)
    """Times that of the data"""
    trajectories: int | None = None


FEW_AND_FAR = Sweep(tau=(90.0, 95.0), factor=(1.5, 2.0), radius=(0.85, 0.9, 0.95, 1.0, 0.8))
SWEEPS: dict[RuledPolicy, Sweep] = {"adaptive": Sweep(), "divergence": FEW_AND_FAR}


@dataclass(frozen=True)
class Long:
    """Rollouts of one model to the end of long trajectories."""

    model: str
    """Its name"""
    marks: tuple[int, ...]
    """Steps at which errors are reported, up to the last"""
    plan: SplitPlan | None = None
    """Of the trajectories, as split "test": the data's own, under the same seed, that go on for
    longer; None: the data's own"""
    policies: tuple[PolicyName, ...] = ("fixed", "adaptive", "random", "two-sided")
    """The first is the one that the others are compared with"""


@dataclass(frozen=True)
class Profile:
    """Which models are run, and how large everything is."""

    base: TrainConfig
    models: tuple[Model, ...]
    seeds: tuple[int, ...]
    marks: tuple[int, ...]
    """Steps at which errors are reported; the last one is that of the conclusions"""
    trajectories: int | None = None
    """Trajectories of a split that are rolled out, the first ones; None: all"""
    horizon: int | None = None
    """Frames of the rollouts; None: to the end"""
    sweeps: Mapping[RuledPolicy, Sweep] = field(default_factory=lambda: SWEEPS)
    """By whom the rules let see farther"""
    gate: float | None = None
    """Edges on predicted over those on true positions that the fixed graph's baseline must come
    within at the last mark on validation; its training is doubled until then"""
    gate_steps: int = 0
    """Training steps past which it is not doubled again"""
    plans: Mapping[str, Mapping[str, SplitPlan]] = field(default_factory=dict)
    """Data sets that are generated for this profile instead of the embedded ones"""
    long: Mapping[str, Long] = field(default_factory=dict)
    """By data set: rollouts over far more frames than :attr:`horizon`"""

    def seeds_of(self, model: Model) -> tuple[int, ...]:
        """Those that ``model`` is trained with."""
        return self.seeds[: model.seeds]

    def trajectories_of(self, model: Model, split: str) -> int | None:
        """How many of the split's trajectories ``model`` is rolled out over; None: all."""
        whole = split == "long" or (split == "test" and model.whole_test)
        return None if whole else self.trajectories

    def models_on(self, data: str) -> tuple[Model, ...]:
        """Those that are trained on the data set of that source."""
        return tuple(each for each in self.models if each.sets is None or data in each.sets)

    def model(self, name: str) -> Model:
        """The one of that name."""
        return next(model for model in self.models if model.name == name)


WATER_TO_THE_END = Long("nll", marks=(200, 500, 1000 - HISTORY))
"""Of the paper's 1,000 frames"""


PROFILES: dict[ProfileName, Profile] = {
    "smoke": Profile(
        base=replace(PRESETS["smoke"], steps=12, validate_every=12, validate_horizon=5),
        models=(
            MSE,
            NLL,
            MLP,
            EARLY[1],
            DECOUPLED,
            TUNED,
            *on_water(longer(400, TUNED, TUNED_DIVERGENCE)),
        ),
        sweeps=dict.fromkeys(SWEEPS, Sweep(tau=(70.0,), factor=(1.1, 1.267), radius=(0.9, 1.0))),
        seeds=(0, 1),
        marks=(5, 10),
        horizon=10,
        plans={
            scene: {
                "train": SplitPlan(scene, 2, frames=24, particles=(30, 50)),
                "valid": SplitPlan(scene, 1, frames=24, particles=(30, 50)),
                "test": SplitPlan(scene, 2, frames=24, particles=(30, 50)),
            }
            for scene in ("waterdrop", "sand")
        },
        long={
            "waterdrop": Long(
                LONG_NLL,
                marks=(10, 20, 40 - HISTORY),
                plan=SplitPlan("waterdrop", 2, frames=40, particles=(30, 50)),
            )
        },
    ),
    "laptop": Profile(
        base=PRESETS["laptop"],
        models=(
            MSE,
            NLL,
            MLP,
            DECOUPLED,
            TWO_SIDED_NLL,
            *EARLY,
            *LONG,
            LONG_NARROW,
            *LONGEST,
            ADAPTIVE_NLL,
            SHAPED,
            DENSER_MSE,
            MIDDLE_NLL,
            MATCHED_MSE,
            *ONE_SEED,
            TUNED,
        ),
        sweeps={name: replace(sweep, trajectories=5) for name, sweep in SWEEPS.items()},
        seeds=(0, 1, 2),
        marks=(50, 100, 200),
        trajectories=10,
        horizon=200,
        long={
            "waterdrop": replace(
                WATER_TO_THE_END,
                model=LONG_NLL,
                plan=SplitPlan("waterdrop", 10, frames=1000),
            )
        },
    ),
    "full": Profile(
        base=replace(PRESETS["laptop"], steps=120_000, validate_every=10_000, validate_horizon=200),
        models=PAPER_MODELS,
        seeds=(0, 1, 2),
        marks=(50, 100, 200),
        gate=1.2,
        gate_steps=2_000_000,
        plans={
            "waterdrop": {
                "train": SplitPlan("waterdrop", 400, frames=300, particles=(40, 200)),
                "valid": SplitPlan("waterdrop", 10, frames=400),
                "test": SplitPlan("waterdrop", 30, frames=1000),
            },
        },
        long={"waterdrop": WATER_TO_THE_END},
    ),
    "paper": Profile(
        base=PRESETS["paper"],
        models=PAPER_MODELS,
        seeds=(0, 1, 2),
        marks=(50, 100, 200),
        plans={
            "waterdrop": {
                "train": SplitPlan("waterdrop", 1000, frames=1000),
                "valid": SplitPlan("waterdrop", 30, frames=1000),
                "test": SplitPlan("waterdrop", 30, frames=1000),
            },
            "sand": {
                "train": SplitPlan("sand", 1000, frames=320),
                "valid": SplitPlan("sand", 100, frames=320),
                "test": SplitPlan("sand", 30, frames=320),
            },
        },
        long={"waterdrop": WATER_TO_THE_END},
    ),
}
