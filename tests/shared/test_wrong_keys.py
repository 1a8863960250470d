"""A key or path that is wrong is told with the one that was meant."""

from __future__ import annotations

import pytest

from polysight.shared.config import load_instrument
from polysight.shared.errors import ConfigError, no_such
from tests.support.paths import RIG_FILE


@pytest.mark.parametrize(
    ("line", "wrong", "told"),
    [
        ("step_x_mm = 2.0", "stepx_mm = 2.0", "did you mean 'step_x_mm'?"),
        ("step_x_mm = 2.0", "samples = 2", "it belongs to [chirp]"),
        ("step_x_mm = 2.0", "qqqq = 2", "nor one like it"),
        ("[stage]", "[stagge]", "did you mean 'stage'?"),
    ],
)
def test_an_unknown_key(line, wrong, told, tmp_path):
    text = RIG_FILE.read_text()
    assert text.count(f"\n{line}") == 1
    (tmp_path / "rig.toml").write_text(text.replace(f"\n{line}", f"\n{wrong}"))
    with pytest.raises(ConfigError) as e:
        load_instrument(tmp_path / "rig.toml")
    assert told in e.value.what


def test_a_path_at_which_there_is_nothing(tmp_path):
    (tmp_path / "scan-7").mkdir()
    assert "did you mean 'scan-7'?" in str(no_such(tmp_path / "scan-77"))
    assert "is not there either" in str(no_such(tmp_path / "away" / "scan-7"))
