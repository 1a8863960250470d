"""Compile the loops of `burst.c` and `direct_path.c` into `kernels.so`: `python -m polysight.sync.build`.

`setup.py` does this when the package is installed, with the system's C compiler or that of the package `ziglang`. This
module uses only the standard library, for nothing else is available during installation.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

HERE = Path(__file__).resolve().parent
LIBRARY = "kernels.so"
SOURCES = ("burst.c", "direct_path.c")
"""Compiled once per vector width."""

# Multiplications and additions may be fused and sums rearranged, so that loops are vectorised.
_FLAGS = "-std=c99 -Werror=implicit-function-declaration -O3 -fPIC"
_FLAGS += " -fopenmp-simd -ffp-contract=fast -fno-math-errno -fno-trapping-math -fno-signed-zeros"
# -fassociative-math instead of -ffast-math: linked with that, a library may make the whole process, other libraries
# too, flush subnormal numbers to zero.
_FLAGS += " -fassociative-math"
# Flags by width of the vectors in bits: at run time the widest is used that the processor has.
_WIDTHS = {
    128: "",
    256: "-mavx2 -mfma",
    512: "-mavx512f -mavx512bw -mavx512dq -mavx512vl -mfma -mprefer-vector-width=512",
}
TARGETS = {
    "manylinux_2_17_x86_64": "x86_64-linux-gnu.2.17",
    "manylinux_2_17_aarch64": "aarch64-linux-gnu.2.17",
}
"""Platforms of wheels for other machines, with their names for `zig cc`."""


class BuildError(Exception):
    """No compiler was found, or it failed."""


def source_digest() -> str:
    """Return 16 hex digits that change with the C sources and headers.

    They are the last bytes of a library's file, so that one of older sources, or one that was cut, is not loaded.
    """
    digest = hashlib.sha256()
    for path in sorted([*HERE.glob("*.c"), *HERE.glob("*.h")]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def find_compiler(environment: Mapping[str, str] = os.environ) -> list[str] | None:
    """Return the command of a C compiler: $CC, the system's or ziglang's; None without any."""
    if environment.get("CC"):
        return shlex.split(environment["CC"])
    for name in ("cc", "gcc", "clang"):
        path = shutil.which(name, path=environment.get("PATH"))
        if path:
            return [path]
    return _find_zig()


def build(folder: Path = HERE, target: str = "") -> Path:
    """Compile the library into a folder and return its path.

    `target` is a key of `TARGETS` for another machine; "": this machine.

    Raises
    ------
    BuildError
        if there is no compiler, or it fails.
    """
    # Imported here, because `loops.py` imports this module and needs no threads.
    from concurrent.futures import ThreadPoolExecutor

    compiler = _find_zig() if target else find_compiler()
    if compiler is None:
        raise BuildError("no C compiler was found")
    if target:
        compiler = [*compiler, "-target", TARGETS[target]]
    machine = target or platform.machine().lower()
    widths = _WIDTHS if machine.endswith(("x86_64", "amd64")) else {128: ""}
    with tempfile.TemporaryDirectory(prefix="polysight-build-") as build_folder:
        # Source with its flags, and the name of its object file.
        jobs = [
            ([source, f"-DWIDTH={bits}", *flags.split()], f"{source}-{bits}.o")
            for bits, flags in widths.items()
            for source in SOURCES
        ]
        # Finds the processor's width at run time.
        jobs.append((["width.c"], "width.o"))
        with ThreadPoolExecutor(os.cpu_count()) as workers:
            commands = [
                [*compiler, *_FLAGS.split(), "-c", *arguments, "-o", f"{build_folder}/{name}"]
                for arguments, name in jobs
            ]
            list(workers.map(_run, commands))
        library = f"{build_folder}/{LIBRARY}"
        objects = [f"{build_folder}/{name}" for _, name in jobs]
        # ziglang links its own checks of undefined behaviour unless an option forbids it.
        _run([*compiler, "-O3", "-fno-sanitize=undefined", "-s", "-shared", "-o", library, *objects, "-lm"])
        new = folder / f".{LIBRARY}-{os.getpid()}"
        new.write_bytes(Path(library).read_bytes() + source_digest().encode())
        # Replaced by a rename: programs that have loaded the old library keep it.
        new.replace(folder / LIBRARY)
    return folder / LIBRARY


def _find_zig() -> list[str] | None:
    """Return the command of the package `ziglang`; None without it."""
    if importlib.util.find_spec("ziglang") is None:
        return None
    return [sys.executable, "-m", "ziglang", "cc"]


def _run(command: Sequence[str]) -> None:
    """Run a command in the folder of the sources. Raises BuildError with its messages if it fails."""
    try:
        completed = subprocess.run(command, cwd=HERE, capture_output=True, text=True, check=False)
    except OSError as e:
        raise BuildError(f"{shlex.join(command)}\n{e}") from None
    if completed.returncode != 0:
        raise BuildError(f"{shlex.join(command)}\n{completed.stderr.strip()}")


def main() -> int:
    """Compile for this machine; the library lies in the folder of this file."""
    try:
        sys.stdout.write(f"{build()}\n")
    except (BuildError, OSError) as e:
        sys.stderr.write(f"{e}\ninstall a C compiler (apt install gcc, or pip install ziglang) and run this again\n")
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
