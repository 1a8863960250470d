"""Compiled loops are kept on disk, and compiled anew when a file they were made of has changed."""

import os
import shutil
import subprocess
import sys

import pytest

from tests.support.paths import REPO

pytest.importorskip("numba", reason="numba is not installed")
CALL = """
import numpy as np
from polysight.host.sync import compiled
tone = compiled._interpolated(np.ones(4, np.float32), np.ones(4, np.float32), np.arange(4), 1, 8)
print(abs(tone[1]), sum(compiled._interpolated.stats.cache_hits.values()))
"""


def call(folder):
    """Amplitude of a tone that `compiled` makes with `kernels.cis`, and how often it came out of the cache."""
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", CALL],
        cwd=folder,
        env={**environment, "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        check=True,
    )
    amplitude, hits = done.stdout.split()
    return float(amplitude), int(hits)


def test_a_changed_kernel_is_compiled_anew_also_where_it_was_inlined(tmp_path):
    for package in ("host", "shared"):
        shutil.copytree(REPO / package, tmp_path / "polysight" / package, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "polysight" / "__init__.py").write_text("", encoding="utf-8")
    first, hits = call(tmp_path)
    assert (first, hits) == (pytest.approx(2**0.5), 0)
    again, hits = call(tmp_path)
    assert (again, hits) == (first, 1)

    kernels = tmp_path / "polysight" / "host" / "sync" / "compiled_loops.py"
    source = kernels.read_text(encoding="utf-8")
    changed = source.replace("return 1 - 2 * s * s, 2 * s * c", "return 3 * (1 - 2 * s * s), 3 * (2 * s * c)")
    assert changed != source
    kernels.write_text(changed, encoding="utf-8")
    other, hits = call(tmp_path)
    assert (other, hits) == (pytest.approx(3 * first), 0)
