"""Write a scan's phase history as CPHD 1.1, the input format of SAR processors (NGA.STND.0068, by sarkit).

The scene is placed at latitude and longitude 0, because the rig has no position on the Earth. The object plane is the
ground, the rig is above it; x of the rig points east and y south, so that both frames are right-handed. The data are
bistatic: one channel for each receiving antenna, one vector for each stage position. Signals are in the domain FX with
SGN = +1: an echo later than that of the reference point by t has the factor exp(+j 2 pi f t).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.products import temporary_path
from polysight.store import versions
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError
from polysight_shared.units import SPEED_OF_LIGHT_M_S

Floats = NDArray[np.float64]
EARTH_RADIUS_M = 6_378_137.0
"""Equatorial radius of WGS 84."""
NAMESPACE = "http://api.nsgreg.nga.mil/schema/cphd/1.1.0"
_NO_START = "1970-01-01T00:00:00Z"
"""Replaces an unknown start, which the standard requires; a parameter of the file says so."""
_EACH = (
    ("TxTime", 1), ("TxPos", 3), ("TxVel", 3), ("RcvTime", 1), ("RcvPos", 3), ("RcvVel", 3), ("SRPPos", 3),
    ("aFDOP", 1), ("aFRR1", 1), ("aFRR2", 1), ("FX1", 1), ("FX2", 1), ("TOA1", 1), ("TOA2", 1), ("TDTropoSRP", 1),
    ("SC0", 1), ("SCSS", 1), ("SIGNAL", 1),
)  # fmt: skip
"""Parameters of a vector and their sizes in words of 8 bytes."""


@dataclass(frozen=True)
class Channel:
    """One receiving antenna: samples complex64 [vector, frequency], position [vector, 3] in m, valid bool [vector].

    The phase of samples is +2 pi f (path - `direct_m`) / c, with the direct path in metres; polarisation "H" or "V".
    """

    name: str
    polarisation: str
    samples: NDArray[np.complex64]
    rx_m: Floats
    direct_m: float
    valid: NDArray[np.bool_]


@dataclass(frozen=True)
class PhaseHistory:
    """A scan's phase history in the rig frame; vectors in the order of time.

    Attributes
    ----------
    started_utc
        Start of the scan, ISO 8601; empty if not known.
    channels
        All receiving antennas.
    time_s, tx_m, velocity_m_s
        float64 [vector], [vector, 3], [vector, 3]: nominal time, position and velocity of the transmitting antenna.
    frequencies_hz
        float64 [frequency], evenly spaced.
    gate_m
        Smallest and largest excess path of the range gate.
    centre_m
        Centre of the image, on the object plane [3].
    shape, pixel_m
        Pixels of the image (ny, nx), and their pitch.
    """

    scan_id: str
    simulated: bool
    started_utc: str
    channels: Sequence[Channel]
    time_s: Floats
    tx_m: Floats
    velocity_m_s: Floats
    frequencies_hz: Floats
    gate_m: tuple[float, float]
    centre_m: Floats
    shape: tuple[int, int]
    pixel_m: float


def to_earth(places_m: Floats, z_m: float, vector: bool = False) -> Floats:
    """Convert positions [..., 3] of the rig frame to Earth-centred; object plane at `z_m`. Only rotate a `vector`."""
    x, y, z = np.moveaxis(np.asarray(places_m, np.float64), -1, 0)
    up = -z if vector else EARTH_RADIUS_M + z_m - z
    return np.stack([up, x, -y], axis=-1)


def write_cphd(path: Path, history: PhaseHistory) -> None:
    """Write the CPHD file. Raises ConfigError if sarkit is not installed, OSError if the file cannot be written."""
    try:
        cphd: Any = import_module("sarkit.cphd")
        etree: Any = import_module("lxml.etree")
    except ImportError:
        raise ConfigError(
            "CPHD needs the package sarkit, which is not installed",
            "only this export uses it, so it is an extra",
            "pip install 'polysight[export]', or pip install sarkit",
            code=ErrorCode.PACKAGE_MISSING,
        ) from None
    vectors = {channel.name: _vectors(history, channel) for channel in history.channels}
    root = etree.Element(f"{{{NAMESPACE}}}CPHD", nsmap={None: NAMESPACE})
    _fill(etree, root, _tables(history, vectors))
    tree = root.getroottree()
    form = cphd.get_pvp_dtype(tree)
    arrays = {}
    for name, columns in vectors.items():
        arrays[name] = np.zeros(history.time_s.size, form)
        for key, values in columns.items():
            arrays[name][key] = values
    first = history.channels[0].name
    where = next(k for k, child in enumerate(root) if child.tag.endswith("}Dwell")) + 1
    root.insert(where, cphd.compute_reference_geometry(tree, arrays[first]))
    part = temporary_path(path)
    with part.open("wb") as file, cphd.Writer(file, cphd.Metadata(xmltree=tree)) as writer:
        for channel in history.channels:
            writer.write_signal(channel.name, _signal(history, channel))
            writer.write_pvp(channel.name, arrays[channel.name])
    part.replace(path)


def _reference_path_m(history: PhaseHistory, channel: Channel) -> Floats:
    """Return the path from TX over the scene's centre to the receiving antenna, [vector]."""
    out = np.linalg.norm(history.tx_m - history.centre_m, axis=1)
    return out + np.linalg.norm(channel.rx_m - history.centre_m, axis=1)


