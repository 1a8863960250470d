"""Distribution over workers: a file's tests run in one of them, so that its fixtures are made once.

pytest-xdist's own `--dist loadgroup` would do for most of it, but it writes its groups into the names of tests, and
since pytest 9.2 nothing reads them there: every test is a group of its own, without a word
(https://github.com/pytest-dev/pytest-xdist/issues/1386).
"""

from __future__ import annotations

import pytest
from xdist.scheduler import LoadScopeScheduling

TOGETHER = {
    "tests/process/test_drawn_boxes.py": "tests/process/test_laws.py",
    "tests/process/test_products.py": "tests/process/test_samples.py",
}
"""Files whose tests share an expensive fixture with another file's."""

ROOMS = ("tests/api", "tests/materials")
"""Folders with an expensive fixture for most of their files: one worker runs them."""

FIRST = (
    "tests/e2e/test_operator_page.py",
    "tests/materials",
    "tests/e2e/test_killed_processes.py",
    "tests/doctor/test_live_rig.py",
    "tests/serve/test_pages.py",
    "tests/api",
    "tests/process/test_laws.py",
    "tests/process/test_samples.py",
    "tests/papers/test_reproduce.py",
    "tests/store/test_cut_anywhere.py",
    "tests/stage/test_dialogues.py",
    "tests/papers/test_patches.py",
    "tests/e2e/test_kill_and_resume.py",
    "tests/e2e/test_demo.py",
    "tests/e2e/test_radar_backends.py",
    "tests/e2e/test_wrong_input.py",
    "tests/imaging/test_focus.py",
    "tests/stage/test_uno.py",
    "tests/store/test_killed_anywhere.py",
    "tests/e2e/test_live_view.py",
    "tests/process/test_verdicts.py",
    "tests/stage/test_uno_safety.py",
    "tests/benchmarks/test_runs.py",
)
"""Files and folders that take longest: begun first, so that no worker ends long after the others."""


def group_of(node_id: str) -> str:
    """Folder or file whose tests share a worker."""
    file = node_id.partition("::")[0]
    room = file.rpartition("/")[0]
    return room if room in ROOMS else TOGETHER.get(file, file)


def longest_first(items: list[pytest.Item]) -> None:
    """Sort tests in place: those of the longest files first, the others as they were."""
    place = {file: n for n, file in enumerate(FIRST)}
    items.sort(key=lambda item: place.get(group_of(item.nodeid), len(place)))


class ByFile(LoadScopeScheduling):
    """Hands out whole files, in the order of collection."""

    def _split_scope(self, nodeid: str) -> str:
        return group_of(nodeid)

    def schedule(self) -> None:
        """As the base class, without its sorting by number of tests."""
        self.config.option.loadscopereorder = False
        super().schedule()
