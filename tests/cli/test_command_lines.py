"""Command lines with ineffective options are refused, and messages name the expected numbers."""

import argparse
import contextlib
import functools
import inspect
import io
import json
from importlib import import_module
from pathlib import Path

import pytest
from tests.support.paths import RIG_FILE
from tests.support.refusals import expect_refusal

from polysight.cli.main import build_parser, main
from polysight.cli.options import CommandParser, join_negative_values
from polysight.materials.library import SIMULATED_LIBRARY
from polysight.products import write_json
from polysight_pi.cli import main as polysight_pi
from polysight_shared.errors import ErrorCode
from polysight_shared.program import expand_home

E = {"real": 4.5, "imag": -0.4, "real_std": 0.07, "imag_std": 0.08}
SEGMENTS = [
    {"label": 1, "name": "copper", "confidence": None, "metal_like": True, "permittivity": None},
    {"label": 2, "name": "PET", "confidence": 0.62, "metal_reference": False, "permittivity": E},
    {"label": 3, "name": None, "confidence": None, "metal_reference": False, "permittivity": E | {"real_std": None}},
]


@pytest.fixture
def scan(tmp_path) -> Path:
    """A folder with those files of a processed scan that these commands read."""
    products = tmp_path / "scan" / "products"
    write_json(products / "materials.json", {"scan_id": "s7", "simulated": True, "segments": SEGMENTS})
    (products / "report.html").write_text("<p>here</p>")
    return tmp_path / "scan"


@pytest.mark.parametrize(
    ("words", "options"),
    [
        (["train", "scans/a", "--authors", "data", "--out", "l.npz"], ["DATA", "--authors"]),
        (["train", "--simulate", "s", "--authors", "data", "--out", "l.npz"], ["--simulate", "--authors"]),
        (["classify", str(SIMULATED_LIBRARY), "--library", "l.npz"], ["--library"]),
        (["classify", str(SIMULATED_LIBRARY), "--model", "knn"], ["--model"]),
        (["permittivity", "out", "--bands", "3"], ["--bands", "--layer"]),
        (["permittivity", "out", "--amplitude", "5"], ["--amplitude", "--layer"]),
        (["scan", "--out", "o", "--no-process", "--metal-box", "0,0,9,9"], ["--metal-box", "--no-process"]),
        (["resume", "s", "--no-process", "--labels", "x", "--model", "knn"], ["--labels and --model", "--no-process"]),
        (["process", "scan", "--out", "o", "--library", "l.npz", "--model", "none"], ["--library", "--model none"]),
        (["doctor", "--move", "--no-pulse"], ["--move", "--no-pulse"]),
    ],
)
def test_options_that_would_do_nothing_are_refused(words, options):
    args = build_parser().parse_args(words)
    with expect_refusal(ErrorCode.VALUES_CONFLICT, *options):
        args.run(args)


def read_refusal(*words: str) -> str:
    output = io.StringIO()
    with contextlib.redirect_stderr(output), pytest.raises(SystemExit):
        build_parser().parse_args(words)
    return output.getvalue().splitlines()[-1]


@pytest.mark.parametrize("text", ["many", "-1", "1e9", ""])
@pytest.mark.parametrize(
    ("words", "rule"),
    [
        (["calibrate", "direct-path", "s", "--prior"], "a length above 0, at most 50 mm"),
        (["doctor", "--bursts"], "a whole number from 1 to 16"),
        (["focus", "s", "--out", "o", "--depth"], "a length of 0.5 to 100 mm"),
        (["card", "--listen"], "a number of seconds from 0 to 3600"),
        (["permittivity", "o", "--amplitude"], "a percentage from 0 to 100"),
        (["concentration", "l", "--confidence"], "a share from 0.5 to below 1"),
    ],
)
def test_a_number_that_is_none_is_refused_in_words(words, rule, text):
    assert read_refusal(*words[:-1], f"{words[-1]}={text}").endswith(f"{text} is not {rule}")


def test_a_chirp_has_an_even_number_of_samples_at_least_8():
    for text in ("8", "10", "256"):
        assert build_parser().parse_args(["inspect", "a.bin", "--samples", text]).samples == int(text)
    for text in ("6", "9", "0", "-8"):
        assert read_refusal("inspect", "a.bin", f"--samples={text}").endswith(
            f"{text} is not an even number, 8 or more"
        )


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "1e5"])
@pytest.mark.parametrize("place", ["{},0,40,40", "0,{},40,40", "0,0,{},40", "0,0,40,{}"])
def test_a_metal_box_is_a_place_on_the_image(text, place):
    assert place.format(text) in read_refusal("process", "s", "--out", "o", f"--metal-box={place.format(text)}")


@pytest.mark.parametrize("text", ["nan", "inf", "0.499", "19.9", "10001", "-200"])
def test_an_object_distance_is_one_in_the_lab(text):
    assert read_refusal("plan", f"--object-distance-mm={text}").endswith(
        f"{text} is not a distance from 20 to 10000 mm"
    )


