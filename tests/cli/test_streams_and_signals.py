"""Commands whose output is closed or full, or that Ctrl-C ends at any moment, print one message and no traceback."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from tests.support.paths import BIN, RIG_FILE
from tests.support.processes import wait_for
from tests.support.products import write_judged_products

from polysight_shared.errors import DeviceError

POLYSIGHT = str(BIN / "polysight")
# The exit status that shells give to a program that Ctrl-C ended.
INTERRUPTED = 128 + signal.SIGINT


@pytest.fixture
def products(tmp_path) -> Path:
    return write_judged_products(tmp_path / "products", "good")


def run_in_shell(line: str, folder: Path) -> tuple[int, str]:
    """Run a line of a shell, in which $P is `polysight`; return its exit status and stderr."""
    environment = {**os.environ, "P": POLYSIGHT, "PYTHONUNBUFFERED": ""}
    process = subprocess.run(
        ["sh", "-c", line], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    return process.returncode, process.stderr


@pytest.mark.parametrize("command", ["materials products", "--help"])
@pytest.mark.parametrize("streams", [">&-", "<&- >&- 2>&-"])
def test_a_command_with_closed_streams_succeeds_without_output(products, command, streams):
    assert run_in_shell(f"$P {command} {streams}", products.parent) == (0, "")


def test_with_closed_streams_no_output_is_written_into_the_command_s_files(products):
    """The system gives the first file that is opened the number of the closed standard output."""
    assert run_in_shell("$P export products --csv --out o <&- >&- 2>&-", products.parent) == (0, "")
    table = (products.parent / "o" / "materials.csv").read_text()
    assert "PET" in table
    assert "writing" not in table


@pytest.mark.parametrize("command", ["materials products", "--help"])
def test_output_that_cannot_be_written_is_an_error(products, command):
    status, messages = run_in_shell(f"$P {command} >/dev/full", products.parent)
    assert status == DeviceError.exit_status
    assert "No space left" in messages
    assert "Traceback" not in messages
    assert "Exception ignored" not in messages


# A module that takes long to load, as extensions do. Loading ends by an interrupt, or when the file `go` exists.
SLOW_MODULE = """
import sys
from pathlib import Path
sys.stderr.write("loading, ")
sys.stderr.flush()
while not Path("go").exists():
    pass
sys.stderr.write("loaded, ")
"""
INTERRUPT_WHILE_LOADING = """
import sys
import polysight.cli.materials
from polysight.cli.main import main
def load(args):
    import slow_module
    while True:
        pass
polysight.cli.materials._run_materials = load
sys.exit(main(["materials", "x"]))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_waits_for_the_module_that_is_loading(tmp_path, number):
    """Extensions that are interrupted while they load end in a traceback, or in a segmentation fault."""
    (tmp_path / "slow_module.py").write_text(SLOW_MODULE)
    messages = tmp_path / "said"
    with messages.open("w") as err:
        program = subprocess.Popen([sys.executable, "-c", INTERRUPT_WHILE_LOADING], cwd=tmp_path, stderr=err)
    wait_for(lambda: "loading" in messages.read_text(), "the module loads")
    program.send_signal(number)
    (tmp_path / "go").touch()
    assert program.wait(timeout=60) == INTERRUPTED
    assert messages.read_text() == "loading, loaded, polysight materials: stopped\n"


INTERRUPT_AFTER = """
import signal, sys
from polysight.cli.main import main
signal.signal(signal.SIGPROF, lambda *_: signal.raise_signal(signal.SIGINT))
signal.setitimer(signal.ITIMER_PROF, float(sys.argv[1]))
status = main(sys.argv[2:])
signal.setitimer(signal.ITIMER_PROF, 0)
sys.exit(status)
"""


def test_an_interrupt_at_any_moment_ends_in_one_line_at_most():
    """A command is interrupted after growing CPU times, until it ends before the interrupt.

    Before its first modules are loaded, the signal ends it without a word, as it ends other programs.
    """
    ends = []
    for cpu_ms in range(2, 5000, 60):
        command = [sys.executable, "-c", INTERRUPT_AFTER, f"{cpu_ms / 1e3}", "plan", "--config", str(RIG_FILE)]
        process = subprocess.run(command, capture_output=True, text=True, check=False)
        end = (process.returncode, process.stderr)
        ends.append(end)
        if process.returncode == 0:
            break
    stopped = (INTERRUPTED, "polysight plan: stopped\n")
    ended_by_signal = (-signal.SIGINT, "")
    *interrupted_ends, _ = ends
    assert stopped in ends
    assert set(interrupted_ends) <= {stopped, ended_by_signal}


INTERRUPT_THE_PI = """
import signal, sys
from polysight_pi import cli
assert "msgspec" not in sys.modules
cli._make_parser = lambda: signal.raise_signal(signal.SIGINT)
sys.exit(cli.main([]))
"""


def test_an_early_interrupt_on_the_pi_prints_no_traceback():
    """The modules of `polysight-pi` take a second to load on a Pi: they are loaded when Ctrl-C is already handled."""
    process = subprocess.run([sys.executable, "-c", INTERRUPT_THE_PI], capture_output=True, text=True, check=False)
    assert process.returncode == INTERRUPTED
    assert process.stderr == ""


def test_characters_that_the_terminal_lacks_cause_no_traceback(products):
    (products.parent / "Käse").mkdir()
    products.rename(products.parent / "Käse" / "products")
    line = "PYTHONIOENCODING=ascii $P materials Käse/products > output"
    assert run_in_shell(line, products.parent) == (0, "")
    assert r"K\xe4se" in (products.parent / "output").read_text()


INTERRUPT_AN_IMPORT = """
import signal, sys
class Interrupting:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name == sys.argv[1]:
            sys.stderr.write("interrupted")
            sys.stderr.flush()
            signal.raise_signal(signal.SIGINT)
for name in [name for name in sys.modules if name.partition(".")[0] in ("typing", "importlib", "pathlib")]:
    del sys.modules[name]
sys.meta_path.insert(0, Interrupting)
from polysight.cli.main import main
sys.exit(main(["plan", "--help"]))
"""


@pytest.mark.parametrize("module", ["typing", "pathlib", "polysight_shared.program", "polysight.cli.options"])
def test_an_interrupt_while_the_first_modules_load_prints_no_traceback(module):
    command = [sys.executable, "-c", INTERRUPT_AN_IMPORT, module]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    # Before the program has installed its handler, the signal itself ends it.
    assert process.returncode in (INTERRUPTED, -signal.SIGINT)
    assert process.stderr.removeprefix("interrupted") in ("", "polysight plan: stopped\n")
