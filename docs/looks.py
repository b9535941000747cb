"""Three pictures of `docs/pictures.md`, of a rollout at hand: TensorBoard's, the viewer, VTK.

    python -m adaptgns.rollout --checkpoint waterdrop --policy adaptive --steps 200 \
      --trajectories 6 --out drop.h5
    python docs/looks.py drop.h5 --trajectory 3 --step 85

Writes `images/validation.png`, `images/viewer.png` and `images/vtk.png` next to this file. Needs
Chromium with its driver, the extras `test` and `formats`, and pyvista.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path

import pyvista
from PIL import Image
from selenium import webdriver

from adaptgns.plot import viewer, vtk
from adaptgns.rollout_file import RolloutFile
from adaptgns.snapshot import snapshot

IMAGES = Path(__file__).parent / "images"


def draw_validation(rollout: Path, trajectory: int) -> Path:
    with RolloutFile(rollout) as file:
        one = file[trajectory]
        mobile = file.metadata.mobile(one.particle_type)
        picture = snapshot(file.metadata, one.true, one.predicted, one.sigma, mobile)
    Image.fromarray(picture).save(IMAGES / "validation.png", optimize=True)
    return IMAGES / "validation.png"


def draw_viewer(rollout: Path, trajectory: int, step: int, folder: Path) -> Path:
    page = folder / "page.html"
    viewer(rollout, page, trajectory=trajectory)
    options = webdriver.ChromeOptions()
    for argument in ("headless=new", "no-sandbox", "disable-gpu", "window-size=1240,860"):
        options.add_argument(f"--{argument}")
    options.binary_location = shutil.which("chromium")
    service = webdriver.ChromeService(executable_path=shutil.which("chromedriver"))
    browser = webdriver.Chrome(options=options, service=service)
    try:
        browser.get(page.as_uri())
        browser.set_script_timeout(60)
        browser.execute_async_script(
            "const done = arguments[0]; let sought = false; const look = () => {"
            " if (!(window.viewer && viewer.draws && !viewer.waiting)) setTimeout(look, 20);"
            f" else if (sought) done(); else {{ sought = true; viewer.seek({step}); look(); }} }};"
            "look();"
        )
        browser.save_screenshot(str(IMAGES / "viewer.png"))
    finally:
        browser.quit()
    return IMAGES / "viewer.png"


def draw_vtk(rollout: Path, trajectory: int, step: int, folder: Path) -> Path:
    vtk(rollout, folder / "vtk", trajectory=trajectory)
    points, graph = (
        pyvista.read(folder / "vtk" / name / f"{step:05d}.vtu") for name in ("prediction", "graph")
    )
    plotter = pyvista.Plotter(off_screen=True, window_size=(900, 500))
    plotter.set_background("white")
    plotter.add_mesh(graph, scalars="extra", cmap=["#b9c4d0", "#0b8457"], show_scalar_bar=False)
    plotter.add_mesh(
        points,
        scalars="sigma",
        cmap="inferno",
        log_scale=True,
        point_size=9,
        render_points_as_spheres=True,
        scalar_bar_args={"vertical": True, "color": "black", "n_labels": 3, "fmt": "%.2g"}
        | {"position_x": 0.9, "position_y": 0.3, "height": 0.4, "title": "sigma "},
    )
    plotter.view_xy()
    plotter.camera.tight(padding=0.08, adjust_render_window=False)
    plotter.screenshot(str(IMAGES / "vtk.png"))
    return IMAGES / "vtk.png"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rollout", type=Path)
    parser.add_argument("--trajectory", type=int, default=0)
    parser.add_argument("--step", type=int, default=85)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        at = (asked.rollout, asked.trajectory, asked.step, Path(folder))
        for path in (draw_validation(*at[:2]), draw_viewer(*at), draw_vtk(*at)):
            print(f"{path}: {path.stat().st_size // 1024} KiB")


if __name__ == "__main__":
    main()
