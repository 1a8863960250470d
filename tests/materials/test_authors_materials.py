"""The published material files are read as text, and never run."""

import os
import pickle

import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight.materials.train import read_material, read_materials, read_pickle
from polysight_shared.errors import DataError, ErrorCode

RNG = np.random.default_rng(1)

# Gains of the channels, any numbers: they are equal for the plate and the metal and must cancel.
GAIN_H = 3.0 * np.exp(0.7j)
GAIN_V = 0.5


def make_content(n=90):
    """Return what a published material file holds: n pixels with H = 0.6 and V = 0.15 relative to metal, so P = 4."""
    h = GAIN_H * (0.6 + 0.01 * RNG.standard_normal(n))
    v = GAIN_V * (0.15 + 0.01 * RNG.standard_normal(n)).astype(complex)
    metal_h = GAIN_H * np.ones(40)
    metal_v = GAIN_V * np.ones(40, complex)
    return {
        "name": "PET",
        "thickness": 0.5,
        "collection_name": "scan_12",
        "incident_angle": 55,
        "ref_name": "copper",
        "ref_thickness": 1.0,
        "values": [(h / v).astype(np.complex64), h.astype(np.complex64), v.astype(np.complex64)],
        "ref_values": [(metal_h / metal_v).astype(np.complex64), metal_h.astype(np.complex64), metal_v],
    }


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_values_come_out_relative_to_the_reference(tmp_path, protocol):
    path = tmp_path / "PET_55.pkl"
    path.write_bytes(pickle.dumps(make_content(), protocol=protocol))
    entry = read_material(path)
    assert (entry.name, entry.scan, entry.incidence_deg, entry.reference) == ("PET", "scan_12", 55.0, "copper")
    assert entry.thickness_mm == 0.5
    assert not entry.simulated
    # The pixels scatter by 0.01: a median of 90 has an error of 1.25 * 0.01 / sqrt(90) = 0.0013. That is 0.2 % of H
    # and 0.9 % of V and P.
    assert np.median(entry.h) == pytest.approx(0.6, rel=0.01)
    assert np.median(entry.v) == pytest.approx(0.15, rel=0.03)
    assert np.median(entry.p.real) == pytest.approx(4.0, rel=0.03)


@pytest.mark.parametrize(
    ("answer", "mm"), [("3 mm", 3.0), ("0.5", 0.5), ("", None), ("thin", None), (None, None), (2, 2.0)]
)
def test_a_thickness_may_be_a_text(tmp_path, answer, mm):
    path = tmp_path / "PET_55.pkl"
    path.write_bytes(pickle.dumps(make_content(4) | {"thickness": answer}))
    assert read_material(path).thickness_mm == mm


def test_control_characters_in_the_texts_of_a_file_are_replaced(tmp_path):
    """The texts are printed, and an escape sequence would control the terminal."""
    path = tmp_path / "PET_55.pkl"
    names = {"name": "PET\x1b[31m\n3 mm\n", "collection_name": "scan\t1\x00", "ref_name": "\u202ecopper"}
    path.write_bytes(pickle.dumps(make_content(4) | names))
    entry = read_material(path)
    assert (entry.name, entry.scan, entry.reference) == ("PET?[31m 3 mm", "scan 1?", "?copper")


@pytest.mark.parametrize("angle", [float("nan"), float("inf"), 0, -55, 90, 550])
def test_an_incidence_angle_outside_0_to_90_degrees_is_refused(tmp_path, angle):
    path = tmp_path / "PET_55.pkl"
    path.write_bytes(pickle.dumps(make_content(4) | {"incident_angle": angle}))
    with expect_refusal(ErrorCode.FILE_FOREIGN, "incident_angle"):
        read_material(path)


def test_files_written_with_numpy_1_are_read(tmp_path):
    """numpy 2 renamed the module that a pickled array refers to."""
    path = tmp_path / "PET_55.pkl"
    pickled = pickle.dumps(make_content(), protocol=2)
    path.write_bytes(pickled.replace(b"numpy._core.multiarray", b"numpy.core.multiarray"))
    assert read_material(path).name == "PET"


@pytest.mark.parametrize(
    "content",
    [
        np.arange(5), np.arange(5.0), [], ["values"], "text", 3, None, {}, np.zeros((), [("values", float)]),
        {"values": np.arange(5), "ref_values": 3}, make_content() | {"values": np.zeros(0)},
        make_content() | {"incident_angle": 10**400}, make_content() | {"incident_angle": []},
    ],
)  # fmt: skip
def test_a_pickle_of_something_else_is_not_a_material_file(tmp_path, content):
    path = tmp_path / "PET_55.pkl"
    path.write_bytes(pickle.dumps(content))
    with expect_refusal(ErrorCode.FILE_FOREIGN, path):
        read_material(path)


class Hostile:
    """An object whose pickle runs a shell command when it is loaded."""

    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return os.system, (f"touch {self.target}",)


def test_a_hostile_file_is_refused_and_does_nothing(tmp_path):
    file_of_command = tmp_path / "ran"
    path = tmp_path / "evil_55.pkl"
    path.write_bytes(pickle.dumps(make_content() | {"name": Hostile(file_of_command)}))
    with expect_refusal(ErrorCode.FILE_FOREIGN, "system"):
        read_material(path)
    assert not file_of_command.exists()


@pytest.mark.parametrize(
    ("module", "name"), [("builtins", "eval"), ("numpy", "load"), ("builtins", "getattr"), ("numpy.f2py", "main")]
)
def test_a_pickle_may_only_call_what_arrays_need(tmp_path, module, name):
    path = tmp_path / "x.pkl"
    # The form of protocol 0: load module.name, call it with the text "1".
    path.write_bytes(f"c{module}\n{name}\n(S'1'\ntR.".encode())
    with expect_refusal(ErrorCode.FILE_FOREIGN, name):
        read_pickle(path)


def test_damaged_files_are_errors_at_every_length(tmp_path):
    content_bytes = pickle.dumps(make_content(4))
    path = tmp_path / "x.pkl"
    # Every seventh length: all would take seven times as long.
    for length in range(0, len(content_bytes), 7):
        path.write_bytes(content_bytes[:length])
        with pytest.raises(DataError):
            read_material(path)


@pytest.mark.parametrize(
    "fields",
    [{"values": [np.ones(2), np.ones(3), np.ones(2)]}, {"ref_values": [[0], [0], [0]]}],
    ids=["arrays of different lengths", "metal without a signal"],
)
def test_values_that_cannot_be_divided_by_the_reference_are_refused(tmp_path, fields):
    path = tmp_path / "x.pkl"
    path.write_bytes(pickle.dumps(make_content() | fields))
    with pytest.raises(DataError):
        read_material(path)


def test_a_folder_without_material_files_is_refused(tmp_path):
    with expect_refusal(ErrorCode.FILE_MISSING, tmp_path):
        read_materials(tmp_path)
