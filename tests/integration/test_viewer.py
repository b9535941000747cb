"""The page that `plot viewer` writes, in a real browser."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from PIL import Image
from selenium import webdriver

from adaptgns import palette, viewer
from adaptgns._core import adaptive_graph, radius_graph
from adaptgns.data.metadata import Metadata
from adaptgns.data.trajectory import Trajectory
from adaptgns.metrics import position_mse
from adaptgns.plot import main
from adaptgns.rollout_file import RolloutFile, RolloutWriter
from tests.unit.rollouts import Step, settings, write_rollout

RULE = {"tau": 70.0, "factor": 1.6}
Open = Callable[[Path], Any]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium without a window or a graphics card, at 1200 × 800.

    Tests skip where there is none, but fail where CI is true.
    """
    program, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if not (program and driver):
        absent = pytest.fail if os.environ.get("CI") == "true" else pytest.skip
        absent("no Chromium here (Debian: apt-get install chromium chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(argument)
    options.add_argument("--window-size=1200,900")
    service = webdriver.ChromeService(executable_path=driver)
    opened = webdriver.Chrome(options=options, service=service)
    try:
        yield opened
    finally:
        opened.quit()


@pytest.fixture
def show(browser: Any, tmp_path: Path) -> Open:
    """Makes a rollout's page and opens it; what it drew is on the screen."""

    def show(rollout: Path) -> Any:
        page = tmp_path / "page.html"
        main(["viewer", str(rollout), "--out", str(page)])
        browser.get(page.as_uri())
        settle(browser)
        assert browser.get_log("browser") == []
        return browser

    return show


@pytest.fixture
def adaptive(tmp_path: Path, metadata: Metadata) -> Path:
    return write_rollout(tmp_path / "a.h5", metadata, policy="adaptive", adaptive=RULE)


def settle(browser: Any) -> None:
    """Wait until the page has drawn what it last was asked for."""
    browser.set_script_timeout(20)
    browser.execute_async_script(
        "const done = arguments[0]; const look = () => window.viewer && viewer.draws && "
        "!viewer.waiting ? done() : setTimeout(look, 10); look();"
    )


def run(browser: Any, script: str) -> Any:
    result = browser.execute_script(script)
    settle(browser)
    return result


def press(browser: Any, *keys: str) -> int:
    """The frame after these keys."""
    for key in keys:
        run(
            browser,
            f"document.dispatchEvent(new KeyboardEvent('keydown', {{key: '{key}'}}))",
        )
    return int(run(browser, "return viewer.frame"))


def picture(browser: Any) -> np.ndarray:
    """``[height, width, 3]`` of the canvas as it is on the screen."""
    canvas = browser.find_element("id", "particles")
    with Image.open(BytesIO(canvas.screenshot_as_png)) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def text(browser: Any, name: str) -> str:
    return str(browser.find_element("id", name).text)


def test_keys_slider_and_curves_move_through_the_steps(adaptive: Path, show: Open) -> None:
    page = show(adaptive)
    start = picture(page)
    assert len(np.unique(start.reshape(-1, 3), axis=0)) > 50
    assert press(page, "ArrowRight", "ArrowRight") == 2
    assert text(page, "now") == "step 2 of 12"
    assert not np.array_equal(picture(page), start)
    assert press(page, "End", "ArrowRight") == 12
    assert press(page, "ArrowLeft") == 11
    assert press(page, "Home", "ArrowLeft") == 0
    np.testing.assert_array_equal(picture(page), start)

    # The slider is a native one: it has keys of its own.
    run(page, "element('time').value = 7; element('time').dispatchEvent(new Event('input'))")
    assert run(page, "return viewer.frame") == 7
    page.find_element("id", "curve-mse").click()  # in the middle
    settle(page)
    assert run(page, "return viewer.frame") in (5, 6)


def test_it_plays_to_the_end_and_from_the_start_again(adaptive: Path, show: Open) -> None:
    page = show(adaptive)
    page.find_element("id", "play").click()
    page.execute_async_script(
        "const done = arguments[0]; const look = () => viewer.frame === 12 && !viewer.playing "
        "? done() : setTimeout(look, 20); look();"
    )
    assert text(page, "play") == "play"
    # The button still has the focus, and answers to the key itself; the page must not do so, too.
    run(page, "element('rate').value = 8")
    assert run(page, "return document.activeElement.id") == "play"
    page.switch_to.active_element.send_keys(" ")
    assert page.execute_script("return [viewer.playing, viewer.frame < 12]") == [True, True]
    page.execute_script("document.activeElement.blur()")
    page.find_element("tag name", "body").send_keys(" ")
    assert not page.execute_script("return viewer.playing")
    # A menu gives the keys back once a choice is made.
    menu = page.find_element("id", "colour")
    pytest.importorskip("selenium.webdriver.support.ui").Select(menu).select_by_value("speed")
    page.switch_to.active_element.send_keys("\ue010")  # end
    settle(page)
    assert page.execute_script("return [viewer.frame, element('colour').value]") == [12, "speed"]


def test_a_particle_is_drawn_where_it_is_in_the_colour_of_its_sigma(
    tmp_path: Path, metadata: Metadata, show: Open
) -> None:
    path = write_rollout(tmp_path / "a.h5", replace(metadata, radius=0.05))
    with h5py.File(path, "r+") as file:
        file["00000/true"][:] = 0.15
        file["00000/predicted"][:] = [0.7, 0.3]
        file["00000/sigma"][:] = 1.0
        file["00000/sigma"][5, 10] = 9.0  # not in frame 5, but in frame 6
        file["00000/particle_type"][:] = 5
    page = show(path)
    press(page, *["ArrowRight"] * 5)
    drawn = picture(page)
    # The box fills 0.92 of the lower side of a panel, the right half of the canvas.
    height, width = drawn.shape[:2]
    scale = 0.92 * min(height, width / 2) / 0.8
    x = round(0.75 * width + (0.7 - 0.5) * scale)
    y = round(0.5 * height - (0.3 - 0.5) * scale)
    lowest = np.array(palette.SIGMA_MAP(0.0, bytes=True)[:3])
    np.testing.assert_allclose(drawn[y, x], lowest, atol=2)
    background = [int(palette.PANEL[k : k + 2], 16) for k in (1, 3, 5)]
    np.testing.assert_array_equal(drawn[y - 40, x], background)
    # The truth has no sigma; it has the plain colour, in the lower left corner of its box.
    truth = drawn[round(0.5 * height + 0.35 * scale), round(0.25 * width - 0.35 * scale)]
    np.testing.assert_allclose(truth, [int(palette.TRUE[k : k + 2], 16) for k in (1, 3, 5)], atol=2)
    # A high sigma glows.
    run(page, "viewer.rollout.scales.sigma = [1, 9]; viewer.seek(6)")
    around = np.s_[y - 8 : y + 9, x - 8 : x + 9]
    assert picture(page)[around].sum() > drawn[around].sum() + 1000


def test_what_the_page_holds_is_what_the_file_holds(adaptive: Path, show: Open) -> None:
    page = show(adaptive)
    with RolloutFile(adaptive) as file:
        rollout = file[0]
        predicted, true, sigma = rollout.predicted, rollout.true, rollout.sigma
        mobile = file.metadata.mobile(rollout.particle_type)
    assert sigma is not None
    step = 0.8 * (1 + 2 * viewer.MARGIN) / 65534
    script = (
        "const r = viewer.rollout; return [r.codes('predicted', 8), r.sigma(8), r.error(8), "
        "r.speed('true', 8)].map((a) => Array.from(a))"
    )
    codes, spread, error, speed = (np.array(values) for values in run(page, script))
    positions = 0.1 - 0.8 * viewer.MARGIN + codes.reshape(-1, 2) * step
    np.testing.assert_allclose(positions, predicted[7], atol=0.51 * step)
    np.testing.assert_allclose(spread, sigma[7], rtol=1e-4)
    distance = np.linalg.norm(predicted[7] - true[7], axis=1)
    np.testing.assert_allclose(error, distance, atol=2 * step)
    moved = np.linalg.norm(true[7] - true[6], axis=1) / 0.0025
    np.testing.assert_allclose(speed, moved, atol=2 * step / 0.0025)
    page.execute_script("viewer.seek(8)")
    settle(page)
    mse = position_mse(predicted, true, mobile)[7]
    assert float(text(page, "mse-now")) == pytest.approx(mse, rel=0.005)
    assert text(page, "edges-now") == "10"


@pytest.mark.parametrize("periodic", [False, True])
def test_the_page_finds_the_edges_that_the_next_step_sees(
    tmp_path: Path, metadata: Metadata, show: Open, periodic: bool
) -> None:
    bounds = ((0.4, 0.5), (0.3, 0.6)) if periodic else metadata.bounds
    metadata = replace(metadata, periodic=(periodic, False), bounds=bounds, radius=0.021)
    path = write_rollout(
        tmp_path / "a.h5", metadata, policy="adaptive", adaptive=RULE, trained_radius=0.021
    )
    page = show(path)
    with RolloutFile(path) as file:
        mobile, box = metadata.mobile(file[0].particle_type), metadata.box
    # On the positions as the page has them, rounded: a pair may lie that near the radius.
    script = (
        "const r = viewer.rollout, g = graphOf(r, {0}); "
        "return [g.baseCount, g.extraCount, g.base.length + g.extra.length, "
        "Array.from(r.codes('predicted', {0})), r.lower, r.extent, Array.from(r.sigma({0}) || [])]"
    )
    for frame in (1, 6):
        *counted, codes, lower, extent, sigma = run(page, script.format(frame))
        positions = lower + np.reshape(codes, (-1, 2)) * np.array(extent) / 65534
        base = radius_graph(positions, 0.021, box=box).shape[1]
        both = adaptive_graph(
            positions, np.array(sigma), 0.021, 70, 1.6, box=box, eligible=mobile
        ).shape[1]
        assert [2 * counted[0], 2 * (counted[0] + counted[1])] == [base, both]
        assert counted[1] > 0
        assert (counted[2] < both) == periodic  # those through the boundary are not drawn
    # Before the first step there is no sigma yet, and the graph is the base graph.
    assert run(page, script.format(0))[1] == 0


@pytest.fixture
def solid(tmp_path: Path, metadata: Metadata) -> Path:
    """A cloud in 3D that keeps its shape, under the adaptive policy."""
    names = ("velocity_mean", "velocity_std", "acceleration_mean", "acceleration_std")
    metadata = replace(
        metadata,
        dim=3,
        bounds=((0.1, 0.9), (0.1, 0.9), (0.1, 1.3)),
        periodic=(False,) * 3,
        **{name: (1.0, 1.0, 1.0) for name in names},
    )
    rng = np.random.default_rng(0)
    cloud = rng.uniform(0.3, 0.6, (1, 80, 3)) + np.arange(9)[:, None, None] * 0.01
    trajectory = Trajectory("cloud", cloud.astype(np.float32), np.full(80, 5))
    rule = settings(policy="adaptive", adaptive=RULE, trained_radius=0.08)
    with RolloutWriter(tmp_path / "solid.h5", metadata=metadata, settings=rule) as writer:
        writer.add(
            trajectory,
            (
                Step(positions, rng.uniform(0.1, 2.0, 80).astype(np.float32), np.zeros(80))
                for positions in trajectory.positions[6:]
            ),
        )
    return tmp_path / "solid.h5"


def test_three_dimensions_turn_under_the_mouse(solid: Path, show: Open) -> None:
    page = show(solid)
    press(page, "End")
    first = picture(page)
    canvas = page.find_element("id", "particles")
    actions = pytest.importorskip("selenium.webdriver").ActionChains(page)
    actions.drag_and_drop_by_offset(canvas, 90, 40).perform()
    settle(page)
    assert run(page, "return viewer.scene.yaw") != 0.52
    assert not np.array_equal(picture(page), first)
    press(page, "0")
    np.testing.assert_array_equal(picture(page), first)
    # Straight from the front and without perspective: x to the right, y up.
    codes = "Array.from(viewer.rollout.codes('predicted', 3))"
    script = (
        "Object.assign(viewer.scene, {yaw: 0, pitch: 0}); viewer.draw(); const s = viewer.scene, "
        f"p = s.project(viewer.rollout.codes('predicted', 3)); return [{codes}, s.scale, "
        "Array.from(p.x), Array.from(p.y), Array.from(p.near)]"
    )
    packed, scale, x, y, near = run(page, script)
    with RolloutFile(solid) as file:
        positions = file[0].predicted[2]
    np.testing.assert_allclose(np.diff(x), np.diff(positions[:, 0]) * scale, atol=0.05)
    np.testing.assert_allclose(np.diff(y), -np.diff(positions[:, 1]) * scale, atol=0.05)
    assert (np.argsort(near) == np.argsort(np.reshape(packed, (-1, 3))[:, 2])).mean() > 0.9
    # The graph of the next step, of positions that are rounded.
    with RolloutFile(solid) as file:
        sigma = file[0].sigma
    assert sigma is not None
    edges = adaptive_graph(positions.astype(float), sigma[2].astype(float), 0.08, 70, 1.6)
    counted = run(page, "const g = graphOf(viewer.rollout, 3); return [g.baseCount, g.extraCount]")
    assert 2 * sum(counted) == edges.shape[1]
    assert 2 * counted[0] == radius_graph(positions.astype(float), 0.08).shape[1]


def test_wheel_and_drag_move_a_flat_scene(adaptive: Path, show: Open) -> None:
    page = show(adaptive)
    first = picture(page)
    canvas = page.find_element("id", "particles")
    chain = pytest.importorskip("selenium.webdriver").ActionChains
    origin = pytest.importorskip("selenium.webdriver.common.actions.wheel_input").ScrollOrigin
    chain(page).scroll_from_origin(origin.from_element(canvas), 0, -300).perform()
    settle(page)
    zoomed = picture(page)
    chain(page).drag_and_drop_by_offset(canvas, 60, 0).perform()
    settle(page)
    assert run(page, "return viewer.scene.zoom") > 1.5
    assert not np.array_equal(zoomed, first)
    assert not np.array_equal(picture(page), zoomed)
    press(page, "0")
    np.testing.assert_array_equal(picture(page), first)


def test_edges_can_be_shown_each_kind_alone(adaptive: Path, show: Open) -> None:
    page = show(adaptive)
    press(page, "ArrowRight")
    pictures = [picture(page)]
    for key in ("x", "e", "x"):
        press(page, key)
        pictures.append(picture(page))
    extra, none, base, both = pictures
    assert all(not np.array_equal(a, b) for a, b in ((extra, none), (none, base), (base, both)))
    assert text(page, "key-extra").startswith("extra edges")
    # Overlaid, in every colour: each differs from the others.
    press(page, "o")
    kinds = [picture(page)]
    for _ in range(3):
        press(page, "c")
        kinds.append(picture(page))
    assert len({kind.tobytes() for kind in kinds}) == 4


def test_the_picture_keeps_its_proportions_when_the_page_changes(
    adaptive: Path, show: Open
) -> None:
    page = show(adaptive)
    run(page, "element('legend').style.height = '200px'")
    page.execute_async_script("requestAnimationFrame(() => requestAnimationFrame(arguments[0]))")
    settle(page)
    canvas = run(page, "const c = viewer.scene.canvas; return [c.height, c.clientHeight]")
    assert canvas[0] == canvas[1]


def test_a_diverged_particle_is_counted_and_not_drawn(adaptive: Path, show: Open) -> None:
    with h5py.File(adaptive, "r+") as file:
        file["00000/predicted"][6:, 5] = np.nan
        file["00000/predicted"][6:, 6] = 3.0
    page = show(adaptive)
    run(page, "viewer.seek(7)")
    assert text(page, "lost-predicted") == "2 out of sight"
    assert text(page, "mse-now") == "not finite"
    values = run(page, "return Array.from(viewer.values('error', 'predicted'))")
    assert values[5:7] == [-1, -1]


def test_without_sigma_there_is_nothing_to_choose(
    tmp_path: Path, metadata: Metadata, show: Open
) -> None:
    page = show(write_rollout(tmp_path / "a.h5", metadata, sigma=False))
    options = "return Array.from(element('colour').options, (option) => option.value)"
    assert run(page, options) == ["error", "speed", "type"]
    press(page, "x")
    assert not run(page, "return element('extra').checked")
    run(page, "element('colour').value = 'type'; viewer.refresh()")
    assert text(page, "type-keys") == "type 3, boundary\ntype 5, water"


def test_frames_are_thinned_below_the_limit_and_the_page_says_so(
    tmp_path: Path, adaptive: Path, show: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = tmp_path / "whole.html"
    main(["viewer", str(adaptive), "--out", str(whole)])
    limit = whole.stat().st_size - 2000
    monkeypatch.setattr(viewer, "LIMIT", limit)
    page = show(adaptive)
    assert (tmp_path / "page.html").stat().st_size <= limit
    every = run(page, "return viewer.rollout.every")
    assert every > 1
    assert f"1 step in {every} is shown" in text(page, "facts")
    assert run(page, "return viewer.rollout.frames") == sorted({*range(0, 13, every), 12})
    run(page, "viewer.seek(viewer.frameOf(viewer.rollout.every + 1))")
    assert text(page, "now") == f"step {every} of 12"


def test_an_old_browser_is_told_what_it_lacks(adaptive: Path, browser: Any, tmp_path: Path) -> None:
    page = tmp_path / "old.html"
    main(["viewer", str(adaptive), "--out", str(page)])
    old = "<script>delete window.DecompressionStream</script><!doctype html>"
    page.write_text(old + page.read_text("utf-8"), "utf-8")
    browser.get(page.as_uri())
    assert "needs a browser of 2023 or later" in text(browser, "message")
    browser.get_log("browser")
