"""Write structs as JSON, and read them back from files of any release."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from polysight_shared.errors import DataError, ErrorCode
from polysight_shared.files import read_json
from polysight_shared.findings import Finding

T = TypeVar("T")


def to_plain(value: Any) -> Any:
    """Convert a value to strict JSON types.

    Structs become objects without their UNSET fields, numpy arrays lists, complex numbers {real, imag}, numbers that
    are not finite None, findings {what, why, do}, and anything else its text.
    """
    if isinstance(value, Finding):
        return {"what": value.what, "why": value.why, "do": value.do}
    if isinstance(value, msgspec.Struct):
        fields = {name: getattr(value, name) for name in value.__struct_fields__}
        return {name: to_plain(item) for name, item in fields.items() if item is not msgspec.UNSET}
    if isinstance(value, dict):
        return {str(k): to_plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return to_plain(value.tolist())
    if isinstance(value, np.generic):
        return to_plain(value.item())
    if isinstance(value, complex):
        return {"real": to_plain(value.real), "imag": to_plain(value.imag)}
    if isinstance(value, float):
        if not math.isfinite(value):
            return None
        return value
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)


def format_one_line(finding: Finding) -> str:
    """Return a finding as one line of text: what, why and remedy."""
    head = ": ".join(part for part in (finding.what, finding.why) if part)
    return "; ".join(part for part in (head, finding.do) if part)


def encode_json(content: Any) -> str:
    """Return a value as the text of a JSON file, see :func:`to_plain`."""
    return json.dumps(to_plain(content), indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def read_object(path: Path) -> dict[str, Any] | None:
    """Read a JSON file that holds an object; None if it is missing. Raises DataError if it is damaged."""
    try:
        content = read_json(path)
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as e:
        raise damage_error(path, str(e)) from None
    if not isinstance(content, dict):
        raise damage_error(path, "not a JSON object")
    return content


def convert(content: dict[str, Any], kind: type[T], path: Path) -> T:
    """Convert the content of a file to its struct; unknown keys are ignored. Raises DataError."""
    try:
        # The keys of a JSON object are text, also where they stand for numbers.
        return msgspec.convert(content, kind, str_keys=True)
    except msgspec.ValidationError as e:
        raise damage_error(path, str(e)) from None


def damage_error(path: Path, what: str) -> DataError:
    """Return the error of a product that cannot be read."""
    return DataError(
        f"{path}: cannot be read: {what}",
        "it was changed or damaged",
        "process the scan again",
        code=ErrorCode.FILE_DAMAGED,
    )
