"""The shipped demo, of tilted and uneven plates before a table, has the result that README states."""

from benchmarks.coverage import Cubes
from tests.support.paths import EXAMPLES
from tests.support.rigs import load_published_rig

from polysight.materials import match_truth, read_true_plates
from polysight.pipeline import Pipeline
from polysight.settings import Settings
from polysight_simulators.scene.scene_file import apply_scene, load_scene
from polysight_simulators.scene.simulated_scan import truth


def test_each_plate_of_the_demo_has_a_permittivity_and_half_of_them_their_names():
    """The samples are perfectly synchronised; the table that shines through is not reported as a layer."""
    rig = load_published_rig()
    scene = load_scene(EXAMPLES / "demo.toml")
    pipeline = Pipeline(Cubes(rig, scene), Settings())
    for row in pipeline.source.rows():
        pipeline.add_row(row)
    result = pipeline.examine(pipeline.form_images()).analysis
    true_plates = read_true_plates(truth(apply_scene(rig, scene), scene, scene.seed))
    plate_of_patch = match_truth([patch_result.patch for patch_result in result.patches], true_plates)
    assert [patch_result.refused for patch_result in result.patches if patch_result.refused is not None] == []
    dielectrics = 0
    right_names = 0
    for patch_result in result.patches:
        plate = plate_of_patch[patch_result.patch.label]
        if plate.metal:
            continue
        dielectrics += 1
        assert patch_result.permittivity.value is not None
        right_names += patch_result.patch_name is not None and patch_result.patch_name.name == plate.name
    assert dielectrics == 8
    assert right_names >= dielectrics / 2
