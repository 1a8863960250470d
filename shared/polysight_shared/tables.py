"""Read TOML and JSON tables into typed declarations, and write them back.

An unknown key, a wrong type or a broken rule raises ConfigError with the file, the key, the value and the rule.
"""

from __future__ import annotations

import re
import tomllib
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec

from polysight_shared.errors import ConfigError, DataError, ErrorCode, suggest_word
from polysight_shared.files import read_bounded

# Chosen: far above any table written by hand.
_MAX_BYTES = 64 << 20
_WHERE_KEYS_ARE_EXPLAINED = "instrument.toml in the repository and shared/polysight_shared/config.py explain every key"
T = TypeVar("T")
# The upper limits only refuse infinities and typing errors.
Positive = Annotated[float, msgspec.Meta(gt=0, le=1e15)]
NonNegative = Annotated[float, msgspec.Meta(ge=0, le=1e15)]
Count = Annotated[int, msgspec.Meta(ge=1, le=1_000_000_000)]


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base class of a table of the rig file; unknown keys are refused."""


def require(ok: bool, rule: str) -> None:
    """Check a rule of a table. Raises ValueError, which `decode` turns into a ConfigError."""
    if not ok:
        raise ValueError(rule)


def read_toml(path: Path) -> dict[str, Any]:
    """Parse a TOML file. Raises ConfigError if it is missing, unreadable or not TOML, or has a control character."""
    table = _parse_toml(path)
    # A terminal that shows the text would obey the character, and no path or port has one.
    for key, text in _list_texts(table):
        if any(unicodedata.category(c) == "Cc" and c not in "\n\t" for c in text):
            raise ConfigError(
                f"{path}: {key!r}: {text!r} has a control character",
                "it was pasted, or the file is damaged",
                "remove the character",
                code=ErrorCode.VALUE_INVALID,
            )
    return table


def _list_texts(node: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Yield every text in a parsed table, keys included, with the key at which it stands."""
    if isinstance(node, str):
        yield key, node
    elif isinstance(node, dict):
        for name, value in node.items():
            yield name, name
            yield from _list_texts(value, name)
    elif isinstance(node, list):
        for value in node:
            yield from _list_texts(value, key)


def _parse_toml(path: Path) -> dict[str, Any]:
    """Parse a TOML file; errors as of `read_toml`."""
    try:
        # Editors of Windows write a mark of the byte order first.
        return tomllib.loads(read_bounded(path, _MAX_BYTES).decode("utf-8-sig"))
    except FileNotFoundError:
        remedy = "give the path of a TOML file"
        raise ConfigError(f"{path}: no such file", "the path is wrong", remedy, code=ErrorCode.FILE_MISSING) from None
    except DataError as e:
        raise ConfigError(e.what, e.why, e.remedy, code=ErrorCode.FILE_UNREADABLE) from None
    except OSError as e:
        summary = f"{path}: cannot be read: {e}"
        cause = "it is not a readable text file"
        raise ConfigError(summary, cause, "check the path", code=ErrorCode.FILE_UNREADABLE) from None
    except UnicodeDecodeError as e:
        line = e.object[: e.start].count(b"\n") + 1
        raise ConfigError(
            f"{path}: line {line} is not text in UTF-8",
            "it was saved in another encoding, such as Latin-1 or UTF-16, or it is not a text file",
            "save it as UTF-8 in the editor",
            code=ErrorCode.FILE_UNREADABLE,
        ) from None
    except (tomllib.TOMLDecodeError, RecursionError) as e:
        summary = f"{path}: not valid TOML: {e}"
        raise ConfigError(summary, "a typing error", "correct that line", code=ErrorCode.FILE_DAMAGED) from None


def decode(raw: dict[str, Any], kind: type[T], source: str, keys: str = "") -> T:
    """Convert a parsed TOML or JSON table to a typed declaration.

    `source` is the file's name for messages; `keys` says where its keys are explained, "" for the rig file.

    Raises
    ------
    ConfigError
        with `source`, the key, its value and the broken rule.
    """
    try:
        return msgspec.convert(raw, kind)
    except msgspec.ValidationError as e:
        # msgspec writes: Expected `int`, got `str` - at `$.grid.columns`. At the top there is no place.
        message, _, path = str(e).partition(" - at `")
        path = path.rstrip("`") or "$"
        key = path.removeprefix("$").lstrip(".")
        rule, code = _rewrite_rule(message, kind)
        value = _lookup(raw, path)
        if value:
            rule = f"{key} = {value}: {rule}"
        elif key:
            rule = f"{key}: {rule}"
        raise ConfigError(
            f"{source}: {rule}",
            "the file breaks a rule of its format",
            f"correct {key or 'that'} in {source}; {keys or _WHERE_KEYS_ARE_EXPLAINED}",
            code=code,
        ) from None


