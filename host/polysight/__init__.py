"""See what things are made of: bistatic polarimetric SAR with commodity mmWave radars.

The names below are the public Python interface. They are imported when first used, so that `import polysight` is quick
and needs no other package. Start with :func:`open_scan`.

`pipeline.py` is the whole flow on one screen. Every folder is a room: its `__init__` says what it takes and gives, and
neighbours import from there only (docs/decisions/0008-rooms.md). Beside this package: `polysight_shared`
(configuration, messages, errors), `polysight_pi` (the Raspberry Pi), `polysight_simulators`, `polysight_papers`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from polysight_shared import __version__

if TYPE_CHECKING:
    from polysight.api import Scan, open_scan, read_netcdf
    from polysight.imaging import backproject
    from polysight.polarimetry import fresnel, multilayer, permittivity_from_ratio

__all__ = [
    "Scan",
    "__version__",
    "backproject",
    "fresnel",
    "multilayer",
    "open_scan",
    "permittivity_from_ratio",
    "read_netcdf",
]

_HOME = {
    "Scan": "polysight.api",
    "open_scan": "polysight.api",
    "read_netcdf": "polysight.api",
    "backproject": "polysight.imaging",
    "fresnel": "polysight.polarimetry",
    "multilayer": "polysight.polarimetry",
    "permittivity_from_ratio": "polysight.polarimetry",
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
