"""Edges and thin walls: they give no permittivity, and normals are those of the surface."""

from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from polysight.jobs.surface import check_is_metal
from polysight.surfaces import (
    SeenEchoes,
    Segment,
    Uncertainty,
    analyse_surface,
    find_shape,
    find_voltages,
    learn_gains,
    result,
)
from polysight.surfaces.gains import predict_voltages, reflect_points
from polysight.surfaces.measure import group_echoes
from polysight.surfaces.paths import STRIDE_M
from polysight.surfaces.permittivity import find_interior, find_reflecting, find_shares, fit_permittivity
from polysight.surfaces.points import find_offset_that_sees, predict_echo
from polysight.surfaces.result import (
    BEHIND_ANOTHER_REASON,
    NO_SINGLE_MEDIUM,
    add_permittivity,
    describe_segment,
    doubt_places,
    estimate_wall_std,
    find_depth_behind,
    judge_segment,
)
from polysight.surfaces.window import Echoes
from polysight_shared.errors import DataError
from polysight_worlds.media import Stack
from polysight_worlds.shapes import cylinder, plate

# A rig that stands as its file says: only noise and the method's own errors remain.
EXACT = Uncertainty(leakage=1e-4, axis_rad=1e-4, place_m=1e-6)

# In the middle between TX and the receivers, half a metre before the stage
CENTRE_M = (-0.01, 0.104, 0.5)

# Permittivity of the objects
MEDIUM = 4.2 - 0.4j

# Over the linear part of the published sweep, 1 / m
WAVE_NUMBERS = 2 * np.pi * np.linspace(76.282e9, 79.749e9, 24) / 299792458


def find_gains(learnt, voltages):
    """Gains [n, 2] of H and V that the metal sphere has shown: the level is that of H, the ratio H over V."""
    gain_h = np.exp(learnt.level(voltages))
    return np.stack([gain_h, gain_h / learnt.ratio(voltages.arrival)], axis=1)


def test_the_sharp_edges_of_a_tilted_plate_are_not_a_surface(see, gains, optics):
    """The plate is seen from two thirds of the grid, and only its edges from the rest."""
    tilted_plate = plate("plate", Stack(below=MEDIUM), CENTRE_M, size_m=(0.1, 0.1), tilt_deg=(2.0, -2.0))
    surface = analyse_surface(see([tilted_plate]), optics, gains, uncertainty=EXACT)
    # Coordinates on the plate of the place that is nearest to each point
    _, a, b = tilted_plate.project(surface.points_m)
    true_normals = tilted_plate.evaluate(a, b).normal.T
    angles_rad = np.linalg.norm(surface.normals - true_normals, axis=1)
    # Points that the edges disturb are left out; the median error is 0.32 degrees.
    assert np.median(np.degrees(angles_rad)) < 0.5
    for segment in surface.segments:
        if segment.permittivity is not None:
            error = segment.permittivity - MEDIUM
            parts = np.array([error.real, error.imag])
            # 99.9 % of chi squared with two degrees of freedom
            assert parts @ np.linalg.inv(np.array(segment.covariance)) @ parts < 13.8


def test_edges_alone_give_no_permittivity(see, gains, optics):
    """The plate is tilted so far that no position of the grid sees its mirror point."""
    tilted_plate = plate("plate", Stack(below=MEDIUM), CENTRE_M, size_m=(0.1, 0.1), tilt_deg=(12.0, 0.0))
    surface = analyse_surface(see([tilted_plate], columns=64, rows=44), optics, gains, uncertainty=EXACT)
    assert [s.permittivity for s in surface.segments] == [None] * len(surface.segments)
    assert all(s.reason for s in surface.segments)


