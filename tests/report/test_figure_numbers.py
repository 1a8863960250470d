"""Numbers in the report's figures: ranges of colour maps, phases, the shown part of an image, lines along normals.

P is the ratio H / V of the two channels. A patch is an area of one material that was found in the image.
"""

import math
from types import SimpleNamespace
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from polysight.report import figures
from polysight.results import PatchFigures, PermittivityFigures

# Distance of the pixels in the images of these tests.
STEP_MM = 2.0


def make_patch(x_mm: float, **changes: Any) -> PatchFigures:
    """A patch of 20 x 20 mm whose centre is at `x_mm` and at y = 0."""
    fields = {"label": 1, "box_mm": (x_mm - 10, -10.0, x_mm + 10, 10.0)}
    return PatchFigures(**(fields | changes))


def make_scan(phases_deg: dict[float, Any], segments: list[PatchFigures] | None = None) -> Any:
    """A scan with plates of 12 x 12 mm. On plates |P| is 3, elsewhere P is 1j.

    `phases_deg` has the phase of P by the plate's x in mm: one number, or one for each of its 7 x 7 pixels. Without
    `segments`, a patch of 20 mm is around each plate.
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
        # 170 and -170 degrees are 20 degrees apart.
        ({-30.0: 170.0, 30.0: -170.0}, (165.0, 195.0)),
        ({-30.0: -100.0, 30.0: -60.0}, (-110.0, -50.0)),
    ],
)
def test_the_colours_of_phases_span_the_phases_inside_the_patches(phases_deg, limits):
    assert figures.find_phase_limits_deg(make_scan(phases_deg)) == limits


def test_phases_around_the_whole_circle_have_no_range():
    whole_circle = np.linspace(-180, 180, 49).reshape(7, 7)
    assert figures.find_phase_limits_deg(make_scan({0.0: whole_circle})) is None


def test_phases_over_more_than_half_of_the_circle_have_a_range():
    more_than_half = np.linspace(-100, 100, 49).reshape(7, 7)
    # The middle 90 per cent of them, -90 to 90, and 15 per cent of these 180 on either side, rounded to multiples of 5.
    assert figures.find_phase_limits_deg(make_scan({0.0: more_than_half})) == (-120.0, 120.0)


def test_a_patch_outside_the_image_gives_no_range_of_phases():
    outside_the_image = make_patch(0.0, box_mm=(90.0, 0.0, 95.0, 1.0))
    assert figures.find_phase_limits_deg(make_scan({0.0: 40.0}, [outside_the_image])) is None


def test_metal_does_not_widen_the_range_of_phases_if_there_is_another_patch():
    metal = make_patch(-30.0, metal_reference=True)
    phases_deg = {-30.0: 2.0, 30.0: 62.0}
    assert figures.find_phase_limits_deg(make_scan(phases_deg, [metal, make_patch(30.0)])) == (50.0, 75.0)
    # Without another patch the range is that of the metal.
    assert figures.find_phase_limits_deg(make_scan(phases_deg, [metal])) == (-10.0, 15.0)


@pytest.mark.parametrize(
    ("angle", "text"),
    [
        (0.0, "0"), (170.0, "170"), (180.0, "180"), (-180.0, "180"),
        (190.0, "-170"), (-190.0, "170"), (-5.0, "-5"),
    ],
)  # fmt: skip
def test_a_phase_is_written_between_minus_180_and_180(angle, text):
    assert figures._wrap_degrees(angle) == text


@pytest.mark.parametrize("limits", [(165.0, 195.0), (-110.0, -50.0), (-20.0, 20.0)])
def test_phases_are_drawn_within_half_a_circle_of_the_middle(monkeypatch, limits):
    phases_deg = np.arange(-180.0, 181.0, 7.0)[None, :]
    phase_map = SimpleNamespace(numbers=phases_deg, limits=(-180.0, 180.0), opacity=None)
    monkeypatch.setattr(figures, "map_scan", lambda *_: phase_map)
    scan: Any = SimpleNamespace(extent_mm=(0.0, 1.0, 0.0, 1.0), metal_referenced=True, judged=True)
    image, unit = figures.draw_channel(Figure().add_subplot(), scan, "phase_p", limits)
    drawn_deg = np.asarray(image.get_array())
    middle_deg = sum(limits) / 2
    assert unit == "degrees"
    half_a_circle_deg = 180
    assert (abs(drawn_deg - middle_deg) <= half_a_circle_deg).all()
    assert np.allclose(np.exp(1j * np.radians(drawn_deg)), np.exp(1j * np.radians(phases_deg)))
    assert image.get_clim() == limits
    # Without limits the phases are drawn as they are.
    image, _ = figures.draw_channel(Figure().add_subplot(), scan, "phase_p")
    assert np.array_equal(image.get_array(), phases_deg)
    assert image.get_clim() == (-180.0, 180.0)


@pytest.mark.parametrize(
    ("referenced", "judged", "unit"),
    [(True, True, "dB (metal = 0)"), (True, False, "dB (reference = 0)"), (False, False, "dB")],
)
def test_the_unit_of_amplitudes_says_which_reference_has_0_db(referenced, judged, unit):
    scan: Any = SimpleNamespace(metal_referenced=referenced, judged=judged)
    assert figures._name_amplitude_unit(scan) == unit


@pytest.mark.parametrize(
    ("boxes", "limits"),
    [
        # A margin of 20 mm on either side, 12 mm below and 24 mm above for the name; then the shorter side of the map
        # is made as long as the longer one.
        ([(-10.0, -10.0, 10.0, 10.0)], (-30.0, 30.0, -24.0, 36.0)),
        ([(-40.0, -10.0, -20.0, 10.0), (20.0, 0.0, 40.0, 10.0)], (-60.0, 60.0, -54.0, 66.0)),
        # The map is not larger than the image.
        ([(90.0, 90.0, 100.0, 100.0)], (70.0, 100.0, 76.0, 100.0)),
        ([], (-100.0, 100.0, -100.0, 100.0)),
    ],
)
def test_a_map_shows_the_plates_with_room_for_their_names(boxes, limits):
    # The first box is a patch that was found in the image, others are plates of the true scene.
    segments = [SimpleNamespace(box_mm=box) for box in boxes[:1]]
    plates = [SimpleNamespace(box_mm=box) for box in boxes[1:]]
    scan: Any = SimpleNamespace(segments=segments, plates=plates, extent_mm=(-100.0, 100.0, -100.0, 100.0))
    ax = Figure().add_subplot()
    figures._crop_to_plates(ax, scan)
    assert (*ax.get_xlim(), *ax.get_ylim()) == pytest.approx(limits)


@pytest.mark.parametrize(
    ("values", "limits"), [([], (0.5, 1.5)), ([3.0], (2.5, 3.5)), ([3.0, 3.8], (2.9, 3.9)), ([2.0, 6.0], (1.8, 6.2))]
)
def test_the_colours_of_a_surface_span_its_permittivities(values, limits):
    """The span is 1 at least; a larger one is widened by 5 per cent on either side."""
    segments = [SimpleNamespace(permittivity=complex(value)) for value in values]
    surface: Any = SimpleNamespace(segments=[*segments, SimpleNamespace(permittivity=None)])
    assert figures.colour_range(surface) == pytest.approx(limits)


SMALL_PERMITTIVITY = PermittivityFigures(real=3.0, imag=-4.0, covariance=[[0.3**2, 0.0], [0.0, 0.4**2]])
LARGE_PERMITTIVITY = PermittivityFigures(real=8.0, imag=0.0, covariance=[[0.1**2, 0.0], [0.0, 0.1**2]])


@pytest.fixture
def filled_patches(monkeypatch):
    """Values, texts and range of colours of each map of patches that is drawn, in the order of drawing."""
    calls = []

    def note_call(_figure, _axes, _scan, values, texts, colours):
        _colour_map, low, high, _title = colours
        calls.append(SimpleNamespace(values=values, texts=texts, limits=(low, high)))

    monkeypatch.setattr(figures, "_fill_patches", note_call)
    monkeypatch.setattr(figures.style, "encode_png", lambda _: b"")
    return calls


def test_the_maps_of_permittivity_show_the_real_part_and_the_relative_error_of_both_parts(filled_patches):
    scan: Any = SimpleNamespace(segments=[make_patch(0.0, permittivity=SMALL_PERMITTIVITY)], stamped=False)
    assert figures.draw_permittivity_map(scan) == b""
    map_of_real_part, map_of_error = filled_patches
    assert map_of_real_part.values == {1: 3.0}
    assert map_of_real_part.texts == {1: "3.00\n± 0.30"}
    # The range of colours is 0.5 at least.
    assert map_of_real_part.limits == pytest.approx((3 - 0.25, 3 + 0.25))
    # Errors of 0.3 and 0.4 are together 0.5, which is 10 % of |3 - 4j| = 5.
    assert map_of_error.values == {1: pytest.approx(10.0)}
    assert map_of_error.texts[1].startswith("10")
    assert map_of_error.limits == pytest.approx((0.0, 10.0))


def test_the_colours_of_permittivities_reach_a_tenth_of_their_difference_beyond_the_smallest_and_largest(
    filled_patches,
):
    segments = [
        make_patch(0.0, permittivity=SMALL_PERMITTIVITY),
        make_patch(0.0, label=2, permittivity=LARGE_PERMITTIVITY),
        make_patch(0.0, label=3),
    ]
    scan: Any = SimpleNamespace(segments=segments, stamped=False)
    figures.draw_permittivity_map(scan)
    map_of_real_part, _ = filled_patches
    margin = (8.0 - 3.0) / 10
    assert map_of_real_part.limits == pytest.approx((3.0 - margin, 8.0 + margin))
    assert set(map_of_real_part.values) == {1, 2}, "the patch without a permittivity is not filled"


def test_a_scan_without_permittivities_has_no_map_of_them():
    scan: Any = SimpleNamespace(segments=[make_patch(0.0)], stamped=False)
    assert figures.draw_permittivity_map(scan) is None


@pytest.mark.parametrize("count", [1, 59, 60, 119, 120, 500])
def test_a_picture_of_a_surface_has_up_to_120_lines_along_its_normals(monkeypatch, count):
    """The views are from the rig, from the side and from above. Far points are drawn first: near ones hide them.

    The lines, called needles, are 12 mm long. Only each n-th point has one, as more would hide each other.
    """
    drawn_figures: list[Figure] = []
    monkeypatch.setattr(figures.style, "encode_png", drawn_figures.append)
    rng = np.random.default_rng(count)
    directions = rng.standard_normal((count, 3))
    normals = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    surface: Any = SimpleNamespace(
        points_m=rng.uniform(-0.1, 0.1, (count, 3)),
        normals=normals,
        segment=np.zeros(count, int),
        segments=[],
        simulated=True,
    )
    with matplotlib.rc_context({"figure.max_open_warning": 0}):
        figures.surface_figure(surface)
    points_mm = 1e3 * surface.points_m
    x, y, z = points_mm.T
    # For each view: the coordinates to the right and upwards (0: x, 1: y, 2: z), and the distance from the eye.
    views = (([0, 1], z), ([2, 1], -x), ([0, 2], -y))
    (figure,) = drawn_figures
    for ax, (plane, distance) in zip(figure.axes, views, strict=True):
        (dots,) = ax.collections
        far_to_near = np.argsort(-distance)
        assert np.allclose(dots.get_offsets(), points_mm[far_to_near][:, plane])
        needles = ax.lines
        # Each n-th point has a needle, with the smallest n that gives 120 or fewer; this gives 60 or more if there are
        # so many points.
        assert min(count, 60) <= len(needles) <= 120
        points_per_needle = math.ceil(count / len(needles))
        starts_mm = points_mm[::points_per_needle]
        ends_mm = starts_mm + 12 * normals[::points_per_needle]
        for needle, start_mm, end_mm in zip(needles, starts_mm, ends_mm, strict=True):
            assert np.allclose(needle.get_xydata(), [start_mm[plane], end_mm[plane]])
