"""Files that come with the package: the rig file `instrument.toml` and the scenes of `examples/`."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).parent
_REPOSITORY = _PACKAGE.parents[2]

# `host/setup.py` copies the files into a wheel. Sources used in place find them at the top of the repository.
FOLDER = _PACKAGE if (_PACKAGE / "instrument.toml").exists() else _REPOSITORY


def find_packaged(path: Path) -> Path:
    """Return `path` if it exists, else the file or folder of that name that comes with the package, else `path`.

    So `instrument.toml` and `examples/demo.toml` are found from any folder, and a file of one's own comes
    first.
    """
    packaged_path = FOLDER / path
    if path.is_absolute() or path.exists() or not packaged_path.exists():
        return path
    return packaged_path