def test_echoes_whose_amplitude_falls_as_that_of_an_edge_are_not_a_reflection(metal, gains, optics):
    """The diffraction of an edge falls as 1 / angle from the border of the zone into which its surface reflects.

    A surface has the same level everywhere. Here the echoes of the metal sphere are changed to those of such an edge.
    """
    voltages = find_voltages(metal, optics)
    amplitude = np.abs(metal.h.amplitude)
    segment = np.zeros(len(metal), int)
    learnt = gains(optics)
    # All points of the unchanged sphere reflect.
    assert find_reflecting(voltages, amplitude, segment, learnt).mean() > 0.9
    # The angle from the border; the fall is 1 at the first point, 0.02 rad away from it.
    angle = metal.h.slope[:, 0] - metal.h.slope[:, 0].min() + 0.02
    fall = 0.02 / angle
    edge = replace(voltages, voltage=voltages.voltage * fall[:, None])
    assert not find_reflecting(edge, amplitude * fall, segment, learnt).any()


def test_a_reflection_weaker_than_of_any_medium_is_not_a_surface(metal, gains, optics):
    voltages = find_voltages(metal, optics)
    amplitude = np.abs(metal.h.amplitude)
    segment = np.zeros(len(metal), int)

    def find_reflecting_points(reflection):
        """Points that count as a surface if it reflects this much of what metal does."""
        weaker = replace(voltages, voltage=reflection * voltages.voltage)
        return find_reflecting(weaker, reflection * amplitude, segment, gains(optics))

    # Foam reflects about 5 %, and all of its points count; 2 % is less than any medium reflects.
    assert find_reflecting_points(0.05).mean() > 0.9
    assert not find_reflecting_points(0.02).any()


def test_a_thin_wall_gives_no_permittivity(see, gains, optics, request):
    thicknesses_mm = [0.7]
    if request.config.getoption("--long"):
        thicknesses_mm.append(1.6)
    for wall_mm in thicknesses_mm:
        check_a_thin_wall(see, gains, optics, wall_mm)


def check_a_thin_wall(see, gains, optics, wall_mm):
    """A tube with a radius of 70 mm, air inside: its points have a place, but no permittivity and a reason why."""
    air = 1.0
    wall = Stack(((MEDIUM, wall_mm / 1000),), below=air)
    x_m, y_m, front_m = CENTRE_M
    tube = cylinder("tube", wall, (x_m, y_m, front_m + 0.07), radius_m=0.07, length_m=0.3)
    surface = analyse_surface(see([tube], columns=64, rows=44), optics, gains, uncertainty=EXACT)
    assert len(surface.points_m)
    assert [s.permittivity for s in surface.segments] == [None] * len(surface.segments)
    assert all(s.reason for s in surface.segments)
    # Both faces make one echo: points lie millimetres away from the outer one, as their errors say.
    away_m = np.abs(tube.project(surface.points_m)[0])
    assert np.mean(away_m < 1.96 * surface.position_std_m) >= 0.9


def test_it_is_reported_whether_one_medium_explains_a_small_body(metal, gains, optics):
    """A body with a radius below 40 mm gets no permittivity, and this is the reason that is given.

    If no single medium reflects as the body does, that is the reason instead: the body may be a thin wall, whose points
    are displaced.
    """
    learnt = gains(optics)
    voltages = find_voltages(metal, optics)
    expected = predict_voltages(voltages, reflect_points(MEDIUM, voltages, optics.wave_number))
    received = find_gains(learnt, voltages) * expected
    ball = replace(describe_segment(0, find_shape(metal.h, optics)), radius_mm=30.0)
    # A medium; a level that rises by 10 % over the band; a level 20 % too high
    for level, rise, reason in ((1.0, 0.0, "below 40 mm"), (1.0, 0.1, NO_SINGLE_MEDIUM), (1.2, 0.0, NO_SINGLE_MEDIUM)):
        band_rise = np.tile(learnt.band_rise + rise, (len(metal), 1))
        changed = replace(voltages, voltage=level * received, band_rise=band_rise)
        judged, fit = judge_segment(ball, changed, learnt, [], optics.wave_number)
        assert reason in judged.reason
        assert fit is None
    # Outside of the directions that the reference covers, the level of the gains is uncertain: an echo that is 10 % too
    # strong may be an error of the gains.
    for_other_directions = replace(learnt, covered=tuple(border + 0.5 for border in learnt.covered))
    brighter = replace(voltages, voltage=1.1 * received, band_rise=np.tile(learnt.band_rise, (len(metal), 1)))
    reasons = [
        judge_segment(ball, brighter, known_gains, [], optics.wave_number)[0].reason
        for known_gains in (learnt, for_other_directions)
    ]
    assert reasons[0] == NO_SINGLE_MEDIUM
    assert "below 40 mm" in reasons[1]


