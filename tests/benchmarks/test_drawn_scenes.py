"""Drawn scenes of the benchmarks can be simulated."""

import pytest
from benchmarks import coverage, layers


@pytest.mark.parametrize("kind", coverage.KINDS)
def test_drawn_scenes_of_each_kind_keep_the_limits_of_scene_files(kind: str) -> None:
    for seed in range(20):
        coverage.draw_scene(seed, kind)


def test_drawn_stacks_of_layers_keep_the_limits_of_scene_files() -> None:
    for seed in range(20):
        layers.draw_scene(seed)
