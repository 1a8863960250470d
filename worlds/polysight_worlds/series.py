"""Exact echoes of a sphere and of an endless cylinder between two small antennas, by multipole series.

The antennas are dipoles whose field towards the specular point is that of the antenna. Inside this module fields vary
as exp(-i omega t), as in the books: outgoing waves are Hankel functions of the first kind. `scatter_sphere` and
`scatter_cylinder` return the wave of the other sign, exp(+j omega t), as the rest of the package. All arguments and
fields `permittivity` are its eps' - j eps'' (None: metal), conjugated where they are used. Echoes are in 1 / m: for a
field of 1 at 1 m from TX.

A body that absorbs shows its front only: its inner wave runs inwards and never comes back (the first term of Debye's
series). With `with_inside`, waves that crossed the body are included.

M and N are the transverse electric and transverse magnetic vector waves of these books, k is the wave number in air
(rad / m), h its part along a cylinder's axis and eta = sqrt(k^2 - h^2) the part across it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy import special

from polysight_worlds.media import LIGHT_M_PER_S
from polysight_worlds.optics import Antenna

# Nepers to the middle of a body. A wave that crossed it is weaker by exp(-2 ABSORBED), 2e-9: then the standing wave
# (J, j) and the one that only runs inwards (H2, h2) have the same rates, and only the first one's recurrence is stable.
ABSORBED = 10.0
# Azimuthal orders whose terms are computed together; chosen, it trades memory for fewer calls.
ORDERS_AT_ONCE = 32
# Terms beyond x + 4.05 x^(1/3) of the size parameter x. Wiscombe's criterion for double precision (1980) has 2; ten
# more are chosen.
MORE_TERMS = 12
# Orders above the highest at which recurrences downwards begin with a wrong value, which dies out on the way; chosen.
ORDERS_ABOVE = 30
# Samples of the integrand over the axial wave number, in units of sqrt(1 / second derivative of the phase), and the
# weight of each, by which the moments 1, t^2, t^4 and t^6 of exp(-i t^2 / 2) are right: 1, -i, -3 and 15i. The first
# order in 1 / (k path) needs them all: with t^2 alone H / V of a level cylinder was 1 % off.
PLACES = np.arange(-3.0, 4.0)
PLACE_WEIGHTS = np.linalg.solve(np.vander(PLACES, increasing=True).T, [1, 0, -1j, 0, -3, 0, 15j])
# A cylinder's coefficients are looked up by Chebyshev series in the path. Such a series of exp(i z x) converges from
# the degree z on, with z the radians by which the coefficients' phase turns over half of the paths: so its degree is z
# and these more. With the degree 23 alone, a cylinder of 173 mm along x had errors of 15 % and 0.2 rad.
MORE_DEGREES = 24
# Up to this many stage offsets, coefficients are computed for each one instead of looked up in a table, which itself
# takes as many evaluations as its degree; chosen.
FEW_OFFSETS = 40


@dataclass(frozen=True)
class Pair:
    """TX and RX relative to the body, for n stage offsets: positions and dipoles, each [3, n].

    The dipoles (`sent` of TX, `received` of RX) are complex and conjugated, for exp(-i omega t).
    """

    tx_m: NDArray
    rx_m: NDArray
    sent: NDArray
    received: NDArray

    @staticmethod
    def aim(tx: Antenna, rx: Antenna, offsets_m: NDArray, origin_m: NDArray, points_m: NDArray) -> Pair:
        """Return antennas aimed at `points_m` [3, n] at stage offsets [n, 3], relative to a body at `origin_m` [3]."""
        places = []
        fields = []
        for antenna in (tx, rx):
            place = antenna.position[:, None] + offsets_m.T
            ray = points_m - place
            fields.append(np.conj(antenna.field(ray / np.linalg.norm(ray, axis=0))))
            places.append(place - np.asarray(origin_m)[:, None])
        return Pair(places[0], places[1], fields[0], fields[1])

    def rotate(self, axes: NDArray) -> Pair:
        """Return the pair in local axes (columns of `axes` [3, 3])."""
        return Pair(*(np.einsum("ji,jn->in", axes, part) for part in vars(self).values()))


def _dot(a: NDArray, b: NDArray) -> NDArray:
    return np.einsum("in,in->n", a, b)


def needed_orders(x: float) -> NDArray:
    """Return the orders 0, 1, .. that a body of size parameter x (k radius) needs, by Wiscombe's criterion (1980)."""
    return np.arange(int(np.ceil(x + 4.05 * x ** (1 / 3) + MORE_TERMS)) + 1)


