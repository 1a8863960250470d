"""The folder of products: written whole or not at all, and read back.

`making_products` gives a new folder that takes the place of the earlier one when it is whole. `SavedProducts`,
found by `read_products`, is the one place that knows how the files are laid out and named.
"""

from polysight.host.products.dataset_files import read_netcdf, write_netcdf, write_zarr
from polysight.host.products.datasets import (
    CONVENTION,
    ProcessedScan,
    Rows,
    full_dataset,
    image_dataset,
    patch_dataset,
    read_processed,
    runs,
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
from polysight.host.products.material_table import material_columns

__all__ = [
    "CONVENTION",
    "FINISHED",
    "IMAGE",
    "LABELS",
    "MATERIALS",
    "QUALITY",
    "RAW_DROPPED",
    "SCAN",
    "ProcessedScan",
    "Rows",
    "SavedProducts",
    "check_products_folder",
    "find_products",
    "full_dataset",
    "image_dataset",
    "making_products",
    "material_columns",
    "patch_dataset",
    "plain",
    "read_image",
    "read_netcdf",
    "read_processed",
    "read_products",
    "runs",
    "rx_gains",
    "scan_facts",
    "write_atomically",
    "write_image",
    "write_json",
    "write_netcdf",
    "write_scan_facts",
    "write_zarr",
]
