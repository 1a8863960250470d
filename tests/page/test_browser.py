"""The tests' browser ends with all its processes: a process that remained would take time from all later tests."""

import os
import signal
from contextlib import suppress
from pathlib import Path

import pytest
from tests.support.page.chromium import Browser, find_chromium
from tests.support.processes import wait_for


def list_running_in_group(group: int) -> set[int]:
    """Numbers of the processes of this group that have not ended."""
    running = set()
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit():
            continue
        with suppress(OSError):
            # proc_pid_stat(5): after the name, which ends in a bracket, come the state, the parent and the group.
            fields_after_name = (folder / "stat").read_text(errors="replace").rpartition(") ")[2].split()
            state, _, process_group = fields_after_name[:3]
            # Z and X: the process has ended.
            if int(process_group) == group and state not in "ZX":
                running.add(int(folder.name))
    return running


@pytest.mark.parametrize("leader_is_killed", [False, True])
def test_a_browser_that_ended_leaves_no_process(tmp_path, leader_is_killed):
    if find_chromium() is None:
        pytest.skip("no chromium here: sudo apt-get install chromium")
    with Browser(tmp_path) as browser:
        group = browser.process_group
        assert len(list_running_in_group(group)) > 1
        if leader_is_killed:
            os.kill(group, signal.SIGKILL)
    wait_for(lambda: not list_running_in_group(group), "the end of the browser's processes")
