"""Products of processed scans: write a folder of products, read it back, and convert it to xarray datasets.

`making_products` is a context manager: products are written to a temporary folder, which replaces the old one when
all are complete. `read_products` returns `SavedProducts`, the content of each file. `ProcessedScan` adds the patch of
each pixel, also for results that are not saved; `image_dataset`, `patch_dataset` and `full_dataset` make datasets of
it. Names and permittivities of scans whose verdict is "no result" are never returned (`withhold`).
"""

from polysight.products.dataset_files import read_netcdf, write_netcdf, write_zarr
from polysight.products.datasets import (
    CONVENTION,
    full_dataset,
    image_dataset,
    patch_dataset,
    ranges_text,
    verdict_attributes,
)
from polysight.products.files import (
    FINISHED,
    IMAGE,
    LABELS,
    MATERIALS,
    QUALITY,
    REPORT,
    SCAN,
    SavedProducts,
    find_products,
    plain,
    read_image,
    read_products,
    rx_gains,
    scan_facts,
    temporary_path,
    withhold,
    write_atomically,
    write_image,
    write_json,
    write_scan_facts,
)
from polysight.products.folder import (
    LABELS_PICTURE,
    RAW_DROPPED,
    check_products_folder,
    find_labels,
    label_folder,
    making_products,
    products_locked,
    raw_dropped,
    scan_folder_of,
)
from polysight.products.material_table import (
    material_columns,
    permittivity_spread,
    refused_text,
)
from polysight.products.processed import ProcessedScan, Rows

__all__ = [
    "CONVENTION",
    "FINISHED",
    "IMAGE",
    "LABELS",
    "LABELS_PICTURE",
    "MATERIALS",
    "QUALITY",
    "RAW_DROPPED",
    "REPORT",
    "SCAN",
    "ProcessedScan",
    "Rows",
    "SavedProducts",
    "check_products_folder",
    "find_labels",
    "find_products",
    "full_dataset",
    "image_dataset",
    "label_folder",
    "making_products",
    "material_columns",
    "patch_dataset",
    "permittivity_spread",
    "plain",
    "products_locked",
    "ranges_text",
    "raw_dropped",
    "read_image",
    "read_netcdf",
    "read_products",
    "refused_text",
    "rx_gains",
    "scan_facts",
    "scan_folder_of",
    "temporary_path",
    "verdict_attributes",
    "withhold",
    "write_atomically",
    "write_image",
    "write_json",
    "write_netcdf",
    "write_scan_facts",
    "write_zarr",
]
