"""The animation shows what it should."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from adaptgns import video
from adaptgns.animation import Animation
from adaptgns.data.metadata import Metadata
from adaptgns.plot import animate, main, viewer
from adaptgns.rollout_file import RolloutFile
from adaptgns.view import View
from tests.unit.rollouts import write_rollout


@pytest.fixture
def adaptive(tmp_path: Path, metadata: Metadata) -> Path:
    rule = {"tau": 70.0, "factor": 3.0}
    return write_rollout(tmp_path / "a.h5", metadata, policy="adaptive", adaptive=rule)


def picture(path: Path, row: int = 6) -> np.ndarray:
    with RolloutFile(path) as file:
        return next(Animation(file, file[0], every=1).pictures([row])).astype(int)


def panel(image: np.ndarray, right: bool) -> np.ndarray:
    """The inside of one of the two panels of particles."""
    height, width = image.shape[:2]
    half = width // 2
    return image[height // 10 : 7 * height // 10, half * right : half * (1 + right)]


def colours(image: np.ndarray) -> set[tuple[int, ...]]:
    return {tuple(colour) for colour in np.unique(image.reshape(-1, 3), axis=0)}


def test_gif_has_every_nth_step_and_the_last(tmp_path: Path, adaptive: Path) -> None:
    animate(adaptive, tmp_path / "new" / "a.gif", every=5, fps=20)
    with Image.open(tmp_path / "new" / "a.gif") as gif:
        # Of 12 steps: 5, 10 and 12.
        assert (gif.n_frames, gif.info["duration"], gif.info["loop"]) == (3, 50, 0)
        frames = []
        for index in range(gif.n_frames):
            gif.seek(index)
            frames.append(np.asarray(gif.convert("RGB")))
    assert all(len(colours(panel(frame, right))) > 20 for frame in frames for right in (0, 1))
    assert not np.array_equal(panel(frames[0], False), panel(frames[2], False))
    assert not np.array_equal(panel(frames[0], True), panel(frames[2], True))


def test_mp4_shows_the_pictures_of_the_gif(tmp_path: Path, adaptive: Path) -> None:
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is missing")
    animate(adaptive, tmp_path / "new" / "a.mp4", every=5, fps=20)
    film = str(tmp_path / "new" / "a.mp4")
    decode = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", film, "-f", "rawvideo", "-pix_fmt", "rgb24"]
    decoded = subprocess.run([*decode, "-"], capture_output=True, check=True)
    for expected in (b"h264", b"yuv420p", b"960x660", b"20 fps"):
        assert expected in decoded.stderr
    frames = np.frombuffer(decoded.stdout, np.uint8).reshape(-1, 660, 960, 3).astype(int)
    # Steps 5, 10 and 12, the last for a second.
    assert len(frames) == 22
    for frame, row in ((0, 4), (1, 9), (2, 11), (21, 11)):
        drawn = picture(adaptive, row)
        others = [np.abs(picture(adaptive, other) - frames[frame]).mean() for other in (2, 6)]
        # Lossy, and with a fourth of the colours; another step is farther away.
        assert np.abs(drawn - frames[frame]).mean() < min(3, *others)
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["a.mp4"]


@pytest.mark.parametrize("fails", ["at once", "at the end"])
def test_a_film_that_cannot_be_encoded_does_not_appear(
    tmp_path: Path, adaptive: Path, monkeypatch: pytest.MonkeyPatch, fails: str
) -> None:
    program = tmp_path / "ffmpeg"
    reading = "cat > /dev/null" if fails == "at the end" else ""
    program.write_text(f"#!/bin/sh\n{reading}\necho 'no space left' >&2\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setattr(video, "_ffmpeg", lambda: str(program))
    with pytest.raises(OSError, match=r"a\.mp4: ffmpeg could not write it: no space left"):
        animate(adaptive, tmp_path / "film" / "a.mp4", every=5)
    assert not list((tmp_path / "film").iterdir())


def test_without_its_package_or_with_another_suffix_no_film(
    tmp_path: Path,
    adaptive: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    told = {
        "a.mp4": "imageio-ffmpeg, which is not installed: pip install 'adaptgns[video]'",
        "a.avi": "a.avi; accepted are names that end in .gif or .mp4",
    }
    for name, message in told.items():
        with pytest.raises(SystemExit, match="2"):
            main(["animate", str(adaptive), "--out", str(tmp_path / name)])
        assert message in capsys.readouterr().err
        assert not (tmp_path / name).exists()


def test_without_a_program_no_film(
    tmp_path: Path,
    adaptive: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is missing")
    monkeypatch.delenv("IMAGEIO_FFMPEG_EXE", raising=False)
    monkeypatch.setattr(imageio_ffmpeg._utils, "_get_ffmpeg_exe", lambda: None)
    with pytest.raises(SystemExit, match="2"):
        main(["animate", str(adaptive), "--out", str(tmp_path / "a.mp4")])
    told = capsys.readouterr().err
    assert "which imageio-ffmpeg doesn't bring for this machine: install ffmpeg" in told
    assert told.count("\n") == 1
    assert not (tmp_path / "a.mp4").exists()


def test_sigma_colours_the_prediction_alone(tmp_path: Path, metadata: Metadata) -> None:
    path = write_rollout(tmp_path / "a.h5", metadata)
    before = picture(path)
    with h5py.File(path, "r+") as file:
        file["00000/sigma"][6] = file["00000/sigma"][6][::-1]
    after = picture(path)
    np.testing.assert_array_equal(panel(after, False), panel(before, False))
    assert not np.array_equal(panel(after, True), panel(before, True))


def test_without_sigma_both_sides_show_the_speed(tmp_path: Path, metadata: Metadata) -> None:
    path = write_rollout(tmp_path / "a.h5", metadata, sigma=False, error=0.0)
    image = picture(path)
    assert colours(panel(image, False)) & colours(panel(image, True)) > {(10, 13, 19)}


def test_extra_edges_are_drawn_for_the_adaptive_policy(
    tmp_path: Path, metadata: Metadata, adaptive: Path
) -> None:
    def green_pixels(path: Path) -> int:
        red, green, blue = np.moveaxis(panel(picture(path), True), -1, 0)
        return int(((green > red + 50) & (green > blue + 10)).sum())

    fixed = write_rollout(tmp_path / "f.h5", metadata, policy="fixed")
    assert green_pixels(adaptive) > 20
    assert green_pixels(fixed) == 0


def test_particles_are_where_they_are(tmp_path: Path, metadata: Metadata) -> None:
    path = write_rollout(tmp_path / "a.h5", metadata)
    with h5py.File(path, "r+") as file:
        file["00000/predicted"][6] = [0.8, 0.8]
    image = panel(picture(path), True)
    bright = np.argwhere(image.max(axis=-1) > 120)
    high, right = bright.mean(axis=0) / image.shape[:2]
    assert high < 0.35
    assert right > 0.7


def test_what_is_not_finite_is_refused(tmp_path: Path, adaptive: Path) -> None:
    with h5py.File(adaptive, "r+") as file:
        file["00000/predicted"][6, 0] = np.nan
    with pytest.raises(ValueError, match="positions that are not finite"):
        animate(adaptive, tmp_path / "a.gif")
    assert not (tmp_path / "a.gif").exists()


def test_command(tmp_path: Path, adaptive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "a.gif"
    main(["animate", str(adaptive), "--out", str(out), "--every", "6"])
    assert out.stat().st_size > 1000
    for wrong in (["--trajectory", "2"], ["--every", "0"]):
        with pytest.raises(SystemExit) as stopped:
            main(["animate", str(adaptive), "--out", str(out), *wrong])
        assert stopped.value.code == 2
    assert "error: every, fps: got 0" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--out", "a.gif"], "out: got a.gif; a file called .html is accepted"),
        (["--out", "a.html", "--trajectory", "2"], "trajectory: got 2; "),
        (["--out", "a.html", "--trajectory", "-1"], "trajectory: got -1; "),
    ],
)
def test_viewer_refuses(
    tmp_path: Path,
    adaptive: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    told: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        main(["viewer", str(adaptive), *arguments])
    assert stopped.value.code == 2
    assert f"error: {told}" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


def test_viewer_refuses_a_scene_that_predicts_nothing(tmp_path: Path, adaptive: Path) -> None:
    with h5py.File(adaptive, "r+") as file:
        file["00000/particle_type"][:] = 3
    with pytest.raises(ValueError, match=r"trajectory block 0 .*has kinematic particles only"):
        viewer(adaptive, tmp_path / "a.html")


@pytest.mark.parametrize("periodic", [False, True])
def test_viewer_shows_what_diverged(tmp_path: Path, metadata: Metadata, periodic: bool) -> None:
    path = write_rollout(tmp_path / "a.h5", replace(metadata, periodic=(periodic, False)))
    with h5py.File(path, "r+") as file:
        file["00000/predicted"][4:] = np.inf
        file["00000/sigma"][:] = np.nan
    viewer(path, tmp_path / "a.html")


def test_viewer_page_is_whole_by_itself(tmp_path: Path, adaptive: Path) -> None:
    viewer(adaptive, tmp_path / "a.html")
    page = (tmp_path / "a.html").read_text("utf-8")
    assert not [word for word in ("http", "src=", "href=", "import(", "fetch(") if word in page]
    assert "{{" not in page
    viewer(adaptive, tmp_path / "b.html")
    assert (tmp_path / "b.html").read_text("utf-8") == page


def in_three_dimensions(metadata: Metadata) -> Metadata:
    vectors = ("velocity_mean", "velocity_std", "acceleration_mean", "acceleration_std")
    return replace(
        metadata,
        dim=3,
        bounds=((0.0, 1.0), (0.0, 1.0), (0.0, 2.0)),
        periodic=(False, False, False),
        **{name: (1.0, 1.0, 1.0) for name in vectors},
    )


def test_view_of_three_dimensions(metadata: Metadata) -> None:
    view = View(in_three_dimensions(metadata))
    positions = np.array([[0.2, 0.3, 0.1], [0.2, 0.3, 1.9], [0.9, 0.3, 0.1], [0.2, 0.9, 0.1]])
    points, order = view.points(positions)
    assert sorted(order) == [0, 1, 2, 3]
    # The second axis points straight up; all that is in the bounds is in the picture.
    assert points[3, 0] == pytest.approx(points[0, 0])
    assert points[3, 1] > points[0, 1]
    # From the front right corner: x goes right, and z out of the picture.
    assert points[2, 0] > points[0, 0]
    assert list(order).index(1) > list(order).index(0)
    corners = view.frame.reshape(-1, 2)
    assert (len(view.frame), len(view.front)) == (9, 3)
    assert (corners > view.lower).all()
    assert (corners < view.upper).all()
    assert (points > view.lower).all()
    assert (points < view.upper).all()


@pytest.mark.parametrize("solid", [False, True])
def test_what_covers_what(metadata: Metadata, solid: bool) -> None:
    view = View(in_three_dimensions(metadata) if solid else metadata)
    # The second and third are kinematic. In 3D they are in front, the first is farthest away.
    positions = np.array([[0.2, 0.2, 0.2], [0.8, 0.2, 1.8], [0.7, 0.2, 1.7]])[:, : 2 + solid]
    artist = Figure().subplots().scatter([], [], linewidths=0)
    view.paint(
        artist,
        positions,
        np.tile([1.0, 0.0, 0.0, 1.0], (3, 1)),
        np.array([True, False, False]),
        kinematic="#0000ff",
        background="#000000",
    )
    faces = artist.get_facecolors()
    if solid:
        assert (faces[0, 0] > 0, list(faces[1:, 0])) == (True, [0, 0])
        assert faces[0, 0] < faces[1, 2] < faces[2, 2] < 1  # paler the farther
        assert (artist.get_edgecolors()[:, :3] <= faces[:, :3]).all()
        np.testing.assert_allclose(artist.get_offsets()[2], view.points(positions)[0][1])
    else:
        np.testing.assert_array_equal(faces[:, :3], [[0, 0, 1], [0, 0, 1], [1, 0, 0]])
        assert not artist.get_linewidths().any()


def test_edges_through_a_periodic_boundary_are_not_drawn(metadata: Metadata) -> None:
    view = View(replace(metadata, periodic=(True, False)))
    positions = np.array([[0.11, 0.5], [0.12, 0.5], [0.89, 0.5]])
    pairs = np.array([[0, 1, 0, 2], [1, 0, 2, 0]])
    np.testing.assert_allclose(view.segments(positions, pairs), [positions[:2]])


def test_periodic_positions_are_shown_inside_the_bounds(metadata: Metadata) -> None:
    view = View(replace(metadata, periodic=(True, False)))
    points, _ = view.points(np.array([[0.95, 0.95]]))
    np.testing.assert_allclose(points, [[0.15, 0.95]])


def test_particles_out_of_sight_are_counted(metadata: Metadata) -> None:
    positions = np.array([[0.5, 0.5], [0.895, 0.105], [0.5, -3.0], [1.2, 1.2], [0.5, 0.95]])
    assert View(metadata).outside(positions) == 3
