"""The hub of simulated wires keeps each sender's order, loses nothing, and sends only what a client subscribed to."""

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from polysight_shared.errors import DeviceError
from polysight_shared.wires import WireClient, WireEdge, WireMessage, WireMotion
from polysight_simulators.wires import WireHub

Serve = Callable[..., Path]
Join = Callable[..., WireClient]


@pytest.fixture
def join() -> Iterator[Join]:
    """Function that connects a client to the hub; clients are closed after the test."""
    with ExitStack() as joined:
        yield lambda *arguments, **options: joined.enter_context(closing(WireClient(*arguments, **options)))


@pytest.fixture
def reports() -> list[str]:
    return []


@pytest.fixture
def serve(tmp_path: Path, reports: list[str]) -> Iterator[Serve]:
    stop = threading.Event()
    threads: list[tuple[threading.Thread, WireHub]] = []

    def start(**options: int) -> Path:
        hub = WireHub(tmp_path / "w.sock", reports.append, **options)
        thread = threading.Thread(target=hub.serve, args=(stop, 0.01))
        thread.start()
        threads.append((thread, hub))
        return tmp_path / "w.sock"

    yield start
    stop.set()
    for thread, hub in threads:
        thread.join()
        hub.close()


def take(client: WireClient, n: int) -> list[WireMessage]:
    """Return the next n messages; fewer if 5 s pass without one."""
    received: list[WireMessage] = []
    while len(received) < n and (message := client.receive(5.0)) is not None:
        received.append(message)
    return received


def test_edges_arrive_in_the_order_of_each_sender(serve: Serve, join: Join) -> None:
    path = serve()
    listener = join(path, (22, 26), motion=True)
    stage = join(path)
    pi = join(path)
    n = 5000
    # Lines 26 and 22: the stage's trigger and the Pi's pulses
    triggers = [WireEdge(1000 * k, 26, k % 2) for k in range(n)]
    pulses = [WireEdge(1000 * k + 7, 22, k % 2) for k in range(n)]

    def send(client: WireClient, edges: list[WireEdge]) -> None:
        for i in range(0, n, 37):
            client.send(*edges[i : i + 37])

    senders = [threading.Thread(target=send, args=job) for job in ((stage, triggers), (pi, pulses))]
    for thread in senders:
        thread.start()
    received = take(listener, 2 * n)
    for thread in senders:
        thread.join()
    assert [m for m in received if isinstance(m, WireEdge) and m.line == 26] == triggers
    assert [m for m in received if isinstance(m, WireEdge) and m.line == 22] == pulses
    assert listener.receive(0.05) is None


def test_a_client_gets_its_subscriptions_and_never_its_own_lines(serve: Serve, join: Join) -> None:
    path = serve()
    pi = join(path, (26,))
    cards = join(path, (22,), motion=True)
    stage = join(path)
    # The Pi has subscribed to line 26; its own edge on that line does not come back to it.
    pi.send(WireEdge(t_ns=1, line=26, value=1))
    motion = WireMotion(t_ns=2, x_um=0, y_um=0, vx_um_s=5)
    trigger = WireEdge(t_ns=3, line=26, value=1)
    not_subscribed = WireEdge(t_ns=4, line=27, value=1)
    stage.send(motion, trigger, not_subscribed)
    assert take(pi, 1) == [trigger]
    pulse = WireEdge(t_ns=5, line=22, value=1)
    pi.send(pulse)
    assert take(cards, 2) == [motion, pulse]
    assert pi.receive(0.05) is None
    assert cards.receive(0.05) is None


def test_a_client_that_does_not_read_delays_no_other_and_loses_nothing(serve: Serve, join: Join) -> None:
    path = serve()
    slow = join(path, (26,))
    fast = join(path, (26,))
    stage = join(path)
    edges = [WireEdge(k, 26, k % 2) for k in range(50_000)]
    stage.send(*edges)
    assert take(fast, len(edges)) == edges
    assert take(slow, len(edges)) == edges


def test_beyond_the_limit_only_the_slow_client_is_disconnected(serve: Serve, join: Join, reports: list[str]) -> None:
    path = serve(max_pending_bytes=10_000)
    slow = join(path, (26,))
    fast = join(path, (26,))
    stage = join(path)
    edges = [WireEdge(k, 26, k % 2) for k in range(50_000)]
    for i in range(0, len(edges), 100):
        stage.send(*edges[i : i + 100])
        assert len(take(fast, 100)) == 100
    with pytest.raises(DeviceError):
        take(slow, len(edges))
    assert len(reports) == 1
    assert "26" in reports[0]
