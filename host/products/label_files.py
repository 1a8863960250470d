"""Where boxes drawn by hand are kept: beside the rows of a scan folder, else in the folder of products.

A scan folder's `labels.json` is a person's. The one among products is the classifier's, unless it says `by_hand`; then
it outlives the products, as long as they are of the same scan.
"""

from __future__ import annotations

from pathlib import Path

from polysight.host.materials import Labels, read_labels
from polysight.host.products.files import LABELS, SavedProducts
from polysight.host.store import is_source
from polysight.shared.errors import DataError

LABELS_PICTURE = "labels.png"
_BY_HAND = b'"by_hand": true'


def scan_folder_of(folder: Path) -> Path | None:
    """The scan folder that this is, or whose products these are; None for products that lie elsewhere."""
    if is_source(folder):
        return folder
    above = folder.resolve().parent
    if not is_source(above):
        return None
    return folder.parent if folder.parent.resolve() == above else above  # of `.` the parent is `.` again


def label_place(folder: Path) -> Path:
    """Folder that `labels.json` of a scan or of products belongs into."""
    return scan_folder_of(folder) or folder


def find_labels(folder: Path) -> tuple[Path, Labels] | None:
    """Boxes that a person drew for a scan or for its products, and their file; None where nobody did.

    Raises
    ------
    DataError
        when the file cannot be read.
    """
    scan = scan_folder_of(folder)
    if scan is not None and (path := scan / LABELS).exists():
        return path, read_labels(path)
    for path in (folder / LABELS, folder / "products" / LABELS):
        if path.exists() and (labels := read_labels(path)).by_hand:
            return path, labels
    return None


def kept_files(products: Path, scan_id: str) -> dict[str, bytes]:
    """Boxes by hand among products of this scan, and their picture: name to content. Empty where there are none."""
    path = products / LABELS
    try:
        if not path.exists() or SavedProducts(products).scan_id != scan_id or not _is_by_hand(path):
            return {}
        files = (path, products / LABELS_PICTURE)
        return {f.name: f.read_bytes() for f in files if f.exists()}
    except (OSError, DataError):  # of a damaged folder nothing is known to be this scan's
        return {}


def _is_by_hand(path: Path) -> bool:
    try:
        return read_labels(path).by_hand
    except DataError:  # edited and damaged: still nothing to throw away
        return _BY_HAND in path.read_bytes()
