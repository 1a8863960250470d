"""The command line of `polysight`: what it accepts and refuses, the text of refusals, and the form of help.

A metal box is the rectangle of the image in which the metal reference lies; a patch is an area of one material.
"""

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
from polysight_shared.errors import DataError, ErrorCode
from polysight_shared.program import expand_home

PERMITTIVITY = {"real": 4.5, "imag": -0.4, "real_std": 0.07, "imag_std": 0.08}
WITHOUT_ERRORS = PERMITTIVITY | {"real_std": None}
# The patches in materials.json.
SEGMENTS = [
    {"label": 1, "name": "copper", "confidence": None, "metal_like": True, "permittivity": None},
    {"label": 2, "name": "PET", "confidence": 0.62, "metal_reference": False, "permittivity": PERMITTIVITY},
    {"label": 3, "name": None, "confidence": None, "metal_reference": False, "permittivity": WITHOUT_ERRORS},
]


@pytest.fixture
def scan(tmp_path) -> Path:
    """Folder of a processed scan with a table of materials and a report, and without raw data."""
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
    """Last line that the parser writes when it refuses a command line."""
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
def test_an_invalid_number_is_refused_with_the_range_that_is_allowed(words, rule, text):
    *command, option = words
    assert read_refusal(*command, f"{option}={text}").endswith(f"{text} is not {rule}")


def test_a_chirp_has_an_even_number_of_samples_at_least_8():
    for text in ("8", "10", "256"):
        assert build_parser().parse_args(["inspect", "a.bin", "--samples", text]).samples == int(text)
    for text in ("6", "9", "0", "-8"):
        assert read_refusal("inspect", "a.bin", f"--samples={text}").endswith(
            f"{text} is not an even number, 8 or more"
        )


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "1e5"])
@pytest.mark.parametrize("box_format", ["{},0,40,40", "0,{},40,40", "0,0,{},40", "0,0,40,{}"])
def test_a_metal_box_with_a_coordinate_that_no_image_has_is_refused(text, box_format):
    box = box_format.format(text)
    assert box in read_refusal("process", "s", "--out", "o", f"--metal-box={box}")


@pytest.mark.parametrize("text", ["nan", "inf", "0.499", "19.9", "10001", "-200"])
def test_an_object_distance_that_no_lab_has_is_refused(text):
    assert read_refusal("plan", f"--object-distance-mm={text}").endswith(
        f"{text} is not a distance from 20 to 10000 mm"
    )


@pytest.mark.parametrize("words", ["--columns 1", "--rows 1", "--width-mm 0.5", "--height-mm 0.9", "--step-x-mm 5000"])
def test_a_plan_without_an_aperture_is_refused(words):
    args = build_parser().parse_args(["plan", "--config", str(RIG_FILE), *words.split()])
    with expect_refusal(ErrorCode.VALUE_INVALID, "positions"):
        args.run(args)


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "1e9"])
def test_a_shift_of_the_image_plane_by_more_than_a_metre_is_refused(text):
    assert read_refusal("image", "s", "--out", "o", f"--depth={text}").endswith(
        f"{text} is not a shift of at most 1000 mm"
    )


@pytest.mark.parametrize(
    ("words", "value"),
    [(["--metal-box", "-65,-20,-25,20"], (-65, -20, -25, 20)), (["--metal-box=-.5,-1,1,2"], (-0.5, -1, 1, 2))],
)  # fmt: skip
def test_a_box_that_begins_with_a_minus_sign_is_not_taken_as_an_option(words, value):
    joined_words = join_negative_values(["process", "scan", *words, "--out", "o"])
    assert build_parser().parse_args(joined_words).metal == value


@pytest.mark.parametrize("words", [["{}"], ["--out={}"], ["--out", "{}"], ["--strips", "90={}"]])
def test_a_tilde_that_the_shell_did_not_expand_is_the_home_folder(words, monkeypatch):
    monkeypatch.setenv("HOME", "/home/somebody")
    home_words = [word.format("~/scans/one") for word in words]
    expanded_words = [word.format("/home/somebody/scans/one") for word in words]
    assert expand_home(home_words) == expanded_words
    unchanged_words = ["~", "~other/x", "a ~/b", "--text", "see a=b ~/c"]
    assert expand_home(unchanged_words) == unchanged_words


