"""The runs of a study: what each is, where its files lie, and how it is made.

A run trains one model with one seed on one data set, rolls it out under each of the model's
policies, and measures that. Files in the study's folder:

- ``training/DATA/MODEL-SEED/``: what ``train`` writes; an interrupted run goes on from there
- ``metrics/DATA/MODEL-SEED-POLICY.json``: what the report is made of, with its configuration
- ``metrics/DATA/MODEL-SEED-adaptive.npz``: frames of its first trajectory, of one seed, for figures
- ``metrics/DATA/MODEL-SEED-POLICY-long.json``: the same of long rollouts, and ``long.json``: what
  their trajectories are like
- ``metrics/DATA/data.json``: what the data are like; ``gate.json``: how long it had to be trained;
  ``sweep*/``: the rules that were tried on validation; ``times.json``: milliseconds of a step
- ``data/``: data sets that are generated for a profile

What comes with the package already, of the same configuration and data, is not trained again.
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from adaptgns.atomic import six_digits, write_json, written_whole
from adaptgns.checkpoint import (
    LAST,
    PRETRAINED,
    Checkpoint,
    build_simulator,
    read_checkpoint,
)
from adaptgns.config import (
    HISTORY,
    AdaptiveConfig,
    Device,
    PolicyName,
    RolloutConfig,
    TrainConfig,
    from_json,
    to_json,
    torch_device,
)
from adaptgns.data.default import EMBEDDED, dataset_folder
from adaptgns.data.generation import generate_dataset
from adaptgns.data.metadata import Metadata, read_metadata
from adaptgns.data.trajectories import Trajectories, open_split
from adaptgns.evaluate import STATISTICS_STEP, measure
from adaptgns.graph_statistics import GraphStatistics, graph_statistics
from adaptgns.policies import make_policy
from adaptgns.processes import ALONE
from adaptgns.reproduce.profiles import (
    ADAPTIVE,
    DENSER,
    MSE,
    NLL,
    Chosen,
    Long,
    Model,
    Profile,
    ProfileName,
)
from adaptgns.rollout import Step, steps, write_rollouts
from adaptgns.rollout_file import RolloutFile
from adaptgns.sweep import RESULT, SweepConfig, sweep
from adaptgns.train import run_folder, train

Split = Literal["valid", "test", "long"]
"""What is rolled out: a part of the data, or the trajectories of the long rollouts"""

MACHINES = "machine.json"
"""What a study was made on"""
SNAPSHOTS = (1, 10, 50, 100)
"""Steps whose frames are kept for the figures"""
EVERY = 10
"""Steps between those of the statistics' evolution"""
TIMED = 40
"""Steps that are timed"""
FARTHEST = 1.5
"""Times or part of the data's radius up to which one is matched to a number of edges"""
DRAWN = (NLL.name, "adaptive")
"""Model and policy whose frames the figures show, of the first seed"""
LOCAL = {
    *("out", "checkpoint", "data", "resume", "preset", "device", "threads", "workers"),
    *("checkpoint_every", "test_trajectories", "test_horizon"),
}
"""Settings that say where and how a run was made, not what it is"""


class StudyError(ValueError):
    """A run that is missing, or is not what the study would make."""


@dataclass(frozen=True)
class Study:
    """All runs of a profile on some data sets."""

    preset: ProfileName
    profile: Profile
    data: tuple[str, ...]
    """Embedded sets' names, or folders"""
    out: Path
    device: Device = "auto"
    threads: int | None = None

    @cached_property
    def sets(self) -> dict[str, DataSet]:
        """By name, in order."""
        sets = {Path(data).name: DataSet(self, data) for data in self.data}
        if len(sets) < len(self.data):
            raise StudyError(f"data: got {', '.join(self.data)}, two of one name; rename one")
        return sets

    def runs(self) -> Iterator[Run]:
        """The most telling first: one seed of everything, then the next; what depends on other
        runs last."""
        for depends in (False, True):
            for seed in self.profile.seeds:
                for data in self.sets.values():
                    for model in self.profile.models_on(data.source):
                        seeds = self.profile.seeds_of(model)
                        if model.depends == depends and seed in seeds:
                            yield Run(data, model, seed)

    @property
    def last_mark(self) -> int:
        """The step of the conclusions."""
        return self.profile.marks[-1]


