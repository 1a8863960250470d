"""A small scan without any fault, as the reference for others."""

import random
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import pytest
from tests.support.store.small_scan import Samples, SmallScan

T = TypeVar("T")


@pytest.fixture
def draw_cases(request: pytest.FixtureRequest) -> Callable[[Sequence[T], int], list[T]]:
    """Function that draws `n` cases with the first and the last, the same in every run; with --long up to 2000."""

    def draw(cases: Sequence[T], n: int) -> list[T]:
        n = 2000 if request.config.getoption("--long") else n
        if len(cases) <= n:
            return list(cases)
        chosen = random.Random(request.node.name).sample(range(len(cases)), n)
        return [cases[i] for i in sorted({0, len(cases) - 1, *chosen})]

    return draw


@pytest.fixture(scope="session")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Samples:
    return Samples(tmp_path_factory.mktemp("scene"))


class Undisturbed(SmallScan):
    """A finished scan; :meth:`copy` returns another one that a test may damage."""

    def __init__(self, samples: Samples, folder: Path) -> None:
        super().__init__(samples, folder)
        self._of = samples
        self._folder = folder
        assert self.run().exit_status == "success"
        self.digests = self.rows()
        self.final_image = self.image()

    def copy(self, folder: Path) -> SmallScan:
        """The same scan and journal in another folder, replaced if it is there."""
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(self._folder, folder)
        return SmallScan(self._of, folder)


@pytest.fixture(scope="session")
def undisturbed_scan(samples: Samples, tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    return Undisturbed(samples, tmp_path_factory.mktemp("undisturbed"))
