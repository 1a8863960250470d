"""CURVE keys for addresses that are not loopback: the Pi's and its clients', and which clients are allowed.

`allowed_clients` in the key folder has a line for each client that may connect: its public key (40 characters) and its
name. Without that file `host.key` alone is allowed, as before there was one. It is read anew when it has changed.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import zmq.utils.z85
from zmq.auth import create_certificates, load_certificate

from polysight.shared.errors import ConfigError
from polysight.shared.sockets import HOST_KEYS

PARTIES = ("pi", "host")
ALLOWED = "allowed_clients"
KEY_CHARACTERS = 40
COPY = f"copy {' and '.join(HOST_KEYS)} to the host, into its pi.key_dir; pi.key_secret stays on the Pi"


class AllowedKeys:
    """The clients that may connect."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._names: dict[str, str] = {}
        self._seen = (-1, -1)
        with suppress(OSError):
            self._names = read_allowed(folder)

    def name_of(self, key: bytes) -> str:
        """Name of the client with this public key (32 bytes); empty when it is not allowed."""
        with suppress(OSError):  # gone or unreadable: what was allowed before stays so
            stat = (self._folder / ALLOWED).stat()
            if self._seen != (stat.st_mtime_ns, stat.st_size):
                self._names = read_allowed(self._folder)
                self._seen = (stat.st_mtime_ns, stat.st_size)
        return self._names.get(zmq.utils.z85.encode(key).decode("ascii"), "") if len(key) == 32 else ""


def read_allowed(folder: Path) -> dict[str, str]:
    """Public keys (Z85 text) and names of the clients that may connect. A key folder without the file allows `host`."""
    try:
        lines = (folder / ALLOWED).read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        with suppress(OSError, ValueError):
            return {_public(folder, "host"): "host"}
        return {}
    keys = (line.strip().partition(" ") for line in lines)
    return {key: name.strip() or "nameless" for key, _, name in keys if len(key) == KEY_CHARACTERS}


# --- for `polysight-pi keys`: these raise ConfigError, or OSError when the folder cannot be written -------------------


def make_keys(folder: Path, replace: bool = False) -> list[Path]:
    """Make `pi.key`, `pi.key_secret`, `host.key` and `host.key_secret`, the secret ones readable by the owner alone.

    Returns the files. Raises ConfigError when there are keys already (unless `replace`).
    """
    there = [p for name in PARTIES if (p := folder / f"{name}.key_secret").exists()]
    if there and not replace:
        raise ConfigError(
            f"{there[0]} exists",
            "keys were made before; new ones lock out every host that has the old ones",
            f"keep them, or give --replace, then {COPY}",
        )
    folder.mkdir(parents=True, exist_ok=True)
    made = [path for name in PARTIES for path in _create(folder, name)]
    _write_allowed(folder, {_public(folder, "host"): "host"})
    return made


def allow(folder: Path, name: str) -> list[Path]:
    """Make keys for one more client and allow them. Returns its files; the secret one goes to the client alone."""
    if not name.replace("-", "").replace("_", "").isalnum() or name in PARTIES or name in read_allowed(folder).values():
        raise ConfigError(
            f"client {name!r} cannot be added",
            "its name is taken, or has other signs than a-z 0-9 - _",
            "choose another name, or revoke that client first",
        )
    made = _create(folder, name)
    _write_allowed(folder, read_allowed(folder) | {_public(folder, name): name})
    return made


def revoke(folder: Path, name: str) -> None:
    """Allow this client no more, at once: its next command is refused, and it cannot connect."""
    names = read_allowed(folder)
    left = {key: other for key, other in names.items() if other != name}
    if left == names:
        raise ConfigError(f"no client {name!r} is allowed", "a typing error", f"allowed: {', '.join(names.values())}")
    _write_allowed(folder, left)


def _public(folder: Path, name: str) -> str:
    return load_certificate(folder / f"{name}.key")[0].decode("ascii")


def _create(folder: Path, name: str) -> list[Path]:
    public, secret = map(Path, create_certificates(folder, name))
    secret.chmod(0o600)
    return [public, secret]


def _write_allowed(folder: Path, names: dict[str, str]) -> None:
    new = folder / (ALLOWED + ".new")
    new.write_text("".join(f"{key} {name}\n" for key, name in names.items()), encoding="utf-8")
    new.replace(folder / ALLOWED)
