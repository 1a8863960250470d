"""See what things are made of: bistatic polarimetric SAR with commodity mmWave radars.

The names below are the public Python interface. They are imported when first used, so that `import polysight` is quick
and needs no other package. Start with :func:`open_scan`.

The parts behind them: `polysight.host` (from the capture cards to the report), `polysight.shared` (configuration,
messages, errors), `polysight.pi_controller` (the Raspberry Pi), `polysight.simulators`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from polysight.shared import __version__

if TYPE_CHECKING:
    from polysight.host.api import Scan, open_scan, read_netcdf
    from polysight.host.api.bluesky_device import RadarScan, radar_scan
    from polysight.host.imaging import backproject
    from polysight.host.polarimetry import fresnel, multilayer, permittivity_from_ratio

__all__ = [
    "RadarScan",
    "Scan",
    "__version__",
    "backproject",
    "fresnel",
    "multilayer",
    "open_scan",
    "permittivity_from_ratio",
    "radar_scan",
    "read_netcdf",
]

_HOME = {
    "RadarScan": "polysight.host.api.bluesky_device",
    "Scan": "polysight.host.api",
    "open_scan": "polysight.host.api",
    "read_netcdf": "polysight.host.api",
    "backproject": "polysight.host.imaging",
    "fresnel": "polysight.host.polarimetry",
    "multilayer": "polysight.host.polarimetry",
    "permittivity_from_ratio": "polysight.host.polarimetry",
    "radar_scan": "polysight.host.api.bluesky_device",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOME[name]), name)
    return value


def __dir__() -> list[str]:
    """Names of the module, the public ones included."""
    return sorted({*globals(), *__all__})
