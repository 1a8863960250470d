"""The whole simulated rig as processes: stage, radars, capture cards, and the Pi's program."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import tomli_w

from polysight.store.scan_folder import ScanFolder
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.errors import PolysightError
from polysight_shared.tables import decode, to_builtins
from tests.support.paths import RIG_FILE
from tests.support.processes import Bench, Program, wait_for
from tests.support.scenes import write_small_scene

SCENE = write_small_scene(columns=12, rows=6, pulses=4, pixels=40, pixel_mm=4.0)


class Rig(Bench):
    """A running simulated rig with its Pi.

    `scan` starts a scan of the host with the rig file `config`. Times in the rig are shorter by `time_scale`.
    """

    def __init__(self, folder: Path, time_scale: float, env: dict[str, str] | None, scene: str) -> None:
        super().__init__(folder)
        self._scene = scene
        self._env = env
        self.config = folder / "rig.toml"
        self._time_scale = time_scale

    def begin(self) -> None:
        """Start the simulators and the Pi."""
        folder = self.folder
        (folder / "scene.toml").write_text(self._scene)
        options: list[str | Path] = ["--config", RIG_FILE, "--scene", folder / "scene.toml"]
        options += ["--dir", folder / "rig", "--time-scale", str(self._time_scale)]
        self.simulators = self.start("python", "-m", "polysight_simulators.rig", *options, env=self._env)
        # When they are ready the simulators print the path of a rig file with their addresses.
        simulated_rig_file = Path(self.simulators.wait_ready())
        table = to_builtins(load_instrument(simulated_rig_file))
        # These limits are short, so that tests that end a program do not wait long for the error.
        table["limits"] |= {"command_timeout_s": 1.5, "end_of_record_s": 1.0}
        table["pi"]["heartbeat_ms"] = 100
        self.instrument = decode(table, Instrument, "test")
        self.config.write_text(tomli_w.dumps(table))
        self.pi = self.start_pi()

    def start_pi(self) -> Program:
        """Start the Pi's program, after an earlier one has ended."""
        wires = self.folder / "rig" / "wires.sock"
        self.pi = self.start("polysight-pi", "run", "--config", self.config, "--wires", wires)
        self.pi.wait_ready()
        return self.pi

    def scan(self, *more: str) -> Program:
        """Start a scan into `folder`."""
        return self.start("polysight", "scan", "--config", self.config, "--out", self.folder / "scan", *more)

    def wait_mid_row(self, scan: Program, rows: int) -> None:
        """Wait until this number of rows is committed, and the Pi's journal has an event of the next row."""
        # Size of the journal when the next row was seen to be running; 0 until then.
        bytes_at_start = 0

        def is_mid_row() -> bool:
            nonlocal bytes_at_start
            assert scan.process.poll() is None, f"the scan ended too early: {scan.err}"
            journal_bytes = sum(path.stat().st_size for path in self.folder.glob("rig/journal/*.journal"))
            # A row that is being received has files that end in `.part`.
            is_receiving = any(self.folder.glob("scan/raw/*/*.part"))
            if self.count_committed_rows() < rows or not is_receiving:
                bytes_at_start = 0
            elif not bytes_at_start:
                bytes_at_start = journal_bytes
            return 0 < bytes_at_start < journal_bytes

        wait_for(is_mid_row, f"row {rows} being received")

    def count_committed_rows(self) -> int:
        """Return the number of committed rows of the scan; 0 before there is a scan folder."""
        with suppress(PolysightError):
            return len(ScanFolder.load(self.folder / "scan").committed_rows())
        return 0

    def close(self) -> None:
        """End all processes of this rig; fail if one of them still runs."""
        super().close()
        remaining = self.list_processes()
        assert not remaining, remaining


@contextmanager
def run_simulated_rig(
    folder: Path, time_scale: float = 40.0, env: dict[str, str] | None = None, scene: str = SCENE
) -> Iterator[Rig]:
    """Run a simulated rig in `folder`; all its processes are ended afterwards."""
    new_rig = Rig(folder, time_scale, env, scene)
    try:
        new_rig.begin()
        yield new_rig
    finally:
        new_rig.close()