@dataclass(frozen=True)
class DataSet:
    """A data set of the study."""

    study: Study
    source: str

    @property
    def name(self) -> str:
        """That of its folder, or the embedded set's."""
        return Path(self.source).name

    @property
    def metrics(self) -> Path:
        """The folder of what was measured on it."""
        return self.study.out / "metrics" / self.name

    @cached_property
    def folder(self) -> Path:
        """Where the data are, which are made where the profile has its own."""
        plans = self.study.profile.plans.get(self.source)
        if plans is None or self.source not in EMBEDDED:
            return dataset_folder(self.source)
        folder = self.study.out / "data" / self.name
        generate_dataset(folder, plans, console=Console(stderr=True, quiet=folder.exists()))
        return folder

    @cached_property
    def metadata(self) -> Metadata:
        """Of the data."""
        return read_metadata(self.folder)

    def describe(self) -> None:
        """Measure the true graphs, for table 2, and what the policy knn takes its k from.

        StudyError where that has been done of other data.
        """
        path = self.metrics / "data.json"
        train, valid, test = (open_split(self.folder, name) for name in ("train", "valid", "test"))
        fingerprint = self._fingerprint(train, valid, test)
        if _describes(path, fingerprint, self.folder):
            return
        metadata, marks = self.metadata, self.study.profile.marks
        shortest = min(int(test.lengths.min()) - HISTORY, STATISTICS_STEP)

        def statistics(frame: NDArray[np.float32]) -> GraphStatistics:
            return graph_statistics(frame, metadata.radius, metadata.box)

        content = {
            "fingerprint": fingerprint,
            "radius": metadata.radius,
            "step": shortest,
            "statistics": [asdict(statistics(frames[shortest])) for frames in courses(test)],
            "evolution_every": EVERY,
            "evolution": [
                [asdict(statistics(frame)) for frame in frames[::EVERY]] for frames in courses(test)
            ],
            "valid_degree": float(
                np.mean(
                    [statistics(f).degree for frames in courses(valid) for f in frames[::EVERY]]
                )
            ),
            "centroid_mse": centroid_mse(test, marks),
        }
        write_json(path, content)

    @property
    def long(self) -> Long | None:
        """The long rollouts that the profile asks for; None: none."""
        return self.study.profile.long.get(self.source)

    @cached_property
    def long_folder(self) -> Path:
        """Where their trajectories are, which are made where they have a plan."""
        assert self.long is not None
        plan = self.long.plan
        if plan is None:
            return self.folder
        folder = self.study.out / "data" / f"{self.name}-long"
        # Rollouts need no statistics of motion: one trajectory is enough to have some.
        plans = {"train": replace(plan, trajectories=1), "test": plan}
        generate_dataset(folder, plans, console=Console(stderr=True, quiet=folder.exists()))
        return folder

    def describe_long(self) -> None:
        """As :meth:`describe`, of the trajectories of the long rollouts."""
        assert self.long is not None
        path = self.metrics / "long.json"
        split = open_split(self.long_folder, "test")
        fingerprint = self._fingerprint(split)
        if _describes(path, fingerprint, self.long_folder):
            return
        last = int(split.lengths.min()) - HISTORY
        if last < self.long.marks[-1]:
            raise StudyError(
                f"{self.long_folder}: a trajectory ends after step {last}; the long rollouts are "
                f"reported at step {self.long.marks[-1]}"
            )
        every = centroid_mse(split, range(1, last + 1))
        content = {
            "fingerprint": fingerprint,
            "trajectories": len(split),
            "centroid_mse": {str(mark): every[str(mark)] for mark in self.long.marks},
            "centroid_mse_mean": [float(np.mean(values)) for values in every.values()],
        }
        write_json(path, content)

    @property
    def described_long(self) -> dict[str, Any]:
        """What :meth:`describe_long` wrote."""
        return read_json(self.metrics / "long.json")

    def _fingerprint(self, *splits: Trajectories) -> str:
        """Tells data apart by their metadata, sizes, and the ends of each split."""
        digest = hashlib.sha256(json.dumps(self.metadata.to_json(), sort_keys=True).encode())
        for split in splits:
            digest.update(np.array([split.lengths, split.particle_counts], np.int64).tobytes())
            for index in (0, len(split) - 1):
                digest.update(split[index].positions.tobytes())
        return digest.hexdigest()[:16]

    @property
    def described(self) -> dict[str, Any]:
        """What :meth:`describe` wrote."""
        return read_json(self.metrics / "data.json")

    @property
    def steps(self) -> int:
        """Training steps of a full run: the profile's, or those that the gate asked for."""
        path = self.metrics / "gate.json"
        if self.study.profile.gate is None or not path.exists():
            return self.study.profile.base.steps
        return int(read_json(path)["steps"])

    def rule(self, chosen: Chosen) -> dict[str, float]:
        """What the sweep chose. StudyError where it is missing or was another one."""
        path = self.metrics / chosen.folder / RESULT
        content = read_json(path)
        profile = self.study.profile
        Run(self, profile.model(chosen.budget), profile.seeds[0]).read("fixed", "valid")  # is there
        config = self._sweep_config(chosen)
        asked = json.loads(json.dumps(to_json(config)))
        for name, value in content["settings"].items():
            if asked[name] != value:
                raise StudyError(
                    f"{path}: was made with {name} {value}; the study has {asked[name]}. Remove "
                    "its folder, or give another --out"
                )
        rule: dict[str, float] = content["chosen"]
        return rule

    def _sweep_config(self, chosen: Chosen) -> SweepConfig:
        profile, radius = self.study.profile, float(self.described["radius"])
        budget, rules = profile.model(chosen.budget), profile.sweeps[chosen.policy]
        count = rules.trajectories
        edges = valid_edges(self, budget, profile.seeds[0], "fixed", trajectories=count)
        return SweepConfig(
            checkpoint=Path(chosen.weights),
            out=self.metrics / chosen.folder,
            policy=chosen.policy,
            tau=rules.tau,
            factor=rules.factor,
            radius=tuple(six_digits(share * radius) for share in rules.radius),
            edges=six_digits(edges),
            steps=self.study.last_mark,
            trajectories=count,
            device=self.study.device,
        )

    def choose_rule(self, chosen: Chosen, console: Console) -> None:
        """Sweep the adaptive rule on validation, within its budget of edges."""
        if (self.metrics / chosen.folder / RESULT).exists():
            return
        profile = self.study.profile
        run = Run(self, profile.model(chosen.weights), profile.seeds[0])
        run.require_training()
        config = self._sweep_config(chosen)
        sweep(replace(config, checkpoint=run.checkpoint, data=str(self.folder)), console)

    def time_steps(self, runs: Sequence[Run]) -> None:
        """Time a step under every model and policy in ``runs``, in turns, on true positions of one
        test trajectory; what has been timed is kept."""
        path = self.metrics / "times.json"
        content: dict[str, Any] = {"threads": self.study.threads, "times": {}}
        if path.exists():
            content = read_json(path)
        missing: dict[str, tuple[Run, PolicyName]] = {}
        for run in runs:
            for policy in run.model.policies:
                if (name := self.timed_name(run.model, policy)) not in content["times"]:
                    missing.setdefault(name, (run, policy))
        if not missing:
            return
        if content["threads"] != self.study.threads:
            raise StudyError(
                f"{path}: was timed with {content['threads']} threads, not {self.study.threads}; "
                f"give --threads {content['threads']}, or remove it"
            )
        test = open_split(self.folder, "test")
        sizes = test.particle_counts
        trajectory = test[int(np.argmin(np.abs(sizes - np.median(sizes))))]
        start = max(0, min(STATISTICS_STEP, len(trajectory.positions) - HISTORY - TIMED))
        trajectory = replace(trajectory, positions=trajectory.positions[start:])
        count = min(TIMED, len(trajectory.positions) - HISTORY)
        rolling: dict[str, Iterator[Step]] = {}
        for name, (run, policy) in missing.items():
            config = run.rollout_config(policy)
            rule = make_policy(policy, config.adaptive, k=config.k, seed=config.seed)
            if rule.needs_sigma:
                simulator = read_checkpoint(run.checkpoint).simulator()
            else:  # whatever its weights, a step has the same edges and takes as long
                simulator = build_simulator(run.config(), self.metadata).eval()
            rolling[name] = steps(
                simulator.to(torch_device(self.study.device)),
                trajectory,
                rule,
                count,
                radius=config.radius,
                teacher_forcing=True,
            )
        times: dict[str, list[Step]] = {name: [] for name in rolling}
        for _ in range(count):
            for name, each in rolling.items():
                times[name].append(next(each))
        write_json(
            path,
            {
                "particles": len(trajectory.particle_type),
                "threads": self.study.threads,
                "times": content["times"]
                | {
                    name: {
                        kind: float(np.median([getattr(step, kind) for step in taken]))
                        for kind in ("graph_ms", "model_ms", "edges")
                    }
                    | {"processor": processor()}
                    for name, taken in times.items()
                },
            },
        )

    def timed_name(self, model: Model, policy: PolicyName) -> str:
        """Names a step of ``model`` among the times; where a rule was chosen, with the rule."""
        name = f"{model.timed_as or model.name}, {policy}"
        if model.chosen is None:
            return name
        rule = self.rule(model.chosen)
        return ", ".join(
            [name, *(f"{part} {rule[part]:g}" for part in ("tau", "factor", "radius"))]
        )

    @property
    def times(self) -> dict[str, Any]:
        """What :meth:`time_steps` measured: by model and policy, and on what."""
        return read_json(self.metrics / "times.json")

    def step_time(self, model: Model, policy: PolicyName) -> dict[str, Any]:
        """Of :attr:`times`, those of one model under one policy, and whether they are from
        "elsewhere", another processor than that of the first."""
        name, times = self.timed_name(model, policy), self.times["times"]
        if name not in times:
            raise StudyError(
                f"{self.metrics / 'times.json'}: has no step of {name}; the command without "
                "--report-only times it"
            )
        first = next(iter(times.values()))
        elsewhere = times[name].get("processor") != first.get("processor")
        return {**times[name], "elsewhere": elsewhere}

    def pass_gate(self, console: Console) -> None:
        """Find how long the fixed graph's baseline must train until it does not clump."""
        profile, path = self.study.profile, self.metrics / "gate.json"
        if profile.gate is None or path.exists():
            return
        steps, ratios = profile.base.steps, {}
        while True:
            model = replace(MSE, name=f"gate-{steps}", share=steps / profile.base.steps)
            run = Run(self, model, profile.seeds[0])
            run.train(console)
            row = run.measured("fixed", split="valid", console=console)["rollouts"][0]
            mark = f"clumping@{self.study.last_mark}"
            if mark not in row["scalars"]:
                raise StudyError(
                    f"{self.name}: no validation trajectory reaches step {self.study.last_mark}"
                )
            ratio = row["scalars"][mark]["mean"]
            ratios[str(steps)] = ratio
            passed = ratio is not None and ratio <= profile.gate
            if passed or 2 * steps > profile.gate_steps:
                break
            steps *= 2
        write_json(path, {"steps": steps, "ratios": ratios, "wanted": profile.gate})


