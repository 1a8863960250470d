"""CURVE keys for addresses that are not loopback."""

from __future__ import annotations

from pathlib import Path

from polysight.pi_controller.finding import PROGRAM
from polysight.shared.errors import ConfigError
from polysight.shared.sockets import HOST_KEYS

PARTIES = ("pi", "host")
COPY = f"copy {' and '.join(HOST_KEYS)} to the host, into its pi.key_dir; pi.key_secret stays on the Pi"


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
    except OSError as e:
        raise ConfigError(
            f"keys cannot be written to {folder}: {e.strerror}",
            "another user's folder, or the disk is full",
            f"as the service's user: `sudo -u polysight {PROGRAM} keys`; or choose --dir",
        ) from None
    return made
