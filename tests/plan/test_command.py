"""`polysight plan` as it is called."""

from __future__ import annotations

import json
import tomllib

import pytest
import tomli_w

from polysight.host.cli.main import main
from tests.support.paths import RIG_FILE

RIG = ["--config", str(RIG_FILE)]
SMALL = ["--columns", "40", "--rows", "30"]


def test_a_plan_in_words_and_as_numbers(capsys):
    assert main(["plan", *RIG, *SMALL]) == 0
    words = capsys.readouterr().out
    assert main(["plan", *RIG, *SMALL, "--json"]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert f"{numbers['columns']} x {numbers['rows']} positions" in words
    assert sum(numbers["time_s"].values()) == pytest.approx(2 * numbers["time_s"]["total"])
    assert "simulated" in words
    assert "simulated" in numbers["noise_source"]


def test_a_plan_that_would_be_refused_says_so_and_fails(capsys):
    assert main(["plan", *RIG, *SMALL, "--speed-mm-s", "100", "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["possible"] is False
    assert any(w["refused"] and "too fast for the burst" in w["text"] for w in told["warnings"])


def test_what_breaks_the_rig_file_is_one_message(capsys):
    assert main(["plan", *RIG, "--width-mm", "5000"]) == 2
    assert "do not fit stage.travel_x_mm" in capsys.readouterr().err


def test_the_lines_of_a_plan_make_the_rig_file_that_plan(capsys, tmp_path):
    """Put into the rig file as they are printed, they give the plan's own figures, and nothing is left to ask for."""
    asked = [*SMALL, "--accel-mm-s2", "345", "--object-distance-mm", "480", "--width-mm", "120"]
    minutes = ["--minutes", "3", "--count", "1"]
    assert main(["plan", *RIG, *asked, *minutes]) == 0
    lines = capsys.readouterr().out.rpartition("rig file, all that differ:\n\n")[2]
    assert "Pi's rig file too" in lines
    assert main(["plan", *RIG, *asked, *minutes, "--json"]) == 0
    proposed = json.loads(capsys.readouterr().out)["plans"][0]
    table = tomllib.loads(RIG_FILE.read_text())
    changed = tomllib.loads(lines)
    for section, keys in changed.items():
        assert all(table[section].get(key) != value for key, value in keys.items())
        table[section] |= keys
    (tmp_path / "rig.toml").write_text(tomli_w.dumps(table))
    assert {"accel_mm_s2", "speed_mm_s"} <= set(changed["stage"])
    assert changed["geometry"] == {"object_distance_mm": 480.0}
    rig = ["--config", str(tmp_path / "rig.toml")]
    assert main(["plan", *rig, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == proposed


def test_no_plan_within_the_time(capsys):
    assert main(["plan", *RIG, "--minutes", "0.5"]) == 1
    assert "no plan keeps 0.5 minutes" in capsys.readouterr().err


def test_given_noise_and_standstill_are_used(capsys):
    assert main(["plan", *RIG, *SMALL, "--json", "--snr-db", "10", "--row-overhead-s", "2"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["position_snr_db"] == pytest.approx(22.04, abs=0.01)
    assert told["time_s"]["standstill"] == pytest.approx(60.0)