@pytest.mark.parametrize("words", ["--columns 1", "--rows 1", "--width-mm 0.5", "--height-mm 0.9", "--step-x-mm 5000"])
def test_a_plan_without_an_aperture_is_refused(words):
    args = build_parser().parse_args(["plan", "--config", str(RIG_FILE), *words.split()])
    with expect_refusal(ErrorCode.VALUE_INVALID, "positions"):
        args.run(args)


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "1e9"])
def test_a_shift_of_the_plane_is_a_length_in_the_lab(text):
    assert read_refusal("image", "s", "--out", "o", f"--depth={text}").endswith(
        f"{text} is not a shift of at most 1000 mm"
    )


@pytest.mark.parametrize(
    ("words", "value"),
    [(["--metal-box", "-65,-20,-25,20"], (-65, -20, -25, 20)), (["--metal-box=-.5,-1,1,2"], (-0.5, -1, 1, 2))],
)  # fmt: skip
def test_a_place_left_of_the_middle_needs_no_equals_sign(words, value):
    joined_words = join_negative_values(["process", "scan", *words, "--out", "o"])
    assert build_parser().parse_args(joined_words).metal == value


@pytest.mark.parametrize("words", [["{}"], ["--out={}"], ["--out", "{}"], ["--strips", "90={}"]])
def test_a_tilde_that_the_shell_left_is_the_home_folder(words, monkeypatch):
    monkeypatch.setenv("HOME", "/home/somebody")
    home_words = [word.format("~/scans/one") for word in words]
    assert expand_home(home_words) == [word.format("/home/somebody/scans/one") for word in words]
    unchanged_words = ["~", "~other/x", "a ~/b", "--text", "see a=b ~/c"]
    assert expand_home(unchanged_words) == unchanged_words