def receive_wall(voltages, wave_numbers, medium, wall_m):
    """Voltages [n, 2] of a wall in ray optics, and their rise over the band.

    The echo of both faces is taken at the path where the matched filter over the band is largest.
    """
    sine = np.sin(voltages.theta)[..., None]
    cos = np.cos(voltages.theta)[..., None]
    inner = np.sqrt(medium - sine**2)
    through = np.exp(-2j * wave_numbers * wall_m * inner)
    faces = np.stack([(cos - inner) / (cos + inner), (medium * cos - inner) / (medium * cos + inner)])
    # All echoes between the two faces added up (Airy)
    r_s, r_p = faces * (1 - through) / (1 - faces**2 * through)
    # In these formulas metal has r_p = +1, in the signs of `polysight` -1.
    echoes = voltages.response[..., :1] * r_s - voltages.response[..., 1:2] * r_p
    paths_m = np.linspace(-0.02, 0.06, 161)
    matched = np.exp(1j * np.outer(paths_m, wave_numbers - wave_numbers.mean()))
    level_of_paths = np.abs(echoes[:, 0] @ matched.T).mean(axis=0)
    echoes = echoes * matched[level_of_paths.argmax()]
    half = len(wave_numbers) // 2
    upper = np.abs(echoes[..., half:].mean(axis=2))
    lower = np.abs(echoes[..., :half].mean(axis=2))
    return echoes.mean(axis=2), np.log(upper / lower)


def test_a_random_wall_has_no_permittivity_or_that_of_its_medium(metal, gains, optics):
    """Walls with a weak echo of the back face are nearly a half space, and may get a permittivity if it is right.

    With limits of 10 % for the level and 2 % for the rise, some walls would get one that is wrong by 7 to 15 %.
    """
    learnt = gains(optics)
    # Every fourth point, for speed
    voltages = find_voltages(metal[np.arange(0, len(metal), 4)], optics)
    flat = 0 * voltages.curvature_inside
    voltages = replace(voltages, curvature_inside=flat, curvature_across=flat, twist=flat)
    gain = find_gains(learnt, voltages)
    plane = replace(describe_segment(0, find_shape(metal.h, optics)), radius_mm=None)
    rng = np.random.default_rng(7)

    def find_error(medium, wall_m):
        """Relative error of a wall's permittivity; None if it has none."""
        received, rise = receive_wall(voltages, WAVE_NUMBERS, medium, wall_m)
        noise = 0.01 * (rng.standard_normal(received.shape) + 1j * rng.standard_normal(received.shape))
        changed = replace(voltages, voltage=gain * received * (1 + noise), band_rise=rise + learnt.band_rise)
        judged, fit = judge_segment(plane, changed, learnt, [], optics.wave_number)
        if fit is None:
            return None
        assert not judged.reason
        return abs(fit.eps - medium) / abs(medium)

    media = [complex(rng.uniform(2, 9), -rng.uniform(0.5, 1)) for _ in range(80)]
    errors = [find_error(medium, rng.uniform(1.5e-3, 3e-3)) for medium in media]
    # The largest error is 1.2 %.
    errors_of_accepted = [error for error in errors if error is not None]
    assert max(errors_of_accepted, default=0.0) < 0.03
    # A wall of 0.1 m of these lossy media is a half space. The noise leaves errors of up to 1 %.
    for medium in media[:20]:
        error = find_error(medium, 0.1)
        assert error is not None
        assert error < 0.02


