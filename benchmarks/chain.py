"""The instrument's processing of a whole scan in a process of its own, `python -m benchmarks.chain SOURCE.json HOW`.

SOURCE.json names a scan folder (`scan`), or rows that are repeated to a grid: `files` has the paths of each board's
recorded rows by its name, `grid` the keys of the scene's grid that differ (`published_scene`). HOW is "batch", or
"live" as during a scan, with the images updated by every row. For every line on the standard input all of it is
processed once, from reading to the images of H and V, then the last row a few times more; the answer is one line of
JSON (:func:`process`).

The rig's publication has a processing method of its own (`benchmarks/published.py`), to which other benchmarks compare.
Nothing of it is imported here: SciPy's signal and statistics, which it needs, would count 45 MB as memory of the
instrument.
"""

import json
import sys
from pathlib import Path
from typing import Any

from benchmarks.data import RepeatedRows, published_scene
from benchmarks.measure import AnonymousMemory, Child, Seconds
from polysight.pipeline import Pipeline
from polysight.store import ScanFolder

# How often the last row is added again after the whole scan, to time it; chosen.
LAST_ROWS = 5


def process(source: dict[str, Any], live: bool) -> dict[str, Any]:
    """Process the whole scan once, then its last row `LAST_ROWS` times more.

    Returns
    -------
    Number of `rows`; CPU and wall seconds of the whole scan (`cpu_s`, `wall_s`); CPU seconds of the steps done once,
    before the first row and after the last (`once_cpu_s`); seconds of each repeat from the last row to both images
    (`last_row_wall_s`, `last_row_cpu_s`, lists); wall seconds of each stage of the whole scan, without the repeats
    (`stages`).
    """
    if "scan" in source:
        scan = ScanFolder.load(Path(source["scan"]))
    else:
        rig, _ = published_scene(**source["grid"])
        scan = RepeatedRows(rig, {name: [Path(f) for f in files] for name, files in source["files"].items()})
    total = Seconds()
    once = Seconds()
    last = Seconds()
    with total.time_block():
        with once.time_block():
            pipeline = Pipeline(scan, live=live)
            rows = list(scan.rows())
        for row in rows:
            pipeline.add_row(row)
        with once.time_block():
            pipeline.form_images()
    stages = dict(pipeline.quality.seconds)
    for _ in range(LAST_ROWS):
        with last.time_block():
            pipeline.add_row(rows[-1])
            # A live scan's images come from its running sums.
            pipeline.form_images(from_sums=live)
    return {
        "rows": len(rows),
        "cpu_s": total.cpu[0],
        "wall_s": total.wall[0],
        "once_cpu_s": sum(once.cpu),
        "last_row_wall_s": last.wall,
        "last_row_cpu_s": last.cpu,
        "stages": stages,
    }


class Chain(Child):
    """The process of this module, started for a source and watched for its memory.

    `source` is written as SOURCE.json into `folder`; `how` is HOW.
    """

    def __init__(self, folder: Path, how: str, source: dict[str, Any]) -> None:
        path = folder / "source.json"
        path.write_text(json.dumps(source), encoding="utf-8")
        super().__init__("benchmarks.chain", path, how)
        self._memory = AnonymousMemory(self._process.pid)

    def run(self) -> dict[str, Any]:
        """Process once and return the figures of :func:`process`. Raises RuntimeError if the process ends instead."""
        self.say()
        return self.hear()

    def end(self) -> int:
        """End the process; return the highest anonymous memory that it held, bytes."""
        self.close()
        return self._memory.close()


def main(argv: list[str]) -> int:
    """Process the source for each line of the standard input, until it ends, and print the figures as a line."""
    source = json.loads(Path(argv[1]).read_text(encoding="utf-8"))
    for _ in sys.stdin:
        sys.stdout.write(json.dumps(process(source, live=argv[2] == "live")) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv))