def sphere_coefficients(
    radius_m: float, k: float, permittivity: complex | None, *, with_inside: bool
) -> tuple[NDArray, NDArray]:
    """Mie's coefficients (a_n, b_n), each [orders], for n = 1, 2, .. (Bohren and Huffman, 4.88).

    a_n belongs to N (electric multipoles), b_n to M (magnetic ones).
    """
    x = k * radius_m
    orders = needed_orders(x)
    count = len(orders) - 1
    psi: Any = x * special.spherical_jn(orders, x)
    xi = psi + 1j * x * special.spherical_yn(orders, x)
    n = orders[1:]
    if permittivity is None:
        # Derivatives: psi_n' = psi_{n-1} - n / x psi_n, and so xi_n'.
        psi_rate = psi[:-1] - n / x * psi[1:]
        xi_rate = xi[:-1] - n / x * xi[1:]
        return psi_rate / xi_rate, psi[1:] / xi[1:]
    index = np.sqrt(np.conj(permittivity))
    rates = _inner_rates(index * x, count, with_inside)
    pair = []
    for factor in (1 / index, index):
        admittance = factor * rates + n / x
        pair.append((admittance * psi[1:] - psi[:-1]) / (admittance * xi[1:] - xi[:-1]))
    return pair[0], pair[1]


def _inner_rates(y: complex, count: int, with_inside: bool) -> NDArray:
    """Logarithmic derivatives [count] for n = 1 .. count of y j_n(y), or of the wave that only runs inwards, y h2_n(y).

    `y`: size parameter times the refractive index, with an imaginary part above zero in a body that absorbs.
    The second one is taken without `with_inside`, unless the body absorbs so much that both are the same.
    """
    rates = np.zeros(count + 1, complex)
    if not with_inside and y.imag < ABSORBED:
        # y h2_0(y) is a multiple of exp(-i y).
        rates[0] = -1j
        for n in range(1, count + 1):
            rates[n] = 1 / (n / y - rates[n - 1]) - n / y
        return rates[1:]
    # Downwards, where the recurrence is stable.
    rate = 0j
    for n in range(int(max(count, abs(y))) + ORDERS_ABOVE, 0, -1):
        if n <= count:
            rates[n] = rate
        rate = n / y - 1 / (rate + n / y)
    return rates[1:]


def scatter_sphere(
    pair: Pair, radius_m: float, permittivity: complex | None, frequency_hz: float, *, with_inside: bool = False
) -> NDArray:
    """Echo of a sphere at the origin, complex [n]: dyadic Green's function of the sphere (Tai 1971, section 10-2).

    The sum over azimuthal orders is done by the addition theorem: with c the cosine between the two directions and z
    the radial functions, sum M M' = z z' (r x grad)(r' x grad') P_n(c), and likewise N N'.
    """
    k = 2 * np.pi * frequency_hz / LIGHT_M_PER_S
    electric, magnetic = sphere_coefficients(radius_m, k, permittivity, with_inside=with_inside)
    rx_r = np.linalg.norm(pair.rx_m, axis=0)
    tx_r = np.linalg.norm(pair.tx_m, axis=0)
    to_rx = pair.rx_m / rx_r
    to_tx = pair.tx_m / tx_r
    q = pair.received
    p = pair.sent
    # Cosine of the angle between both directions.
    c = _dot(to_rx, to_tx)
    # Products of the dipoles with the derivatives of c by either direction.
    q_r = _dot(q, to_rx)
    p_r = _dot(p, to_tx)
    q_t = _dot(q, to_tx) - c * q_r
    p_t = _dot(p, to_rx) - c * p_r
    # With the derivative of c by both directions.
    mixed = _dot(q, p) - _dot(p, to_rx) * q_r - p_r * q_t
    # Of M, what goes with the second and the first derivative of P_n.
    across = np.cross(q, to_rx, axis=0)
    m_second = _dot(across, to_tx) * _dot(p, np.cross(to_tx, to_rx, axis=0))
    m_first = _dot(p, np.cross(to_tx, across, axis=0))

    waves = [_RadialWaves(k * distance) for distance in (rx_r, tx_r)]
    legendre = _Legendre(c)
    total = np.zeros(c.shape, complex)
    for n, (a_n, b_n) in enumerate(zip(electric, magnetic, strict=True), start=1):
        (z, rate), (z_tx, rate_tx) = (wave.step(n) for wave in waves)
        value, first, second = legendre.step(n)
        radial = n * (n + 1) * z / (k * rx_r)
        radial_tx = n * (n + 1) * z_tx / (k * tx_r)
        m_part = z * z_tx * (second * m_second + first * m_first)
        n_part = radial * radial_tx * q_r * p_r * value
        n_part += (radial * rate_tx * q_r * p_t + rate * radial_tx * p_r * q_t) * first
        n_part += rate * rate_tx * (second * q_t * p_t + first * mixed)
        total -= (2 * n + 1) / (n * (n + 1)) * (b_n * m_part + a_n * n_part)
    # 4 pi, for a field of 1 at 1 m, times the factor i k / (4 pi) of Green's function.
    return np.conj(1j * k * total)


