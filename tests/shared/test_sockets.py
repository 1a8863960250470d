"""Sockets of host and Pi: an address that cannot be bound is refused with the likely cause."""

import errno
from pathlib import Path
from unittest.mock import Mock

import pytest
import zmq

from polysight_shared.errors import DeviceError, ErrorCode
from polysight_shared.sockets import create_replier


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