@dataclass(frozen=True)
class Run:
    """One training and its rollouts."""

    data: DataSet
    model: Model
    seed: int

    @property
    def name(self) -> str:
        """Names it in the study."""
        return f"{self.data.name}/{self.model.name}-{self.seed}"

    @property
    def study(self) -> Study:
        """That it is part of."""
        return self.data.study

    @property
    def folder(self) -> Path:
        """Of the training."""
        return self.study.out / "training" / self.data.name / f"{self.trained.name}-{self.seed}"

    @property
    def trained(self) -> Model:
        """The model whose training it uses, as a rule its own."""
        chosen = self.model.chosen
        return self.model if chosen is None else self.study.profile.model(chosen.weights)

    @property
    def shipped(self) -> Path | None:
        """The checkpoint that comes with the package, where it is what this run would train: of its
        configuration, and of its data; before those are described, of some of that name."""
        path = PRETRAINED / f"{self.data.name}.safetensors"
        if self.trained.radius == "matched" or not path.exists():
            return None
        checkpoint = read_checkpoint(path)
        if different(checkpoint.config, self._config(checkpoint.metadata.radius)):
            return None
        described = (self.data.metrics / "data.json").exists()
        return None if described and checkpoint.metadata != self.data.metadata else path

    @property
    def checkpoint(self) -> Path:
        """Of the training: its folder, or what comes with the package where nothing was trained."""
        if (self.folder / LAST).exists():
            return self.folder
        return self.shipped or self.folder

    def metrics(self, policy: PolicyName, split: Split = "test") -> Path:
        """What was measured under ``policy``."""
        ending = "" if split == "test" else f"-{split}"
        return self.data.metrics / f"{self.model.name}-{self.seed}-{policy}{ending}.json"

    @property
    def missing(self) -> list[tuple[PolicyName, Split]]:
        """What is to be measured: under which policies, over what."""
        long = self.data.long
        wanted: list[tuple[PolicyName, Split]] = [(each, "test") for each in self.model.policies]
        if long is not None and long.model == self.model.name:
            wanted += [(each, "long") for each in long.policies]
        return [each for each in wanted if not self.metrics(*each).exists()]

    @property
    def done(self) -> bool:
        """Whether everything has been measured."""
        return not self.missing

    @property
    def trained_whole(self) -> bool:
        """Whether its training has come to its end, or comes with the package."""
        last = self.folder / LAST
        if not last.exists():
            return self.shipped is not None
        checkpoint = self._own(last)
        return checkpoint.step == checkpoint.config.steps and checkpoint.validated

    def config(self) -> TrainConfig:
        """Of the training. StudyError where it depends on runs that are missing."""
        radius = float(self.data.described["radius"])
        config = self._config(radius)
        if self.model.radius == "matched":
            matched = matched_radius(self.data, self.model.matches, radius)
            config = replace(config, model=replace(config.model, radius=matched))
        return config

    def _config(self, radius: float) -> TrainConfig:
        """Of the training on data of that radius, but for a radius that depends on other runs."""
        base = replace(self.study.profile.base, steps=self.data.steps, data=self.data.source)
        return self.trained.config(base, self.seed, radius)

    def rollout_config(self, policy: PolicyName, split: Split = "test") -> RolloutConfig:
        """Of the rollouts under ``policy``; what of it is local says only where they belong."""
        profile, rule, radius = self.study.profile, ADAPTIVE, None
        if self.model.chosen is not None:
            chosen = self.data.rule(self.model.chosen)
            rule, radius = AdaptiveConfig(chosen["tau"], chosen["factor"]), chosen["radius"]
        return RolloutConfig(
            checkpoint=self.folder,
            out=self.folder / f"{self.model.name}-{policy}.h5",
            data=str(self.data.source),
            split="valid" if split == "valid" else "test",
            policy=policy,
            adaptive=rule,
            radius=radius,
            k=max(1, round(self.data.described["valid_degree"])),
            steps=None if split == "long" else profile.horizon,
            trajectories=profile.trajectories_of(self.model, split),
            seed=self.seed,
            device=self.study.device,
        )

    def do(self, console: Console) -> None:
        """Make what is missing of it."""
        if self.done:
            return
        if self.model.chosen is None:
            self.train(console)
        else:
            self.require_training()
            self.data.choose_rule(self.model.chosen, console)
        drawn = (*DRAWN, self.study.profile.seeds[0], "test")
        for policy, split in self.missing:
            snapshot = (self.model.name, policy, self.seed, split) == drawn
            content = self.measured(policy, console=console, split=split, snapshot=snapshot)
            write_json(self.metrics(policy, split), content)

    def require_training(self) -> None:
        """Raise StudyError unless its training is done."""
        name = f"{self.data.name}/{self.trained.name}-{self.seed}"
        last = self.folder / LAST
        if not last.exists():
            if self.shipped is not None:
                return
            raise StudyError(f"{self.name}: needs {name}, which is missing")
        checkpoint = self._own(last)
        if checkpoint.step < checkpoint.config.steps or not checkpoint.validated:
            raise StudyError(
                f"{self.name}: needs {name}, which is at step {checkpoint.step} of "
                f"{checkpoint.config.steps}"
            )

    def _own(self, last: Path) -> Checkpoint:
        """The checkpoint ``last``. StudyError where it is of another configuration or of other
        data."""
        checkpoint = read_checkpoint(last)
        refuse_difference(str(last), checkpoint.config, self.config())
        if checkpoint.metadata != self.data.metadata:
            raise StudyError(f"{last}: was trained on other data. Remove it, or give another --out")
        return checkpoint

    def train(self, console: Console) -> None:
        """Train to the end, from where it was left."""
        config = replace(
            self.config(),
            data=str(self.data.folder),
            out=self.folder,
            device=self.study.device,
            threads=self.study.threads,
        )
        if self.trained_whole:
            return
        if (self.folder / LAST).exists():
            config = replace(config, resume=self.folder)
        console.print(f"{self.name}: training", highlight=False)
        with run_folder(config) as folder:
            train(config, folder, console, ALONE)

    def measured(
        self,
        policy: PolicyName,
        *,
        console: Console,
        split: Split = "test",
        snapshot: bool = False,
    ) -> dict[str, Any]:
        """Roll out under ``policy``, and measure; the report as JSON, of which nothing tells where
        it was made."""
        folder = self.data.long_folder if split == "long" else self.data.folder
        config = replace(
            self.rollout_config(policy, split), checkpoint=self.checkpoint, data=str(folder)
        )
        origin = "" if config.checkpoint == self.folder else ", the package's weights"
        console.print(f"{self.name}: {split}, {policy}{origin}", highlight=False)
        write_rollouts(config, console)
        marks, fingerprint = self._measures(split)
        content = measure([config.out], marks).to_json()
        if snapshot:
            write_snapshot(config.out, self.metrics(policy).with_suffix(".npz"))
        config.out.unlink()
        del content["baselines"]  # the same for every run
        for row in content["rollouts"]:
            row["file"] = None
            for settings in (row["settings"], row["settings"]["training"]):
                for name in ("out", "checkpoint", "resume"):
                    settings.pop(name, None)
                settings["data"] = self.data.name
        content["data_fingerprint"] = fingerprint
        return content

    def _measures(self, split: Split) -> tuple[tuple[int, ...], str]:
        """Steps at which errors are reported, and what tells the data."""
        if split == "long":
            assert self.data.long is not None
            return self.data.long.marks, self.data.described_long["fingerprint"]
        return self.study.profile.marks, self.data.described["fingerprint"]

    def read(self, policy: PolicyName, split: Split = "test") -> dict[str, Any]:
        """The row of metrics of a split under ``policy``.

        StudyError where it is missing, or not what this run would measure.
        """
        path = self.metrics(policy, split)
        if not path.exists():
            raise StudyError(
                f"{path}: missing; run `python -m adaptgns.reproduce --preset {self.study.preset} "
                f"--only '{self.name}'`"
            )
        content = read_json(path)
        marks, fingerprint = self._measures(split)
        if content["data_fingerprint"] != fingerprint:
            raise StudyError(f"{path}: was measured on other data. Remove it")
        if content["marks"] != sorted(marks):
            raise StudyError(f"{path}: was measured at other steps, {content['marks']}. Remove it")
        row: dict[str, Any] = content["rollouts"][0]
        settings = row["settings"]
        trained = from_json(TrainConfig, settings["training"], source=str(path))
        refuse_difference(str(path), trained, self.config())
        asked = self.rollout_config(policy, split)
        # What older files lack has its default.
        known = {name: settings[name] for name in to_json(asked) if name in settings}
        local = {"checkpoint": "", "out": ""}
        made = from_json(RolloutConfig, {**local, **known}, source=str(path))
        refuse_difference(str(path), made, asked)
        return row


