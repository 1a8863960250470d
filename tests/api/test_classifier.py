"""The classifiers as estimators of scikit-learn."""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.model_selection import LeaveOneGroupOut, cross_val_score
from sklearn.utils.estimator_checks import check_estimator

from polysight import Classifier, Library, PaperKNeighborsClassifier
from polysight.materials import SIMULATED_LIBRARY, Samples, invert_ratios
from polysight.materials.classify import PAPER_MODEL, PaperKnn, Weights

# Checks that scikit-learn skips by itself here: array API without its switch, and estimators without decision_function.
NOT_CHECKED = {"check_array_api_input", "check_classifiers_multilabel_output_format_decision_function"}


@pytest.fixture(scope="module")
def library():
    """Six scans of the packaged library, few pixels of each patch."""
    simulated_library = Library.load(SIMULATED_LIBRARY)
    angle = simulated_library.angles_deg[0]
    return Library(
        tuple(entry for entry in simulated_library.at_angle(angle).entries if entry.scan in simulated_library.scans[:6])
    )


def test_a_notebook_shows_a_library_in_a_line(library):
    assert repr(library).startswith("<Library: ")
    assert "6 scans, 54.9 degrees" in repr(library)
    assert len(repr(library)) < 500


@pytest.mark.parametrize("measure", ["log", "paper"])
def test_the_paper_s_classifier_passes_scikit_learn_s_checks(measure):
    results = check_estimator(PaperKNeighborsClassifier(measure=measure), on_skip=None)
    assert {result["check_name"] for result in results if result["status"] != "passed"} == NOT_CHECKED


def test_the_paper_s_metric_is_the_distance_by_which_neighbours_are_chosen(library):
    X, y, _ = library.columns()
    knn = PaperKNeighborsClassifier(3, weight_h=0.5, weight_v=2.0).fit(X[::7], y[::7])
    distance, nearest = knn.kneighbors(X[1:5])
    for row, pixel in enumerate(X[1:5]):
        assert distance[row] == pytest.approx([knn.metric(pixel, X[::7][near]) for near in nearest[row]])
        assert (np.diff(distance[row]) >= 0).all()


def test_the_paper_s_classifier_names_as_the_model_of_libraries(library):
    X, _, _ = library.columns()
    samples = Samples.from_library(library)
    model = PaperKnn(weights=Weights(0.7, 1.3, 1.0, "inverse", 5)).fit(samples)
    knn = PaperKNeighborsClassifier(5, weight_h=0.7, weight_v=1.3, measure="inverse")
    knn.fit(invert_ratios(samples.x), samples.names)
    ours = model.by_pixel(invert_ratios(X[::29]))[0]
    # Both may break a tie in another way: up to 1 % of the pixels, chosen.
    assert (knn.predict(X[::29]) == ours).mean() > 0.99


@pytest.mark.parametrize("model", ["knn", "discriminant"])
def test_a_classifier_is_an_estimator(library, model):
    X, y, scans = library.columns()
    classifier = clone(Classifier(model))
    assert isinstance(classifier, Classifier)
    classifier.fit(X, y, scans)
    probability = classifier.predict_proba(X[::50])
    assert probability.shape == (len(X[::50]), len(classifier.classes_))
    assert probability.sum(axis=1) == pytest.approx(1)
    assert (classifier.predict(X[::50]) == classifier.classes_[probability.argmax(axis=1)]).all()
    assert classifier.score(X[::50], y[::50]) > 0.7
    with pytest.raises(ValueError, match="features"):
        classifier.predict(X[:, :3])


@pytest.mark.parametrize(
    ("model", "expected_failures"),
    [
        ("knn", set()),
        # This check's clouds of points are anywhere in X, and do not look like reflections of materials.
        ("discriminant", {"check_classifiers_train"}),
    ],
)
def test_both_models_pass_scikit_learn_s_checks(monkeypatch, model, expected_failures):
    """The checks have 1 to 10 columns; the discriminant gets additional columns, so that all angles are complete."""

    def fill_angle(X):
        return invert_ratios(np.pad(X, ((0, 0), (0, -X.shape[1] % 4)), constant_values=1.0))

    monkeypatch.setattr("polysight.api.classifier._to_features", fill_angle)
    results = check_estimator(Classifier(model), on_skip=None, on_fail=None)
    failed = {result["check_name"] for result in results if result["status"] == "failed"}
    skipped = {result["check_name"] for result in results if result["status"] == "skipped"}
    assert failed == expected_failures
    assert skipped <= NOT_CHECKED


def test_columns_that_are_not_angles_are_refused(library):
    X, y, _ = library.columns()
    with pytest.raises(ValueError, match="3 feature"):
        Classifier("discriminant").fit(X[:, :3], y)


def test_scans_left_out_are_judged_by_scikit_learn_and_by_us_alike(library):
    X, y, scans = library.columns()
    theirs = cross_val_score(Classifier("knn"), X[::9], y[::9], groups=scans[::9], cv=LeaveOneGroupOut())
    ours = Classifier("knn").score_by_scans(library)
    assert ours.model == PAPER_MODEL
    assert abs(theirs.mean() - ours.pixels) < 0.15
