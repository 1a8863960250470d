"""Messages survive a round trip, invalid ones are refused by name, and minor versions are compatible."""

from typing import Any

import msgpack
import msgspec
import pytest
from hypothesis import given, strategies as st
from msgspec import inspect
from tests.support.refusals import expect_refusal

from polysight_shared import messages as m
from polysight_shared.errors import ErrorCode, ProtocolError
from polysight_shared.raster import RasterPlan


def draw_values(declared: Any) -> st.SearchStrategy:
    """A strategy of values of a declared type (msgspec.inspect) within its limits.

    Texts, lists and dictionaries are small, so that hypothesis tries many messages.
    """
    match declared:
        case inspect.IntType():
            largest = declared.le if declared.lt is None else declared.lt - 1
            return st.integers(declared.ge, largest)
        case inspect.FloatType():
            return st.floats(declared.ge, declared.le, allow_nan=False)
        case inspect.StrType(pattern=None):
            return st.text(max_size=40)
        case inspect.StrType():
            return st.from_regex(declared.pattern, fullmatch=True).map(lambda text: text[: declared.max_length])
        case inspect.BoolType():
            return st.booleans()
        case inspect.LiteralType():
            return st.sampled_from(declared.values)
        case inspect.ListType():
            return st.lists(draw_values(declared.item_type), max_size=3)
        case inspect.DictType():
            return st.dictionaries(draw_values(declared.key_type), draw_values(declared.value_type), max_size=5)
        case inspect.UnionType():
            return st.one_of(*map(draw_values, declared.types))
        case inspect.StructType():
            fields = {f.name: draw_values(f.type) for f in declared.fields if f.name != "version"}
            return st.builds(declared.cls, **fields)
    raise TypeError(declared)


# Any plan: its values do not matter here.
PLAN = RasterPlan(columns=1, rows=1, step_x_mm=1.0, step_y_mm=1.0)
# Fields that every event has, without and with the version that is added on the wire.
STAMP = {"scan_id": "a", "seq": 1, "t_mono_ns": 5}
HEAD_OF_EVENT = {"version": "1.0", **STAMP}

events = draw_values(inspect.type_info(m.AnyEvent))
commands = draw_values(inspect.type_info(m.AnyCommand))
replies = draw_values(inspect.type_info(m.AnyReply))


@given(events)
def test_events_round_trip(event: m.AnyEvent):
    assert m.unpack_event(m.pack(event)) == event


@given(commands)
def test_commands_round_trip(command: m.AnyCommand):
    assert m.unpack_command(m.pack(command)) == command


@given(replies)
def test_replies_round_trip(reply: m.AnyReply):
    assert m.unpack_reply(m.pack(reply)) == reply


@pytest.mark.parametrize(
    ("message", "written"),
    [
        (
            m.Fault(**STAMP, number=101, problem="p", cause="c", remedy="r"),
            {**HEAD_OF_EVENT, "type": "Fault", "number": 101, "what": "p", "why": "c", "remedy": "r"},
        ),
        (
            m.RunStarted(**STAMP, plan=PLAN, resumed=True, lost_events=3),
            {**HEAD_OF_EVENT, "type": "RunStarted", "plan": msgspec.to_builtins(PLAN), "resumed": True, "lost": 3},
        ),
        (
            m.Refused(number=111, problem="p", cause="c", remedy="r"),
            {"type": "Refused", "version": "1.0", "number": 111, "what": "p", "why": "c", "remedy": "r"},
        ),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_field_with_another_name_in_the_code_keeps_its_key_on_the_wire(message: Any, written: dict):
    """Peers and files of earlier releases have these keys, in this order, byte for byte; the type comes first."""
    assert m.pack(message) == msgpack.packb({"type": written["type"], **written})


@given(events, st.data())
def test_a_truncated_message_is_refused(event: m.AnyEvent, data: st.DataObject):
    raw = m.pack(event)
    kept_bytes = data.draw(st.integers(0, len(raw) - 1))
    with pytest.raises(ProtocolError):
        m.unpack_event(raw[:kept_bytes])


@given(st.binary(max_size=200))
def test_random_bytes_raise_a_protocol_error_or_none(raw: bytes):
    for unpack in (m.unpack_event, m.unpack_command, m.unpack_reply):
        try:
            unpack(raw)
        except ProtocolError:
            continue


def test_another_major_version_is_refused_by_name():
    raw = msgpack.packb({**msgspec.to_builtins(m.Home()), "version": "2.0"})
    with expect_refusal(ErrorCode.VERSION_UNSUPPORTED, "Home", "2.0", m.WIRE_VERSION):
        m.unpack_command(raw)


def test_a_newer_minor_version_with_a_new_field_is_understood():
    raw = msgpack.packb({**msgspec.to_builtins(m.Home()), "version": "1.9", "gently": True})
    assert isinstance(m.unpack_command(raw), m.Home)


def test_an_older_message_without_a_defaulted_field_is_understood():
    content = msgspec.to_builtins(m.RunStarted(scan_id="a", seq=1, t_mono_ns=0, plan=PLAN))
    del content["resumed"]
    assert m.unpack_event(msgpack.packb(content)).resumed is False


@pytest.mark.parametrize(
    ("change", "named"),
    [({"seq": -1}, "seq"), ({"seq": "1"}, "seq"), ({"type": "Nonsense"}, "Nonsense"), ({"status": "fine"}, "status")],
)
def test_an_invalid_field_is_refused_by_name(change: dict, named: str):
    event = m.RowFinished(
        scan_id="a", seq=1, t_mono_ns=0, row_index=0, take=1, status="done", points=1, edges=1, bursts=1, pulses=16
    )
    with expect_refusal(ErrorCode.MESSAGE_INVALID, named):
        m.unpack_event(msgpack.packb({**msgspec.to_builtins(event), **change}))
