"""A host at the serial line of the emulated board, in lockstep."""

from __future__ import annotations

from polysight_shared.stage_line import Command, Immediate, Parameter, Reply
from polysight_simulators.uno import EmulatedUno, PinEdge


class Host:
    """A host at the board's serial line."""

    def __init__(self, uno: EmulatedUno) -> None:
        self.uno = uno
        self.sequence = 0
        self.zero = (0, 0)

    def replies(self) -> list[Reply]:
        self.uno.settle()
        lines = bytes(self.uno.received).splitlines(keepends=True)
        self.uno.received.clear()
        return [Reply.decode(line) for line in lines]

    def line(self, verb: str, *args: int) -> bytes:
        self.sequence = (self.sequence + 1) % 65536
        return Command(self.sequence, verb, args).encode()

    def command(self, verb: str, *args: int) -> Reply:
        self.uno.feed(self.line(verb, *args))
        (reply,) = self.replies()
        assert reply.sequence == self.sequence
        return reply

    def obeyed(self, verb: str, *args: int) -> None:
        assert self.command(verb, *args).kind == "ok"

    def set(self, parameter: Parameter, value: int) -> None:
        self.obeyed("SET", int(parameter), value)

    def motion(self, verb: str, *args: int) -> Reply:
        self.uno.edges.clear()
        self.obeyed(verb, *args)
        self.uno.rest()
        (done,) = self.replies()
        assert (done.kind, done.sequence) == ("done", self.sequence), done
        return done

    def ready(self) -> Host:
        assert [r.kind for r in self.replies()] == ["banner"]
        self.obeyed("HELLO")
        self.set(Parameter.HEARTBEAT, 60_000)
        self.obeyed("ENABLE", 1)
        self.motion("HOME")
        x, left, right = self.uno.motors
        assert left == right
        self.zero = (x, left)
        return self

    def status(self) -> Reply:
        self.uno.feed(bytes([Immediate.STATUS]))
        (*_, last) = self.replies()
        assert last.kind == "status"
        return last

    def at(self, edge: PinEdge) -> tuple[int, int]:
        """Return the position of the motors at an edge, in the firmware's coordinates."""
        assert edge.left == edge.right
        return edge.x - self.zero[0], edge.left - self.zero[1]