@pytest.mark.parametrize(
    ("program", "words"),
    [(main, ["validate", "~/nowhere"]), (polysight_pi, ["check", "--config", "~/nowhere"])],
    ids=["polysight", "polysight-pi"],
)
def test_both_programs_expand_a_tilde(program, words, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HOME", str(tmp_path))
    # The file does not exist; its path in the message shows the expansion.
    assert program(words) > 0
    assert str(tmp_path / "nowhere") in capsys.readouterr().err


def test_options_of_earlier_releases_are_accepted(capsys):
    """A box was given by its centre and its size; a notice says how it is written now."""
    joined_words = join_negative_values(["process", "scan", "--metal", "-45,0,40,40", "--out", "o"])
    left_x = -45 - 40 / 2
    right_x = -45 + 40 / 2
    assert build_parser().parse_args(joined_words).metal == (left_x, -20, right_x, 20)
    assert "--metal-box -65,-20,-25,20" in capsys.readouterr().err
    assert build_parser().parse_args(["permittivity", "out", "--segment", "3"]).patch == 3


@pytest.mark.parametrize(("text", "strips"), [("-180=a", (-180, Path("a"))), ("180=a=b", (180, Path("a=b")))])
def test_metal_strips_are_given_as_their_angle_in_degrees_and_the_folder_of_their_scan(text, strips):
    assert build_parser().parse_args(["leakage", "plate", f"--strips={text}"]).strips == [strips]


@pytest.mark.parametrize("text", ["-180.5=a", "180.5=a", "nan=a", "a=b", "90", "90="])
def test_metal_strips_without_a_valid_angle_or_without_a_scan_are_refused(text):
    assert text in read_refusal("leakage", "plate", f"--strips={text}")


@pytest.mark.parametrize("text", ["20,0,-20,10", "20,0,20,10", "0,20,10,20", "0,20,10,-20", "1,2,3", "a,b,c,d"])
def test_a_box_needs_four_numbers_lower_left_before_upper_right_corner(text):
    assert text in read_refusal("process", "s", "--out", "o", f"--metal-box={text}")


@pytest.mark.parametrize("text", ["0", "", "0,", ",45"])
def test_the_axis_of_a_turntable_needs_two_coordinates(text):
    assert read_refusal("surface", "s", "--out", "o", f"--axis={text}").endswith(
        f"{text!r} is not of the form X,Z in mm, e.g. 0,45"
    )


@pytest.mark.parametrize("text", ["0,nan", "inf,0", "0,1001"])
def test_the_axis_of_a_turntable_is_at_most_a_metre_away(text):
    assert read_refusal("surface", "s", "--out", "o", f"--axis={text}").endswith("is not a shift of at most 1000 mm")


def test_words_that_are_no_negative_coordinates_are_not_joined():
    words = ["process", "-x", "--out", "-o", "--json", "-1", "--a=b"]
    assert join_negative_values(words) == words


@pytest.mark.parametrize(
    ("text", "place_mm"),
    [("-60,0", (-60.0, 0.0)), ("-.5,-1", (-0.5, -1.0)), ("60,-1", (60.0, -1.0))],
)
def test_a_negative_coordinate_of_a_place_is_not_taken_as_an_option(text, place_mm):
    args = build_parser().parse_args(join_negative_values(["probe", "scan", text]))
    assert args.place_mm == place_mm


def list_jobs(parser: argparse.ArgumentParser, options_of_parents: frozenset[str] = frozenset()):
    """Yield the name of each function in `polysight.jobs` that a command runs, with the options of the command."""
    own_options = {action.dest for action in parser._actions}
    options = (options_of_parents | own_options) - {"help", "command", "action", "version"}
    run = parser.get_default("run")
    subcommands = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    needs_a_subcommand = any(action.required for action in subcommands)
    if isinstance(run, functools.partial) and not needs_a_subcommand:
        yield run.args[0], options
    for action in subcommands:
        for subparser in action.choices.values():
            yield from list_jobs(subparser, options)


def test_options_of_a_command_are_the_parameters_of_the_function_that_it_runs():
    jobs = list(list_jobs(build_parser()))
    # With fewer the search has missed some.
    assert len(jobs) >= 20
    for name, options in jobs:
        module, _, function = name.partition(".")
        job = getattr(import_module(f"polysight.jobs.{module}"), function)
        # It raises TypeError for an unknown parameter, and for one that is missing.
        inspect.signature(job).bind(**dict.fromkeys(options))


def test_materials_are_listed_for_the_folder_of_a_scan_or_of_its_products(scan, capsys):
    assert main(["materials", str(scan), str(scan / "products")]) == 0
    lines = capsys.readouterr().out.splitlines()
    lines_of_scan = lines[:4]
    lines_of_products = lines[4:]
    assert lines_of_scan == lines_of_products
    title, copper_line, pet_line, unnamed_line = lines_of_scan
    assert title == f"{scan / 'products'}: simulated scan s7"
    assert copper_line.split() == ["1", "copper", "metal-like"]
    assert pet_line.split() == ["2", "PET", "62", "%", "4.50", "-", "j0.40", "+-", "0.07,", "0.08"]
    assert unnamed_line.split() == ["3", "not", "named", "4.50", "-", "j0.40"]


def test_materials_as_json_have_null_for_the_permittivity_of_metal(scan, capsys):
    assert main(["materials", str(scan), "--json"]) == 0
    (content,) = json.loads(capsys.readouterr().out)
    copper, pet, _ = content["segments"]
    assert copper["name"] == "copper"
    assert copper["permittivity"] is None
    assert pet["confidence"] == 0.62
    assert pet["permittivity"]["real"] == PERMITTIVITY["real"]


def test_a_scan_without_a_table_of_materials_is_a_data_error(scan):
    (scan / "products" / "materials.json").unlink()
    assert main(["materials", str(scan)]) == DataError.exit_status


def test_the_path_of_the_report_is_printed(scan, capsys):
    for folder in (scan, scan / "products"):
        assert main(["report", str(folder)]) == 0
        assert capsys.readouterr().out == f"report:   {scan / 'products' / 'report.html'}\n"


def test_a_missing_report_needs_the_raw_data_to_be_made_again(scan):
    (scan / "products" / "report.html").unlink()
    assert main(["report", str(scan)]) == DataError.exit_status


@pytest.mark.parametrize(("words", "error"), [([], 0.1), (["--amplitude", "5"], 0.05), (["--amplitude", "0.5"], 0.005)])
def test_the_error_of_amplitudes_is_given_in_per_cent(monkeypatch, words, error):
    """It is 10 % without the option."""
    received_options = {}

    def note_options(**options):
        received_options.update(options)
        return 0

    monkeypatch.setattr("polysight.jobs.materials.permittivity", note_options)
    args = build_parser().parse_args(["permittivity", "out", "--layer", "paint,?,0.1", *words])
    assert args.run(args) == 0
    assert received_options["amplitude_error"] == pytest.approx(error)


DIRECT_PATH = ("calibrate", "direct-path", "s", "--target", "t")


@pytest.mark.parametrize("text", ["0.01", "50"])
def test_the_error_of_a_place_measured_by_hand_may_be_50_mm(text):
    assert build_parser().parse_args([*DIRECT_PATH, "--prior", text]).prior_mm == float(text)


@pytest.mark.parametrize("text", ["-1", "0", "51"])
def test_the_error_of_a_place_measured_by_hand_is_above_0_and_not_more_than_50_mm(text):
    assert "a length above 0, at most 50 mm" in read_refusal(*DIRECT_PATH, "--prior", text)


@pytest.mark.parametrize(
    ("options", "listed_first"),
    [
        # With --help there are 3 or 4, which are one section: a second section would have --help alone.
        (2, 3),
        (3, 4),
        # The first section has 3, and "more options" the others.
        (4, 3),
        (9, 3),
    ],
)
def test_a_help_lists_each_option_once_and_the_most_used_ones_first(options, listed_first):
    parser = CommandParser(prog="polysight try", description="Try.", epilog="example:\n  polysight try a")
    parser.add_argument("data", help="a scan")
    for number in range(options):
        parser.add_argument(f"--option-{number}", help=f"option {number}")
    group = parser.add_argument_group("layers", "a stack")
    group.add_argument("--layer", help="one of the stack")
    last_option = f"--option-{options - 1}"
    parser.most_used = (last_option,)
    expected_order = [last_option]
    expected_order += [f"--option-{number}" for number in range(options - 1)]
    expected_order.append("--help")

    text = parser.format_help()
    head, after_arguments = text.split("\narguments:")
    arguments, after_options = after_arguments.split("\noptions:")
    all_options, layers = after_options.split("\nlayers:")
    first_options, _, _ = all_options.partition("\nmore options:")
    assert "example:" in head
    assert "a scan" in arguments
    assert "one of the stack" in layers
    for name in expected_order:
        assert text.count(f"{name} ") == 1
    places = [all_options.index(f"{name} ") for name in expected_order]
    assert places == sorted(places)
    assert [name for name in expected_order if f"{name} " in first_options] == expected_order[:listed_first]
