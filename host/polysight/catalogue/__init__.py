"""Recorded and processed scans for lists, pages and commands; nothing is processed here.

`Scans` lists the scans under a folder and finds the folder of one by its name. `Notes` are the operator's notes and
tags beside a scan. Of a processed scan, `result_of` gives the results as plain data, `draw_products` draws its maps and
`probe` reads one place; `compare` takes two scans. They share `Pixels`: images with permittivity and errors.
"""

from polysight.catalogue.pictures import (
    AMPLITUDE,
    PHASE,
    Picture,
    Pixels,
    colour_bar,
    draw,
    draw_products,
    thumbnail,
)
from polysight.catalogue.results import (
    DIFFERENCE,
    EXPORT,
    Comparison,
    PermittivityDifference,
    compare,
    draw_comparison,
    files_of,
    probe,
    result_of,
)
from polysight.catalogue.scans import (
    NOTES,
    PROGRAM,
    Notes,
    Scans,
    Summary,
    folder_bytes,
    is_plain,
    log_tail,
    printable,
    read_notes,
    write_notes,
)

__all__ = [
    "AMPLITUDE",
    "DIFFERENCE",
    "EXPORT",
    "NOTES",
    "PHASE",
    "PROGRAM",
    "Comparison",
    "Notes",
    "PermittivityDifference",
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
    "thumbnail",
    "write_notes",
]
