"""`patches.npz`: a scan that is named again later has the same errors as when it was first named."""

import io
import json

import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight.imaging import Images
from polysight.materials import UNKNOWN, Classifier, match_patches, pack_patches, read_patches
from polysight_shared.errors import ErrorCode


def name_from_file(result, scene, classifier, path):
    """Names of a result's patches, by number, from its file."""
    path.write_bytes(pack_patches(result, scene.x_m, scene.y_m, simulated=True))
    patches = read_patches(path)
    matched = [m for m in match_patches([patches]) if m.label in patches.evidence]
    renamed = classifier.scan([m.features for m in matched], [m.evidence for m in matched])
    return {m.label: n.patch_name for m, n in zip(matched, renamed, strict=True)}


def test_a_scan_is_named_again_as_it_was_named(synthetic, library, name_placement, tmp_path):
    scene = synthetic(3)
    classifier = Classifier(library)
    analysis = name_placement(3)
    renamed = name_from_file(analysis, scene, classifier, tmp_path / "patches.npz")
    for r in analysis.patches:
        if r.named is not None:
            assert renamed[r.patch.label].name == r.named.patch_name.name
            assert renamed[r.patch.label].probabilities == pytest.approx(r.named.patch_name.probabilities, abs=1e-3)


@pytest.mark.parametrize("gain", [0.8, 1.25])
def test_brightness_that_all_plates_share_does_not_change_their_names(
    gain, synthetic, library, name_placement, tmp_path
):
    """A low or tilted metal plate makes all others brighter or darker in both channels: V / H stays."""
    scene = synthetic(3)
    classifier = Classifier(library)
    plain = name_placement(3)
    metal = plain.segmentation.labels == plain.metal.label
    factor = np.where(metal, 1.0, gain)
    pair = Images(scene.h * factor, scene.v * factor, scene.x_m, scene.y_m, np.ones(scene.h.shape, bool))
    analysis = scene.analyse(classifier=classifier, pair=pair)
    renamed = name_from_file(analysis, scene, classifier, tmp_path / "patches.npz")
    names = {r.patch.label: r.named.patch_name.name for r in plain.patches if r.named is not None}
    changed_names = {
        n: (names[n], v.name) for n, v in renamed.items() if n in names and v.name not in (names[n], UNKNOWN)
    }
    assert not changed_names
    assert sum(v.name == names.get(n) for n, v in renamed.items()) >= 0.7 * len(names)


def test_a_file_without_an_error_budget_is_read_as_before(synthetic, library, name_placement, tmp_path):
    scene = synthetic(3)
    analysis = name_placement(3)
    path = tmp_path / "patches.npz"
    path.write_bytes(pack_patches(analysis, scene.x_m, scene.y_m, simulated=True))
    with np.load(path) as z:
        old_arrays = {k: z[k] for k in z if not k.startswith("evidence_")}
    meta = json.loads(old_arrays["meta"].tobytes())
    del meta["judged"]
    out = io.BytesIO()
    np.savez(out, **{**old_arrays, "meta": np.frombuffer(json.dumps(meta).encode(), np.uint8)})
    path.write_bytes(out.getvalue())
    patches = read_patches(path)
    assert not patches.evidence
    assert len(patches.patches) == len(analysis.patches)
    matched = match_patches([patches])
    names = [n.patch_name.name for n in Classifier(library).scan([m.features for m in matched])]
    true = [m.truth for m in matched]
    assert not [n for n, t in zip(names, true, strict=True) if n in library.names and n != t]


def test_a_budget_of_other_patches_is_refused(synthetic, analyse_placement, tmp_path):
    scene = synthetic(3)
    path = tmp_path / "patches.npz"
    path.write_bytes(pack_patches(analyse_placement(1000), scene.x_m, scene.y_m, simulated=True))
    with np.load(path) as z:
        arrays = {k: z[k] for k in z}
    out = io.BytesIO()
    np.savez(out, **{**arrays, "evidence_ratio": arrays["evidence_ratio"][:-1]})
    path.write_bytes(out.getvalue())
    with expect_refusal(ErrorCode.FILE_UNREADABLE, path):
        read_patches(path)
