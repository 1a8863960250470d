"""The emulated UNO with the real machine code, at a serial port, and the true position of its motors."""

import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

from tests.support.paths import REPO

from polysight_shared.wires import WireMotion, parse

# Time without a change of the motion after which the stage counts as resting
REST_S = 1.0


class Uno:
    """A board that has been switched on, in real time.

    Parameters
    ----------
    config
        The rig file.
    work
        Folder for its port and its wires.
    """

    def __init__(self, config: Path, work: Path) -> None:
        self.port = work / "ttyUNO"
        wires = work / "wires"
        # The last change of the motion, and when it was received.
        self.motion: WireMotion | None = None
        self._heard_s = time.monotonic()
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(wires))
        self._listener.listen()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        command = [sys.executable, "-m", "polysight_simulators.uno", "--config", str(config)]
        command += ["--wires", str(wires), "--link", str(self.port)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=REPO)
        assert self._process.stdout is not None
        assert self._process.stdout.readline().startswith("ready")

    def _read(self) -> None:
        peer, _ = self._listener.accept()
        with peer, peer.makefile("r", encoding="ascii") as lines:
            for line in lines:
                # Only these lines can be a change of the motion.
                message = parse(line) if line.startswith(("M", "S")) else None
                if isinstance(message, WireMotion):
                    self._heard_s = time.monotonic()
                    self.motion = message

    @property
    def moving(self) -> bool:
        """True if it moves along x, or if its motion has changed within the last second."""
        return bool(self.motion and self.motion.vx_um_s) or time.monotonic() - self._heard_s < REST_S

    @property
    def speed_mm_s(self) -> float:
        """Speed along x."""
        return self.motion.vx_um_s / 1e3 if self.motion else 0.0

    @property
    def x_mm(self) -> float:
        """Present position of the stage in x."""
        since_s = time.monotonic() - self._heard_s
        return self.stands_at_mm[0] + self.speed_mm_s * since_s

    @property
    def stands_at_mm(self) -> tuple[float, float]:
        """Position of the stage when it last rested or changed its speed, counted at the pins."""
        assert self.motion is not None
        return self.motion.x_um / 1e3, self.motion.y_um / 1e3

    def close(self) -> None:
        """Switch it off."""
        self._process.terminate()
        self._process.wait(30)
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._listener.close()
        self._reader.join(30)
