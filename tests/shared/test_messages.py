"""Laws of the wire: messages round-trip, wrong ones are refused by name, old and new minor versions interoperate."""

import msgpack
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from polysight.shared import messages as m
from polysight.shared.errors import ProtocolError
from polysight.shared.raster import RasterPlan, Row

n = st.integers(0, 2**62)
text = st.text(max_size=40)
x = st.floats(-1e6, 1e6, allow_nan=False)
scan_ids = st.from_regex(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,39}", fullmatch=True)
seqs = st.integers(0, 2**31 - 1)
indices = st.integers(0, 99_999)
numbers = st.integers(0, 999)
micros = st.floats(0, 1e7)
owners = st.sampled_from(["", "0a1b2c"])
plans = st.builds(RasterPlan, columns=st.integers(1, 999), rows=st.integers(1, 999), step_x_mm=x, step_y_mm=x)
rows = st.builds(Row, index=indices, y_mm=x, x_start_mm=x, step_mm=x, points=indices)
head = {"version": st.just(m.WIRE_VERSION), "scan_id": scan_ids | st.just(""), "seq": seqs, "t_mono_ns": n}
exits = st.sampled_from(["success", "abort", "fail"])
states = st.sampled_from(["idle", "homing", "ready", "running", "held", "fault"])
small = st.integers(1, 10**6)

events = st.one_of(
    st.builds(m.RunStarted, plan=plans, resumed=st.booleans(), **head),
    st.builds(m.RunStopped, exit_status=exits, reason=text, **head),
    st.builds(m.RowStarted, row=rows, take=small, **head),
    st.builds(
        m.RowFinished,
        row_index=indices,
        take=small,
        status=st.sampled_from(["done", "aborted", "fault"]),
        points=n,
        edges=n,
        bursts=n,
        pulses=n,
        fault=numbers,
        reason=text,
        **head,
    ),
    st.builds(
        m.Capture,
        row_index=indices,
        take=small,
        point=n,
        column=n,
        edge_ns=n,
        first_pulse_ns=n,
        last_pulse_ns=n,
        pulses=n,
        width_max_ns=n,
        jitter_ns=n,
        **head,
    ),
    st.builds(m.StageStatus, state=text, x_mm=x, y_mm=x, points=n, alarm=numbers, **head),
    st.builds(m.Heartbeat, state=states, period_ms=n, **head),
    st.builds(m.Fault, number=numbers, what=text, why=text, remedy=text, **head),
)
v = {"version": st.just(m.WIRE_VERSION)}
commands = st.one_of(
    st.builds(m.Hello, host_release=text, **v),
    st.builds(
        m.BeginRun,
        scan_id=scan_ids,
        plan=plans,
        pulses=st.integers(1, 65_536),
        period_us=micros,
        width_us=micros,
        speed_mm_s=st.floats(0, 1e5),
        **v,
    ),
    st.builds(m.EndRun, scan_id=scan_ids, exit_status=exits, reason=text, **v),
    st.builds(m.Home, **v),
    st.builds(m.RunRow, scan_id=scan_ids, row_index=indices, take=small, **v),
    st.builds(m.Hold, owner=owners, **v),
    st.builds(m.Resume, **v),
    st.builds(m.Abort, reason=text, owner=owners, **v),
    st.builds(m.Status, **v),
    st.builds(m.Pulse, pulses=st.integers(1, m.MOST_PULSES), period_us=micros, width_us=micros, **v),
    st.builds(m.Replay, scan_id=scan_ids, from_seq=small, limit=st.integers(1, 10000), **v),
)
replies = st.one_of(
    st.builds(
        m.HelloReply,
        pi_release=text,
        firmware=text,
        backend=text,
        state=states,
        scan_id=scan_ids,
        last_seq=seqs,
        stage=st.dictionaries(text, x, max_size=5),
        **v,
    ),
    st.builds(m.Accepted, state=states, **v),
    st.builds(m.Refused, number=numbers, what=text, why=text, remedy=text, **v),
    st.builds(
        m.StatusReply,
        state=states,
        homed=st.booleans(),
        x_mm=x,
        y_mm=x,
        scan_id=scan_ids,
        row_index=st.integers(-1, 99_999),
        take=seqs,
        points=n,
        pulses=n,
        last_seq=seqs,
        fault=numbers,
        reason=text,
        **v,
    ),
    st.builds(m.Pulsed, pulses=n, width_max_ns=n, jitter_ns=n, fault=numbers, **v),
    st.builds(m.ReplayReply, events=st.lists(events, max_size=3), last_seq=seqs, **v),
)


@given(events)
def test_events_round_trip(event: m.AnyEvent):
    assert m.unpack_event(m.pack(event)) == event


@given(commands)
def test_commands_round_trip(command: m.AnyCommand):
    assert m.unpack_command(m.pack(command)) == command


@given(replies)
def test_replies_round_trip(reply: m.AnyReply):
    assert m.unpack_reply(m.pack(reply)) == reply


@given(events, st.data())
def test_a_truncated_message_is_refused(event: m.AnyEvent, data: st.DataObject):
    raw = m.pack(event)
    with pytest.raises(ProtocolError):
        m.unpack_event(raw[: data.draw(st.integers(0, len(raw) - 1))])


@given(st.binary(max_size=200))
def test_random_bytes_never_raise_anything_else(raw: bytes):
    for unpack in (m.unpack_event, m.unpack_command, m.unpack_reply):
        try:
            unpack(raw)
        except ProtocolError:
            continue


def test_another_major_version_is_refused_by_name():
    raw = msgpack.packb({**msgspec.to_builtins(m.Home()), "version": "2.0"})
    with pytest.raises(ProtocolError, match=r"'Home' has wire version 2\.0, this program speaks 1\.0"):
        m.unpack_command(raw)


def test_a_newer_minor_version_with_a_new_field_is_understood():
    raw = msgpack.packb({**msgspec.to_builtins(m.Home()), "version": "1.9", "gently": True})
    assert isinstance(m.unpack_command(raw), m.Home)


def test_an_older_message_without_a_defaulted_field_is_understood():
    node = msgspec.to_builtins(m.RunStarted(scan_id="a", seq=1, t_mono_ns=0, plan=RasterPlan(1, 1, 1.0, 1.0)))
    del node["resumed"]
    assert m.unpack_event(msgpack.packb(node)).resumed is False


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seq": -1}, "seq"),
        ({"seq": "1"}, "seq"),
        ({"type": "Nonsense"}, "Nonsense"),
        ({"status": "fine"}, "status"),
    ],
)
def test_wrong_content_is_refused_with_the_path(change: dict, words: str):
    event = m.RowFinished(
        scan_id="a", seq=1, t_mono_ns=0, row_index=0, take=1, status="done", points=1, edges=1, bursts=1, pulses=16
    )
    with pytest.raises(ProtocolError, match=words):
        m.unpack_event(msgpack.packb({**msgspec.to_builtins(event), **change}))
