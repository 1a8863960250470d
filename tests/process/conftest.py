"""Small simulated scans, shared by the tests of this folder."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.support import mangled_scans
from tests.support.paths import EXAMPLES
from tests.support.pipelines import make_pipeline
from tests.support.rigs import load_published_rig, make_rig_with
from tests.support.scenes import COPPER, PET, make_scene
from tests.support.suite import make_once

from polysight.imaging import Images
from polysight.materials import TruthPlate, read_truth
from polysight.store.scan_folder import ScanFolder
from polysight_shared.config import Instrument
from polysight_simulators.scene import Scene, decode_scene, load_scene, simulate


class Imaged:
    """A simulated scan, processed up to its images."""

    def __init__(self, folder: Path) -> None:
        self.pipeline = make_pipeline(ScanFolder.load(folder))
        self.images: Images = self.pipeline.form_images()
        self.rig: Instrument = self.pipeline.source.instrument
        self.plates: tuple[TruthPlate, ...] = read_truth(folder / "truth.json")


Make = Callable[..., Imaged]


@pytest.fixture(scope="session")
def six_plates(tmp_path_factory: pytest.TempPathFactory) -> ScanFolder:
    """Raw data of the scene of `mangled_scans`."""
    scene = decode_scene(mangled_scans.SCENE, "test")
    folder = make_once(
        tmp_path_factory, "six-plates", lambda path: simulate(load_published_rig(), scene, path / "scan")
    )
    return ScanFolder.load(folder / "scan")


@pytest.fixture(scope="session")
def process_six_plates(six_plates: ScanFolder) -> mangled_scans.ProcessMangled:
    return mangled_scans.make_processor(six_plates)


@pytest.fixture(scope="session")
def image_scene(tmp_path_factory: pytest.TempPathFactory) -> Make:
    """`image_scene("nine-materials", seed=2, leakage_h=[0, 0])`: the example scene with changed disturbances, imaged.

    Four pulses per position instead of sixteen: a scan takes a third of the time.
    """
    rig = make_rig_with(burst={"pulses": 4})
    # Echoes of a scene, which scans with different disturbances share.
    fields = tmp_path_factory.mktemp("fields")
    imaged_scans: dict[str, Imaged] = {}

    def make(name: str, seed: int | None = None, **disturbances: Any) -> Imaged:
        key = f"{name} {seed} {disturbances}"
        if key not in imaged_scans:
            scene: Scene = load_scene(EXAMPLES / f"{name}.toml").with_disturbances(**disturbances)
            folder = tmp_path_factory.mktemp("scan")
            imaged_scans[key] = Imaged(simulate(rig, scene, folder / "scan", seed=seed, cache_dir=fields))
        return imaged_scans[key]

    return make


@pytest.fixture(scope="session")
def make_scan() -> Callable[..., Path]:
    """`make_scan(folder, scene, rig)`: a simulated scan, in a scan folder."""

    def make(folder: Path, scene: dict[str, Any], rig: Instrument | None = None, **more: Any) -> Path:
        return simulate(rig or load_published_rig(), decode_scene(scene, "test"), folder, **more)

    return make


@pytest.fixture(scope="session")
def two_plates(make_scan: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A scan of copper and PET; a test that writes into it takes a copy."""
    scan = make_scan(tmp_path_factory.mktemp("two") / "scan", make_scene(COPPER, PET, columns=15, rows=17))
    files = sorted(scan.rglob("*"))
    yield scan
    assert sorted(scan.rglob("*")) == files, "a test changed the scan that all share"
