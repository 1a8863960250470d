"""Simulated scans, made once and shared by the laws that look at them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from polysight.host.imaging import ChannelImages
from polysight.host.materials import TruthPlate, read_truth
from polysight.host.pipeline import Pipeline
from polysight.host.store.scan_folder import ScanFolder
from polysight.shared.config import Instrument, load_instrument
from polysight.simulators.scene import Scene, load_scene, simulate

ROOT = Path(__file__).parents[2]


class Imaged:
    """A simulated scan that went through the host's pipeline up to the images."""

    def __init__(self, folder: Path) -> None:
        self.pipeline = Pipeline(ScanFolder.load(folder))
        for row in self.pipeline.source.rows():
            self.pipeline.add_row(row)
        self.images: ChannelImages = self.pipeline.form_images()
        self.rig: Instrument = self.pipeline.source.instrument
        self.plates: tuple[TruthPlate, ...] = read_truth(folder / "truth.json")


Make = Callable[..., Imaged]


@pytest.fixture(scope="session")
def rig() -> Instrument:
    return load_instrument(ROOT / "instrument.toml")


@pytest.fixture(scope="session")
def imaged(rig: Instrument, tmp_path_factory: pytest.TempPathFactory) -> Make:
    """`imaged("nine-materials", seed=2, leakage_h=[0, 0])`: the example scene with changed disturbances, imaged."""
    done: dict[str, Imaged] = {}

    def make(name: str, seed: int | None = None, **disturbances: Any) -> Imaged:
        key = f"{name} {seed} {disturbances}"
        if key not in done:
            scene: Scene = load_scene(ROOT / "examples" / f"{name}.toml").with_disturbances(**disturbances)
            folder = tmp_path_factory.mktemp("scan")
            done[key] = Imaged(simulate(rig, scene, folder / "scan", seed=seed))
        return done[key]

    return make
