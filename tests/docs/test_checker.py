"""`python -m docs.check` finds faults of a page (dead links, wrong commands and code) and can run its commands.

It reports each fault with its line, and nothing on a page without faults.
"""

import signal
import subprocess
import sys
import time

import pytest
from docs.check.__main__ import main
from docs.check.looking import page_faults
from docs.check.pages import ROOT, read_page
from docs.check.running import run_page
from tests.support.processes import wait_for
from tests.support.stage.processes import runs

from polysight_shared.errors import ConfigError


def make_page(tmp_path, text):
    """A page with this text, next to a page with three headings."""
    path = tmp_path / "page.md"
    path.write_text(text, encoding="utf-8")
    (tmp_path / "other.md").write_text("# Two words, `code` and more\n\n## Again\n\n## Again\n", encoding="utf-8")
    return read_page(path)


# A page with links, commands and blocks of all kinds, without a fault.
PAGE_WITHOUT_FAULTS = """# Page

[there](other.md), [part](other.md#two-words-code-and-more), [second](other.md#again-1), [here](#page), [out](https://a.b/c)

Say `polysight scan`, `polysight-pi home --json`, `make demo` or `polysight` and `ls -l`.

<!-- check: rig -->
```sh
polysight scan --config instrument.toml --out scans/one   # a comment
cat > truth.json <<'END'
{"a": "it's"} # polysight nonsense
END
for n in 1 2; do
  echo 'polysight
    nonsense'; polysight scan --out scans/$n
done
cd x && polysight process scans/one \\
  --out out/one > log 2>&1 | tail
```
```console
$ polysight validate scans/one
scans/one: polysight nonsense is only output here
```
<!-- check: hardware -->
```sh
ssh -t pi@host sudo -u polysight /opt/polysight/venv/bin/polysight-pi check --config /etc/polysight/instrument.toml
make -C arduino_stage firmware; make flash PORT=/dev/ttyACM0
systemctl status polysight-pi
.venv/bin/python -m pytest tests/stage --stage-port /dev/ttyACM0 -v
python -m polysight_simulators.rig --config instrument.toml --dir rig --pattern
```
```python
from polysight.imaging import ImageBuilder
```
```toml
[pi]
trigger_in = 26
```
"""


def test_no_faults_are_found_on_a_page_without_faults(tmp_path):
    assert page_faults(make_page(tmp_path, PAGE_WITHOUT_FAULTS)) == []


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("[a](gone.md)", "no such file"),
        ("![a](gone.png)", "no such file"),
        ('<img src="gone.png">', "no such file"),
        ("[a](other.md#gone)", "no such heading"),
        ("[a](#gone)", "no such heading"),
        ("say `polysight skan`", "no subcommand 'skan'"),
        ("say `polysight scan --fast`", "no option --fast"),
        ("say `make demmo`", "no target demmo"),
        ("```\npolysight scan --fast\n```", "no option --fast"),
        ("```sh\npolysight skan\n```", "invalid choice: 'skan'"),
        ("```sh\npolysight scan --out a --fast\n```", "unrecognized arguments: --fast"),
        ("<!-- check: hardware -->\n```sh\npolysight scan\n```", "--out"),
        ("<!-- check: minutes -->\n```sh\ncd x && sudo -u y polysight-pi jog --dz 1\n```", "--dz"),
        ("```console\n$ polysight validate\n```", "SCAN"),
        ("```sh\npython -m polysight_simulators.gone\n```", "no module"),
        ("```sh\npython -m polysight_simulators.stage --config a --link b --gone\n```", "--gone"),
        ("```sh\nmake reproduce WAY=1\n```", "no variable WAY"),
        ("```sh\npython -m pytest tests/gone\n```", "no path tests/gone"),
        ("```sh\npython -m pytest tests/stage --stage-portt x\n```", "no option --stage-portt"),
        ("<!-- check: sometimes -->\n```sh\nls\n```", "unknown mark 'sometimes'"),
        ("```python\nfrom polysight.imaging import Gone\n```", "has no Gone"),
        ("```python\nfrom polysight.gone import a\n```", "No module named"),
        ("```python\nx = (\n```", "python block"),
        ("```toml\nx =\n```", "toml block"),
    ],
)
def test_each_fault_is_found_with_its_line(tmp_path, text, fault):
    (report,) = page_faults(make_page(tmp_path, f"# Page\n\n{text}\n"))
    assert fault in report
    _, line, *_ = report.split(":")
    # The text begins in line 3, or in line 4 after a comment that marks the block. The fault of a block is reported at
    # its first line or at the command in it.
    first_line = 4 if text.startswith("<!--") else 3
    assert int(line) in (first_line, first_line + 1)


def make_folder(tmp_path):
    """A folder in which commands run. The runner makes another folder next to it."""
    copy = tmp_path / "scratch/copy"
    copy.mkdir(parents=True)
    return copy


def test_the_line_of_a_failing_command_is_reported_and_no_later_command_runs(tmp_path):
    copy = make_folder(tmp_path)
    lines = ["# Page", "", "```sh", "true", "", "echo seen", "ls /gone", "touch never", "```"]
    run = run_page(make_page(tmp_path, "\n".join(lines) + "\n"), copy)
    assert run.failed_line == lines.index("ls /gone") + 1
    assert "seen" in run.output
    assert not (copy / "never").exists()


def test_a_command_that_never_ends_is_a_failure_and_is_ended(tmp_path):
    run = run_page(make_page(tmp_path, "# Page\n\n```sh\nsleep 1000\n```\n"), make_folder(tmp_path), limit_s=1.0)
    assert run.failed_line


def test_the_commands_of_a_page_end_if_the_check_is_terminated(tmp_path):
    pid_file = tmp_path / "pid"
    commands = f"echo $$ > {pid_file}.part\nmv {pid_file}.part {pid_file}\nsleep 10000"
    make_page(tmp_path, f"# Page\n\n```sh\n{commands}\n```\n")
    check = subprocess.Popen(
        [sys.executable, "-m", "docs.check", "--run", str(tmp_path / "page.md")],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while not pid_file.exists():
        assert check.poll() is None
        time.sleep(0.05)
    check.terminate()
    assert check.wait() == 128 + signal.SIGTERM
    # A process whose parent was killed remains in the table of processes until the system's first process removes it.
    shell_pid = int(pid_file.read_text())
    wait_for(lambda: not runs(shell_pid), "the page's commands end with the check")


def test_a_block_in_a_list_that_ends_at_a_line_with_too_little_indentation_is_a_fault(tmp_path):
    """The line `y = 2` ends the block, so that the closing fence begins another one: the heading is shown as code."""
    lines = ["# Page", "", "1. a", "", "   ```toml", "   x = 1", "y = 2", "   ```", "", "## Next"]
    (report,) = page_faults(make_page(tmp_path, "\n".join(lines) + "\n"))
    heading_line = lines.index("## Next") + 1
    assert f":{heading_line}: a heading in a code block" in report


def test_a_page_that_does_not_exist_is_a_usage_error(tmp_path, capsys):
    with pytest.raises(SystemExit) as exit_info:
        main([str(tmp_path / "nope.md")])
    assert exit_info.value.code == ConfigError.exit_status
    assert "nope.md is not a page" in capsys.readouterr().err
