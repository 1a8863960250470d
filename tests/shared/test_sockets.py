"""Sockets of host and Pi: an address that cannot be bound is refused with the likely cause."""

import errno
from pathlib import Path
from unittest.mock import Mock

import pytest
import zmq

from polysight_shared.errors import ConfigError, DeviceError, ErrorCode
from polysight_shared.sockets import create_replier, host_name


@pytest.mark.parametrize(
    ("number", "cause", "remedy", "code"),
    [
        (zmq.EADDRINUSE, "another program", "ss -ltnp", ErrorCode.BUSY),
        (errno.EACCES, "may not", "1024", ErrorCode.OTHER),
        (errno.EPERM, "may not", "1024", ErrorCode.OTHER),
        (zmq.EADDRNOTAVAIL, "does not exist on this machine", "instrument.toml", ErrorCode.OTHER),
        (errno.ENODEV, "does not exist on this machine", "instrument.toml", ErrorCode.OTHER),
        (errno.EMFILE, "refuses", "instrument.toml", ErrorCode.OTHER),
    ],
)
def test_an_address_that_cannot_be_bound_is_refused_with_its_cause(
    tmp_path: Path, number: int, cause: str, remedy: str, code: ErrorCode
) -> None:
    """`number` is the error number of the operating system or of libzmq."""
    context = Mock()
    socket = context.socket.return_value
    socket.bind.side_effect = zmq.ZMQError(number)
    with pytest.raises(DeviceError) as caught:
        create_replier(context, "tcp://127.0.0.1:80", tmp_path)
    assert caught.value.code == code
    assert zmq.strerror(number) in caught.value.what
    assert cause in caught.value.why
    assert remedy in caught.value.remedy
    socket.close.assert_called_once_with()


@pytest.mark.parametrize("port", ["65536", "99999", "²", "9" * 5000, "-1", ""])
def test_a_port_that_does_not_exist_is_refused(port: str) -> None:
    """libzmq keeps the last 16 bits of a number: it would bind port 34463 for 99999."""
    with pytest.raises(ConfigError) as caught:
        host_name(f"tcp://127.0.0.1:{port}")
    assert caught.value.code == ErrorCode.VALUE_INVALID


def test_the_highest_port_is_accepted() -> None:
    assert host_name("tcp://127.0.0.1:65535") == "127.0.0.1"