def _signal(history: PhaseHistory, channel: Channel) -> NDArray[np.complex64]:
    """Return the samples with the scene's centre as reference of the phase, instead of the direct path."""
    later = (channel.direct_m - _reference_path_m(history, channel)) / SPEED_OF_LIGHT_M_S
    turned = channel.samples * np.exp(2j * np.pi * np.outer(later, history.frequencies_hz))
    return turned.astype(np.complex64)


def _vectors(history: PhaseHistory, channel: Channel) -> dict[str, Any]:
    """Return the parameters of each vector of a channel. Vectors without data have SIGNAL 0."""
    c, f, z = SPEED_OF_LIGHT_M_S, history.frequencies_hz, float(history.centre_m[2])
    path = _reference_path_m(history, channel)
    toa = (np.array(history.gate_m)[:, None] + channel.direct_m - path) / c
    rate = sum(
        np.sum((p - history.centre_m) * history.velocity_m_s, axis=1) / np.linalg.norm(p - history.centre_m, axis=1)
        for p in (history.tx_m, channel.rx_m)
    )
    velocity = to_earth(history.velocity_m_s, z, vector=True)
    return {
        "TxTime": history.time_s,
        "TxPos": to_earth(history.tx_m, z),
        "TxVel": velocity,
        "RcvTime": history.time_s + path / c,
        "RcvPos": to_earth(channel.rx_m, z),
        "RcvVel": velocity,
        "SRPPos": to_earth(history.centre_m, z),
        "aFDOP": -rate / c,
        "aFRR1": 0.0,
        "aFRR2": 0.0,
        "FX1": f[0],
        "FX2": f[-1],
        "TOA1": toa[0],
        "TOA2": toa[1],
        "TDTropoSRP": 0.0,
        "SC0": f[0],
        "SCSS": f[1] - f[0],
        "SIGNAL": channel.valid.astype(np.int64),
    }


