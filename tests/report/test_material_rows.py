"""The table of patches in CSV and MATLAB files of `polysight export`: each cell is compared with materials.json."""

import csv

import numpy as np
import pytest
import scipy.io

from polysight.cli.main import main
from polysight.imaging import Images
from polysight.products import write_image, write_json

# The decimals do not end: a file that rounds the number has another one.
PERMITTIVITY_REAL = 1 / 3 + 3.5
PATCH = {
    "label": 4, "name": 'PET, "0.5 mm"', "name_source": "library",
    "confidence": 0.75, "metal_reference": False, "metal_like": True,
    "box_mm": [10.0, -20.0, 50.0, 40.0], "outline_mm": [], "pixels": 99, "interior_pixels": 77, "incidence_deg": 54.5,
    "ratio": {"real": 0.0, "imag": 10.0}, "inverse_ratio_std": 0.004,
    "permittivity": {"real": PERMITTIVITY_REAL, "imag": -0.25, "real_std": 0.0625, "imag_std": 0.125,
                     "covariance": [[0.0625**2, -0.002], [-0.002, 0.125**2]], "half_widths_68": [0.05, 0.09375],
                     "dominated_by": "leakage"},
    "truth": {"name": "vinyl", "permittivity": {"real": 3.75, "imag": -0.5}},
}  # fmt: skip
METAL = {
    "label": 5, "name": None, "confidence": None, "metal_reference": True, "metal_like": False,
    "box_mm": [-8.0, 2.0, -4.0, 4.0], "outline_mm": [], "pixels": 9, "interior_pixels": 7, "incidence_deg": 55.0,
    "ratio": None, "inverse_ratio_std": None, "permittivity": None, "truth": None, "box": "copper foil",
    "refused": {"what": "noise", "why": "nothing reflects", "do": "look at the image"},
}  # fmt: skip
# Each column of the table has the values of both patches.
EXPECTED = {
    "patch": [4, 5],
    "name": ['PET, "0.5 mm"', None],
    "name_source": ["library", None],
    "confidence": [0.75, None],
    "metal_reference": [False, True],
    "metal_like": [True, False],
    "centre_x_mm": [30.0, -6.0],
    "centre_y_mm": [10.0, 3.0],
    "width_mm": [40.0, 4.0],
    "height_mm": [60.0, 2.0],
    # The pixels behind the result: `interior_pixels`, without those at the edge of the patch.
    "pixels": [77, 7],
    "incidence_deg": [54.5, 55.0],
    "permittivity_real": [PERMITTIVITY_REAL, None],
    "permittivity_real_standard_error": [0.0625, None],
    "permittivity_loss": [0.25, None],
    "permittivity_loss_standard_error": [0.125, None],
    # The loss is minus the imaginary part: the covariance changes its sign.
    "permittivity_real_loss_covariance": [0.002, None],
    "permittivity_real_half_width_68": [0.05, None],
    "permittivity_loss_half_width_68": [0.09375, None],
    "dominated_by": ["leakage", None],
    "refused": [None, "noise: nothing reflects; look at the image"],
    # P is the complex `ratio` of the channels, 10j.
    "p_real": [0.0, None],
    "p_imag": [10.0, None],
    "p_abs_db": [20.0, None],
    "p_phase_deg": [90.0, None],
    "inverse_p_standard_error": [0.004, None],
    "true_name": ["vinyl", None],
    "true_permittivity_real": [3.75, None],
    "true_permittivity_loss": [0.5, None],
    # The name that the operator gave to a drawn box: `box`.
    "drawn_as": [None, "copper foil"],
}


@pytest.fixture
def exported_folder(tmp_path):
    """Folder with the exported files of these two patches."""
    products = tmp_path / "products"
    ones = np.ones((2, 3), np.complex64)
    images = Images(
        h=ones,
        v=ones,
        x_m=np.array([-0.1, 0.0, 0.1]),
        y_m=np.array([0.0, 0.1]),
        valid=np.ones((2, 3), bool),
        p=ones,
    )
    write_image(products / "image.npz", images)
    write_json(products / "materials.json", {"scan_id": "s", "simulated": True, "segments": [PATCH, METAL]})
    assert main(["export", str(products), "--csv", "--mat", "--out", str(tmp_path / "out")]) == 0
    return tmp_path / "out"


def replace_unknown(values: list, replacement: object) -> list:
    """The values with the replacement for None."""
    return [replacement if value is None else value for value in values]


def test_csv_keeps_every_digit(exported_folder):
    with (exported_folder / "materials.csv").open(newline="", encoding="utf-8") as file:
        header, pet_row, metal_row = csv.reader(file)
    assert header == list(EXPECTED)
    for name, pet_cell, metal_cell in zip(header, pet_row, metal_row, strict=True):
        expected_cells = [str(value) for value in replace_unknown(EXPECTED[name], "")]
        assert [pet_cell, metal_cell] == expected_cells, name


def test_a_matlab_file_has_the_same_columns(exported_folder):
    """Unknown numbers are NaN, and unknown texts are empty arrays."""
    columns = scipy.io.loadmat(exported_folder / "image.mat", simplify_cells=True)["materials"]
    assert set(columns) == set(EXPECTED)
    for name, expected in EXPECTED.items():
        if any(isinstance(value, str) for value in expected):
            texts = ["" if np.size(value) == 0 else value for value in columns[name]]
            assert texts == replace_unknown(expected, ""), name
        else:
            numbers = np.asarray(columns[name], float)
            np.testing.assert_array_equal(numbers, np.array(replace_unknown(expected, np.nan), float), err_msg=name)
