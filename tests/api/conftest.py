"""One small simulated scan of copper and PET, and the products that `polysight process` makes of it."""

import shutil
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from tests.support.products import skip_rendering
from tests.support.rigs import load_published_rig
from tests.support.scenes import make_scene

from polysight.cli.main import main
from polysight_simulators.scene import decode_scene, simulate

REPO = Path(__file__).resolve().parents[2]
COPPER = {"name": "copper", "centre_mm": [-45.0, 0.0], "size_mm": [45.0, 45.0], "metal": True}
PET = {"name": "PET", "centre_mm": [45.0, 0.0], "size_mm": [45.0, 45.0], "permittivity": [3.78, 0.7]}


def simulate_plates(folder: Path, *plates: dict[str, Any], **more: Any) -> Path:
    """Simulate a scan of plates on the grid of examples/own-scene.toml; without plates on a coarser, faster grid."""
    grid: dict[str, Any]
    if plates:
        grid = {"columns": 31, "rows": 27, "step_mm": (10.0, 6.0)}
    else:
        grid = {"columns": 15, "rows": 17, "step_mm": (14.0, 8.0)}
    image = {"columns": 90, "rows": 60, "pixel_mm": 2.0}
    scene = make_scene(*plates, **grid, image=image)
    return simulate(load_published_rig(), decode_scene(scene, "test"), folder, **more)


def run_command(*words: object) -> None:
    """Run a command of the host, which must succeed; its report is not rendered."""
    with redirect_stdout(StringIO()), skip_rendering():
        assert main([str(word) for word in words]) == 0


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan folder of copper and PET, without products."""
    return simulate_plates(tmp_path_factory.mktemp("api") / "scan", COPPER, PET)


@pytest.fixture(scope="session")
def products(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Products of `polysight process` for a copy of the scan folder, so that `folder` itself is not changed."""
    products_folder = tmp_path_factory.mktemp("processed")
    run_command("process", shutil.copytree(folder, products_folder / "scan"), "--out", products_folder / "products")
    return products_folder / "products"