def test_both_programs_take_a_tilde(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HOME", str(tmp_path))
    for program in (["validate", "~/nowhere"], ["pi", "check", "--config", "~/nowhere"]):
        status = polysight_pi(program[1:]) if program[0] == "pi" else main(program)
        assert status > 0
        assert str(tmp_path / "nowhere") in capsys.readouterr().err


def test_the_earlier_form_of_a_box_is_read_with_a_notice(capsys):
    joined_words = join_negative_values(["process", "scan", "--metal", "-45,0,40,40", "--out", "o"])
    assert build_parser().parse_args(joined_words).metal == (-65, -20, -25, 20)
    assert "--metal-box -65,-20,-25,20" in capsys.readouterr().err
    assert build_parser().parse_args(["permittivity", "out", "--segment", "3"]).patch == 3


@pytest.mark.parametrize(("text", "strips"), [("-180=a", (-180, Path("a"))), ("180=a=b", (180, Path("a=b")))])
def test_the_orientation_of_strips_is_an_angle_and_their_scan(text, strips):
    assert build_parser().parse_args(["leakage", "plate", f"--strips={text}"]).strips == [strips]


@pytest.mark.parametrize("text", ["-180.5=a", "180.5=a", "nan=a", "a=b", "90", "90="])
def test_strips_without_an_orientation_or_scan_are_refused(text):
    assert text in read_refusal("leakage", "plate", f"--strips={text}")


@pytest.mark.parametrize("text", ["20,0,-20,10", "20,0,20,10", "0,20,10,20", "0,20,10,-20", "1,2,3", "a,b,c,d"])
def test_a_box_has_a_lower_left_and_an_upper_right_corner(text):
    assert text in read_refusal("process", "s", "--out", "o", f"--metal-box={text}")


@pytest.mark.parametrize("text", ["0", "", "0,", ",45"])
def test_the_axis_of_a_turntable_has_two_places(text):
    assert read_refusal("surface", "s", "--out", "o", f"--axis={text}").endswith(
        f"{text!r} is not of the form X,Z in mm, e.g. 0,45"
    )


@pytest.mark.parametrize("text", ["0,nan", "inf,0", "0,1001"])
def test_the_axis_of_a_turntable_is_in_the_lab(text):
    assert read_refusal("surface", "s", "--out", "o", f"--axis={text}").endswith("is not a shift of at most 1000 mm")


def test_other_words_are_left_as_they_are():
    words = ["process", "-x", "--out", "-o", "--json", "-1", "--a=b"]
    assert join_negative_values(words) == words


@pytest.mark.parametrize("place", ["-60,0", "-.5,-1", "60,-1"])
def test_a_negative_coordinate_is_not_taken_as_an_option(place):
    words = build_parser().parse_args(join_negative_values(["probe", "scan", place]))
    assert words.place_mm == tuple(map(float, place.split(",")))


def list_named_jobs(parser: argparse.ArgumentParser, options: frozenset[str] = frozenset()):
    """Each job of a command, with the options of that command and of its parents."""
    options |= {action.dest for action in parser._actions if action.dest not in ("help", "command", "action")}
    options -= {"version"}
    run = parser.get_default("run")
    branches = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    needs_an_action = any(branch.required for branch in branches)
    if isinstance(run, functools.partial) and not needs_an_action:
        yield run.args[0], options
    for branch in branches:
        for sub in branch.choices.values():
            yield from list_named_jobs(sub, options)


def test_options_of_a_command_that_names_a_job_are_its_parameters():
    jobs = list(list_named_jobs(build_parser()))
    assert len(jobs) >= 20
    for name, options in jobs:
        module, _, function = name.partition(".")
        job = getattr(import_module(f"polysight.jobs.{module}"), function)
        inspect.signature(job).bind(**dict.fromkeys(options))


def test_materials_of_a_scan_or_of_its_products(scan, capsys):
    assert main(["materials", str(scan), str(scan / "products")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{scan / 'products'}: simulated scan s7"
    assert lines[:4] == lines[4:]
    assert lines[1].split() == ["1", "copper", "metal-like"]
    assert lines[2].split() == ["2", "PET", "62", "%", "4.50", "-", "j0.40", "+-", "0.07,", "0.08"]
    assert lines[3].split() == ["3", "not", "named", "4.50", "-", "j0.40"]
    assert main(["materials", str(scan), "--json"]) == 0
    copper, pet, _ = json.loads(capsys.readouterr().out)[0]["segments"]
    assert (copper["name"], copper["permittivity"]) == ("copper", None)
    assert (pet["confidence"], pet["permittivity"]["real"]) == (0.62, E["real"])
    (scan / "products" / "materials.json").unlink()
    assert main(["materials", str(scan)]) == 3


def test_where_the_report_is(scan, capsys):
    for folder in (scan, scan / "products"):
        assert main(["report", str(folder)]) == 0
        assert capsys.readouterr().out == f"report:   {scan / 'products' / 'report.html'}\n"
    (scan / "products" / "report.html").unlink()
    assert main(["report", str(scan)]) == 3, "it is made again from the raw rows, and there are none"


@pytest.mark.parametrize(("words", "error"), [([], 0.1), (["--amplitude", "5"], 0.05), (["--amplitude", "0.5"], 0.005)])
def test_the_error_of_amplitudes_is_given_in_per_cent(monkeypatch, words, error):
    given = []
    monkeypatch.setattr("polysight.jobs.materials.permittivity", lambda **options: given.append(options) or 0)
    args = build_parser().parse_args(["permittivity", "out", "--layer", "paint,?,0.1", *words])
    assert args.run(args) == 0
    assert given[0]["amplitude_error"] == pytest.approx(error)


@pytest.mark.parametrize(
    ("text", "is_taken"), [("-1", False), ("0", False), ("0.01", True), ("50", True), ("51", False)]
)
def test_places_measured_by_hand_have_an_error_above_0_of_at_most_50_mm(text, is_taken):
    parse = functools.partial(
        build_parser().parse_args, ["calibrate", "direct-path", "s", "--target", "t", "--prior", text]
    )
    if is_taken:
        assert parse().prior_mm == float(text)
    else:
        with pytest.raises(SystemExit), contextlib.redirect_stderr(io.StringIO()) as said:
            parse()
        assert "a length above 0, at most 50 mm" in said.getvalue()


@pytest.mark.parametrize(("options", "shown"), [(2, 3), (3, 4), (4, 3), (9, 3)])
def test_a_help_lists_each_option_once_and_the_most_used_ones_first(options, shown):
    """With --help, four options are one section: a second one would have --help alone."""
    parser = CommandParser(prog="polysight try", description="Try.", epilog="example:\n  polysight try a")
    parser.add_argument("data", help="a scan")
    for number in range(options):
        parser.add_argument(f"--option-{number}", help=f"option {number}")
    group = parser.add_argument_group("layers", "a stack")
    group.add_argument("--layer", help="one of the stack")
    parser.most_used = (f"--option-{options - 1}",)
    text = parser.format_help()
    sections = {title: text.index(f"\n{title}:") for title in ("arguments", "options", "layers")}
    assert list(sections.values()) == sorted(sections.values())
    more = text.find("\nmore options:")
    listed = [f"--option-{options - 1}", *(f"--option-{number}" for number in range(options - 1)), "--help"]
    places = [text.index(f"{name} ") for name in listed]
    assert places == sorted(places)
    assert all(text.count(f"{name} ") == 1 for name in listed)
    first = [name for name, place in zip(listed, places, strict=True) if more < 0 or place < more]
    assert first == listed[:shown]
    assert text.index("one of the stack") > sections["layers"]
    assert "a scan" in text[sections["arguments"] : sections["options"]]
    assert text.index("example:") < sections["arguments"]