def test_points_behind_a_body_may_be_echoes_from_inside(metal, gains, optics):
    def add_echo(path_m, shift_m=0.0):
        """The points of the metal sphere as segment 0, and an echo of each as segment 1.

        The echo's path is `path_m` longer, and it is received `shift_m` farther away in x.
        """
        later = replace(metal.h, path_m=metal.h.path_m + path_m, at_m=metal.h.at_m + np.array([shift_m, 0.0, 0.0]))
        echoes = [{f.name: getattr(h, f.name) for f in fields(h)} for h in (metal.h, later)]
        h = replace(metal.h, **{name: np.concatenate([part[name] for part in echoes]) for name in echoes[0]})
        segment = np.repeat([0, 1], len(metal))
        return SeenEchoes(h, h, segment), find_shape(h, optics)

    # At 53 degrees of incidence a point at the depth d has a path that is longer by 2 d cos(53 degrees) = 1.2 d.
    depth_m = 0.2 / (2 * np.cos(np.radians(53)))
    echoes, shape = add_echo(0.2)
    assert find_depth_behind(echoes, shape, 1) == pytest.approx(depth_m, rel=0.05)
    # There is no surface before the front.
    assert find_depth_behind(echoes, shape, 0) is None
    # A path that is 20 mm longer is not resolved from the first one.
    assert find_depth_behind(*add_echo(0.02), 1) is None
    # An echo that is received half a metre to the side is not behind the body.
    assert find_depth_behind(*add_echo(0.2, shift_m=0.5), 1) is None

    # Such an echo looks like that of a small ball, but its shape must not count as reliable.
    front, echo = (describe_segment(number, shape[echoes.segment == number]) for number in (0, 1))
    echo = replace(echo, radius_mm=18.0, reason="radius 18 mm: below 40 mm only the shape is reliable")
    judged, unknown_m = doubt_places([front, echo], echoes, shape, find_voltages(echoes, optics, shape), gains(optics))
    assert [segment.reason for segment in judged] == ["", BEHIND_ANOTHER_REASON]
    # An error as large as the radius itself
    assert judged[1].radius_std_mm >= echo.radius_mm
    assert not unknown_m[: len(metal)].any()
    # The standard deviation of an error that is uniform within the depth to either side
    assert unknown_m[-1] == pytest.approx(depth_m / np.sqrt(3), rel=0.05)


def test_points_near_the_border_of_a_segment_are_reported_but_not_at_the_end_of_the_scan():
    """A segment that fills the scan in y, and ends within it in x.

    A window is 34 mm wide: points whose window reaches over the border, within about 17 mm, may be wrong. The points
    are 8 mm apart; those at 16 and 24 mm, near that limit, may be either.
    """
    x, y = np.meshgrid(np.arange(0.1, 0.3, 0.008), np.arange(0.0, 0.2, 0.008))
    at_m = np.stack([x.ravel(), y.ravel()], axis=1)
    extent_m = np.array([0.0, 0.0]), np.array([0.5, float(y.max())])
    interior = find_interior(at_m, np.zeros(len(at_m), int), extent_m)
    from_border_m = np.minimum(at_m[:, 0] - x.min(), x.max() - at_m[:, 0])
    assert not interior[from_border_m < 0.014].any()
    assert interior[from_border_m > 0.026].all()


