"""A Pi 3B on QEMU with this release installed as docs/how-to/install.md says, and its host outside."""

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import tomli_w
from tests.pi_box.box import Box
from tests.pi_box.installed import InstalledPi, print_figure, rig_of_the_box
from tests.pi_box.uno import Uno
from tests.support.pi.host_side import HostSide

from polysight_shared.tables import to_builtins
from polysight_simulators.uno import ENABLING_COMMAND, list_missing_packages

HERE = Path(__file__).parent


@pytest.fixture(scope="session")
def image(request: pytest.FixtureRequest) -> Path:
    """Folder with the card's image and the kernel."""
    if not request.config.getoption("--pi-box"):
        pytest.skip("not asked for: `make test-pi` builds a Debian for a Pi (10 minutes, once) and runs these too")
    if lacking := list_missing_packages():
        pytest.skip(f"no emulated UNO without {' '.join(lacking)}: `{ENABLING_COMMAND}` runs these tests too")
    if shutil.which("qemu-system-aarch64") is None:
        pytest.skip("no QEMU: `sudo apt-get install qemu-system-arm` runs these tests too")
    command = ["env", f"PYTHON={sys.executable}", str(HERE / "build_root.sh")]
    built = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    assert built.returncode == 0, "the Pi's Debian was not built: see above"
    return Path(built.stdout.splitlines()[-1])


@pytest.fixture(scope="session")
def pi(image: Path) -> Iterator[InstalledPi]:
    """The Pi, switched on, with this release installed and its service running."""
    with tempfile.TemporaryDirectory(prefix="pi-box-") as folder:
        work = Path(folder)
        rig_file = work / "instrument.toml"
        rig_file.write_bytes(tomli_w.dumps(to_builtins(rig_of_the_box())).encode())
        uno = Uno(rig_file, work)
        try:
            box = Box(image, work, uno.port)
            try:
                pi = InstalledPi(box, uno, work)
                begun = time.monotonic()
                pi.install()
                print_figure(f"booted in {box.boot_s:.0f} s, installed in {time.monotonic() - begun:.0f} s")
                # The release that came with the image: libraries without a program.
                box.run("sudo rm -r /opt/polysight/releases/0")
                pi.allow_for_a_slow_processor()
                pi.configure()
                pi.make_keys()
                pi.start()
                yield pi
            finally:
                box.close()
        finally:
            uno.close()


@pytest.fixture
def host(pi: InstalledPi) -> Iterator[HostSide]:
    """The host, connected with its keys."""
    host = pi.host()
    yield host
    host.close()
