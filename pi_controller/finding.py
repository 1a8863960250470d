"""What one check found."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

from polysight.shared.errors import PolysightError, os_error

PROGRAM = "/opt/polysight/venv/bin/polysight-pi"  # where install.sh puts it
AS_THE_SERVICE = f"as the service's user: `sudo -u polysight {PROGRAM} ...`"
Verdict = Literal["ok", "warn", "fail"]


class Finding(NamedTuple):
    """One check: its name, how it went, what was found, and what to do when it is not ok."""

    name: str
    verdict: Verdict
    found: str
    remedy: str = ""


def attempt(name: str, check: Callable[[], str | Finding]) -> Finding:
    """Run a check: ok with what it returns, its own finding, or fail with the error it raises."""
    try:
        found = check()
    except PolysightError as e:
        return Finding(name, "fail", e.what + (f" ({e.why})" if e.why else ""), e.remedy)
    except OSError as e:
        return Finding(name, "fail", os_error(e).what, AS_THE_SERVICE)
    return found if isinstance(found, Finding) else Finding(name, "ok", found)
