"""Data sets: what they know about themselves, and their trajectories, read lazily."""

from adaptgns.data.errors import DataError, DataWarning
from adaptgns.data.metadata import Metadata, read_metadata, write_metadata
from adaptgns.data.trajectories import Trajectories, Trajectory, open_split

__all__ = [
    "DataError",
    "DataWarning",
    "Metadata",
    "Trajectories",
    "Trajectory",
    "open_split",
    "read_metadata",
    "write_metadata",
]
