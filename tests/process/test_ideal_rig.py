"""A scan of an ideal rig is processed as one: what its scene switched off is not taken away once more."""

from polysight.host.materials import Classifier, Library
from polysight.host.materials.analyse import KnownScene
from polysight.host.materials.library import SIMULATED_LIBRARY


def test_all_plates_of_an_ideal_scan_are_named_right(imaged):
    """No filter and no leakage in the data: the recorded rig says so, and neither is corrected."""
    scan = imaged("nine-materials", ideal=True)
    rig = scan.rig
    assert (rig.chirp.hpf1_khz, rig.chirp.hpf2_khz) == (0.0, 0.0)
    assert rig.polarimetry.leakage_h == rig.polarimetry.leakage_v == (0.0, 0.0)
    assert all(setup.equaliser is None for setup in scan.pipeline.synchroniser.setups.values())
    found = scan.pipeline.find_materials(
        scan.images, known=KnownScene(plates=scan.plates), classifier=Classifier(Library.load(SIMULATED_LIBRARY))
    )
    named = [p for p in found.patches if p.verdict is not None]
    assert [p.verdict.name for p in named] == [p.truth.name for p in named]
    assert [p.truth.name for p in found.patches if p.verdict is None] == ["copper"]  # the reference
    assert len(found.patches) == 9
    assert found.metal.certain
