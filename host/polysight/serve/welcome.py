"""What a server prints when it starts: its addresses with the token, what they allow, and a QR code for a phone."""

from __future__ import annotations

import ipaddress
import socket
import struct
import sys
from contextlib import suppress

from polysight.serve.guard import Access

# linux/sockios.h
SIOCGIFADDR = 0x8915
# A documentation address (RFC 5737): it stands for every network that is reached by the default route.
ELSEWHERE = ("203.0.113.1", 9)
# One character shows two modules of the code, the keys say whether the upper and the lower one are dark. Colours are
# given, black on white, since the terminal's own may be either way round and a camera reads no inverted code.
HALF_BLOCKS = {(0, 0): " ", (1, 0): "\u2580", (0, 1): "\u2584", (1, 1): "\u2588"}
BLACK_ON_WHITE = "\033[38;5;16;48;5;231m"
RESET = "\033[0m"


def describe_server(access: Access, what: str, bound: tuple[str, int]) -> str:
    """Return the text for a server of `what` ("scans") on the address and port to which its socket is `bound`."""
    host, port = bound
    if host in ("0.0.0.0", "::"):
        names = [*find_addresses(), socket.gethostname()]
    else:
        names = [host]
    scheme = "https" if access.secure else "http"
    token = f"#token={access.token}" if access.token else ""
    addresses = [f"{scheme}://{f'[{name}]' if ':' in name else name}:{port}/{token}" for name in names]
    lines = [f"{what}: {addresses[0]}"]
    if addresses[1:]:
        lines.append("in other networks of this machine, or by its name:")
        lines += [f"  {address}" for address in addresses[1:]]
    if access.control:
        lines.append("anyone with this address and its token can start, pause and stop scans")
    else:
        lines.append("read-only; buttons come with `serve` without --read-only, or `preview` with --control")
    if not ipaddress.ip_address(host).is_loopback:
        warning = "" if access.secure else "; nothing is encrypted: --certificate and --key do that"
        lines.append(f"anyone who reaches this machine and has the token can read all scans{warning}")
        if sys.stderr.isatty():
            lines.append(draw_code(addresses[0]))
    lines.append("Ctrl-C ends the page; started programs go on\n")
    return "\n".join(line for line in lines if line)


def find_addresses() -> list[str]:
    """Return the IPv4 addresses of this machine in its networks, that of the default route first.

    An interface with several addresses counts with its first; systems without these calls have none.
    """
    addresses: list[str] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        with suppress(OSError):
            # A datagram socket that is connected sends nothing, and gets the address it would send from.
            probe.connect(ELSEWHERE)
            addresses.append(probe.getsockname()[0])
        with suppress(OSError, ModuleNotFoundError):
            # A module of POSIX systems; this file is imported on others, too.
            import fcntl

            for _, interface in socket.if_nameindex():
                with suppress(OSError):
                    answer = fcntl.ioctl(probe, SIOCGIFADDR, struct.pack("256s", interface.encode()))
                    # struct ifreq: name (16 bytes), family and port (4), address.
                    addresses.append(socket.inet_ntoa(answer[20:24]))
    return [address for address in dict.fromkeys(addresses) if not ipaddress.ip_address(address).is_loopback]


def draw_code(address: str) -> str:
    """Draw the address as a QR code, two rows of modules a line; "" without the library."""
    try:
        import segno
    except ImportError:
        return ""
    rows = [*segno.make(address, error="l").matrix_iter()]
    if len(rows) % 2:
        rows.append(bytearray(len(rows)))
    lines = []
    for upper, lower in zip(rows[::2], rows[1::2], strict=True):
        blocks = "".join(HALF_BLOCKS[pair] for pair in zip(upper, lower, strict=True))
        lines.append(f"{BLACK_ON_WHITE}{blocks}{RESET}")
    return "\n".join(lines)
