"""Settings that pyproject.toml cannot contain: compilation of the loops; a wheel is for one platform, any Python.

With POLYSIGHT_WHEEL set to a platform of `polysight/sync/build.py`, wheels are made for that one. POLYSIGHT_KERNELS is
a library that was compiled for this machine before: it is taken if it is one of these sources.
"""

import importlib.util
import os
import shutil
import sys
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

spec = importlib.util.spec_from_file_location("build_kernels", Path("polysight", "sync", "build.py"))
kernels = importlib.util.module_from_spec(spec)
spec.loader.exec_module(kernels)
TOP = Path("..")
TARGET = os.environ.get("POLYSIGHT_WHEEL", "")
COMPILED = Path(os.environ.get("POLYSIGHT_KERNELS", ""))


def copy_data(folder):
    """Copy the rig file, the scenes and the pages that errors name into the package that is built."""
    data_files = [*(TOP / "examples").rglob("*.toml"), *(TOP / "docs").rglob("*.md"), *(TOP / "docs").rglob("*.svg")]
    files = [Path("instrument.toml"), *(path.relative_to(TOP) for path in data_files)]
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(TOP / file, folder / file)


class PlatformDistribution(Distribution):
    """A distribution with compiled code."""

    def has_ext_modules(self):
        """Yes: not through Python's own headers, so setuptools cannot know."""
        return True


class BuildWithKernels(build_py):
    """Copies the package and its data, and compiles the kernels into it, or into sources used in place."""

    def run(self):
        """Build the compiled loops; if no compiler works, say so and continue: the same runs in NumPy, more slowly."""
        super().run()
        sources = Path("polysight", "sync")
        folder = sources if self.editable_mode else Path(self.build_lib) / sources
        if not self.editable_mode:
            copy_data(Path(self.build_lib, "polysight", "data"))
        # A compiled library ends with the digest of its sources.
        if not TARGET and COMPILED.is_file() and COMPILED.read_bytes().endswith(kernels.source_digest().encode()):
            shutil.copyfile(COMPILED, folder / kernels.LIBRARY)
            return
        try:
            kernels.build(folder.resolve(), TARGET)
        except kernels.BuildError as error:
            if TARGET:
                raise
            sys.stderr.write(f"polysight: synchronisation was not compiled and will be slow: {error}\n")


class PlatformWheel(bdist_wheel):
    """The kernels need no Python: one wheel serves all versions on a platform."""

    def get_tag(self):
        """Return the tag of the wheel, such as py3-none-linux_x86_64."""
        return "py3", "none", TARGET or super().get_tag()[2]


setup(
    distclass=PlatformDistribution,
    cmdclass={"build_py": BuildWithKernels, "bdist_wheel": PlatformWheel},
    # Asked for at building, and only where it is needed: 100 MB.
    setup_requires=["ziglang"] if TARGET or kernels.find_compiler() is None else [],
)
