"""`polysight doctor --bundle FILE.zip`: findings, versions, logs and manifests for remote help; no raw data, no keys.

docs/how-to/doctor.md and the archive's README.txt list the files of the archive. All of them are texts, from which a
`Redactor` removes keys.
"""

from __future__ import annotations

import io
import json
import os
import platform
import re
import resource
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict
from importlib.metadata import distributions
from pathlib import Path

from polysight.doctor.context import DoctorOptions, finding_to_json, read_interface
from polysight.store import MANIFEST, utc_now, versions
from polysight_shared.config import Instrument
from polysight_shared.errors import DataError, DeviceError
from polysight_shared.files import read_bounded, refuse_link, write_atomically
from polysight_shared.findings import Finding

README = """Findings of `polysight doctor --bundle`, {utc}.

findings.txt, findings.json  what each check of the doctor found
rig.toml                     the rig file
versions.json                releases of this program, Python and every installed package; the system
kernel.txt                   kernel, limits of this login, receive buffers
network.json                 interfaces, routes and neighbours, from the kernel
scans/                       the last {lines} lines of the manifest of the newest {scans} scans under --out
logs/                        the last {kilobytes} kB of the logs beside the rig file and under --out
traces/                      the newest {traces} traces of radars (radar.trace_dir)

Not included: raw data, images, labels, keys. Words from files in pi.key_dir, and values of names like `token` or
`secret`, are replaced by {hidden}. Read the files before you send them: they contain paths, addresses and names of
this computer.
"""
REDACTION = "[removed]"
# Limits of the archive, all chosen: lines of a manifest, and numbers of scans, logs and traces.
_MAX_LINES = 60
_MAX_SCANS = 3
_MAX_LOGS = 20
_MAX_TRACES = 6
# Bytes that are put into the archive from the end of a log, and from the end of a trace; chosen.
_TAIL_BYTES = 64 << 10
_TRACE_BYTES = 4 << 20
# Bytes that are read of a key file, and of a manifest; chosen.
_KEY_BYTES = 64 << 10
_MANIFEST_BYTES = 64 << 20
_KERNEL = ("proc/version", "proc/sys/net/core/rmem_max", "proc/sys/net/core/rmem_default", "proc/loadavg",
           "proc/meminfo", "proc/net/udp", "proc/net/snmp")  # fmt: skip
# A secret after its name. The first group of the expression, which is kept, is a name that contains `token`, `password`
# or the like, or is that of a key, then `=` or `:`, perhaps quotes, perhaps `bearer` or `basic`; or it is only the word
# `bearer`. The second group, which is replaced, is the value: up to the closing quote if it is quoted, else a word.
_NAMED_SECRET = re.compile(
    r"""(?ix)((?:[\w-]*(?:secret|token|password|passwd|passphrase|psk)[\w-]*|(?:private|public|curve|api)[_-]?key
    |authorization)["']?\s*[=:]\s*["']?(?:bearer\s+|basic\s+)?|\bbearer\s+)
    ((?<=")[^"\n]+|(?<=')[^'\n]+|[^\s"',}]{2,})"""
)
# The password of `https://user:password@host`.
_IN_URL = re.compile(r"(://[^\s/:@]+:)[^\s/@]+(?=@)")
# Access tokens of GitHub, GitLab, OpenAI, Slack and AWS have these beginnings.
_TOKENS = re.compile(r"\b(?:gh[opsu]_|github_pat_|glpat-|sk-|xox[abp]-|AKIA)[A-Za-z0-9_-]{10,}")
_PEM = re.compile(r"-----BEGIN [^-]*KEY-----.*?(?:-----END [^-]*KEY-----|\Z)", re.DOTALL)


class Redactor:
    """Removes keys from text: keys in the files of `folders` by their content, others by their name or form."""

    def __init__(self, folders: Sequence[Path]) -> None:
        words: set[str] = set()
        for folder in folders:
            with suppress(OSError):
                for path in sorted(p for p in folder.iterdir() if p.is_file()):
                    with suppress(OSError, DataError):
                        text = read_bounded(path, _KEY_BYTES).decode("utf-8", "replace")
                        # A key may follow a "=", or contain one: the text is split with and without it. Words shorter
                        # than 16 characters are not keys, and removing them would make the files unreadable.
                        parts = re.split(r"[\s\"']+", text) + re.split(r"[\s\"'=]+", text)
                        words |= {word for word in parts if len(word) >= 16}
        self._words = sorted(words, key=len, reverse=True)

    def __call__(self, text: str) -> str:
        """Return the text with keys replaced by `REDACTION`."""
        for word in self._words:
            text = text.replace(word, REDACTION)
        text = _PEM.sub(REDACTION, text)
        for pattern in (_NAMED_SECRET, _IN_URL):
            text = pattern.sub(rf"\1{REDACTION}", text)
        return _TOKENS.sub(REDACTION, text)


