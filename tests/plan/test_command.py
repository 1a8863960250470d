"""`polysight plan` as it is called."""

from __future__ import annotations

import json

import pytest

from host.cli import main

from .conftest import REPO

RIG = ["--config", str(REPO / "instrument.toml")]
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
    assert "does not fit the travel" in capsys.readouterr().err


def test_no_plan_within_the_time(capsys):
    assert main(["plan", *RIG, "--minutes", "0.5"]) == 1
    assert "no plan keeps 0.5 minutes" in capsys.readouterr().err


def test_given_noise_and_standstill_are_used(capsys):
    assert main(["plan", *RIG, *SMALL, "--json", "--snr-db", "10", "--row-overhead-s", "2"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["position_snr_db"] == pytest.approx(22.04, abs=0.01)
    assert told["time_s"]["standstill"] == pytest.approx(60.0)
