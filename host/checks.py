"""Commands that only look: validate, inspect. They load nothing of the processing, so that they answer at once."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path

from polysight.host.capture.inspect import Known, inspect_bin
from polysight.host.capture.inspect_pcap import inspect_pcap, is_pcap
from polysight.host.capture.inspect_text import main_text
from polysight.host.store.scan_folder import MANIFEST, ScanFolder
from polysight.host.store.validate import to_json, validate
from polysight.shared.config import load_instrument
from polysight.shared.errors import DataError, PolysightError


def validate_folder(folder: Path, as_json: bool) -> int:
    """Print every fault of a scan folder; 0 when there is none."""
    findings = validate(folder)
    if as_json:
        sys.stdout.write(to_json(findings) + "\n")
    else:
        sys.stdout.write("".join(f"{f}\n" for f in findings) or f"{folder}: whole\n")
    return 1 if any(f.severity == "error" for f in findings) else 0


def _refuse_text(file: Path) -> None:
    """Text would be taken for samples: payload has no mark by which it is known. Raises DataError."""
    with file.open("rb") as f:
        head = f.read(4096)
    if head.strip() and all(byte >= 0x20 or byte in b"\t\n\r\f" for byte in head) and head.isascii():
        raise DataError(
            f"{file}: a text file", "a card records bytes, not text", "give a row (.bin) or a capture (.pcap)"
        )


def _is_pcap(file: Path) -> bool:
    """By its name, or by its first bytes where the name does not say."""
    if file.suffix in (".pcap", ".bin"):
        return file.suffix == ".pcap"
    with file.open("rb") as f:
        return is_pcap(f.read(4))


def _scan_of(file: Path) -> ScanFolder | None:
    """The scan a row's file belongs to, where its manifest can be read."""
    folders = file.resolve().parents
    if len(folders) < 3 or folders[1].name != "raw" or not (folders[2] / MANIFEST).is_file():
        return None
    try:
        return ScanFolder.load(folders[2])
    except PolysightError:
        return None  # `polysight validate` says what is wrong with it


def inspect_file(file: Path, config: Path | None, plot: Path | None, card_address: str, as_json: bool) -> int:
    """Say what is in a capture, and draw its range profile; returns the exit status.

    `config` is the rig file it was recorded with; a row of a scan folder brings its own. Raises PolysightError.
    """
    if file.is_file():
        _refuse_text(file)
    scan = _scan_of(file)
    rig = load_instrument(config) if config is not None else None if scan is None else scan.instrument
    known = Known() if rig is None else Known.of_instrument(rig)
    pcap = file.is_file() and _is_pcap(file)
    report = inspect_pcap(file, known, card_address) if pcap else inspect_bin(file, known)
    report.simulated = scan is not None and scan.simulated
    if as_json:
        from polysight.host.report import plain

        sys.stdout.write(json.dumps(plain(asdict(report)), indent=1) + "\n")
    else:
        sys.stdout.write(main_text(report))
    if plot is not None:
        from polysight.host.capture.plot import plot_profile

        plot_profile(report, plot)
        sys.stderr.write(f"range profile: {plot}\n")
    return 0
