"""The catalogue: permittivities of real materials near 77 GHz from the open literature (catalogue.toml).

The file has three tables. `sources` has the citation of each publication by its key. `kinds` has, for each kind of
material, its generic names ("wood") and the default spread between specimens. `materials` has a line for each material.

Two names may mean one material if they are equal after `normalise_name`, if both are names of one entry, or if one is
the generic name of the other ("wood" and "oak", but not "oak" and "pine").
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import msgspec

from polysight_shared.errors import ConfigError, ErrorCode
from polysight_shared.tables import decode, read_toml

CATALOGUE = Path(__file__).with_name("catalogue.toml")
"""The file of the package."""


class Source(msgspec.Struct, frozen=True):
    """A publication: its key in the file, and its full citation."""

    key: str
    citation: str


class CatalogueMaterial(msgspec.Struct, frozen=True):
    """A material of the literature.

    Attributes
    ----------
    name, aliases
        Name, and other names of the same material; unique in the catalogue.
    generic
        Wider names of the material, such as that of its kind: "glass" for borosilicate glass.
    kind
        Class of the material: "polymer", "wood", "liquid", ...
    permittivity
        eps' - j eps'', relative to vacuum.
    frequency_hz
        Frequency at which it was measured, or for which the formula was evaluated.
    spread
        Standard deviations of ln eps' and of ln eps'' between specimens.
    spread_is_default
        True if the spread is that of the kind, False if it is that of several sources or specimens.
    sources
        Publications of the value.
    """

    name: str
    aliases: tuple[str, ...]
    generic: tuple[str, ...]
    kind: str
    permittivity: complex
    frequency_hz: float
    spread: tuple[float, float]
    spread_is_default: bool
    sources: tuple[Source, ...]


class _Kind(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Generic names of a kind, and its default standard deviations of ln eps' and ln eps'' between specimens."""

    generic: tuple[str, ...]
    spread: tuple[float, float]


class _Row(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A line of the file: eps' (`real`), eps'' (`loss`, positive), frequency in GHz, aliases (`also`), and so on.

    Without a `spread` of its own the material has that of its kind.
    """

    name: str
    kind: str
    real: float
    loss: float
    ghz: float
    source: tuple[str, ...]
    also: tuple[str, ...] = ()
    generic: tuple[str, ...] = ()
    spread: tuple[float, float] | None = None


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The three tables of the file; see the module's docstring."""

    sources: dict[str, str]
    kinds: dict[str, _Kind]
    materials: tuple[_Row, ...]


def read_catalogue(path: Path) -> tuple[CatalogueMaterial, ...]:
    """Read a catalogue, in the order of the file.

    Raises
    ------
    ConfigError
        if the file is missing, is not TOML, has a wrong or unknown key, or a kind or source that it does not list.
    """
    file = decode(read_toml(path), _File, str(path), keys="docs/spec/catalogue.md explains every key")
    try:
        return tuple(_read_material_line(row, file) for row in file.materials)
    except KeyError as error:
        raise ConfigError(
            f"{path}: {error} is used, but not listed",
            "it is the kind or the source of a material",
            "add it to [kinds] or [sources]",
            code=ErrorCode.KEY_MISSING,
        ) from None


def _read_material_line(row: _Row, file: _File) -> CatalogueMaterial:
    """Parse a line of the catalogue. Raises KeyError if its kind or a source is not listed."""
    kind = file.kinds[row.kind]
    return CatalogueMaterial(
        name=row.name,
        aliases=row.also,
        generic=row.generic + kind.generic,
        kind=row.kind,
        permittivity=complex(row.real, -row.loss),
        frequency_hz=row.ghz * 1e9,
        spread=row.spread or kind.spread,
        spread_is_default=row.spread is None,
        sources=tuple(Source(key, file.sources[key]) for key in row.source),
    )


@cache
def load_catalogue() -> tuple[CatalogueMaterial, ...]:
    """Load the catalogue of the package, once. Raises ConfigError as `read_catalogue`."""
    return read_catalogue(CATALOGUE)


def normalise_name(name: str) -> str:
    """Remove case, punctuation, bracketed remarks and thickness: "PET (0.5 mm)" and "pet 1 mm" become "pet"."""
    bare = re.sub(r"\([^)]*\)|\b\d+(\.\d+)?\s*mm\b", " ", name.casefold())
    return " ".join(re.findall(r"\w+", bare))


@cache
def _index_names() -> dict[str, CatalogueMaterial]:
    """Return normalised name or alias to its material."""
    materials = {}
    for material in load_catalogue():
        for name in (material.name, *material.aliases):
            materials[normalise_name(name)] = material
    return materials


def find_material(name: str) -> CatalogueMaterial | None:
    """Return the material of the catalogue that has this name or alias; None if it has none."""
    return _index_names().get(normalise_name(name))


def is_same_material(name: str, other: str) -> bool:
    """True if both names may mean one material: equal, aliases, or one is the generic name of the other."""
    first = normalise_name(name)
    second = normalise_name(other)
    return first == second or second in _collect_all_names(first) or first in _collect_all_names(second)


@cache
def _collect_all_names(name: str) -> frozenset[str]:
    """Return a normalised name with its aliases and generic names; only itself if it is not in the catalogue."""
    material = _index_names().get(name)
    if material is None:
        return frozenset((name,))
    return frozenset(map(normalise_name, (material.name, *material.aliases, *material.generic)))
