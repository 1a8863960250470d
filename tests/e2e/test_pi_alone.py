"""The Pi half runs with nothing but its own dependencies: no numpy, no scipy; no gpiod where lines are simulated."""

import subprocess
import sys

# Code before that of a test: packages in `absent` cannot be imported, nor can their modules.
BLOCK = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if {{name, name.partition(".")[0]}} & {absent}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
"""
HOST_ONLY = (
    "numpy",
    "scipy",
    "sklearn",
    "skimage",
    "matplotlib",
    "jinja2",
    "rich",
    "gpiod",
    "polysight",
    "polysight_simulators",
)
# Imports every module of the Pi's packages but those that run a program when they are imported.
EVERYTHING = """
import importlib, pkgutil
import polysight_pi, polysight_shared
for package in (polysight_pi, polysight_shared):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
"""


def run_alone(code: str, *absent: str) -> subprocess.CompletedProcess[str]:
    """Run code in a new interpreter in which these packages are absent."""
    code = BLOCK.format(absent=set(absent)) + code
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_every_module_of_the_pi_imports_without_the_host_s_dependencies():
    ended = run_alone(EVERYTHING, *HOST_ONLY)
    assert (ended.returncode, ended.stderr) == (0, "")


def test_an_absent_package_cannot_be_imported():
    assert "No module named 'numpy'" in run_alone("import numpy", *HOST_ONLY).stderr


def test_gpio_without_gpiod_is_an_error_that_names_it():
    code = (
        "from polysight_pi.lines import load_gpiod\n"
        "from polysight_shared.errors import PolysightError\n"
        "try:\n    load_gpiod()\nexcept PolysightError as e:\n    print(e)\n"
    )
    ended = run_alone(code, *HOST_ONLY)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "gpiod" in ended.stdout
    assert "do: " in ended.stdout
