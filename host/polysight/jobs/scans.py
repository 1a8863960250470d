"""Commands on existing scans, as on the operator's page: scans, note, ask, probe, compare."""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec

from polysight.acquisition import ScanCommand, send_command
from polysight.catalogue import (
    Notes,
    PermittivityDifference,
    Scans,
    Summary,
    compare,
    folder_bytes,
    printable,
    probe,
    read_notes,
    write_notes,
)
from polysight.jobs.output import print_json
from polysight.materials import UNKNOWN
from polysight.results import ComplexNumber, plain
from polysight_shared.errors import DataError, no_such

_NAME_WIDTH = 40
"""Widest column of names; a longer name pads no other line."""


def scans(root: Path, tags: list[str], text: str, as_json: bool) -> int:
    """Print the scans under a folder, the newest first; returns 0. Raises DataError when there is no such folder."""
    if not root.is_dir():
        raise no_such(root)
    catalogue, odd = Scans(root), ""
    if left_out := catalogue.left_out():
        odd = f"; not listed, because they are links or have unprintable names: {', '.join(left_out)}"
    found = [s for s in catalogue.list() if set(tags) <= set(s.tags) and text.casefold() in _searched(s)]
    if as_json:
        rows = [msgspec.to_builtins(s) | {"bytes": _bytes_of(root, s)} for s in found]
        print_json({"scans": rows})
        return 0
    width = min(max((len(s.name) for s in found), default=0), _NAME_WIDTH)
    for s in found:
        sys.stdout.write(f"{s.name:{width}}  {_bytes_of(root, s) / 1e6:8.1f} MB  {printable(_line(s))}\n")
    sys.stdout.write(f"{len(found)} scans under {root}{odd}\n")
    return 0


def _bytes_of(root: Path, s: Summary) -> int:
    """Size on the disk; 0 for a folder that does not answer."""
    return 0 if s.state == "silent" else folder_bytes(root / s.name)


def _line(s: Summary) -> str:
    """State, rows, verdict, materials and tags of a scan."""
    parts = [s.state, f"{s.committed}/{s.rows} rows" if s.rows else "", s.verdict]
    parts += ["images only" if s.images_only else "", ", ".join(map(_called, s.materials))]
    parts += ["simulated" if s.simulated else "", " ".join(f"#{tag}" for tag in s.tags)]
    parts.append(s.reason if s.state == "failed" and not s.rows else "")
    return "  ".join(part for part in parts if part)


def _searched(s: Summary) -> str:
    return " ".join((s.name, s.scan_id, s.rig, s.state, s.notes, *s.tags, *s.materials)).casefold()


def note(folder: Path, text: str | None, add: list[str], remove: list[str]) -> int:
    """Change or print the operator's notes and tags of a scan; returns 0. Raises PolysightError."""
    if not folder.is_dir():
        raise no_such(folder)
    notes = read_notes(folder)
    if text is not None or add or remove:
        tags = tuple(t for t in dict.fromkeys((*notes.tags, *add)) if t not in remove)
        notes = write_notes(folder, Notes(notes.notes if text is None else text, tags))
    text = f"{notes.notes}\n" if notes.notes else ""
    sys.stdout.write(printable(f"{text}tags: {', '.join(notes.tags) or 'none'}", keep="\n") + "\n")
    return 0


def ask_scan(folder: Path, command: str) -> int:
    """Send a command to a running scan; return 0 when it has received it. Raises ScanError."""
    if not folder.is_dir():
        raise no_such(folder)
    send_command(folder, ScanCommand(command))
    sys.stdout.write(f"{folder}: heard {command}\n")
    return 0


def probe_scan(folder: Path, place_mm: tuple[float, float], library: Path | None, as_json: bool) -> int:
    """Print the results of a processed scan at one place; return 0. Raises DataError."""
    found = probe(folder, *place_mm, library)
    if as_json:
        print_json(plain(found))
        return 0
    lines = [f"x {found.place_mm[0]:g} mm, y {found.place_mm[1]:g} mm from the image's centre"]
    if not found.lit:
        lines.append("the scan does not light this place")
    lines.append(f"|H| {_value(found.h_db)} dB, |V| {_value(found.v_db)} dB")
    lines.append(f"P = {_complex(found.p)} +- {_value(found.p_sigma)} a part")
    if found.permittivity:
        error = _value(found.permittivity_sigma)
        lines.append(f"permittivity {_complex(found.permittivity)} +- {error} a part, as a half space")
    else:
        lines.append(f"no permittivity: {found.why}")
    if found.patch is not None:
        lines.append(f"in patch {found.patch.label}: {_called(found.patch.name)}")
    lines += [f"  {n.sigmas:g} standard deviations from {n.name}" for n in found.nearest]
    lines.append(found.profile_why or "range profile: --json")
    sys.stdout.write("".join(f"{printable(line)}\n" for line in lines))
    return 0


def compare_scans(first: Path, second: Path, picture: Path | None, as_json: bool) -> int:
    """Print the differences of two processed scans; returns 0. Raises DataError."""
    found = compare(first, second)
    values = found.figures
    if picture is not None:
        from polysight.catalogue import draw_comparison

        try:
            picture.write_bytes(draw_comparison(found, "sigmas").png)
        except OSError as e:
            raise DataError(f"{picture}: cannot be written: {e.strerror}", "no such folder, or no permission") from None
    if as_json:
        print_json(plain(values))
        return 0
    lines = [f"{first} minus {second}: {values.compared} pixels", *(f"note: {n}" for n in values.notes)]
    if values.significant_share is not None:
        share = f"{100 * values.significant_share:.1f} %"
        lines.append(f"P differs by more than {values.significant_sigmas:g} standard deviations in {share} of them")
    for pair in values.patches:
        names = " and ".join(map(_called, pair.names))
        place = f"x {pair.place_mm[0]:g}, y {pair.place_mm[1]:g} mm ({names})"
        if pair.difference is None:
            lines.append(f"{place}: no permittivity in one of them")
            continue
        sure = "" if pair.sigmas is None else f": {pair.sigmas:g} standard deviations"
        lines.append(f"{place}: permittivity differs by {_complex(pair.difference)}{sure}")
    sys.stdout.write("".join(f"{printable(line)}\n" for line in lines))
    return 0


def _called(name: str | None) -> str:
    """A material's name as people read it."""
    return "not in the library" if name == UNKNOWN else name or "not named"


def _value(value: float | None) -> str:
    return "not known" if value is None else f"{value:.3g}"


def _complex(number: ComplexNumber | PermittivityDifference) -> str:
    """`3.1 - 0.2j`."""
    if number.real is None or number.imag is None:
        return "not known"
    return f"{number.real:.3g} {'-' if number.imag < 0 else '+'} {abs(number.imag):.3g}j"