class _RadialWaves:
    """Outgoing spherical Hankel functions of one argument and (rho h_n)' / rho, order by order upwards."""

    def __init__(self, rho: NDArray) -> None:
        self._rho = rho
        # h_{-1} = exp(i rho) / rho and h_0 = -i exp(i rho) / rho.
        self._last: NDArray = np.exp(1j * rho) / rho
        self._now: NDArray = -1j * self._last

    def step(self, n: int) -> tuple[NDArray, NDArray]:
        """Return h_n and (rho h_n)' / rho. To be called for n = 1, 2, .. in turn."""
        self._last, self._now = self._now, (2 * n - 1) / self._rho * self._now - self._last
        return self._now, self._last - n / self._rho * self._now


class _Legendre:
    """P_n(c), its first and second derivative, order by order upwards."""

    def __init__(self, c: NDArray) -> None:
        self._c = c
        ones = np.ones_like(c)
        zero = np.zeros_like(c)
        self._last = (zero, zero, zero)
        self._now = (ones, zero, zero)

    def step(self, n: int) -> tuple[NDArray, NDArray, NDArray]:
        """Return P_n, its first and second derivative. To be called for n = 1, 2, .. in turn."""
        value = ((2 * n - 1) * self._c * self._now[0] - (n - 1) * self._last[0]) / n
        # P_n' = P_{n-2}' + (2 n - 1) P_{n-1}, and once more.
        first = self._last[1] + (2 * n - 1) * self._now[0]
        second = self._last[2] + (2 * n - 1) * self._now[1]
        self._last = self._now
        self._now = (value, first, second)
        return self._now


