"""MP4 files of pictures, encoded by the ffmpeg that the package imageio-ffmpeg brings.

The program is run here, not by that package: its writer does not look at the exit status, so that
a full disk would leave half a film under the name of a whole one.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adaptgns.atomic import written_whole

CONSTANT_QUALITY = "18"
"""Of x264, from 0 (as it is) to 51; thin lines stay sharp at 18"""


def write_mp4(
    path: Path, pictures: Iterable[NDArray[np.uint8]], size: tuple[int, int], fps: int
) -> None:
    """Write ``pictures`` ``[height, width, 3]`` to ``path``, H.264, whole or not at all.

    ``size`` is their width and height, both even; ``fps`` counts pictures per second. ImportError
    without imageio-ffmpeg, OSError where it has no program or encoding or writing fails.
    """
    program = _ffmpeg()
    with written_whole(path) as partial, tempfile.TemporaryFile() as complaints:
        command = [
            *(program, "-y", "-loglevel", "error"),
            *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}"),
            *("-r", str(fps), "-i", "-"),
            # Players know no other subsampling; those that stream want the index in front.
            *("-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", CONSTANT_QUALITY),
            *("-movflags", "+faststart", "-f", "mp4", str(partial)),
        ]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=complaints) as encoder:
            assert encoder.stdin is not None
            try:
                for picture in pictures:
                    encoder.stdin.write(picture.tobytes())
                encoder.stdin.close()
            except BrokenPipeError:
                pass  # It ended early, and has told why.
            except BaseException:
                encoder.kill()
                raise
        if encoder.returncode != 0:
            complaints.seek(0)
            told = complaints.read().decode(errors="replace").strip()
            raise OSError(f"{path}: ffmpeg could not write it: {told or encoder.returncode}")


def _ffmpeg() -> str:
    try:
        # Optional: nothing else needs it.
        import imageio_ffmpeg  # noqa: PLC0415
    except ImportError:
        raise ImportError(
            "MP4 files are encoded with imageio-ffmpeg, which is not installed: "
            "pip install 'adaptgns[video]'; a GIF needs nothing more"
        ) from None
    try:
        program: str = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError:
        raise FileNotFoundError(
            "MP4 files are encoded with ffmpeg, which imageio-ffmpeg doesn't bring for this "
            "machine: install ffmpeg, or name its program in the variable IMAGEIO_FFMPEG_EXE; a "
            "GIF needs nothing more"
        ) from None
    return program