def _describes(path: Path, fingerprint: str, folder: Path) -> bool:
    """Whether ``path`` is there. StudyError where it describes other data than ``folder`` holds."""
    if not path.exists():
        return False
    if read_json(path).get("fingerprint") != fingerprint:
        raise StudyError(f"{path}: describes other data than those in {folder}. Give another --out")
    return True


def courses(split: Trajectories) -> Iterator[NDArray[np.float32]]:
    """Positions ``[1 + steps, N, d]`` from the last that a rollout is given."""
    return (trajectory.positions[HISTORY - 1 :] for trajectory in split)


def centroid_mse(split: Trajectories, marks: Iterable[int]) -> dict[str, list[float]]:
    """Of each trajectory, by step: the error of putting every particle at the true centre of all;
    NaN past its end."""
    errors = [frames.var(axis=1, dtype=np.float64).mean(axis=1) for frames in courses(split)]
    return {
        str(mark): [float(each[mark]) if mark < len(each) else math.nan for each in errors]
        for mark in marks
    }


def matched_radius(data: DataSet, name: str, radius: float) -> float:
    """The radius of the fixed graph that has as many edges as the adaptive one of the model
    ``name`` in rollouts of the validation split with the first seed, by a line in the radius
    squared through two models' rollouts. StudyError where that is far from both."""
    profile = data.study.profile
    seed = profile.seeds[0]
    denser = next((m for m in profile.models if m.radius == DENSER), None)
    if denser is None:
        raise StudyError("matched radius: the profile has no model with the denser graph")
    sparse = valid_edges(data, MSE, seed, "fixed")
    dense = valid_edges(data, denser, seed, "fixed")
    adaptive = valid_edges(data, profile.model(name), seed, "adaptive")
    share = (adaptive - sparse) / (dense - sparse) if dense > sparse else math.inf
    squared = 1 + share * (DENSER**2 - 1)
    if not FARTHEST**-2 <= squared <= FARTHEST**2:
        raise StudyError(
            f"{data.name}: no radius matches the {adaptive:,.0f} edges of {name}, adaptive: fixed "
            f"graphs have {sparse:,.0f} at {radius:g} and {dense:,.0f} at {DENSER * radius:g}"
        )
    return six_digits(radius * math.sqrt(squared))


