"""Play a conversation with a stage from a text file; tests/stage/test_dialogues.py describes its syntax."""

import ast
import re
from pathlib import Path

import pytest

from polysight_shared.errors import ProtocolError
from polysight_shared.stage_line import Command, Immediate, crc16, unseal

# Bits of the limit switches in x and y and of the emergency stop, by their letter in a conversation.
PRESSED = {"X": 1, "Y": 2, "E": 4, "nothing": 0}


class Conversation:
    """One conversation with a stage; its steps are played one after another."""

    def __init__(self, stage) -> None:
        self.stage = stage
        # Number of the last line that was sent.
        self.sequence = 0
        # Number of the last line with each verb.
        self.sequence_by_verb: dict[str, int] = {}
        # Bytes of the last line, for `again`.
        self.last_line = b""

    def send(self, texts: list[str]) -> None:
        """Send the bytes of these texts in one piece."""
        self.stage.send(b"".join([self._bytes(text) for text in texts]))

    def _bytes(self, text: str) -> bytes:
        """Return the bytes of a text to send: a byte's name, a string, `sealed` and a string, `again` or a command."""
        if text.startswith("<"):
            return Immediate[text.strip("<>")].sent
        if text.startswith("sealed "):
            body = ast.literal_eval("b" + text.removeprefix("sealed "))
            return body + b"*%04X\n" % crc16(body)
        if text.startswith('"'):
            return ast.literal_eval("b" + text)
        if text != "again":
            words = text.split()
            if re.fullmatch(r"N\d+", words[0]):
                self.sequence = int(words.pop(0)[1:])
            else:
                self.sequence = self.sequence + 1
            verb = words[0]
            args = tuple(map(int, words[1:]))
            self.sequence_by_verb[verb] = self.sequence
            self.last_line = Command(self.sequence, verb, args).encode()
        return self.last_line

    def expect(self, text: str) -> None:
        """Wait for a line and compare it: `#` is the last line's number, `#VERB` that verb's, `?` any value."""
        if text == "silence":
            self.stage.collect_late_bytes()
            assert self.stage.received == b""
            return
        self.stage.wait_until(lambda: b"\n" in self.stage.received)
        line, newline, self.stage.received = self.stage.received.partition(b"\n")
        text = re.sub(r"#([A-Z]+)", lambda m: str(self.sequence_by_verb[m[1]]), text).replace("#", str(self.sequence))
        assert re.fullmatch(re.escape(text).replace(r"\?", r"[-+.:A-Za-z0-9]+"), unseal(line + newline)), (
            f"expected {text!r}, got {line!r}"
        )

    def act(self, text: str) -> None:
        """Let time pass, press switches, let the motors lose steps, or reset the stage."""
        words = text.split()
        if words[-1] == "ms":
            self.stage.run_ms(float(words[0]))
        elif words[0] == "rest":
            self.stage.run_until_rest()
        elif words[0] == "press":
            self.stage.press(PRESSED[words[1]])
        elif words[0] == "slip":
            self.stage.slip(int(words[1]), int(words[2]))
        elif words[0] == "reset":
            self.stage.reset()
        else:
            raise ValueError(text)


def play(stage, path: Path) -> None:
    """Play every step of the file; fail at the first line of the stage that differs."""
    conversation = Conversation(stage)
    for number, sign, texts in _steps(path):
        try:
            if sign == "->":
                conversation.send(texts)
            elif sign == "<-":
                conversation.expect(texts[0])
            else:
                conversation.act(texts[0])
        except (AssertionError, ProtocolError) as e:
            pytest.fail(f"{path.name}:{number}: {sign} {texts[-1]}: {e}")
    stage.collect_late_bytes()
    assert stage.received == b"", f"{path.name}: not expected"


def _steps(path: Path) -> list[tuple[int, str, list[str]]]:
    """Line number, sign and texts of every step. Consecutive lines to send (`->`) are one step, sent together."""
    steps: list[tuple[int, str, list[str]]] = []
    for number, line in enumerate(path.read_text(encoding="ascii").splitlines(), 1):
        line = line.partition(" //")[0].strip()
        if not line or line.startswith("//"):
            continue
        # Two characters, a space and the text
        sign = line[:2]
        text = line[3:].strip()
        if steps:
            _, last_sign, last_texts = steps[-1]
            if sign == last_sign == "->":
                last_texts.append(text)
                continue
        steps.append((number, sign, [text]))
    return steps
