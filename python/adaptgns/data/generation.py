"""Makes whole data sets with the embedded solver: in parallel, in constant memory, resumable."""

from __future__ import annotations

import hashlib
import json
import os
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import Progress

from adaptgns import _core
from adaptgns.data.errors import DataError
from adaptgns.data.metadata import FILE_NAME, GNS_KINEMATIC, period_lengths, write_metadata
from adaptgns.data.scenes import SCENES, SceneName
from adaptgns.data.statistics import MotionAccumulator, MotionStatistics, compute_statistics
from adaptgns.data.store import StoreWriter, partial_path, read_origin
from adaptgns.data.trajectories import Trajectories, open_split
from adaptgns.data.trajectory import MIN_FRAMES, Trajectory
from adaptgns.interruption import interruption
from adaptgns.progress import progress_bar

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

_SOLVER = "adaptgns MLS-MPM"


@dataclass(frozen=True)
class SplitPlan:
    """Everything that decides the content of one generated split.

    Attributes:
        scene: which random scenes are drawn.
        trajectories: how many.
        frames: frames of each.
        seed: together with the split's name and a trajectory's number it seeds that trajectory,
            so that a shorter split is a prefix of a longer one.
        dim: 2 or 3.
        particles: fewest and most particles of a trajectory, obstacles not counted; None for the
            published sizes.
    """

    scene: SceneName
    trajectories: int
    frames: int
    seed: int = 0
    dim: int = 2
    particles: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if self.scene not in SCENES:
            raise DataError(f"scene is {self.scene!r}; {', '.join(SCENES)} are accepted")
        if self.trajectories < 1:
            raise DataError(f"trajectories is {self.trajectories}; 1 or more are accepted")
        if self.frames < MIN_FRAMES:
            raise DataError(f"frames is {self.frames}; {MIN_FRAMES} or more are accepted")
        if self.dim not in {2, 3}:
            raise DataError(f"dim is {self.dim}; 2 or 3 are accepted")


