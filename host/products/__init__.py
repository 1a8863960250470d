"""The folder of products: written whole or not at all, and read back.

`making_products` gives a new folder that takes the place of the earlier one when it is whole. `SavedProducts`,
found by `read_products`, is the one place that knows how the files are laid out and named.
"""

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
    write_atomically,
    write_image,
    write_json,
    write_scan_facts,
)
from polysight.host.products.folder import RAW_DROPPED, check_products_folder, making_products

__all__ = [
    "FINISHED",
    "IMAGE",
    "LABELS",
    "MATERIALS",
    "QUALITY",
    "RAW_DROPPED",
    "SCAN",
    "SavedProducts",
    "check_products_folder",
    "find_products",
    "making_products",
    "plain",
    "read_image",
    "read_products",
    "rx_gains",
    "write_atomically",
    "write_image",
    "write_json",
    "write_scan_facts",
]
