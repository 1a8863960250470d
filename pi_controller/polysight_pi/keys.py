"""CURVE keys for addresses that are not loopback, and the list of allowed clients.

`allowed_clients` in the key folder has one line per client that may connect: its public key (40 characters) and its
name. Without that file only `host.key` is allowed, as in earlier releases. A changed file is read again.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import zmq.utils.z85
from zmq.auth import create_certificates, load_certificate

from polysight_shared.errors import ConfigError, ErrorCode, quote
from polysight_shared.sockets import HOST_KEYS, PI_SECRET_KEY, advise_keys

# Names of the two pairs of keys that `make_keys` makes.
KEY_PAIRS = ("pi", "host")
# File with the list of allowed clients.
ALLOWED_FILE = "allowed_clients"
# Length of a public key of 32 bytes in Z85 (ZeroMQ RFC 32: 5 characters for 4 bytes).
KEY_CHARACTERS = 40
# Instruction in messages after keys were made.
COPY_INSTRUCTION = f"copy {' and '.join(HOST_KEYS)} to the host, into its pi.key_dir; pi.key_secret stays on the Pi"


class AllowedKeys:
    """The clients that may connect, by the list in the key folder; a changed list is read again at the next query."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        # Names of the clients, by public key (Z85 text).
        self._names: dict[str, str] = {}
        # Time and size of the file when it was last read.
        self._stamp = (-1, -1)
        with suppress(OSError, ConfigError):
            self._names = read_allowed(folder)

    def client_name(self, key: bytes) -> str:
        """Return the name of the client with this public key (32 bytes), or "" if it is not allowed."""
        # Keep the last list if the file is missing or unreadable.
        with suppress(OSError, ConfigError):
            stat = (self._folder / ALLOWED_FILE).stat()
            stamp = (stat.st_mtime_ns, stat.st_size)
            if self._stamp != stamp:
                self._names = read_allowed(self._folder)
                self._stamp = stamp
        if len(key) == 32:
            return self._names.get(zmq.utils.z85.encode(key).decode("ascii"), "")
        return ""


def read_allowed(folder: Path) -> dict[str, str]:
    """Return the names of the clients that may connect, by public key (Z85 text).

    Raises ConfigError if the list is not text, OSError if it cannot be read.
    """
    try:
        lines = (folder / ALLOWED_FILE).read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        path = folder / ALLOWED_FILE
        raise ConfigError(
            f"{path} is not a list of clients",
            "the file is damaged; no client can connect",
            f"remove it, so that the host alone is allowed: `rm {quote(path)}`; then add the other clients again",
            code=ErrorCode.FILE_DAMAGED,
        ) from None
    except FileNotFoundError:
        with suppress(OSError, ValueError):
            return {_derive_public(folder, "host"): "host"}
        return {}
    keys = (line.strip().partition(" ") for line in lines)
    return {key: name.strip() or "nameless" for key, _, name in keys if len(key) == KEY_CHARACTERS}


# --- `polysight-pi keys`: these raise ConfigError, or OSError if the folder cannot be written -------------------------


def make_keys(folder: Path, replace: bool = False) -> list[Path]:
    """Make `pi.key`, `pi.key_secret`, `host.key` and `host.key_secret`; secret files are readable by the owner only.

    Only the host is allowed then: keys of other clients leave the list. Returns the files. Raises ConfigError if there
    are keys already, unless `replace`.
    """
    existing = [p for name in KEY_PAIRS if (p := folder / f"{name}.key_secret").exists()]
    if existing and not replace:
        raise ConfigError(
            f"{existing[0]} exists",
            "keys were made before; new ones lock out every host that has the old ones",
            f"keep them, or give --replace, then {COPY_INSTRUCTION}",
            code=ErrorCode.FILE_EXISTS,
        )
    folder.mkdir(parents=True, exist_ok=True)
    files = [path for name in KEY_PAIRS for path in _create_pair(folder, name)]
    _write_allowed(folder, {_derive_public(folder, "host"): "host"})
    return files


def allow_client(folder: Path, name: str) -> list[Path]:
    """Make keys for one more client and allow it. Return its files; the secret one is for that client only.

    Raises ConfigError if the name is taken or not valid, or before the keys of the Pi are made.
    """
    if not (folder / PI_SECRET_KEY).exists():
        summary = f"{folder} has no keys of the Pi"
        raise ConfigError(summary, "they were not made yet", advise_keys(folder), code=ErrorCode.FILE_MISSING)
    if (
        not name.replace("-", "").replace("_", "").isalnum()
        or name in KEY_PAIRS
        or name in read_allowed(folder).values()
    ):
        raise ConfigError(
            f"client {name!r} cannot be added",
            "its name is taken, or has characters other than letters, digits, - and _",
            "choose another name, or revoke that client first",
            code=ErrorCode.NAME_TAKEN,
        )
    files = _create_pair(folder, name)
    _write_allowed(folder, read_allowed(folder) | {_derive_public(folder, name): name})
    return files


def revoke_client(folder: Path, name: str) -> None:
    """Remove a client from the list: its next command is refused, and it cannot connect again."""
    names = read_allowed(folder)
    remaining = {key: client for key, client in names.items() if client != name}
    if remaining == names:
        remedy = f"allowed: {', '.join(names.values()) or 'no client'}"
        raise ConfigError(f"no client {name!r} is allowed", "a typing error", remedy, code=ErrorCode.KEY_UNKNOWN)
    _write_allowed(folder, remaining)


def _derive_public(folder: Path, name: str) -> str:
    """Return the public key in `name`.key, Z85 text."""
    return load_certificate(folder / f"{name}.key")[0].decode("ascii")


def _create_pair(folder: Path, name: str) -> list[Path]:
    """Create a pair of key files, public and secret; the secret one is readable by the owner only."""
    try:
        public, secret = map(Path, create_certificates(folder, name))
    except OSError as e:
        # pyzmq writes the files without naming them in an error of the disk.
        e.filename = e.filename or str(folder / f"{name}.key")
        raise
    secret.chmod(0o600)
    return [public, secret]


def _write_allowed(folder: Path, names: dict[str, str]) -> None:
    """Replace the list of allowed clients (names by public key) as a whole."""
    new = folder / (ALLOWED_FILE + ".new")
    new.write_text("".join(f"{key} {name}\n" for key, name in names.items()), encoding="utf-8")
    new.replace(folder / ALLOWED_FILE)