@pytest.fixture
def rippled_plane(metal, gains, optics):
    """Voltages of a plane that ends 10 mm beyond its points, weights of the points, and the ripple by its edges [n].

    Each edge adds a wave that is weaker, and changes faster, with the distance from it, as of a half plane.
    """
    learnt = gains(optics)
    voltages = find_voltages(metal, optics)
    flat = 0 * voltages.curvature_inside
    voltages = replace(voltages, curvature_inside=flat, curvature_across=flat, twist=flat)
    expected = predict_voltages(voltages, reflect_points(MEDIUM, voltages, optics.wave_number))
    received = find_gains(learnt, voltages) * expected
    low = voltages.at_m.min(axis=0)
    high = voltages.at_m.max(axis=0)
    from_edges_m = np.concatenate([voltages.at_m - low, high - voltages.at_m], axis=1) + 0.01
    # At 10 mm from an edge its wave has 0.3 of the amplitude of the plane's echo, farther away less. Its path is longer
    # by x^2 / 0.9 m.
    ripple = 0.003 / from_edges_m * np.exp(-1j * optics.wave_number * from_edges_m**2 / 0.9)
    share = find_shares(voltages.at_m, np.zeros(len(metal), int), (low - 0.1, high + 0.1))
    band_rise = np.tile(learnt.band_rise, (len(metal), 1))
    return replace(voltages, voltage=received, band_rise=band_rise), share, ripple.sum(axis=1)


# Six phases of the ripple relative to the plane's echo
TURNS = np.exp(2j * np.pi * np.arange(6) / 6)


def test_ripples_of_edges_average_where_points_near_them_count_less(rippled_plane, gains, optics):
    voltages, share, ripple = rippled_plane
    errors = []
    for turn in TURNS:
        # The ripple changes V only.
        factors = np.stack([np.ones(len(ripple)), 1 + turn * ripple], axis=1)
        rippled = replace(voltages, voltage=voltages.voltage * factors)
        fits = [fit_permittivity(rippled, gains(optics), optics.wave_number, weight) for weight in (1.0, share)]
        errors.append([abs(fit.eps - MEDIUM) for fit in fits])
    error_of_equal_weights, error_of_reduced_weights = np.sqrt(np.mean(np.square(errors), axis=0))
    assert error_of_reduced_weights < 0.6 * error_of_equal_weights


def test_ripples_of_edges_do_not_make_a_plate_a_wall(rippled_plane, metal, gains, optics):
    voltages, share, ripple = rippled_plane
    plane = replace(describe_segment(0, find_shape(metal.h, optics)), radius_mm=None)
    reasons_with_equal_weights = []
    reasons_with_reduced_weights = []
    for turn in TURNS:
        rippled = replace(voltages, voltage=voltages.voltage * (1 + 1.5 * turn * ripple)[:, None])
        for weight, reasons in ((1.0, reasons_with_equal_weights), (share, reasons_with_reduced_weights)):
            judged, _ = judge_segment(plane, rippled, gains(optics), [], optics.wave_number, share=weight)
            reasons.append(judged.reason)
    assert any(reasons_with_equal_weights)
    assert not any(reasons_with_reduced_weights)


@pytest.mark.parametrize(("least", "most"), [(0.1, 0.25), (0.25, 0.4), (0.4, 0.55), (0.55, 0.9)])
def test_points_of_a_wall_have_the_error_of_their_position(least, most):
    """300 random walls whose level (reflection relative to metal) is between `least` and `most`.

    The echoes of both faces add up, at 53 degrees of incidence; the path is that where the matched filter over the band
    is largest. Among them are thick walls, whose faces one window just does not resolve.
    """
    rng = np.random.default_rng(1)
    cos = np.cos(np.radians(53))
    paths_m = np.linspace(-0.1, 0.1, 1601)
    matched = np.exp(1j * np.outer(paths_m, WAVE_NUMBERS - WAVE_NUMBERS.mean()))
    inside = []
    while len(inside) < 300:
        eps = rng.uniform(2, 9) - 1j * 10 ** rng.uniform(-3, 0)
        # eps - sin^2 of the incidence angle
        inner = np.sqrt(eps - 1 + cos**2)
        r_s = (cos - inner) / (cos + inner)
        # 0.5 to 25 mm
        wall_m = 10 ** rng.uniform(-3.3, -1.6)
        through = np.exp(-2j * WAVE_NUMBERS * wall_m * inner)
        echo = r_s * (1 - through) / (1 - r_s**2 * through)
        level_of_paths = np.abs(matched @ echo) / len(WAVE_NUMBERS)
        level = level_of_paths.max()
        if least < level < most:
            at_its_path = echo * matched[level_of_paths.argmax()]
            rise = np.log(np.abs(at_its_path[12:].mean()) / np.abs(at_its_path[:12].mean()))
            away_m = paths_m[level_of_paths.argmax()] / (2 * cos)
            # 95 % of a normal distribution
            inside.append(abs(away_m) < 1.96 * estimate_wall_std(level, rise))
    assert np.mean(inside) > 0.9
    # The stated error must not be far too large, either: then all points would be inside. For weak echoes it is: the
    # more both faces cancel, the rarer are thick walls, but their large errors count for all.
    if least >= 0.4:
        assert np.mean(inside) < 0.99


