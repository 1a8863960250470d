"""Numbers in figures: ranges of colours, phases on the circle, the part of an image that is shown, needles."""

from types import SimpleNamespace
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from polysight.report import figures
from polysight.results import PatchFigures, PermittivityFigures

# Pixels of the made-up images; chosen.
STEP_MM = 2.0


def make_patch(x_mm: float, **changes: Any) -> PatchFigures:
    """A patch of 20 x 20 mm at the middle in y."""
    return PatchFigures(**({"label": 1, "box_mm": (x_mm - 10, -10.0, x_mm + 10, 10.0)} | changes))


def make_scan(phases_deg: dict[float, Any], segments: list[PatchFigures] | None = None) -> Any:
    """A scan whose P is 1 at 90 degrees, and 3 on plates of 12 mm along x: `phases_deg` has the phase at each x.

    Without `segments`, there is a patch of 20 mm about each plate.
    """
    x_mm = np.arange(-60.0, 61.0, STEP_MM)
    y_mm = np.arange(-20.0, 21.0, STEP_MM)
    p = np.full((y_mm.size, x_mm.size), 1j)
    for place, phase_deg in phases_deg.items():
        inside = np.ix_(abs(y_mm) <= 6, abs(x_mm - place) <= 6)
        p[inside] = 3 * np.exp(1j * np.radians(phase_deg))
    return SimpleNamespace(x_mm=x_mm, y_mm=y_mm, p=p, segments=segments or [make_patch(place) for place in phases_deg])


@pytest.mark.parametrize(
    ("phases_deg", "limits"),
    [
        ({0.0: 40.0}, (30.0, 50.0)),
        # From 20 to 60 degrees, and 15 per cent of these 40 on either side, rounded outwards to multiples of 5.
        ({-30.0: 20.0, 30.0: 60.0}, (10.0, 70.0)),
        # Either side of 180 degrees lies together.
        ({-30.0: 170.0, 30.0: -170.0}, (165.0, 195.0)),
        ({-30.0: -100.0, 30.0: -60.0}, (-110.0, -50.0)),
    ],
)
def test_colours_of_phases_span_the_insides_of_patches(phases_deg, limits):
    assert figures.find_phase_limits_deg(make_scan(phases_deg)) == limits


def test_phases_around_the_circle_have_no_range():
    circle = np.linspace(-180, 180, 49).reshape(7, 7)
    assert figures.find_phase_limits_deg(make_scan({0.0: circle})) is None
    more_than_half = np.linspace(-100, 100, 49).reshape(7, 7)
    # The middle 90 per cent of them, -90 to 90, and 15 per cent of these 180 on either side, rounded to multiples of 5.
    assert figures.find_phase_limits_deg(make_scan({0.0: more_than_half})) == (-120.0, 120.0)
    beside_the_image = make_patch(0.0, box_mm=(90.0, 0.0, 95.0, 1.0))
    assert figures.find_phase_limits_deg(make_scan({0.0: 40.0}, [beside_the_image])) is None


def test_metal_and_patches_that_were_not_judged_do_not_widen_the_range():
    metal = make_patch(-30.0, metal_reference=True)
    phases_deg = {-30.0: 2.0, 30.0: 62.0}
    assert figures.find_phase_limits_deg(make_scan(phases_deg, [metal, make_patch(30.0)])) == (50.0, 75.0)
    # Where no other patch is, the metal is shown.
    assert figures.find_phase_limits_deg(make_scan(phases_deg, [metal])) == (-10.0, 15.0)


@pytest.mark.parametrize(
    ("angle", "text"),
    [(0.0, "0"), (170.0, "170"), (180.0, "180"), (-180.0, "180"), (190.0, "-170"), (-190.0, "170"), (-5.0, "-5")],
)
def test_a_phase_is_written_between_minus_180_and_180(angle, text):
    assert figures._wrap_degrees(angle) == text


@pytest.mark.parametrize("limits", [(165.0, 195.0), (-110.0, -50.0), (-20.0, 20.0)])
def test_phases_are_drawn_within_half_a_circle_of_the_middle(monkeypatch, limits):
    numbers = np.arange(-180.0, 181.0, 7.0)[None, :]
    shown = SimpleNamespace(numbers=numbers, limits=(-180.0, 180.0), opacity=None)
    monkeypatch.setattr(figures, "map_scan", lambda *_: shown)
    scan: Any = SimpleNamespace(extent_mm=(0.0, 1.0, 0.0, 1.0), metal_referenced=True, judged=True)
    image, unit = figures.draw_channel(Figure().add_subplot(), scan, "phase_p", limits)
    drawn = np.asarray(image.get_array())
    middle = sum(limits) / 2
    assert unit == "degrees"
    assert (abs(drawn - middle) <= 180).all()
    assert np.allclose(np.exp(1j * np.radians(drawn)), np.exp(1j * np.radians(numbers)))
    assert image.get_clim() == limits
    image, _ = figures.draw_channel(Figure().add_subplot(), scan, "phase_p")
    assert np.array_equal(image.get_array(), numbers)
    assert image.get_clim() == (-180.0, 180.0)


@pytest.mark.parametrize(
    ("referenced", "judged", "unit"),
    [(True, True, "dB (metal = 0)"), (True, False, "dB (reference = 0)"), (False, False, "dB")],
)
def test_decibels_say_what_zero_is(referenced, judged, unit):
    scan: Any = SimpleNamespace(metal_referenced=referenced, judged=judged)
    assert figures._name_amplitude_unit(scan) == unit


