"""Commands start without delay: none loads a package that it does not use.

To load numpy takes 0.2 s, matplotlib or scipy.stats a second.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import scipy.signal
from numpy.testing import assert_allclose
from tests.support.paths import RIG_FILE
from tests.support.products import write_judged_products
from tests.support.rigs import load_published_rig
from tests.support.scenes import write_small_scene

from polysight.cli.main import FAMILIES
from polysight.imaging import TAPERS, make_window
from polysight_simulators.scene import load_scene, simulate

NUMBERS = {"numpy"}
SCIPY = {"scipy"}
# Packages, and parts of scipy, that take long to load.
HEAVY = {
    "distributed", "h5py", "jinja2", "matplotlib", "numba", "pandas", "sklearn", "skimage.measure", "xarray", "zmq",
    "scipy.fft", "scipy.interpolate", "scipy.linalg", "scipy.ndimage", "scipy.optimize", "scipy.signal", "scipy.sparse",
    "scipy.spatial", "scipy.special", "scipy.stats",
}  # fmt: skip

# Runs a command; prints its exit status and the names of all loaded modules.
RUN = """
import contextlib, io, json, sys
from polysight.cli.main import main
with contextlib.redirect_stdout(io.StringIO()):
    try:
        status = main(sys.argv[1:])
    except SystemExit as e:  # of argparse
        status = e.code
sys.stdout.write(json.dumps([status, sorted(sys.modules)]))
"""


def list_loaded_modules(*words: str | Path) -> set[str]:
    """Run a command in a new process, and check that it succeeds; return the modules that it has loaded."""
    command = [sys.executable, "-c", RUN, *map(str, words)]
    process = subprocess.run(command, capture_output=True, text=True, check=True, cwd=RIG_FILE.parent)
    status, modules = json.loads(process.stdout)
    assert status == 0, process.stderr
    return set(modules)


def test_help_and_version_load_neither_numpy_nor_scipy():
    for words in (["--help"], ["--version"]):
        assert list_loaded_modules(*words) & (NUMBERS | SCIPY | HEAVY) == set(), words


@pytest.mark.parametrize("command", [names[0] for names in FAMILIES.values()])
def test_help_of_a_command_loads_neither_numpy_nor_scipy(command):
    """One command of each family is tested: the commands of a family are in one module."""
    assert list_loaded_modules(command, "--help") & (NUMBERS | SCIPY | HEAVY) == set()


@pytest.mark.parametrize("command", ["materials", "report", "permittivity"])
def test_saved_products_are_shown_without_scipy_and_figures(tmp_path, command):
    products = write_judged_products(tmp_path / "products", "good")
    (products / "report.html").write_text("<p>here</p>")
    assert list_loaded_modules(command, products) & HEAVY == set()


def test_a_scan_is_validated_without_scipy(tmp_path):
    (tmp_path / "scene.toml").write_text(write_small_scene(6, 3))
    simulate(load_published_rig(), load_scene(tmp_path / "scene.toml"), tmp_path / "scan")
    assert list_loaded_modules("validate", tmp_path / "scan") & (SCIPY | HEAVY) == set()


def test_images_are_made_without_report_and_figures(tmp_path):
    (tmp_path / "scene.toml").write_text(write_small_scene(6, 3))
    simulate(load_published_rig(), load_scene(tmp_path / "scene.toml"), tmp_path / "scan")
    loaded = list_loaded_modules("image", tmp_path / "scan", "--out", tmp_path / "out")
    assert loaded & {"jinja2", "matplotlib", "polysight.report", "sklearn"} == set()


def test_a_plan_is_made_without_the_parts_of_scipy_that_take_long_to_load():
    assert list_loaded_modules("plan", "--config", RIG_FILE) & HEAVY == set()


def test_modules_of_jobs_load_heavy_packages_only_when_they_compute():
    files_of_jobs = sorted((RIG_FILE.parent / "host" / "polysight" / "jobs").glob("[a-z]*.py"))
    modules = [f"jobs.{file.stem}" for file in files_of_jobs]
    modules += ["pipeline", "acquisition", "doctor", "api", "planning", "serve"]
    imports = "".join(f"import polysight.{module}\n" for module in modules)
    code = f"import sys\n{imports}print(*sys.modules)"
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=RIG_FILE.parent
    )
    assert set(process.stdout.split()) & (HEAVY - {"zmq"}) == set()


@pytest.mark.parametrize("window", ["hann", *TAPERS.values()])
def test_windows_that_are_computed_without_scipy_are_those_of_scipy(window):
    for length in (1, 2, 7, 64):
        # They have no zeros at their ends, as those of scipy do.
        longer_window = scipy.signal.get_window(window, length + 2, fftbins=False)
        # A few rounding errors.
        assert_allclose(make_window(window, length), longer_window[1:-1], rtol=0, atol=1e-15)
