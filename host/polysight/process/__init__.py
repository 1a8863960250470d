"""Processing of one scan: what its settings name, kept samples, quality figures, verdict and products.

`Inputs` are the contents of the files that `polysight.settings.Settings` names. `read_given_images` and
`analyse_given_images` take images of another program instead of rows.
`map_rows` processes rows on several threads. For each row, `Quality` collects quality figures and `KeptSamples` stores
the reduced samples in the scan folder, so that images can be formed again without raw data. `judge` gives the verdict
on the result; `save_images` and `save_materials` write the products. `polysight/pipeline.py` calls them in this order.
"""

from polysight.process.given_images import analyse_given_images, is_given_images, make_reference, read_given_images
from polysight.process.inputs import NO_INPUTS, Inputs, convert_boxes_to_patches, explain_unnamed, load_classifier
from polysight.process.judge import judge
from polysight.process.quality import Quality
from polysight.process.rows import KeptSamples, SampleUse, count_cores, map_boards, map_rows
from polysight.process.save import (
    Findings,
    Products,
    Progress,
    collect_imaged_scan,
    collect_processed_scan,
    no_progress,
    save_images,
    save_materials,
)
