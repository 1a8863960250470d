"""Programs compiled on demand, once for the same sources and command; the sketch compiled for this machine is one."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from polysight.shared.errors import DeviceError

SKETCH_DIR = Path(__file__).resolve().parents[1] / "arduino_stage"
FOLDER = SKETCH_DIR / "build"  # ignored by git, removed by `make clean`
_FLAGS = ("-std=gnu++11", "-O2", "-Wall", "-Wextra", "-fno-exceptions", "-fno-rtti")


def compiled(product: str, sources: Iterable[Path], command: Sequence[str], on_failure: tuple[str, str]) -> Path:
    """The file that `command` makes of `sources`; the command runs only when there is none of these very sources yet.

    Parameters
    ----------
    product
        Name of the file the command makes, such as "stage" or "arduino_stage.hex".
    sources
        Every file the result depends on, headers and build files too.
    command
        Its words; each "{folder}" in them stands for the folder where it must leave `product`.
    on_failure
        Why it may have failed and what to do, for the error.

    Returns
    -------
    Path
        Named by the product and the hash of sources and command: in arduino_stage/build; where that cannot be written,
        in ~/.cache/polysight/build; else in a folder of this user's below the temporary folder. Several processes may
        ask at once.

    Raises
    ------
    DeviceError
        when the command fails or cannot be started; its message is part of the error.
    """
    digest = hashlib.sha256("\0".join(command).encode())
    for path in sorted(sources):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    name = f"{Path(product).stem}-{digest.hexdigest()[:16]}{Path(product).suffix}"
    if (FOLDER / name).is_file():  # also where it may be read only
        return FOLDER / name
    result = _folder() / name
    if result.is_file():
        return result
    with tempfile.TemporaryDirectory(prefix=".making-", dir=result.parent) as folder:
        _run([word.replace("{folder}", folder) for word in command], product, on_failure)
        (Path(folder) / product).replace(result)  # at once: who comes meanwhile sees all of it or nothing
    return result


def _run(command: list[str], product: str, on_failure: tuple[str, str]) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        message, failed = done.stderr.strip(), done.returncode != 0
    except OSError as e:
        message, failed = str(e), True
    if failed:
        raise DeviceError(f"{product} does not compile on this machine:\n{message}", *on_failure)


def _folder() -> Path:
    """The folder for compiled programs, made when absent. Raises DeviceError when the last choice is another user's."""
    places = [FOLDER]
    with suppress(RuntimeError):  # a user without a home
        places.append(Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "polysight" / "build")
    for folder in places:
        try:
            folder.mkdir(exist_ok=True, parents=folder != FOLDER)  # no arduino_stage: installed without the repository
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    fallback = Path(tempfile.gettempdir()) / f"polysight-build-{os.getuid()}"
    fallback.mkdir(mode=0o700, exist_ok=True)
    if fallback.stat().st_uid != os.getuid():
        raise DeviceError(f"{fallback} belongs to another user", "somebody made it first", "set TMPDIR")
    return fallback


def sketch_compiler() -> str | None:
    """The C++ compiler's path; None without one, or without the sketch's sources."""
    return shutil.which("g++") if (SKETCH_DIR / "pc" / "main.cpp").is_file() else None


def build_sketch(gxx: str, flags: tuple[str, ...] = _FLAGS) -> Path:
    """The sketch compiled for this machine. Raises DeviceError when the compiler fails."""
    sources = [*SKETCH_DIR.glob("*.cpp"), *(SKETCH_DIR / "pc").glob("*.cpp")]
    headers = [*SKETCH_DIR.glob("*.h"), *(SKETCH_DIR / "pc").glob("*.h")]
    return compiled(
        "stage",
        [*sources, *headers],
        [gxx, *flags, "-o", "{folder}/stage", *map(str, sorted(sources))],
        (
            "the sources were changed, or the compiler is too old",
            "correct them, or use the Python stand-in: --python",
        ),
    )
