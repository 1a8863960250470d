"""Compile programs on demand and cache them by their sources and command, such as the sketch for this machine."""

import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from polysight_shared.errors import DeviceError

SKETCH_DIR = Path(__file__).resolve().parents[2] / "arduino_stage"
# Ignored by git, removed by `make clean`.
FOLDER = SKETCH_DIR / "build"
# The language and the restrictions of the Arduino build, with warnings: what compiles here shall compile there.
_FLAGS = ("-std=gnu++11", "-O2", "-Wall", "-Wextra", "-fno-exceptions", "-fno-rtti")


def compile_once(product: str, sources: Iterable[Path], command: Sequence[str], on_failure: tuple[str, str]) -> Path:
    """Run `command` to make a file of `sources`, unless these sources were already compiled.

    Parameters
    ----------
    product
        Name of the file that the command makes, such as "stage" or "arduino_stage.hex".
    sources
        All files on which the result depends, with headers and build files.
    command
        Arguments; "{folder}" is replaced by the folder where it must write `product`.
    on_failure
        Cause and remedy for the error.

    Returns
    -------
    Path
        A file named after the product and the hash of sources and command, in arduino_stage/build,
        ~/.cache/polysight/build, or a temporary folder of this user: the first that is writable. Safe with several
        processes.

    Raises
    ------
    DeviceError
        if the command fails; the error has its message.
    """
    digest = hashlib.sha256("\0".join(command).encode())
    for path in sorted(sources):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    name = f"{Path(product).stem}-{digest.hexdigest()[:16]}{Path(product).suffix}"
    # A file that is there is used, from a read-only folder too.
    if (FOLDER / name).is_file():
        return FOLDER / name
    result = _make_folder() / name
    if result.is_file():
        return result
    with tempfile.TemporaryDirectory(prefix=".making-", dir=result.parent) as folder:
        _run([word.replace("{folder}", folder) for word in command], product, on_failure)
        # The rename is atomic: other processes see a complete file or none.
        (Path(folder) / product).replace(result)
    return result


def _run(command: list[str], product: str, on_failure: tuple[str, str]) -> None:
    """Run the compiler. Raises DeviceError with its messages, and `on_failure` as cause and remedy, if it fails."""
    try:
        process = subprocess.run(command, capture_output=True, text=True, check=False)
        message = process.stderr.strip()
        failed = process.returncode != 0
    except OSError as e:
        message = str(e)
        failed = True
    if failed:
        raise DeviceError(f"{product} does not compile on this machine:\n{message}", *on_failure)


def _make_folder() -> Path:
    """Return a writable folder for compiled programs. Raises DeviceError if the temporary one is another user's."""
    places = [FOLDER]
    # The user may have no home folder.
    with suppress(RuntimeError):
        places.append(Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "polysight" / "build")
    for folder in places:
        try:
            # Without the repository there is no arduino_stage.
            folder.mkdir(exist_ok=True, parents=folder != FOLDER)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    fallback = Path(tempfile.gettempdir()) / f"polysight-build-{os.getuid()}"
    fallback.mkdir(mode=0o700, exist_ok=True)
    if fallback.stat().st_uid != os.getuid():
        raise DeviceError(f"{fallback} belongs to another user", "another user created it", "set TMPDIR")
    return fallback


def sketch_compiler() -> str | None:
    """Return the C++ compiler's path; None if it or the sketch's sources are missing."""
    if (SKETCH_DIR / "pc" / "main.cpp").is_file():
        return shutil.which("g++")
    return None


def build_sketch(gxx: str, flags: tuple[str, ...] = _FLAGS) -> Path:
    """Compile the sketch for this machine. Raises DeviceError if the compiler fails."""
    sources = [*SKETCH_DIR.glob("*.cpp"), *(SKETCH_DIR / "pc").glob("*.cpp")]
    headers = [*SKETCH_DIR.glob("*.h"), *(SKETCH_DIR / "pc").glob("*.h")]
    return compile_once(
        "stage",
        [*sources, *headers],
        [gxx, *flags, "-o", "{folder}/stage", *map(str, sorted(sources))],
        (
            "the sources were changed, or the compiler is too old",
            "correct them, or use the Python simulator: --python",
        ),
    )
