"""A segment of a surface is named only by its permittivity, with the same library as the patches of an image."""

from pathlib import Path

import numpy as np
import pytest

import polysight.materials as materials
from polysight.materials import Classifier, Library, name_permittivity

LIBRARY = Path(materials.__file__).parent / "simulated-library.npz"


@pytest.fixture(scope="module")
def classifier() -> Classifier:
    return Classifier(Library.load(LIBRARY))


def test_the_permittivity_of_a_material_of_the_library_gets_its_name(classifier: Classifier) -> None:
    # Standard deviations of 0.05 of eps' and eps'': a good measurement of a surface
    covariance = np.diag([0.05**2, 0.05**2])
    for name, permittivity in classifier.permittivities.items():
        assert name_permittivity(permittivity, covariance, classifier).name == name


def test_a_permittivity_that_no_material_of_the_library_has_gets_none_of_its_names(classifier: Classifier) -> None:
    name = name_permittivity(20.0 - 0.1j, np.diag([0.05**2, 0.05**2]), classifier).name
    assert name not in classifier.permittivities
