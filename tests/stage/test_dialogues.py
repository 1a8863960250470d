"""Whole conversations, written down in dialogues/*.txt, with every kind of stage.

`-> VERB ARGS`       send a command with the next sequence number and its checksum
`-> N7 VERB ARGS`    ... with this number
`-> again`           send the last command's bytes again
`-> <HOLD>`          an immediate byte
`-> "bytes"`         exactly these bytes
`-> sealed "body"`   this body with its checksum and line end
`<- REPLY`           the next reply; # is the number of the last command, #ROW that of the last ROW, ? any value
`<- silence`         nothing has come
`.. 100 ms`          let time go on; also `rest`, `press X|Y|E|nothing`, `slip DX DY`, `reset`

Lines `->` that follow each other are sent in one go. A real stage does not wait while this machine is busy: so what
must be sent before something happens there goes in one go, or it has seconds to spare.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.support.stage.conversation import play

DIALOGUES = sorted((Path(__file__).parent / "dialogues").glob("*.txt"))


@pytest.mark.parametrize("path", DIALOGUES, ids=lambda p: p.stem)
def test_dialogue(talker, path: Path):
    play(talker, path)


def test_there_are_dialogues():
    assert len(DIALOGUES) >= 9
