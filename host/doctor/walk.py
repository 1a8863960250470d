"""The order of the checks, what each of them needs, and the command that walks them.

A hop behind one that is wrong is not tried. `walk` yields findings as they come; `doctor` prints them.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from polysight.host.doctor.bench import Bench, Finding, System, Wanted, not_checked, of_error
from polysight.host.doctor.check_capture import check_buffer, check_card, check_network, check_pulses, check_radar
from polysight.host.doctor.check_host import (
    check_config,
    check_disk,
    check_host_clock,
    check_pi_clock,
    check_receivers,
    check_time,
)
from polysight.host.doctor.check_pi import SIMULATED, check_free, check_keys, check_pi, check_stage, check_trigger
from polysight.shared.config import Board
from polysight.shared.errors import DeviceError, PolysightError, no_such
from polysight.shared.messages import is_simulated

_WIDTH = 16  # of the column of names


def _calibration(bench: Bench) -> Finding:
    from polysight.host.doctor.check_host import check_calibration

    return check_calibration(bench)


def _library(bench: Bench) -> Finding:
    from polysight.host.doctor.check_host import check_library

    return check_library(bench)


def _level(bench: Bench, board: Board) -> Finding:
    from polysight.host.doctor.check_capture import check_level

    return check_level(bench, board)


def _direct_path(bench: Bench, board: Board) -> Finding:
    from polysight.host.doctor.check_capture import check_direct_path

    return check_direct_path(bench, board)


def _skew(bench: Bench) -> Finding:
    from polysight.host.doctor.check_capture import check_skew

    return check_skew(bench)


@dataclass(frozen=True)
class Check:
    """One hop. `needs` must not have failed, nor been left out because of a failure; `unless` must not be wrong."""

    name: str
    run: Callable[..., Finding]
    needs: tuple[str, ...] = ()
    unless: tuple[str, ...] = ()
    each_board: bool = False


CHECKS = (
    Check("config", check_config),
    Check("host clock", check_host_clock),
    Check("keys", check_keys, ("config",)),
    Check("pi", check_pi, ("keys",)),
    Check("pi clock", check_pi_clock, ("pi",)),
    Check("rig is free", check_free, ("pi",)),
    Check("calibration", _calibration, ("config",)),
    Check("library", _library, ("config",)),
    Check("stage", check_stage, ("pi",)),
    Check("card", check_card, ("config",), ("rig is free",), each_board=True),
    Check("network", check_network, ("config",), each_board=True),
    Check("buffer", check_buffer, ("card",), each_board=True),
    Check("receivers", check_receivers, ("config",), ("rig is free",)),
    Check("disk", check_disk, ("config",), ("rig is free",)),
    Check("scan time", check_time, ("config",)),
    Check("trigger line", check_trigger, ("rig is free", "stage")),
    Check("pulses", check_pulses, ("pi", "rig is free")),
    Check("radar", check_radar, ("buffer", "pulses"), each_board=True),
    Check("level", _level, ("radar",), each_board=True),
    Check("direct path", _direct_path, ("level",), each_board=True),
    Check("trigger skew", _skew, ("direct path",)),
)


def walk(bench: Bench) -> Iterator[Finding]:
    """Every check in order. A finding is told as soon as it is there."""
    causes: dict[str, str] = {}  # titles that cannot be relied on, and the first check that was wrong

    def told(title: str, finding: Finding, cause: str) -> Finding:
        if cause:
            causes[title] = cause
        return replace(finding, check=title)

    for check in CHECKS:
        boards = bench.boards if check.each_board and bench.given is not None else (None,)
        for board in boards:
            title = check.name if board is None else f"{check.name} {board.name}"
            cause = _cause(check, board, causes)
            if cause:
                yield told(title, not_checked(f"{cause} failed"), cause)
                continue
            finding = _try(check, bench, board)
            yield told(title, finding, title if finding.verdict == "error" else "")


def _cause(check: Check, board: Board | None, causes: dict[str, str]) -> str:
    """What keeps a check from being tried; "" for nothing. A need is this board's, or of every board."""

    def titles(need: str) -> list[str]:
        if board is not None and f"{need} {board.name}" in causes:
            return [f"{need} {board.name}"]
        own = [need] if need in causes else []
        return own if board is not None else own + [t for t in causes if t.startswith(f"{need} ") and t not in _NAMES]

    for need in check.needs:
        for title in titles(need):
            return causes[title]
    return next((causes[title] for title in check.unless if causes.get(title) == title), "")


_NAMES = frozenset(check.name for check in CHECKS)


def _try(check: Check, bench: Bench, board: Board | None) -> Finding:
    try:
        return check.run(bench) if board is None else check.run(bench, board)
    except PolysightError as e:
        return of_error(e)
    except OSError as e:
        where = f"{e.filename}: " if e.filename else ""
        return of_error(
            DeviceError(f"{where}{e.strerror or e}", "a path, a permission or a device", "see what it says")
        )


def doctor(wanted: Wanted, as_json: bool, system: System = System(), bundle: Path | None = None) -> int:  # noqa: B008 - immutable
    """Walk the rig; 0 when no check found an error, 1 otherwise. `bundle`: write what was found into this archive."""
    findings: list[Finding] = []
    if bundle is not None and not bundle.resolve().parent.is_dir():
        raise no_such(bundle.parent)
    with Bench(wanted, system) as bench:
        for finding in walk(bench):
            findings.append(finding)
            if not as_json:
                sys.stdout.write(line(finding))
                sys.stdout.flush()
        simulated = bench.hello is not None and is_simulated(bench.hello.backend)
        rig = bench.given
    wrong = [f.check for f in findings if f.verdict == "error"]
    told = _sum(findings, wrong) + (f" ({SIMULATED})" if simulated else "") + "\n"
    if as_json:
        found = {"ok": not wrong, "simulated": simulated, "findings": [asdict(f) for f in findings]}
        sys.stdout.write(json.dumps(found, indent=1) + "\n")
    else:
        sys.stdout.write(told)
    if bundle is not None:
        from polysight.host.doctor.bundle import write_bundle

        write_bundle(bundle, wanted, rig, findings, "".join(map(line, findings)) + told, system.root)
        sys.stderr.write(f"{bundle}: to send to somebody; no raw data, no keys. Look through it first\n")
    return 1 if wrong else 0


def line(finding: Finding) -> str:
    """A finding as lines of text."""
    head = f"{finding.verdict:12}{finding.check:{_WIDTH}} {finding.found}".rstrip() + "\n"
    more = (("why", finding.why), ("do", finding.remedy))
    return head + "".join(f"{'':{12 + _WIDTH}} {word}: {text}\n" for word, text in more if text)


def _sum(findings: list[Finding], wrong: list[str]) -> str:
    count = {v: sum(f.verdict == v for f in findings) for v in ("ok", "warning", "not checked")}
    told = f"{count['ok']} ok, {count['warning']} warnings, {len(wrong)} errors, {count['not checked']} not checked"
    return f"{told}: begin with {wrong[0]}" if wrong else told