def valid_edges(
    data: DataSet, model: Model, seed: int, policy: PolicyName, *, trajectories: int | None = None
) -> float:
    """Edges per step of a model's rollouts of the validation split, which are made once; of its
    first ``trajectories``, or all."""
    run = Run(data, model, seed)
    path = run.metrics(policy, "valid")
    if not path.exists():
        run.require_training()
        write_json(path, run.measured(policy, split="valid", console=Console(quiet=True)))
    edges = run.read(policy, "valid")["scalars"]["edges_per_step"]["per_trajectory"]
    return float(np.mean(np.array(edges[:trajectories], dtype=np.float64)))


def different(made: object, wanted: object) -> list[str]:
    """Settings that two configurations differ in, but for where and how they ran."""
    found, asked = to_json(made), to_json(wanted)
    return [name for name in asked if name not in LOCAL and found[name] != asked[name]]


def refuse_difference(path: str, made: object, wanted: object) -> None:
    """Raise StudyError where two configurations differ in more than where and how they ran."""
    for name in different(made, wanted):
        raise StudyError(
            f"{path}: was made with {name} {to_json(made)[name]}; the study has "
            f"{to_json(wanted)[name]}. Remove it, or give another --out"
        )


def write_snapshot(rollouts: Path, path: Path) -> None:
    """Keep frames of the first trajectory in ``rollouts``: positions ``[S, N, d]`` and sigma
    ``[S, N]`` after the steps ``[S]``, and what the graph is made with besides."""
    with RolloutFile(rollouts) as file:
        rollout = file[0]
        steps = [step for step in SNAPSHOTS if step <= rollout.steps]
        rows = [step - 1 for step in steps]
        arrays = {
            "steps": np.array(steps),
            "predicted": rollout.predicted[rows],
            "true": rollout.true[rows],
            "mobile": file.metadata.mobile(rollout.particle_type),
            "box": np.full(file.metadata.dim, np.inf)
            if file.metadata.box is None
            else file.metadata.box,
        }
        sigma = rollout.sigma
        if sigma is not None:
            arrays["sigma"] = sigma[rows]
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as partial, partial.open("wb") as stream:
        np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]


def read_machines(study: Path) -> list[dict[str, Any]]:
    """Those that the study in this folder was made on, each as of its last day; of older ones the
    file holds the last alone."""
    content: Any = read_json(study / MACHINES)
    return content if isinstance(content, list) else [content]


def processor() -> str:
    """Its name, as the system tells it."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def read_json(path: Path) -> dict[str, Any]:
    """What :func:`~adaptgns.atomic.write_json` wrote; StudyError where there is nothing."""
    try:
        content: dict[str, Any] = json.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        raise StudyError(f"{path}: missing; `python -m adaptgns.reproduce` writes it") from None
    except ValueError as error:
        raise StudyError(f"{path}: not readable as JSON: {error}") from None
    return content