def write_bundle(
    path: Path,
    options: DoctorOptions,
    rig: Instrument | None,
    findings: Sequence[Finding],
    text: str,
    root: Path = Path("/"),
) -> None:
    """Write the archive `path`; an existing file is overwritten.

    `rig` is None if the rig file could not be read; `text` is the printed form of `findings`; `root` is the root of
    the file system. Raises DeviceError if the file cannot be written.
    """
    key_folders = [options.config.resolve().parent / "keys"]
    if rig is not None and rig.pi.key_dir:
        key_folders.append(Path(rig.pi.key_dir))
    redact = Redactor(key_folders)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in _collect_contents(options, rig, findings, text, root):
            archive.writestr(name, redact(content))
    try:
        refuse_link(path)
        write_atomically(path, buffer.getvalue())
    except OSError as e:
        raise DeviceError(
            f"{path}: cannot be written: {e.strerror}", "the disk is full, or the path is wrong", "give another FILE"
        ) from None


def _collect_contents(
    options: DoctorOptions, rig: Instrument | None, findings: Sequence[Finding], text: str, root: Path
) -> Iterator[tuple[str, str]]:
    """Yield name and text of every file."""
    limits = {
        "utc": utc_now(),
        "lines": _MAX_LINES,
        "scans": _MAX_SCANS,
        "kilobytes": _TAIL_BYTES >> 10,
        "traces": _MAX_TRACES,
    }
    yield "README.txt", README.format(hidden=REDACTION, **limits)
    yield "findings.txt", text
    yield "findings.json", json.dumps([finding_to_json(f) for f in findings], indent=1)
    yield "versions.json", json.dumps(_list_versions(), indent=1)
    yield "kernel.txt", _describe_kernel(root)
    yield "network.json", json.dumps(_describe_network(root), indent=1)
    if (config := _read_tail(options.config, _TAIL_BYTES)) is not None:
        # Comments are private, and the addresses that are notified of a scan's end may be secret.
        config = re.sub(r"(?m)(^|[ \t])#.*$", "", config)
        yield "rig.toml", re.sub(r"(?m)^(\s*(?:url|command)\s*=\s*).+$", rf'\1"{REDACTION}"', config)
    scan_folders = [options.out, *(path for path in options.out.glob("*") if path.is_dir())]
    for newest_manifest in _find_newest(scan_folders, MANIFEST, _MAX_SCANS):
        folder = newest_manifest.parent
        with suppress(OSError, DataError):
            lines = read_bounded(folder / MANIFEST, _MANIFEST_BYTES).decode("utf-8", "replace").splitlines()
            yield f"scans/{folder.resolve().name}.jsonl", "\n".join(lines[-_MAX_LINES:]) + "\n"
    log_folders = [options.config.parent, options.config.parent / "logs", options.out, options.out / "logs"]
    yield from _collect_files("logs", _find_newest(log_folders, "*.log", _MAX_LOGS), _TAIL_BYTES)
    if rig is not None and rig.radar.trace_dir:
        yield from _collect_files("traces", _find_newest([Path(rig.radar.trace_dir)], "*", _MAX_TRACES), _TRACE_BYTES)


def _collect_files(folder: str, paths: Sequence[Path], max_bytes: int) -> Iterator[tuple[str, str]]:
    """Yield name in `folder` and the end of each file. Names are numbered, so that equal ones do not collide."""
    for number, path in enumerate(paths):
        if (text := _read_tail(path, max_bytes)) is not None:
            yield f"{folder}/{number}-{path.name}", text


def _read_tail(path: Path, max_bytes: int) -> str | None:
    """Return at most the last `max_bytes` bytes of a file as text; None if it cannot be read."""
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - max_bytes))
            return file.read(max_bytes).decode("utf-8", "replace")
    except OSError:
        return None


def _find_newest(folders: Sequence[Path], pattern: str, count: int) -> list[Path]:
    """Return the `count` newest files of some folders whose names match a pattern, without links."""
    paths = (path for folder in folders for path in folder.glob(pattern))
    matches = {path.resolve() for path in paths if path.is_file() and not path.is_symlink()}
    return sorted(matches, key=lambda p: (p.stat().st_mtime, p), reverse=True)[:count]


def _list_versions() -> dict[str, object]:
    """Return releases of this program, of Python and of all packages, and facts of the system."""
    system = {name: getattr(platform, name)() for name in ("platform", "machine", "python_version", "libc_ver")}
    installed = {d.metadata["Name"]: d.version for d in distributions()}
    return {**versions(), **system, "cores": os.cpu_count(), "packages": dict(sorted(installed.items()))}


def _describe_kernel(root: Path) -> str:
    """Return kernel, limits of this process and settings of the kernel under `root` as text."""
    limits = ("RLIMIT_RTPRIO", "RLIMIT_MEMLOCK", "RLIMIT_NOFILE", "RLIMIT_NICE")
    parts = [f"{platform.uname()}", *(f"{name} {resource.getrlimit(getattr(resource, name))}" for name in limits)]
    for name in _KERNEL:
        text = _read_tail(root / name, _TAIL_BYTES)
        if text is None:
            text = "not available"
        parts.append(f"== /{name}\n{text.rstrip()}")
    return "\n".join(parts) + "\n"


def _describe_network(root: Path) -> dict[str, object]:
    """Return the interfaces, and the kernel's tables of routes, neighbours and counters."""
    try:
        names = sorted(p.name for p in (root / "sys/class/net").iterdir())
    except OSError:
        names = []
    interfaces = [asdict(read_interface(name, root)) for name in names]
    tables = {name: _read_tail(root / "proc/net" / name, _TAIL_BYTES) for name in ("route", "arp", "dev")}
    return {"interfaces": interfaces, **tables}
