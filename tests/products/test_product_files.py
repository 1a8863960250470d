"""Files of products are written completely or not at all, and read back unchanged."""

import errno
import json
from dataclasses import replace

import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight.imaging import Images
from polysight.products import write_image, write_json
from polysight.products.exports import create_export_folder
from polysight.products.processed import read_image
from polysight.results import to_plain
from polysight_shared.errors import DataError, ErrorCode
from polysight_shared.files import write_atomically


def test_image_product_round_trips(tmp_path):
    rng = np.random.default_rng(0)
    h, v, p = (rng.standard_normal((3, 5, 7)) + 1j * rng.standard_normal((3, 5, 7))).astype(np.complex64)
    x = np.linspace(-0.1, 0.1, 7)
    y = np.linspace(0.0, 0.1, 5)
    valid = rng.uniform(size=h.shape) < 0.8
    path = tmp_path / "products" / "image.npz"
    images = Images(h, v, x, y, valid, p)
    write_image(path, images)
    read_back = read_image(path)
    assert {name: array.dtype for name, array in vars(read_back).items() if isinstance(array, np.ndarray)} == {
        **dict.fromkeys(("h", "v", "p"), np.dtype(np.complex64)),
        **dict.fromkeys(("x_m", "y_m"), np.dtype(np.float64)),
        "valid": np.dtype(np.bool_),
    }
    np.testing.assert_array_equal(read_back.h, h)
    np.testing.assert_array_equal(read_back.y_m, y)
    # No temporary file is left.
    assert [file.name for file in path.parent.iterdir()] == ["image.npz"]
    # Arrays of different shapes are not written, and a file that was cut off is not read.
    with pytest.raises(DataError):
        write_image(path, replace(images, h=h[1:]))
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DataError):
        read_image(path)


def test_json_products_have_null_for_what_is_not_finite_and_parts_of_complex_numbers(tmp_path):
    content = {"a": np.float32(1.5), "b": [np.inf, float("nan"), 2 - 1j], "c": np.array([1, 2]), "d": (True, None, "ε")}
    write_json(tmp_path / "q.json", content)
    assert json.loads((tmp_path / "q.json").read_text(encoding="utf-8")) == {
        "a": 1.5,
        "b": [None, None, {"real": 2.0, "imag": -1.0}],
        "c": [1, 2],
        "d": [True, None, "ε"],
    }
    assert to_plain(to_plain(content)) == to_plain(content)


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "x.json"
    write_atomically(path, b"old")

    def fail_as_a_full_disk_does(_fd):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", fail_as_a_full_disk_does)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"


def test_exports_are_written_to_the_folder_of_their_products_by_default(tmp_path):
    assert create_export_folder(tmp_path / "products", None) == tmp_path / "products-export"
    assert create_export_folder(tmp_path / "products", tmp_path / "other") == tmp_path / "other"
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "linked-export").symlink_to(tmp_path / "elsewhere")
    with expect_refusal(ErrorCode.PATH_OUTSIDE, "linked-export"):
        create_export_folder(tmp_path / "linked", None)
