"""CURVE keys for addresses that are not loopback: the Pi's and its clients', and which clients are allowed.

`allowed_clients` in the key folder has a line for each client that may connect: its public key (40 characters) and its
name. Without that file `host.key` alone is allowed, as before there was one. It is read anew when it has changed.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import zmq.utils.z85

from polysight.pi_controller import PROGRAM
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
        self._seen: tuple[float, int] | None = None
        self._names: dict[str, str] = {}

    def name_of(self, key: bytes) -> str:
        """Name of the client with this public key (32 bytes); empty when it is not allowed."""
        path = self._folder / ALLOWED
        with suppress(OSError):  # gone or unreadable: what was allowed before stays so
            stat = path.stat()
            if self._seen != (stat.st_mtime_ns, stat.st_size):
                self._names = read_allowed(self._folder)
                self._seen = (stat.st_mtime_ns, stat.st_size)
        if self._seen is None:
            self._names = read_allowed(self._folder)
        return self._names.get(zmq.utils.z85.encode(key).decode("ascii"), "") if len(key) == 32 else ""


def read_allowed(folder: Path) -> dict[str, str]:
    """Public keys (Z85 text) and names of the clients that may connect. A key folder without the file allows `host`."""
    names: dict[str, str] = {}
    try:
        for line in (folder / ALLOWED).read_text(encoding="utf-8").splitlines():
            key, _, name = line.strip().partition(" ")
            if len(key) == KEY_CHARACTERS:
                names[key] = name.strip() or "nameless"
    except FileNotFoundError:
        with suppress(OSError, ValueError):
            names[_public(folder / "host.key")] = "host"
    return names


def _public(certificate: Path) -> str:
    from zmq.auth import load_certificate

    return load_certificate(certificate)[0].decode("ascii")


def _write_allowed(folder: Path, names: dict[str, str]) -> None:
    new = folder / (ALLOWED + ".new")
    new.write_text("".join(f"{key} {name}\n" for key, name in names.items()), encoding="utf-8")
    new.replace(folder / ALLOWED)


def allow(folder: Path, name: str) -> list[Path]:
    """Make keys for one more client and allow them. Returns its files; the secret one goes to the client alone.

    Raises
    ------
    ConfigError
        when the name is taken, or none, or the folder cannot be written.
    """
    from zmq.auth import create_certificates

    if not name.replace("-", "").replace("_", "").isalnum() or name in PARTIES or name in read_allowed(folder).values():
        raise ConfigError(f"client {name!r} cannot be added", "its name is taken, or has other signs than a-z 0-9 - _",
                          "choose another name, or revoke that client first")  # fmt: skip
    try:
        public, secret = map(Path, create_certificates(folder, name))
        secret.chmod(0o600)
        _write_allowed(folder, read_allowed(folder) | {_public(public): name})
    except OSError as e:
        raise _unwritable(folder, e) from None
    return [public, secret]


def revoke(folder: Path, name: str) -> None:
    """Allow this client no more, at once: its next command is refused, and it cannot connect. Raises ConfigError."""
    names = read_allowed(folder)
    left = {key: other for key, other in names.items() if other != name}
    if left == names:
        raise ConfigError(f"no client {name!r} is allowed", "a typing error", f"allowed: {', '.join(names.values())}")
    try:
        _write_allowed(folder, left)
    except OSError as e:
        raise _unwritable(folder, e) from None


def _unwritable(folder: Path, e: OSError) -> ConfigError:
    return ConfigError(
        f"keys cannot be written to {folder}: {e.strerror}",
        "another user's folder, or the disk is full",
        f"as the service's user: `sudo -u polysight {PROGRAM} keys`; or choose --dir",
    )


def make_keys(folder: Path, replace: bool = False) -> list[Path]:
    """Make `pi.key`, `pi.key_secret`, `host.key` and `host.key_secret`, the secret ones readable by the owner alone.

    Parameters
    ----------
    folder
        Made when absent.
    replace
        Whether keys that are there already may be replaced.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    ConfigError
        when there are keys already, or the folder cannot be written.
    """
    from zmq.auth import create_certificates

    made = []
    try:
        there = [p for name in PARTIES if (p := folder / f"{name}.key_secret").exists()]
        if there and not replace:
            raise ConfigError(
                f"{there[0]} exists",
                "keys were made before; new ones lock out every host that has the old ones",
                f"keep them, or give --replace, then {COPY}",
            )
        folder.mkdir(parents=True, exist_ok=True)
        for name in PARTIES:
            public, secret = map(Path, create_certificates(folder, name))
            secret.chmod(0o600)
            made += [public, secret]
        _write_allowed(folder, {_public(folder / "host.key"): "host"})
    except OSError as e:
        raise _unwritable(folder, e) from None
    return made
