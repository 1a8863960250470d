"""A scan folder with simple content, written without a rig: all bytes of a row are the same."""

import zlib
from pathlib import Path

import numpy as np

from polysight.capture.row_files import write_index
from polysight.store.logs import EventWriter
from polysight.store.scan_folder import ScanFolder
from polysight.store.validation import to_text, validate
from polysight_shared.messages import Fault, RunStarted
from polysight_shared.raster import plan_raster
from tests.support.acquisition.fake_rig import make_small_instrument

# Missing byte ranges (start, stop) by board and row
Gaps = dict[tuple[str, int], list[tuple[int, int]]]


def write_scan(folder: Path, gaps: Gaps | None = None) -> Path:
    """Write a scan of four committed rows; return its path. All bytes of row k are k + 1, and those of gaps are 0."""
    instrument = make_small_instrument()
    scan = ScanFolder.create(folder, instrument, plan_raster(instrument.grid), simulated=True)
    frames = instrument.grid.columns * instrument.burst.pulses
    events = EventWriter(scan.path / "events.msgpack")
    events.append(RunStarted(scan_id=scan.scan_id, seq=1, t_mono_ns=1, plan=scan.plan))
    events.append(Fault(scan_id=scan.scan_id, seq=2, t_mono_ns=2, number=101, problem="test"))
    events.sync()
    events.close()
    with scan.writer() as writer:
        for row in scan.plan:
            boards = {}
            for name in ("RH", "RV"):
                missing = (gaps or {}).get((name, row.index), [])
                data = np.full(instrument.row_bytes, row.index + 1, dtype=np.uint8)
                for start, stop in missing:
                    data[start:stop] = 0
                path = scan.row_path(name, row.index)
                data.tofile(path)
                arrivals = np.zeros((2, 2), dtype=np.int64)
                index_crc = write_index(path.with_suffix(".idx"), {"missing": missing}, arrivals)
                boards[name] = {
                    "file": str(path.relative_to(scan.path)), "bytes": data.size, "frames_expected": frames,
                    "frames_received": frames - len(missing),
                    "missing_bytes": sum(stop - start for start, stop in missing),
                    "crc32": f"{zlib.crc32(data.tobytes()):08x}", "index_crc32": f"{index_crc:08x}",
                }  # fmt: skip
            committed = {"fact": "row_committed", "row": row.index, "take": 1, "direction": row.direction}
            writer.append({**committed, "boards": boards, "pulses": frames})
        writer.append({"fact": "scan_ended", "exit_status": "success", "reason": "", "rows_committed": 4})
    return scan.path


def list_errors(folder: Path) -> list[str]:
    """Errors that a validation of the scan folder finds; notes are left out."""
    return [to_text(f) for f in validate(folder) if f.level == "error"]
