"""See what things are made of: bistatic polarimetric SAR with commodity mmWave radars.

The names below are the public Python interface. They are imported when first used, so that `import polysight` is quick
and needs no other package. Start with :func:`open_scan`.

`pipeline.py` is the whole flow on one screen. Every folder is a room: its `__init__` says what it takes and gives, and
other folders import from there only, except from `jobs` and `api`, whose modules are imported directly
(docs/decisions/0008-rooms.md). The other packages of the project are `polysight_shared` (configuration, messages,
errors), `polysight_pi` (the Raspberry Pi), `polysight_simulators` and `polysight_papers`.
"""

from __future__ import annotations

from polysight_shared import __version__

TYPE_CHECKING = False
"""True for a type checker, as in the module `typing`; Ctrl-C while that is imported would be a traceback."""

if TYPE_CHECKING:
    from polysight.api import Scan, open_scan, read_netcdf, write_netcdf
    from polysight.api.classifier import Classifier, train
    from polysight.api.functions import Plan, check, compare, plan, plot_check, simulate
    from polysight.imaging import backproject
    from polysight.materials import Library, PaperKNeighborsClassifier
    from polysight.polarimetry.xarray_labels import fresnel, multilayer, permittivity_from_ratio

# Module to the public names that are imported from it.
_NAMES = {
    "polysight.api": ("Scan", "open_scan", "read_netcdf", "write_netcdf"),
    "polysight.api.classifier": ("Classifier", "train"),
    "polysight.api.functions": ("Plan", "check", "compare", "plan", "plot_check", "simulate"),
    "polysight.imaging": ("backproject",),
    "polysight.materials": ("Library", "PaperKNeighborsClassifier"),
    "polysight.polarimetry.xarray_labels": ("fresnel", "multilayer", "permittivity_from_ratio"),
}
_MODULE_OF_NAME = {name: module for module, names in _NAMES.items() for name in names}

__all__ = [
    "Classifier",
    "Library",
    "PaperKNeighborsClassifier",
    "Plan",
    "Scan",
    "__version__",
    "backproject",
    "check",
    "compare",
    "fresnel",
    "multilayer",
    "open_scan",
    "permittivity_from_ratio",
    "plan",
    "plot_check",
    "read_netcdf",
    "simulate",
    "train",
    "write_netcdf",
]


def __getattr__(name: str) -> object:
    """Import a public name when it is first used."""
    from importlib import import_module

    if name not in _MODULE_OF_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULE_OF_NAME[name]), name)
    return value


def __dir__() -> list[str]:
    """Return the names of the module, the public ones included."""
    return sorted({*globals(), *__all__})
