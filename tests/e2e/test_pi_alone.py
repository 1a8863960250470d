"""The programs of the Pi run without the packages of the host, and without gpiod where its lines are simulated."""

import subprocess
import sys

# Code that runs before that of a test and makes the packages in `absent` and their modules impossible to import.
BLOCK_IMPORTS = """
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
# Imports every module of the Pi's packages, except for those that run a program when they are imported.
IMPORT_ALL_MODULES = """
import importlib, pkgutil
import polysight_pi, polysight_shared
for package in (polysight_pi, polysight_shared):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
"""


def run_alone(code: str, *absent: str) -> subprocess.CompletedProcess[str]:
    """Run code in a new interpreter in which these packages are absent."""
    whole_code = BLOCK_IMPORTS.format(absent=set(absent)) + code
    return subprocess.run([sys.executable, "-c", whole_code], capture_output=True, text=True, check=False)


def test_every_module_of_the_pi_imports_without_the_host_s_dependencies():
    ended = run_alone(IMPORT_ALL_MODULES, *HOST_ONLY)
    assert ended.returncode == 0
    assert ended.stderr == ""


def test_an_absent_package_cannot_be_imported():
    """Without this the other tests would show nothing."""
    assert "No module named 'numpy'" in run_alone("import numpy", *HOST_ONLY).stderr


LOAD_GPIOD = """
from polysight_pi.lines import load_gpiod
from polysight_shared.errors import PolysightError
try:
    load_gpiod()
except PolysightError as error:
    print(error)
"""


def test_if_gpiod_is_not_installed_the_error_names_it_and_says_what_to_do():
    ended = run_alone(LOAD_GPIOD, *HOST_ONLY)
    assert ended.returncode == 0
    assert ended.stderr == ""
    assert "gpiod" in ended.stdout
    assert "do: " in ended.stdout
