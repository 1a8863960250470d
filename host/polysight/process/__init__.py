"""Processing of one scan: its request and options, kept samples, quality figures, verdict and products.

A `ProcessRequest` is the command line as plain data; `Options` are the same settings with their files loaded.
`map_rows` processes rows on several threads. For each row, `Quality` collects quality figures and `KeptSamples` stores
the reduced samples in the scan folder, so that images can be formed again without raw data. `judge` gives the verdict
on the result; `save_images` and `save_materials` write the products. `polysight/pipeline.py` calls them in this order.
"""

from polysight.process.judge import judge
from polysight.process.parallel import cores, map_boards, map_rows
from polysight.process.quality import Quality, masked_runs
from polysight.process.request import Options, ProcessRequest
from polysight.process.samples import Choices, KeptSamples
from polysight.process.save import (
    Findings,
    Products,
    Progress,
    materials_content,
    no_progress,
    quality_content,
    save_images,
    save_materials,
)

__all__ = [
    "Choices",
    "Findings",
    "KeptSamples",
    "Options",
    "ProcessRequest",
    "Products",
    "Progress",
    "Quality",
    "cores",
    "judge",
    "map_boards",
    "map_rows",
    "masked_runs",
    "materials_content",
    "no_progress",
    "quality_content",
    "save_images",
    "save_materials",
]
