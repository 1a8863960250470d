"""Random scenes of the benchmarks are within the limits of scene files: a value beyond them would raise an error."""

import pytest
from benchmarks import coverage, layers


@pytest.mark.parametrize("kind", coverage.KINDS)
def test_random_scenes_of_each_kind_are_valid(kind: str) -> None:
    for seed in range(20):
        coverage.draw_scene(seed, kind)


def test_random_stacks_of_layers_are_valid() -> None:
    for seed in range(20):
        layers.draw_scene(seed)
