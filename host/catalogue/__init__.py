"""What is known of recorded and processed scans, for lists, pages and commands; nothing here computes a scan again.

`Scans` lists the scans under a folder and finds one by its name, never outside. `Notes` are the operator's words beside
a scan. `result_of` says what a processed scan shows, `draw_products` draws it, `probe` looks at one place of it, and
`compare` at two scans.
"""

from polysight.host.catalogue.compare import DIFFERENCE, Comparison, compare, draw_comparison
from polysight.host.catalogue.notes import NOTES, Notes, is_plain, printable, read_notes, write_notes
from polysight.host.catalogue.pictures import (
    AMPLITUDE,
    MAPS,
    PHASE,
    Picture,
    colour_bar,
    draw,
    draw_products,
    thumbnail,
)
from polysight.host.catalogue.pixels import Pixels
from polysight.host.catalogue.probe import probe
from polysight.host.catalogue.result import EXPORT, files_of, result_of
from polysight.host.catalogue.scans import Scans, folder_bytes
from polysight.host.catalogue.summary import PROGRAM, Summary, log_tail, summary_of

__all__ = [
    "AMPLITUDE",
    "DIFFERENCE",
    "EXPORT",
    "MAPS",
    "NOTES",
    "PHASE",
    "PROGRAM",
    "Comparison",
    "Notes",
    "Picture",
    "Pixels",
    "Scans",
    "Summary",
    "colour_bar",
    "compare",
    "draw",
    "draw_comparison",
    "draw_products",
    "files_of",
    "folder_bytes",
    "is_plain",
    "log_tail",
    "printable",
    "probe",
    "read_notes",
    "result_of",
    "summary_of",
    "thumbnail",
    "write_notes",
]
