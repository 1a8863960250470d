"""`polysight doctor`, for people and for programs."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict

from polysight.host.doctor.bench import Bench, System, Wanted
from polysight.host.doctor.check_pi import SIMULATED
from polysight.host.doctor.finding import Finding
from polysight.host.doctor.walk import walk
from polysight.shared.backends import is_simulated

_WIDTH = 16


def doctor(wanted: Wanted, as_json: bool, system: System = System()) -> int:  # noqa: B008 - immutable
    """Walk the rig; 0 when no check found an error, 1 otherwise."""
    findings: list[Finding] = []
    with Bench(wanted, system) as bench:
        for finding in walk(bench):
            findings.append(finding)
            if not as_json:
                sys.stdout.write(line(finding))
                sys.stdout.flush()
        simulated = bench.hello is not None and is_simulated(bench.hello.backend)
    wrong = [f.check for f in findings if f.verdict == "error"]
    if as_json:
        found = {"ok": not wrong, "simulated": simulated, "findings": [asdict(f) for f in findings]}
        sys.stdout.write(json.dumps(found, indent=1) + "\n")
    else:
        sys.stdout.write(_sum(findings, wrong) + (f" ({SIMULATED})" if simulated else "") + "\n")
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
