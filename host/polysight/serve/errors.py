"""Errors as answers: a code for programs and the three parts that people read."""

from __future__ import annotations

import sys
import traceback
from typing import Any

from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response

from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DataError, DeviceError, PolysightError, os_error


def refuse(status: int, code: ErrorCode, problem: str, why: str, do: str) -> Response:
    """An error as JSON: its code, and the three parts that people read."""
    return JSONResponse({"code": code, "what": problem, "why": why, "do": do}, status)


async def tell_error(request: Request, e: Exception) -> Response:
    """An error that was raised. A file that cannot be written or read is no defect of this program."""
    if isinstance(e, OSError):
        error = os_error(e)
    else:
        error = e
    if not isinstance(error, PolysightError):
        raise e
    wrong_values = (ErrorCode.VALUE_INVALID, ErrorCode.VALUES_CONFLICT, ErrorCode.TYPE_WRONG, ErrorCode.KEY_MISSING)
    if isinstance(error, ConfigError) or (request.method == "POST" and error.code in wrong_values):
        status = 400
    elif isinstance(error, DataError):
        status = 404
    elif isinstance(error, DeviceError) and error.code is ErrorCode.NO_ANSWER:
        status = 503
    else:
        status = 409
    return refuse(status, error.code, error.what, error.why, error.remedy)


async def tell_no_page(request: Request, e: Exception) -> Response:
    """An address that leads nowhere."""
    del request, e
    return refuse(404, ErrorCode.OTHER, "There is no such page", "the address is wrong", "begin at the list of scans")


async def _tell_nobody(request: Request, e: Exception) -> Response:
    """The client disconnected in the middle of its request."""
    del request, e
    return Response(status_code=400)


async def _tell_defect(request: Request, e: Exception) -> Response:
    sys.stderr.write(f"{request.method} {request.url.path}\n{''.join(traceback.format_exception(e))}")
    sys.stderr.flush()
    problem = f"An internal error of the server: {type(e).__name__}"
    do = "report it, with the server's terminal output"
    return refuse(500, ErrorCode.OTHER, problem, "a defect of this program", do)


HANDLERS: dict[Any, Any] = {
    PolysightError: tell_error,
    OSError: tell_error,
    ClientDisconnect: _tell_nobody,
    404: tell_no_page,
    Exception: _tell_defect,
}
