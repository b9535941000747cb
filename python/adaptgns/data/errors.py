"""How wrong data is told."""


class DataError(ValueError):
    """Data that can't be used. The message names the file, the trajectory and the frame."""


class DataWarning(UserWarning):
    """Data that can be used but is probably not what its owner thinks it is."""