@pytest.mark.parametrize(
    ("reason", "name", "radius_mm", "depth_m", "judged_as"),
    [
        (NO_SINGLE_MEDIUM, "", 80.0, None, "wall"),
        (NO_SINGLE_MEDIUM, "metal", 80.0, None, "surface"),
        (NO_SINGLE_MEDIUM, "", 80.0, 0.03, "behind"),
        # A radius below 40 mm, 30 mm behind another surface
        ("", "", 39.9, 0.03, "behind"),
        ("", "", 40.1, 0.03, "surface"),
        ("", "", 39.9, None, "surface"),
        ("z: a reason of another kind", "", 39.9, None, "surface"),
    ],
)
def test_a_place_is_doubted_for_a_wall_and_for_an_echo_behind_another_surface(
    monkeypatch, reason, name, radius_mm, depth_m, judged_as
):
    """A small radius alone is no reason to doubt a place: only with another surface in front of it."""

    # Stands for `SeenEchoes`: two points of segment 1 and one of segment 2.
    class ThreePoints(list):
        segment = np.array([1, 1, 2])

    monkeypatch.setattr(result, "find_reflection", lambda *_: np.full(3, 0.3))
    monkeypatch.setattr(result, "find_depth_behind", lambda *_: depth_m)
    segment = Segment(
        number=1,
        points=2,
        centre_m=CENTRE_M,
        normal=(0.0, 0.0, -1.0),
        radius_mm=radius_mm,
        radius_std_mm=1.0,
        incidence_deg=50.0,
        reason=reason,
        name=name,
    )
    voltages = SimpleNamespace(band_rise=np.full((3, 2), 0.1))
    gains = SimpleNamespace(band_rise=np.zeros(2))
    no_shape = None
    (judged,), unknown_m = doubt_places([segment], ThreePoints([0, 0, 0]), no_shape, voltages, gains)
    if judged_as == "wall":
        # Of the reflection of 0.3 and the rise of 0.1 above
        expected_m = estimate_wall_std(0.3, 0.1)
    elif judged_as == "behind":
        # Uniform within the depth of 30 mm to either side
        expected_m = 0.03 / np.sqrt(3)
    else:
        expected_m = 0.0
    np.testing.assert_allclose(unknown_m, [expected_m, expected_m, 0])
    assert judged.reason == (BEHIND_ANOTHER_REASON if judged_as == "behind" else reason)
    assert (judged.radius_std_mm > 1) is (judged_as != "surface")


def test_a_radius_is_reported_where_curvatures_and_normals_disagree(metal, optics):
    """The radius is known from the curvature of each point, and from how the normals turn from point to point.

    At a wall with two faces the two disagree: without a comparison, one of 42 mm would get 75 mm and a small error.
    """
    shape = find_shape(metal.h, optics)
    sphere = describe_segment(0, shape)
    # The sphere of metal has a radius of 125 mm.
    assert sphere.radius_mm == pytest.approx(125, rel=0.02)
    assert sphere.radius_std_mm < 0.05 * sphere.radius_mm
    flatter = describe_segment(0, replace(shape, curvature=shape.curvature / 1.5))
    # The true curvature is within two standard deviations; that of 1 / radius is std / radius^2.
    curvature_std = flatter.radius_std_mm / flatter.radius_mm**2
    assert abs(1 / flatter.radius_mm - 1 / 125) < 1.96 * curvature_std
    flat = describe_segment(0, replace(shape, curvature=0 * shape.curvature))
    assert flat.radius_mm is None
    assert flat.radius_std_mm is None


