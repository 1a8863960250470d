"""The list of checks (`CHECKS`), `run_checks`, which runs them, and `run_doctor`, which prints their findings."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec

from polysight.doctor import rig_checks, signal_checks
from polysight.doctor.bundle import write_bundle
from polysight.doctor.context import CheckContext, DoctorOptions, System, finding_to_json, not_checked, verdict
from polysight_shared.config import Board
from polysight_shared.errors import PolysightError, convert_os_error, make_missing_path_error
from polysight_shared.files import require_writable
from polysight_shared.findings import Finding
from polysight_shared.messages import is_simulated

# The operator's page (serve/static/new.js) parses these lines: a name, which may be longer than its column, ends at two
# spaces.
_VERDICT_WIDTH = 12
_NAME_WIDTH = 15


@dataclass(frozen=True)
class Check:
    """One check of a hop.

    It is skipped if a check in `needs` failed or was skipped because of a failure, or if a check in `unless` failed.
    With `each_board` it runs once for every recorded board.
    """

    name: str
    run: Callable[..., Finding]
    needs: tuple[str, ...] = ()
    unless: tuple[str, ...] = ()
    each_board: bool = False


CHECKS = (
    Check("config", rig_checks.check_config),
    Check("host clock", rig_checks.check_host_clock),
    Check("keys", rig_checks.check_keys, needs=("config",)),
    Check("pi", rig_checks.check_pi, needs=("keys",)),
    Check("pi clock", rig_checks.check_pi_clock, needs=("pi",)),
    Check("rig is free", rig_checks.check_free, needs=("pi",)),
    Check("calibration", rig_checks.check_calibration, needs=("config",)),
    Check("library", rig_checks.check_library, needs=("config",)),
    Check("stage", rig_checks.check_stage, needs=("pi",)),
    Check("card", rig_checks.check_card, needs=("config",), unless=("rig is free",), each_board=True),
    Check("network", rig_checks.check_network, needs=("config",), each_board=True),
    Check("buffer", rig_checks.check_buffer, needs=("card",), each_board=True),
    Check("receivers", rig_checks.check_receivers, needs=("config",), unless=("rig is free",)),
    Check("disk", rig_checks.check_disk, needs=("config",), unless=("rig is free",)),
    Check("scan time", rig_checks.check_time, needs=("config",)),
    Check("trigger line", rig_checks.check_trigger, needs=("rig is free", "stage")),
    Check("pulses", rig_checks.check_pulses, needs=("pi", "rig is free")),
    Check("radar", rig_checks.check_radar, needs=("buffer", "pulses"), each_board=True),
    Check("level", signal_checks.check_level, needs=("radar",), each_board=True),
    Check("direct path", signal_checks.check_direct_path, needs=("level",), each_board=True),
    Check("trigger skew", signal_checks.check_skew, needs=("direct path",)),
)


def run_checks(context: CheckContext) -> Iterator[Finding]:
    """Run every check in order and yield each finding immediately."""
    # (check, board) that failed or was skipped, to the title of the check that failed.
    blocked: dict[tuple[str, str], str] = {}
    for check in CHECKS:
        boards: tuple[Board | None, ...] = (None,)
        if check.each_board and context.loaded_rig is not None:
            boards = tuple(context.loaded_rig.recorded)
        for board in boards:
            board_name = ""
            if board is not None:
                board_name = board.name
            key = (check.name, board_name)
            title = " ".join(key).rstrip()
            if failed := _find_failed_prerequisite(check, board, blocked):
                blocked[key] = failed
                finding = not_checked(f"{failed} failed")
            else:
                finding = _run_check(check, context, board)
                if finding.level == "error":
                    blocked[key] = title
            yield msgspec.structs.replace(finding, where=title)


def _find_failed_prerequisite(check: Check, board: Board | None, blocked: dict[tuple[str, str], str]) -> str:
    """Return the title of the failed check because of which this one is skipped; "" if there is none.

    A check of one board depends on the same board's checks, and one of the whole rig on those of every board.
    """
    for need in check.needs:
        for (name, board_name), failed in blocked.items():
            if name == need and (board is None or board_name in ("", board.name)):
                return failed
    # For `unless` only a check that failed itself counts: a check that was skipped has the title of another one in
    # `blocked`.
    return next((name for name in check.unless if blocked.get((name, "")) == name), "")


def _run_check(check: Check, context: CheckContext, board: Board | None) -> Finding:
    """Run a check; its error becomes its finding."""
    try:
        if board is None:
            return check.run(context)
        return check.run(context, board)
    except PolysightError as e:
        return Finding.of_error(e)
    except OSError as e:
        return Finding.of_error(convert_os_error(e))


def run_doctor(
    options: DoctorOptions,
    as_json: bool,
    system: System = System(),  # noqa: B008 - immutable
    bundle: Path | None = None,
) -> int:
    """Run and print all checks; return 1 if a check failed, otherwise 0.

    `bundle` is the path of an archive that is written in addition, for a person who helps.

    Raises
    ------
    DataError
        if the bundle's folder is missing.
    DeviceError
        if writing the bundle fails after the checks.
    OSError
        if the bundle cannot be written, before any check.
    """
    findings: list[Finding] = []
    if bundle is not None:
        if not bundle.resolve().parent.is_dir():
            raise make_missing_path_error(bundle.parent)
        require_writable(bundle)
    with CheckContext(options, system) as context:
        for finding in run_checks(context):
            findings.append(finding)
            if not as_json:
                sys.stdout.write(_format_finding(finding))
                sys.stdout.flush()
    failed = [f.where for f in findings if f.level == "error"]
    simulated = context.hello is not None and is_simulated(context.hello.backend)
    summary = _count_verdicts(findings, failed)
    if simulated:
        summary += f" ({rig_checks.SIMULATED_NOTE})"
    if as_json:
        document = {"ok": not failed, "simulated": simulated, "findings": [finding_to_json(f) for f in findings]}
        sys.stdout.write(json.dumps(document, indent=1) + "\n")
    else:
        sys.stdout.write(f"{summary}\n")
    if bundle is not None:
        text = "".join(map(_format_finding, findings)) + f"{summary}\n"
        write_bundle(bundle, options, context.loaded_rig, findings, text, system.root)
        sys.stderr.write(f"{bundle}: written, without raw data and keys. Read it before you send it\n")
    return int(bool(failed))


def _format_finding(finding: Finding) -> str:
    """Format a finding as lines: verdict, check and problem; below them cause and remedy."""
    lines = f"{verdict(finding):{_VERDICT_WIDTH}}{finding.where:{_NAME_WIDTH}}  {finding.what}".rstrip() + "\n"
    for word, text in (("why", finding.why), ("do", finding.do)):
        if text:
            lines += f"{'':{_VERDICT_WIDTH + _NAME_WIDTH}}  {word}: {text}\n"
    return lines


def _count_verdicts(findings: list[Finding], failed: list[str]) -> str:
    """Return the counts of the verdicts as a line; it names the first failed check, where to begin."""
    verdicts = [verdict(finding) for finding in findings]
    warnings = verdicts.count("warning")
    counts = (
        f"{verdicts.count('ok')} ok, {warnings} warning{'s' * (warnings != 1)}, {len(failed)}"
        f" error{'s' * (len(failed) != 1)}, {verdicts.count('not checked')} not checked"
    )
    if not failed:
        return counts
    return f"{counts}: begin with {failed[0]}"