def _tables(history: PhaseHistory, vectors: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the content of the XML without the reference geometry, in the order of the schema."""
    f, t, started = history.frequencies_hz, history.time_s, history.started_utc or _NO_START
    known = "as recorded" if history.started_utc else "unknown; the start in this file is a placeholder"
    toa = [np.min([v["TOA1"] for v in vectors.values()]), np.max([v["TOA2"] for v in vectors.values()])]
    return {
        "CollectionID": {
            "CollectorName": "polysight",
            "IlluminatorName": "polysight",
            "CoreName": history.scan_id,
            "CollectType": "BISTATIC",
            "RadarMode": {"ModeType": "SPOTLIGHT"},
            "Classification": "UNCLASSIFIED",
            "ReleaseInfo": "UNRESTRICTED",
            "Parameter": [
                {"@name": "simulated", "#": str(history.simulated).lower()},
                {"@name": "place", "#": "a laboratory: latitude, longitude and height are placeholders"},
                {"@name": "start", "#": known},
                {"@name": "samples", "#": "range-gated, Hann-weighted over the sweep, direct path taken out"},
            ],
        },
        "Global": {
            "DomainType": "FX",
            "SGN": "+1",
            "Timeline": {"CollectionStart": started, "TxTime1": t.min(), "TxTime2": t.max()},
            "FxBand": {"FxMin": f[0], "FxMax": f[-1]},
            "TOASwath": {"TOAMin": toa[0], "TOAMax": toa[1]},
        },
        "SceneCoordinates": _scene(history),
        "Data": _sizes(history),
        "Channel": {
            "RefChId": history.channels[0].name,
            "FXFixedCPHD": True,
            "TOAFixedCPHD": False,
            "SRPFixedCPHD": True,
            "Parameters": [_channel(history, c, vectors[c.name]) for c in history.channels],
        },
        "PVP": _layout(),
        "Dwell": {
            "NumCODTimes": 1,
            "CODTime": {"Identifier": "all", "CODTimePoly": _constant(float(t.min() + t.max()) / 2)},
            "NumDwellTimes": 1,
            "DwellTime": {"Identifier": "all", "DwellTimePoly": _constant(float(np.ptp(t)))},
        },
        "ProductInfo": {
            "CreationInfo": {
                "Application": f"polysight {versions()['polysight']}",
                "DateTime": started,
            }
        },
    }


def _scene(history: PhaseHistory) -> dict[str, Any]:
    """Return the scene's coordinates; x of the image area points along the rig's y."""
    centre, z = history.centre_m, float(history.centre_m[2])
    (ny, nx), pixel = history.shape, history.pixel_m
    x, y = nx * pixel / 2, ny * pixel / 2
    corners = [(-y, -x), (-y, x), (y, x), (y, -x)]  # (along IAX, along IAY), clockwise from above
    places = [to_earth(centre + np.array([b, a, 0.0]), z) for a, b in corners]
    degrees = [np.degrees([np.arctan2(p[2], p[0]), np.arctan2(p[1], p[0])]) for p in (to_earth(centre, z), *places)]
    return {
        "EarthModel": "WGS_84",
        "IARP": {
            "ECF": _xyz(to_earth(centre, z)),
            "LLH": {"Lat": degrees[0][0], "Lon": degrees[0][1], "HAE": 0.0},
        },
        "ReferenceSurface": {
            "Planar": {
                "uIAX": _xyz(to_earth(np.array([0.0, 1.0, 0.0]), 0, vector=True)),
                "uIAY": _xyz(to_earth(np.array([1.0, 0.0, 0.0]), 0, vector=True)),
            }
        },
        "ImageArea": {
            "X1Y1": {"X": -y, "Y": -x},
            "X2Y2": {"X": y, "Y": x},
        },
        "ImageAreaCornerPoints": {
            "IACP": [{"@index": k, "Lat": at[0], "Lon": at[1]} for k, at in enumerate(degrees[1:], 1)]
        },
        "ImageGrid": {
            "IARPLocation": {"Line": (ny - 1) / 2, "Sample": (nx - 1) / 2},
            "IAXExtent": {"LineSpacing": pixel, "FirstLine": 0, "NumLines": ny},
            "IAYExtent": {"SampleSpacing": pixel, "FirstSample": 0, "NumSamples": nx},
        },
    }


def _sizes(history: PhaseHistory) -> dict[str, Any]:
    vectors, samples = history.time_s.size, history.frequencies_hz.size
    words = sum(size for _, size in _EACH)
    return {
        "SignalArrayFormat": "CF8",
        "NumBytesPVP": 8 * words,
        "NumCPHDChannels": len(history.channels),
        "Channel": [
            {
                "Identifier": channel.name,
                "NumVectors": vectors,
                "NumSamples": samples,
                "SignalArrayByteOffset": k * vectors * samples * 8,
                "PVPArrayByteOffset": k * vectors * 8 * words,
            }
            for k, channel in enumerate(history.channels)
        ],
        "NumSupportArrays": 0,
    }


def _channel(history: PhaseHistory, channel: Channel, columns: Mapping[str, Any]) -> dict[str, Any]:
    f = history.frequencies_hz
    good = np.flatnonzero(channel.valid)
    return {
        "Identifier": channel.name,
        "RefVectorIndex": int(good[good.size // 2]) if good.size else 0,
        "FXFixed": True,
        "TOAFixed": bool(np.ptp(columns["TOA1"]) == 0),
        "SRPFixed": True,
        "SignalNormal": bool(channel.valid.all()),
        "Polarization": {"TxPol": "UNSPECIFIED", "RcvPol": channel.polarisation},
        "FxC": (f[0] + f[-1]) / 2,
        "FxBW": f[-1] - f[0],
        "TOASaved": columns["TOA2"].max() - columns["TOA1"].min(),
        "DwellTimes": {"CODId": "all", "DwellId": "all"},
    }


def _layout() -> dict[str, Any]:
    out, offset = {}, 0
    for name, size in _EACH:
        form = {1: "F8", 3: "X=F8;Y=F8;Z=F8;"}[size] if name != "SIGNAL" else "I8"
        out[name] = {"Offset": offset, "Size": size, "Format": form}
        offset += size
    return out


def _constant(value: float) -> dict[str, Any]:
    return {"@order1": 0, "@order2": 0, "Coef": {"@exponent1": 0, "@exponent2": 0, "#": value}}


def _xyz(place: Floats) -> dict[str, float]:
    return dict(zip("XYZ", map(float, place), strict=True))


def _fill(etree: Any, node: Any, content: Any) -> None:
    """Fill an element: dicts become children, lists repeated children, `@` keys attributes, `#` the text."""
    if not isinstance(content, dict):
        node.text = str(content).lower() if isinstance(content, bool) else _number(content)
        return
    for name, value in content.items():
        if name.startswith("@"):
            node.set(name[1:], str(value))
        elif name == "#":
            node.text = _number(value)
        else:
            for one in value if isinstance(value, list) else [value]:
                _fill(etree, etree.SubElement(node, f"{{{NAMESPACE}}}{name}"), one)


def _number(value: Any) -> str:
    return repr(float(value)) if isinstance(value, float | np.floating) else str(value)
