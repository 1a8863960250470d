"""A scan folder of constant bytes, written without any rig."""

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

Gaps = dict[tuple[str, int], list[tuple[int, int]]]


def write_scan(folder: Path, gaps: Gaps | None = None) -> Path:
    """Four committed rows, all bytes of row k being k + 1; `gaps` are missing byte ranges by board and row."""
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
                for a, b in missing:
                    data[a:b] = 0
                path = scan.row_path(name, row.index)
                data.tofile(path)
                index = write_index(path.with_suffix(".idx"), {"missing": missing}, np.zeros((2, 2), dtype=np.int64))
                boards[name] = {
                    "file": str(path.relative_to(scan.path)), "bytes": data.size, "frames_expected": frames,
                    "frames_received": frames - len(missing), "missing_bytes": sum(b - a for a, b in missing),
                    "crc32": f"{zlib.crc32(data.tobytes()):08x}", "index_crc32": f"{index:08x}",
                }  # fmt: skip
            committed = {"fact": "row_committed", "row": row.index, "take": 1, "direction": row.direction}
            writer.append({**committed, "boards": boards, "pulses": frames})
        writer.append({"fact": "scan_ended", "exit_status": "success", "reason": "", "rows_committed": 4})
    return scan.path


def list_errors(folder: Path) -> list[str]:
    """Errors of a scan folder, without notes."""
    return [to_text(f) for f in validate(folder) if f.level == "error"]
