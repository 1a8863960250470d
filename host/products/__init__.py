"""The folder of products: written whole or not at all, and read back.

`making_products` gives a new folder that takes the place of the earlier one when it is whole. `SavedProducts`,
found by `read_products`, is the one place that knows how the files are laid out and named.
"""

from polysight.host.products.dataset_files import read_netcdf, write_netcdf, write_zarr
from polysight.host.products.datasets import (
    CONVENTION,
    full_dataset,
    image_dataset,
    patch_dataset,
    runs,
    verdict_attributes,
)
from polysight.host.products.files import (
    FINISHED,
    IMAGE,
    LABELS,
    MATERIALS,
    QUALITY,
    SCAN,
    SavedProducts,
    find_products,
    fresh_part,
    plain,
    read_image,
    read_products,
    rx_gains,
    scan_facts,
    write_atomically,
    write_image,
    write_json,
    write_scan_facts,
)
from polysight.host.products.folder import RAW_DROPPED, check_products_folder, making_products
from polysight.host.products.label_files import LABELS_PICTURE, find_labels, label_place, scan_folder_of
from polysight.host.products.material_table import (
    PermittivitySpread,
    material_columns,
    permittivity_spread,
    refused_text,
)
from polysight.host.products.processed import ProcessedScan, Rows, read_processed
from polysight.host.products.withhold import withhold

__all__ = [
    "CONVENTION",
    "FINISHED",
    "IMAGE",
    "LABELS",
    "LABELS_PICTURE",
    "MATERIALS",
    "QUALITY",
    "RAW_DROPPED",
    "SCAN",
    "PermittivitySpread",
    "ProcessedScan",
    "Rows",
    "SavedProducts",
    "check_products_folder",
    "find_labels",
    "find_products",
    "fresh_part",
    "full_dataset",
    "image_dataset",
    "label_place",
    "making_products",
    "material_columns",
    "patch_dataset",
    "permittivity_spread",
    "plain",
    "read_image",
    "read_netcdf",
    "read_processed",
    "read_products",
    "refused_text",
    "runs",
    "rx_gains",
    "scan_facts",
    "scan_folder_of",
    "verdict_attributes",
    "withhold",
    "write_atomically",
    "write_image",
    "write_json",
    "write_netcdf",
    "write_scan_facts",
    "write_zarr",
]