def trajectory_seed(seed: int, split: str, index: int) -> int:
    """The solver's seed for one trajectory: 63 bits of a hash, independent of all others."""
    digest = hashlib.sha256(f"{seed}/{split}/{index}".encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1


def generate_dataset(
    folder: Path, plans: Mapping[str, SplitPlan], *, console: Console | None = None
) -> None:
    """Makes the splits of `plans` and their `metadata.json` in `folder`.

    Splits that were finished earlier by the same plan are kept. A split that was interrupted is
    started anew, and said to be. Nothing that something else wrote is ever replaced.

    Args:
        folder: made if missing.
        plans: the plan of each split, by its name; `train` must be among them.
        console: where progress is shown; standard error by default.

    Raises:
        DataError: the folder holds other data, or a plan can't be.
        OSError: the disk is full or the folder can't be written.
    """
    console = console or Console(stderr=True)
    if "train" not in plans:
        raise DataError(f"splits are {', '.join(plans)}; train is needed, for the statistics")
    folder = Path(folder)
    made = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        _generate(folder, plans, console)
    finally:
        if made:
            with suppress(OSError):
                folder.rmdir()  # where nothing came of it, it is empty


def _generate(folder: Path, plans: Mapping[str, SplitPlan], console: Console) -> None:
    finished = [split for split, plan in plans.items() if _is_finished(folder, split, plan)]
    _refuse_foreign_metadata(folder)
    statistics = None
    with progress_bar(console, "trajectories") as progress:
        for split, plan in plans.items():
            path = folder / f"{split}.h5"
            if split in finished:
                progress.console.print(f"{path} was finished before; kept", highlight=False)
                continue
            if partial_path(path).exists():
                progress.console.print(
                    f"{partial_path(path)} was left by an interrupted run; {split} starts anew",
                    highlight=False,
                )
            motion = _write_split(path, split, plan, progress)
            if split == "train":
                statistics = motion
    if statistics is None:
        train = open_split(folder, "train")
        box = _box(plans["train"])
        statistics = compute_statistics(train, box=box, kinematic_types=GNS_KINEMATIC)
    opened = {split: open_split(folder, split) for split in plans}
    write_metadata(folder, _metadata(plans["train"], opened, statistics))


def simulate_split(split: str, plan: SplitPlan) -> Iterator[Trajectory]:
    """The trajectories of a split, in order, simulated on all cores.

    At most two per core are under way or waiting, so memory doesn't grow with the split.
    """
    workers = _cores()
    pool = ThreadPoolExecutor(workers, thread_name_prefix="simulate")
    pending: deque[Future[Trajectory]] = deque()
    submitted = 0
    try:
        while pending or submitted < plan.trajectories:
            while submitted < plan.trajectories and len(pending) < 2 * workers:
                pending.append(pool.submit(_simulate, split, plan, submitted))
                submitted += 1
            yield pending.popleft().result()
    finally:
        # Not waited for: an interrupted run ends as soon as its current trajectories do.
        pool.shutdown(wait=False, cancel_futures=True)


def _simulate(split: str, plan: SplitPlan, index: int) -> Trajectory:
    positions, particle_type = _core.simulate(
        plan.scene,
        seed=trajectory_seed(plan.seed, split, index),
        frames=plan.frames,
        dim=plan.dim,
        particles=plan.particles,
    )
    return Trajectory(f"{index:05d}", positions, particle_type)


def _write_split(path: Path, split: str, plan: SplitPlan, progress: Progress) -> MotionStatistics:
    motion = MotionAccumulator(plan.dim, box=_box(plan), kinematic_types=GNS_KINEMATIC)
    task = progress.add_task(split, total=plan.trajectories)
    with interruption() as interrupted, StoreWriter(path, origin=_origin(split, plan)) as writer:
        for trajectory in simulate_split(split, plan):
            writer.append(trajectory)
            motion.add(trajectory.positions, trajectory.particle_type)
            progress.advance(task)
            if interrupted:
                raise KeyboardInterrupt
    return motion.finish()


def _origin(split: str, plan: SplitPlan) -> str:
    return json.dumps({"solver": _SOLVER, "split": split, **asdict(plan)}, sort_keys=True)


def _is_finished(folder: Path, split: str, plan: SplitPlan) -> bool:
    """Whether the split is there already, made by this plan.

    Raises:
        DataError: something else is there.
    """
    taken = [folder / f"{split}{suffix}" for suffix in (".npz", ".h5")]
    path = next((path for path in taken if path.exists()), None)
    if path is None:
        return False
    origin = read_origin(path)
    if origin == _origin(split, plan):
        return True
    if origin is None:
        raise DataError(f"{path}: exists and wasn't generated by adaptgns; choose another folder")
    made = json.loads(origin)
    wanted = json.loads(_origin(split, plan))
    different = ", ".join(
        f"{key} {made.get(key)} instead of {wanted.get(key)}"
        for key in sorted(made.keys() | wanted.keys())
        if made.get(key) != wanted.get(key)
    )
    raise DataError(
        f"{path}: exists and was generated differently ({different}); choose another folder or "
        "remove it"
    )


def _refuse_foreign_metadata(folder: Path) -> None:
    path = folder / FILE_NAME
    try:
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        return
    except ValueError:
        content = None
    if not isinstance(content, dict) or content.get("solver") != _SOLVER:
        raise DataError(f"{path}: exists and wasn't generated by adaptgns; choose another folder")


def _metadata(
    plan: SplitPlan, splits: Mapping[str, Trajectories], statistics: MotionStatistics
) -> dict[str, Any]:
    """The keys of both GNS and LagrangeBench, whose sequence lengths leave out the last frame."""
    scene = SCENES[plan.scene]
    content: dict[str, Any] = {
        "case": plan.scene,
        "solver": _SOLVER,
        "dim": plan.dim,
        "dt": scene.dt,
        "write_every": 1,
        "bounds": [[scene.low, scene.high]] * plan.dim,
        "periodic_boundary_conditions": [scene.periodic] * plan.dim,
        "kinematic_types": list(GNS_KINEMATIC),
        "material_properties": 0,
        "default_connectivity_radius": scene.radii[plan.dim - 2],
        "sequence_length": plan.frames - 1,
        "num_particles_max": max(int(split.particle_counts.max()) for split in splits.values()),
    }
    for name, split in splits.items():
        content[f"sequence_length_{name}"] = int(split.lengths.max()) - 1
        content[f"num_trajs_{name}"] = len(split)
    return content | statistics.to_file_keys()


def _box(plan: SplitPlan) -> npt.NDArray[np.float64] | None:
    scene = SCENES[plan.scene]
    return period_lengths(((scene.low, scene.high),) * plan.dim, (scene.periodic,) * plan.dim)


def _cores() -> int:
    """Cores that this process may use, which a container or a batch system may restrict."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