@dataclass(frozen=True)
class EndlessCylinder:
    """An endless cylinder about x in local axes; `permittivity` is eps' - j eps'', None: metal."""

    radius_m: float
    permittivity: complex | None
    with_inside: bool

    def coefficients(self, k: float, h: NDArray, orders: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Return the scattered waves for incident ones at axial wave numbers h [n]: three tables, complex [orders, n].

        They are M to M, N to N, and the coupling, which is the same from M to N as from N to M. Tangential E and H are
        continuous at the surface.
        """
        eta = np.sqrt(k**2 - h**2)
        a = self.radius_m
        n = orders[:, None]
        x = eta * a
        j_below, j = _bessel(len(orders), x)
        h1_below, h1 = _hankel(len(orders), x)
        j_rate = eta * (j_below - n / x * j)
        h1_rate = eta * (h1_below - n / x * h1)
        # Orders far above x pass by the body and scatter nothing; their Hankel functions would overflow.
        too_high = n > np.abs(x) + 4.05 * np.abs(x) ** (1 / 3) + MORE_TERMS
        j = np.where(too_high, 0, j)
        j_rate = np.where(too_high, 0, j_rate)
        h1 = np.where(too_high, 1, h1)
        h1_rate = np.where(too_high, 1, h1_rate)
        if self.permittivity is None:
            return -j_rate / h1_rate, -j / h1, np.zeros_like(h1)
        inside = np.conj(self.permittivity)
        eta_1 = np.sqrt(inside * k**2 - h**2 + 0j)
        rate = self._inner_rates(len(orders), eta_1 * a)
        coupling = h * n / (k * a) * (1 - eta**2 / eta_1**2)
        u_j = j_rate - eta**2 / eta_1 * rate * j
        u_h = h1_rate - eta**2 / eta_1 * rate * h1
        v_j = j_rate - inside * eta**2 / eta_1 * rate * j
        v_h = h1_rate - inside * eta**2 / eta_1 * rate * h1
        # With g the coupling, u for M and v for N:
        # [[u_h, g h1], [g h1, v_h]] (M, N) = -[[u_j, g j], [g j, v_j]] (incident M, N)
        determinant = u_h * v_h - (coupling * h1) ** 2
        m_m = -(v_h * u_j - coupling**2 * h1 * j) / determinant
        n_n = -(u_h * v_j - coupling**2 * h1 * j) / determinant
        m_n = -coupling * (v_h * j - h1 * v_j) / determinant
        return m_m, n_n, m_n

    def _inner_rates(self, count: int, y: NDArray) -> NDArray:
        """J_n' / J_n, or H2_n' / H2_n of a wave that only runs inwards, [count, n] for y [n], as for a sphere."""
        rates = np.zeros((count, *y.shape), complex)
        if not self.with_inside and np.imag(y).min() < ABSORBED:
            rates[0] = -special.hankel2(1, y) / special.hankel2(0, y)
            for n in range(1, count):
                rates[n] = 1 / ((n - 1) / y - rates[n - 1]) - n / y
            return rates
        # Downwards, where the recurrence is stable.
        rate = np.zeros_like(y)
        for n in range(int(max(count, np.abs(y).max())) + ORDERS_ABOVE, 0, -1):
            if n < count:
                rates[n] = rate
            rate = (n - 1) / y - 1 / (rate + n / y)
        rates[0] = rate
        return rates


def _bessel(count: int, x: NDArray) -> tuple[NDArray, NDArray]:
    """Return J_{n-1}(x) and J_n(x) for n = 0 .. count - 1, each [count, ...] for x [...], by Miller's recurrence.

    It is stable downwards but leaves a common factor open. That follows from J_0 + 2 (u J_1 + u^2 J_2 + ..) = exp(u x),
    with u = i or -i, whichever makes the sum large.
    """
    most = max(count, float(np.abs(x).max()))
    top = int(most + 4.05 * most ** (1 / 3)) + ORDERS_ABOVE
    values = np.zeros((count, *x.shape), x.dtype)
    above = np.zeros_like(x)
    # Any small value: the common factor is found at the end.
    value = np.full_like(x, 1e-200)
    unit = np.where(np.imag(x) > 0, -1j, 1j)
    turns = (np.ones_like(unit), unit, -np.ones_like(unit), -unit)
    total = np.zeros_like(unit)
    for n in range(top, -1, -1):
        if n < count:
            values[n] = value
        total += (2 if n else 1) * turns[n % 4] * value
        above, value = value, 2 * n / x * value - above
        if n % 8 == 0:
            # Where x is far below the order, values grow without end on the way down: scale them, before they overflow.
            grown = np.abs(above) > 1e100
            if grown.any():
                shrink = np.where(grown, 1e-200, 1.0)
                above = above * shrink
                value = value * shrink
                total = total * shrink
                values[n:] *= shrink
    scale = np.exp(unit * x) / total
    values = values * (scale if np.iscomplexobj(x) else scale.real)
    # J_{-1} = -J_1
    return np.concatenate([-values[1:2], values[:-1]]), values


def _hankel(count: int, x: NDArray) -> tuple[NDArray, NDArray]:
    """H1_{n-1}(x) and H1_n(x) for n = 0 .. count - 1, each [count, ...]: upwards, where the recurrence is stable."""
    values = np.empty((count + 1, *x.shape), complex)
    values[1] = special.hankel1(0, x)
    values[0] = -special.hankel1(1, x)
    for n in range(count - 1):
        # Orders far above the argument grow without end: they are limited to 1e150, and not used.
        grown = np.abs(values[n + 1]) > 1e150
        values[n + 2] = np.where(grown, 1e150, 2 * n / x * np.where(grown, 0, values[n + 1]) - values[n])
    return values[:-1], values[1:]


@lru_cache(maxsize=256)
def _tabulate(
    body: EndlessCylinder, k: float, along_m: float, place: float, path_range_m: tuple[float, float]
) -> tuple[NDArray, NDArray, NDArray]:
    """Chebyshev series of `EndlessCylinder.coefficients` over the path in the cross-section, [degree + 1, orders].

    `along_m`: from TX to RX along the axis. `place`: distance from the stationary axial wave number, see
    `_axial_wave_number`. `path_range_m`: shortest and longest path, which are -1 and 1 of the series.
    """
    low, high = path_range_m
    # Axial wave numbers of the shortest and the longest path.
    ends, _ = _axial_wave_number(k, along_m, np.array(path_range_m), place)
    # Coefficients turn as exp(2i radius sqrt(k^2 - h^2)).
    radians = body.radius_m * abs(np.diff(np.sqrt(k**2 - ends**2))[0])
    degree = MORE_DEGREES + int(np.ceil(radians))
    nodes = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    path_m = (low + high) / 2 + (high - low) / 2 * nodes
    h, _ = _axial_wave_number(k, along_m, path_m, place)
    to_series = np.linalg.inv(chebyshev.chebvander(nodes, degree))
    first, second, third = (to_series @ table.T for table in body.coefficients(k, h, needed_orders(k * body.radius_m)))
    return first, second, third


def _axial_wave_number(k: float, along_m: NDArray | float, path_m: NDArray, place: float) -> tuple[NDArray, NDArray]:
    """Return the axial wave number that lies `place` units from the stationary one, and that unit, rad / m."""
    distance_m = np.hypot(along_m, path_m)
    unit = np.sqrt(k * path_m**2 / distance_m**3)
    return k * along_m / distance_m + unit * place, unit


def scatter_cylinder(
    pair: Pair,
    radius_m: float,
    permittivity: complex | None,
    frequency_hz: float,
    path_m: NDArray,
    *,
    with_inside: bool = False,
) -> NDArray:
    """Return the echo of an endless cylinder about local x, complex [n].

    `path_m`: specular path in the cross-section, [n]. Dyadic Green's function of the cylinder (Tai 1971, section 9-2):
    an integral over axial wave numbers h. Its integrand has the phase h along_m + sqrt(k^2 - h^2) path_m, stationary at
    the ray's own h (`along_m`: from TX to RX along the axis). The rest of the integrand is taken at real places as a
    polynomial of sixth degree, so the error is of second order in 1 / (k path). (On the path of steepest descent, waves
    that creep around the body would grow.)
    """
    k = 2 * np.pi * frequency_hz / LIGHT_M_PER_S
    # To the nanometre: a table needs one value at all stage offsets, which cancel here but for rounding.
    along_m = np.round(pair.rx_m[0] - pair.tx_m[0], 9)
    distance_m = np.hypot(along_m, path_m)
    # Ends at whole centimetres, so that several calls share a table.
    low = float(np.floor(100 * path_m.min()) / 100)
    high = float(np.floor(100 * path_m.max()) / 100) + 0.01
    body = EndlessCylinder(radius_m, permittivity, with_inside)
    total = np.zeros(path_m.shape, complex)
    path_places = (2 * path_m - low - high) / (high - low)
    for place, weight in zip(PLACES.tolist(), PLACE_WEIGHTS.tolist(), strict=True):
        h, unit = _axial_wave_number(k, along_m, path_m, place)
        if len(h) <= FEW_OFFSETS or np.ptp(along_m) > 0:
            m_m, n_n, m_n = (table.T for table in body.coefficients(k, h, needed_orders(k * radius_m)))
        else:
            tables = _tabulate(body, k, float(along_m[0]), place, (low, high))
            basis = chebyshev.chebvander(path_places, len(tables[0]) - 1)
            m_m, n_n, m_n = (basis @ table for table in tables)
        without_phase = sum_orders(pair, (m_m, n_n, m_n), k, h, path_m)
        phase = h * along_m + np.sqrt(k**2 - h**2) * path_m - k * distance_m
        total += weight * unit * without_phase * np.exp(1j * (phase + place**2 / 2))
    # The integral of exp(-i t^2 / 2) is sqrt(-2 pi i).
    total *= np.sqrt(2 * np.pi) * np.exp(-0.25j * np.pi)
    # 4 pi, for a field of 1 at 1 m, times the factor i / (8 pi) of Green's function.
    return np.conj(0.5j * total * np.exp(1j * k * distance_m))


def sum_orders(
    pair: Pair, coefficients: tuple[NDArray, NDArray, NDArray], k: float, h: NDArray, path_m: NDArray
) -> NDArray:
    """Sum the integrand of `scatter_cylinder` at axial wave numbers h [n] over all azimuthal orders, complex [n].

    `coefficients`: those of `EndlessCylinder.coefficients`, transposed to [n, orders]. The sum is divided by the phase
    of the specular path, exp(i h x + i sqrt(k^2 - h^2) path_m), with x the way from TX to RX along the axis.
    """
    eta = np.sqrt(k**2 - h**2)
    m_m = coefficients[0]
    ends = (
        _AzimuthalWaves(pair.rx_m, pair.received, 1, eta, h, k),
        _AzimuthalWaves(pair.tx_m, pair.sent, -1, eta, h, k),
    )
    turn = np.exp(1j * (ends[0].angle - ends[1].angle))
    # Both ends' waves come times exp(-i eta rho): turn them back, less the specular path.
    scale = np.exp(1j * eta * (ends[0].rho + ends[1].rho - path_m)) / eta**2
    total = np.zeros(h.shape, complex)
    power = np.ones_like(turn)
    for first in range(0, m_m.shape[1], ORDERS_AT_ONCE):
        orders = np.arange(first, min(first + ORDERS_AT_ONCE, m_m.shape[1]))
        (q_m, q_m_back), (q_n, q_n_back) = ends[0].products(orders)
        (p_m, p_m_back), (p_n, p_n_back) = ends[1].products(orders)
        m, n, coupling = (table[:, orders].T for table in coefficients)
        # Coefficients that couple M and N change sign with the order, the others do not; `_back`: negative orders.
        wave = q_m * (m * p_m + coupling * p_n) + q_n * (n * p_n + coupling * p_m)
        wave_back = q_m_back * (m * p_m_back - coupling * p_n_back) + q_n_back * (n * p_n_back - coupling * p_m_back)
        wave_back[orders == 0] = 0
        # Powers of `turn`, exp(i n phi) with phi the angle from TX to RX, continue from the last block of orders.
        factors = np.repeat(turn[None], len(orders), axis=0)
        factors[0] = power
        powers = np.cumprod(factors, axis=0)
        total += np.sum(wave * powers + wave_back * powers.conj(), axis=0)
        power = powers[-1] * turn
    return total * scale


class _AzimuthalWaves:
    """Outgoing waves at one antenna, order by order upwards, and products of its dipole with M and N.

    M = curl (e_x H_n(eta rho) exp(i n phi + i h x)), with e_x along the axis, and N = curl M / k. For the transmitter n
    and h change their signs in the exponentials, and so do terms with one factor of either: `sign` is 1 for RX, -1 for
    TX. `place` and `dipole`: [3, n] in local axes.
    """

    def __init__(self, place: NDArray, dipole: NDArray, sign: int, eta: NDArray, h: NDArray, k: float) -> None:
        # Cross-section: local y and z.
        self.rho = np.hypot(place[1], place[2])
        self.angle = np.arctan2(place[2], place[1])
        cosine = place[1] / self.rho
        sine = place[2] / self.rho
        self._radial = dipole[1] * cosine + dipole[2] * sine
        self._azimuthal = dipole[2] * cosine - dipole[1] * sine
        self._axial = dipole[0]
        self._eta = eta
        self._h = h
        self._k = k
        self._argument = eta * self.rho
        self._now = special.hankel1e(0, self._argument)
        self._last = -special.hankel1e(1, self._argument)
        self._sign = sign

    def step(self, n: int) -> tuple[NDArray, NDArray]:
        """Return H_n and its derivative by the argument, times exp(-i argument); call with n = 0, 1, 2 .. in turn."""
        if n > 0:
            following = 2 * (n - 1) / self._argument * self._now - self._last
            self._last = self._now
            self._now = following
        return self._now, self._last - n / self._argument * self._now

    def products(self, orders: NDArray) -> tuple[tuple[NDArray, NDArray], tuple[NDArray, NDArray]]:
        """Return ((M, M of -orders), (N, N of -orders)) times the dipole, without exp(i n phi), each [orders, n].

        To be called with orders 0, 1, .. in turn.
        """
        steps = [self.step(n) for n in orders.tolist()]
        z = np.array([value for value, _ in steps])
        slope = np.array([rate for _, rate in steps]) * self._eta
        around = orders[:, None] * z / self.rho
        m_odd = around * (1j * self._sign * self._radial)
        m_even = slope * self._azimuthal
        n_odd = around * (self._h / self._k * self._azimuthal)
        n_even = slope * (1j * self._sign * self._h / self._k * self._radial) + z * (
            self._eta**2 / self._k * self._axial
        )
        return (m_odd - m_even, -m_odd - m_even), (n_even - n_odd, n_even + n_odd)