@pytest.mark.parametrize(
    ("boxes", "limits"),
    [
        # Room of 20 mm on either side, 12 mm below and 24 mm above for the name. The shorter side is made as long as
        # the longer one.
        ([(-10.0, -10.0, 10.0, 10.0)], (-30.0, 30.0, -24.0, 36.0)),
        ([(-40.0, -10.0, -20.0, 10.0), (20.0, 0.0, 40.0, 10.0)], (-60.0, 60.0, -54.0, 66.0)),
        # Where the image ends, the map ends.
        ([(90.0, 90.0, 100.0, 100.0)], (70.0, 100.0, 76.0, 100.0)),
        ([], (-100.0, 100.0, -100.0, 100.0)),
    ],
)
def test_a_map_shows_the_plates_with_room_for_their_names(boxes, limits):
    scan: Any = SimpleNamespace(
        segments=[SimpleNamespace(box_mm=box) for box in boxes[:1]],
        plates=[SimpleNamespace(box_mm=box) for box in boxes[1:]],
        extent_mm=(-100.0, 100.0, -100.0, 100.0),
    )
    ax = Figure().add_subplot()
    figures._crop_to_plates(ax, scan)
    assert (*ax.get_xlim(), *ax.get_ylim()) == pytest.approx(limits)


@pytest.mark.parametrize(
    ("values", "limits"), [([], (0.5, 1.5)), ([3.0], (2.5, 3.5)), ([3.0, 3.8], (2.9, 3.9)), ([2.0, 6.0], (1.8, 6.2))]
)
def test_colours_of_a_surface_span_its_permittivities(values, limits):
    """The span is 1 at least; a larger one is widened by 5 per cent on either side."""
    segments = [SimpleNamespace(permittivity=complex(value)) for value in values]
    surface: Any = SimpleNamespace(segments=[*segments, SimpleNamespace(permittivity=None)])
    assert figures.colour_range(surface) == pytest.approx(limits)


def test_a_relative_error_is_that_of_both_parts(monkeypatch):
    """Errors of 0.3 and 0.4 are together 0.5, which is 10 % of |3 - 4j| = 5.

    Colours of the real parts reach beyond the smallest and the largest by a tenth of their difference, at least by
    0.25.
    """
    drawn = []
    # Called for each of the two maps, with values, texts and colours as the last arguments.
    monkeypatch.setattr(figures, "_fill_patches", lambda *given: drawn.append(given[3:]))
    monkeypatch.setattr(figures.style, "encode_png", lambda _: b"")
    value = PermittivityFigures(real=3.0, imag=-4.0, covariance=[[0.09, 0.0], [0.0, 0.16]])
    other = PermittivityFigures(real=8.0, imag=0.0, covariance=[[0.01, 0.0], [0.0, 0.01]])
    scan: Any = SimpleNamespace(segments=[make_patch(0.0, permittivity=value)], stamped=False)
    assert figures.draw_permittivity_map(scan) == b""
    (real, texts, (_, low, high, _)), (errors, percents, (_, zero, most, _)) = drawn
    assert (real, errors) == ({1: 3.0}, {1: pytest.approx(10.0)})
    assert texts == {1: "3.00\n± 0.30"}
    assert percents[1].startswith("10")
    assert (low, high, zero, most) == pytest.approx((2.75, 3.25, 0.0, 10.0))
    scan.segments += [make_patch(0.0, label=2, permittivity=other), make_patch(0.0, label=3)]
    drawn.clear()
    figures.draw_permittivity_map(scan)
    values, _, (_, low, high, _) = drawn[0]
    # A tenth of the difference of 5 on either side.
    assert (low, high) == pytest.approx((3.0 - 0.5, 8.0 + 0.5))
    assert set(values) == {1, 2}, "the patch without a permittivity is not filled"
    scan.segments = [make_patch(0.0)]
    assert figures.draw_permittivity_map(scan) is None


@pytest.mark.parametrize("count", [1, 59, 60, 119, 120, 500])
def test_a_surface_has_up_to_120_needles_along_its_normals(monkeypatch, count):
    """Three views: from the rig, from the side and from above. Far points are drawn first, so that near ones hide them.

    Needles are 12 mm long. So that they can be told apart, only each n-th point has one.
    """
    drawn_figures: list[Figure] = []
    monkeypatch.setattr(figures.style, "encode_png", drawn_figures.append)
    rng = np.random.default_rng(count)
    normals = rng.standard_normal((count, 3))
    surface: Any = SimpleNamespace(
        points_m=rng.uniform(-0.1, 0.1, (count, 3)), normals=normals / np.linalg.norm(normals, axis=1)[:, None],
        segment=np.zeros(count, int), segments=[], simulated=True,
    )  # fmt: skip
    with matplotlib.rc_context({"figure.max_open_warning": 0}):
        figures.surface_figure(surface)
    points_mm = 1e3 * surface.points_m
    x, y, z = points_mm.T
    # For each view: the indices of the coordinates to the right and upwards, and the distance from the eye.
    views = (((0, 1), z), ((2, 1), -x), ((0, 2), -y))
    for ax, ((across, up), depth) in zip(drawn_figures[0].axes, views, strict=True):
        (dots,) = ax.collections
        order = np.argsort(-depth)
        assert np.allclose(dots.get_offsets(), points_mm[order][:, [across, up]])
        needles = ax.lines
        assert min(count, 60) <= len(needles) <= 120
        # Points per needle, rounded up.
        stride = -(-count // len(needles))
        for needle, start, normal in zip(needles, points_mm[::stride], surface.normals[::stride], strict=True):
            ends = np.array([start, start + 12 * normal])
            assert np.allclose(needle.get_xydata(), ends[:, [across, up]])
