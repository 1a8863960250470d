"""The shipped demo, tilted and rippled plates before a table, keeps the result that README states."""

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
    true = match_truth(
        [r.patch for r in result.patches], read_true_plates(truth(apply_scene(rig, scene), scene, scene.seed))
    )
    assert {r.patch.label: r.refused.what for r in result.patches if r.refused is not None} == {}
    plates = [(r, true[r.patch.label]) for r in result.patches if not true[r.patch.label].metal]
    assert len(plates) == 8
    assert all(r.permittivity.value is not None for r, _ in plates)
    assert sum(r.patch_name is not None and r.patch_name.name == plate.name for r, plate in plates) >= 4
