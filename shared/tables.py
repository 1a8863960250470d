"""TOML and JSON tables checked against a typed declaration, and back; what declarations are made of.

Unknown keys, wrong types and broken rules are refused with the file, the key, the value and the rule.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec

from polysight.shared.error_codes import ErrorCode
from polysight.shared.errors import ConfigError, DataError, did_you_mean
from polysight.shared.files import read_bounded

_MOST_BYTES = 64 << 20
T = TypeVar("T")
Positive = Annotated[float, msgspec.Meta(gt=0)]
_RIG_KEYS = "instrument.toml in the repository shows every key with its meaning"
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table of the rig file: frozen, unknown keys refused."""


def require(ok: bool, rule: str) -> None:
    """Hold a rule of a table. Raises ValueError, which the reader of the file turns into words."""
    if not ok:
        raise ValueError(rule)


def read_toml(path: Path) -> dict[str, Any]:
    """Parse a TOML file. Raises ConfigError when it is absent, unreadable or not TOML."""
    try:
        return tomllib.loads(read_bounded(path, _MOST_BYTES).decode("utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file", "the path is wrong", "give the path of a TOML file") from None
    except (OSError, UnicodeDecodeError, DataError) as e:
        raise ConfigError(f"{path}: cannot be read: {e}", "not a readable text file", "check the path") from None
    except (tomllib.TOMLDecodeError, RecursionError) as e:
        raise ConfigError(
            f"{path}: not valid TOML: {e}", "a typing error", "correct that line", code=ErrorCode.FILE_DAMAGED
        ) from None


def decode(raw: dict[str, Any], kind: type[T], source: str, keys: str = "") -> T:
    """Check a parsed TOML or JSON table against a typed declaration.

    `keys` says where its keys are explained; "" for the rig file.

    Raises
    ------
    ConfigError
        naming `source`, the key, its value and the rule that is broken.
    """
    try:
        return msgspec.convert(raw, kind)
    except msgspec.ValidationError as e:
        rule, _, path = str(e).partition(" - at `")
        path = path.rstrip("`") or "$"
        value = _lookup(raw, path)
        key = path.removeprefix("$").lstrip(".")
        rule, code = _plain_rule(rule, kind)
        raise ConfigError(
            f"{source}: {key}{' = ' + value if value else ''}{': ' if key else ''}{rule}",
            "the file does not follow its declaration" if not keys else "it does not follow its declaration",
            f"correct {key or 'that'} in {source}; {keys or _RIG_KEYS}",
            code=code,
        ) from None


_TYPES = {
    "int": "a whole number", "float": "a number", "str": "text", "bool": "true or false",
    "array": "a list", "object": "a table", "null": "nothing",
}  # fmt: skip
"""How messages call the types of JSON and TOML."""


def _plain_rule(rule: str, kind: Any) -> tuple[str, ErrorCode]:
    """A message of msgspec in the words of a person, and its code; a rule of our own stays as it is."""
    if found := re.search(r"unknown field `(.*)`", rule):
        return f"no key {found[1]!r}: {_likelier(found[1], kind)}", ErrorCode.KEY_UNKNOWN
    if found := re.search(r"missing required field `(.*)`", rule):
        return f"the key {found[1]!r} is missing", ErrorCode.KEY_MISSING
    if found := re.fullmatch(r"Invalid enum value (.*)", rule):
        return f"{found[1]} is none of its values", ErrorCode.VALUE_INVALID
    found = re.fullmatch(r"Expected `(.+?)`( .+?)?(?:, got `?(.+?)`?)?", rule)
    if found is None:
        return rule, ErrorCode.VALUE_INVALID
    wanted = " or ".join(_TYPES.get(name, name) for name in found[1].split(" | ") if name != "null")
    limit = (found[2] or "").replace("matching regex", "of the form")
    given = f", not {_TYPES.get(found[3], found[3])}" if found[3] else ""
    code = ErrorCode.TYPE_WRONG if given and not limit else ErrorCode.VALUE_INVALID
    return f"must be {wanted}{limit}{given}", code


def _likelier(key: str, kind: Any) -> str:
    """What to write instead of an unknown key: the table it belongs to, or a key like it."""
    known: dict[str, set[str]] = {}
    _collect(msgspec.inspect.type_info(kind), "", known)
    if key in known:
        return f"it belongs to {' or '.join(f'[{table}]' if table else 'the top' for table in sorted(known[key]))}"
    return did_you_mean(key, known) or "nor one like it"


def _collect(kind: Any, table: str, known: dict[str, set[str]]) -> None:
    """Every key of a declaration, with the tables that hold it."""
    for field in getattr(kind, "fields", ()):
        known.setdefault(field.name, set()).add(table)
        parts = [field.type, *getattr(field.type, "types", ()), *getattr(field.type, "item_types", ())]
        for part in (*parts, getattr(field.type, "item_type", None), getattr(field.type, "value_type", None)):
            _collect(part, f"{table}.{field.name}".lstrip("."), known)


def to_builtins(config: Any) -> dict[str, Any]:
    """A configuration as plain dicts and lists, None left out, for JSON, TOML or msgpack."""
    return _without_none(msgspec.to_builtins(config))


def _lookup(data: Any, path: str) -> str:
    """The value a msgspec error path such as `$.boards[0].name` points at, for the message; '' when absent."""
    node = data
    for part in path.removeprefix("$").replace("[", ".[").split("."):
        if not part:
            continue
        try:
            node = node[int(part[1:-1])] if part.startswith("[") else node[part]
        except (KeyError, IndexError, TypeError, ValueError):
            return ""
    return "" if isinstance(node, dict | list) else repr(node)


def _without_none(node: Any) -> Any:
    if isinstance(node, dict):
        return {k: _without_none(v) for k, v in node.items() if v is not None}
    if isinstance(node, list | tuple):
        return [_without_none(v) for v in node]
    return node
