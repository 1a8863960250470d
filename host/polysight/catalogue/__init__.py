"""Recorded and processed scans for lists, pages and commands; nothing is processed here.

`Scans` lists the scans under a folder and finds the folder of one by its name. `Notes` are the operator's notes and
tags of a scan. Of a processed scan, `read_result` gives the results for a page, `draw_products` draws its maps and
`probe` reads one place; `compare` takes two scans. They share `Pixels`: images with permittivity and errors.
"""

from polysight.catalogue.notes import (
    NOTES_FILE,
    Notes,
    change_notes,
    is_plain,
    read_notes,
    remove_unprintable,
    write_notes,
)
from polysight.catalogue.pictures import (
    AMPLITUDE_COLOURS,
    PHASE_COLOURS,
    Picture,
    Pixels,
    colour_bar,
    draw,
    draw_products,
    thumbnail,
)
from polysight.catalogue.results import (
    DIFFERENCE_COLOURS,
    EXPORT_FOLDER,
    Comparison,
    PermittivityDifference,
    compare,
    compare_pixels,
    draw_comparison,
    list_files,
    probe,
    read_result,
)
from polysight.catalogue.scans import (
    PROGRAM_FOLDER,
    Program,
    ProgramRecord,
    Scans,
    Summary,
    explain_failure,
    find_program,
    find_programs,
    folder_bytes,
    is_scan,
    read_generation,
)