# Names of the types of JSON and TOML for messages.
_TYPES = {
    "int": "a whole number", "float": "a number", "str": "text", "bool": "true or false",
    "array": "a list", "object": "a table", "null": "nothing",
}  # fmt: skip


def _rewrite_rule(rule: str, kind: Any) -> tuple[str, ErrorCode]:
    """Rewrite a message of msgspec in plain words, with its code; keep a rule of `require` unchanged."""
    if match := re.search(r"unknown field `(.*)`", rule):
        return f"unknown key {match[1]!r}: {_suggest_key(match[1], kind)}", ErrorCode.KEY_UNKNOWN
    if match := re.search(r"missing required field `(.*)`", rule):
        return f"the key {match[1]!r} is missing", ErrorCode.KEY_MISSING
    if match := re.fullmatch(r"Invalid enum value (.*)", rule):
        return f"{match[1]} is not an allowed value", ErrorCode.VALUE_INVALID
    # Such as: Expected `int | null`, got `str`; Expected `float` > 0.0. The groups are the type, the limit behind it,
    # and what was found instead, of which the latter two may be missing.
    match = re.fullmatch(r"Expected `(.+?)`( .+?)?(?:, got `?(.+?)`?)?", rule)
    if match is None:
        return rule, ErrorCode.VALUE_INVALID
    expected, limit, actual = match.groups()
    types = " or ".join(_TYPES.get(name, name) for name in expected.split(" | ") if name != "null")
    text = f"must be {types}" + (limit or "").replace("matching regex", "of the form")
    if actual == "float" and types == _TYPES["int"]:
        # JSON and TOML tell 350 from 350.0.
        text += ", without a decimal point"
    elif actual:
        text += f", not {_TYPES.get(actual, actual)}"
    code = ErrorCode.TYPE_WRONG if actual and not limit else ErrorCode.VALUE_INVALID
    return text, code


def _suggest_key(key: str, kind: Any) -> str:
    """Suggest a correction of an unknown key: the table to which it belongs, or a similar key."""
    tables_of_key: dict[str, set[str]] = {}
    _collect_keys(msgspec.inspect.type_info(kind), "", tables_of_key)
    if key in tables_of_key:
        tables = [f"[{table}]" if table else "the top" for table in sorted(tables_of_key[key])]
        return f"it belongs to {' or '.join(tables)}"
    return suggest_word(key, tables_of_key) or "it is not a key of this file"


def _collect_keys(kind: Any, table: str, tables_of_key: dict[str, set[str]]) -> None:
    """Add every key of the declaration `kind` (msgspec's description of a type) to the tables that contain it.

    `table` is the name of this table in TOML, such as `radar.native`; "" for the top. Only types of tables have fields.
    """
    for field in getattr(kind, "fields", ()):
        tables_of_key.setdefault(field.name, set()).add(table)
        parts = [field.type, *getattr(field.type, "types", ()), *getattr(field.type, "item_types", ())]
        for part in (*parts, getattr(field.type, "item_type", None), getattr(field.type, "value_type", None)):
            _collect_keys(part, f"{table}.{field.name}".lstrip("."), tables_of_key)


def to_builtins(config: Any) -> dict[str, Any]:
    """Convert a configuration to plain dicts and lists, without None, for JSON, TOML or msgpack."""
    return _remove_none(msgspec.to_builtins(config))


def _lookup(data: Any, path: str) -> str:
    """Return the value at a msgspec error path such as `$.boards[0].name`, for the message; '' if missing."""
    node = data
    for part in path.removeprefix("$").replace("[", ".[").split("."):
        if not part:
            continue
        try:
            node = node[int(part[1:-1])] if part.startswith("[") else node[part]
        except (KeyError, IndexError, TypeError, ValueError):
            return ""
    if isinstance(node, dict | list):
        return ""
    return repr(node)


def _remove_none(node: Any) -> Any:
    """Return nested dicts and lists without the keys whose value is None; tuples become lists."""
    if isinstance(node, dict):
        return {k: _remove_none(v) for k, v in node.items() if v is not None}
    if isinstance(node, list | tuple):
        return [_remove_none(v) for v in node]
    return node