def see_sphere(optics, radius_m: float = 0.125) -> SeenEchoes:
    """Return noiseless echoes, of amplitude 1, of a sphere with the normals that a whole scan shows.

    They are tilted by up to 14 degrees along x and 17 degrees along y.
    """
    x, y = np.meshgrid(np.linspace(-0.25, 0.25, 24), np.linspace(-0.3, 0.3, 24))
    normals = np.stack([x.ravel(), y.ravel(), -np.sqrt(1 - x.ravel() ** 2 - y.ravel() ** 2)], axis=1)
    centre = np.array(CENTRE_M) + radius_m * np.eye(3)[2]
    points = centre + radius_m * normals
    curvature = np.tile(np.eye(2) / radius_m, (len(points), 1, 1))
    zero = np.zeros(len(points))
    channels = []
    for receiver in (optics.h, optics.v):
        at_m = find_offset_that_sees(points, normals, np.zeros((len(points), 3)), optics.tx.at_m, receiver.at_m)
        path_m, slope, bend = predict_echo(points, normals, curvature, at_m, optics.tx.at_m, receiver.at_m)
        amplitude = np.exp(-1j * optics.wave_number * path_m)
        echoes = Echoes(
            at_m=at_m,
            path_m=path_m,
            slope=slope,
            bend=bend,
            amplitude=amplitude,
            amplitude_std=zero + 1e-3,
            path_std_m=zero,
            slope_std=np.zeros((len(points), 2)),
            share=zero,
            band_rise=zero,
        )
        channels.append(echoes)
    return SeenEchoes(channels[0], channels[1], np.zeros(len(points), int))


@pytest.mark.parametrize("medium", [2.1 - 0.002j, 4.2 - 0.4j, 8.0 - 1.0j])
def test_a_sphere_that_is_not_of_metal_is_not_a_reference(medium, optics):
    voltages = find_voltages(see_sphere(optics), optics)

    def learn(eps):
        received = predict_voltages(voltages, reflect_points(eps, voltages, optics.wave_number))
        return learn_gains(replace(voltages, voltage=received), optics.wave_number)

    check_is_metal(Path("scan"), learn(np.inf))
    with pytest.raises(DataError, match="not of metal"):
        check_is_metal(Path("scan"), learn(medium))


def test_a_permittivity_at_the_end_of_the_range_of_the_fit_is_not_reported():
    """The fit ends at a real part of 39 to 40."""
    segment = Segment(
        number=0, points=100, centre_m=CENTRE_M, normal=(0.0, 0.0, -1.0), radius_mm=None, incidence_deg=55.0
    )
    sources = {"scatter": np.eye(2)}
    assert add_permittivity(segment, 38.0 - 9j, sources).permittivity == 38.0 - 9j
    assert add_permittivity(segment, 40.0 - 9j, sources).reason == NO_SINGLE_MEDIUM


@pytest.mark.parametrize(("missing_columns", "pieces"), [(1, 1), (3, 2), (9, 2)])
def test_a_gap_of_one_window_does_not_divide_a_surface_and_a_wider_one_does(metal, optics, missing_columns, pieces):
    x_m = metal.h.at_m[:, 0]
    middle_column_m = x_m[np.argmin(np.abs(x_m - np.median(x_m)))]
    is_kept = np.abs(x_m - middle_column_m) > (missing_columns / 2) * STRIDE_M
    groups = group_echoes(metal.h[is_kept], optics)
    assert set(groups) == set(range(pieces))
    is_right = x_m[is_kept] > middle_column_m
    are_divided = set(groups[is_right]).isdisjoint(groups[~is_right])
    assert are_divided is (pieces == 2)
