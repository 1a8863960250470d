"""The library of a scan is fitted once, for the check before its rows and for its names, and again when it changes."""

import shutil

import pytest
from tests.support.rigs import load_published_rig

from polysight.materials import SIMULATED_LIBRARY, Library
from polysight.process import load_classifier
from polysight.settings import Settings
from polysight_shared.errors import DataError


def test_a_library_is_fitted_once_and_again_when_its_file_was_replaced(tmp_path):
    file = tmp_path / "library.npz"
    shutil.copy(SIMULATED_LIBRARY, file)
    settings = Settings(library=str(file))
    first = load_classifier(settings, load_published_rig())
    assert first is not None
    assert load_classifier(settings, load_published_rig()) is first

    library = Library.load(SIMULATED_LIBRARY)
    removed_material = library.names[0]
    smaller = Library(tuple(entry for entry in library.entries if entry.name != removed_material), library.fit)
    smaller.save(tmp_path / "fewer.npz")
    (tmp_path / "fewer.npz").replace(file)
    second = load_classifier(settings, load_published_rig())
    assert second is not None
    assert set(first.names) - set(second.names) == {removed_material}

    file.unlink()
    with pytest.raises(DataError, match="no such library"):
        load_classifier(settings, load_published_rig())
