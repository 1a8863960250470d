"""Products for other programs: HDF5, MATLAB, PNG, CSV."""

from host.export.read import Exported, read_products
from host.export.table import material_columns, write_csv

__all__ = ["Exported", "material_columns", "read_products", "write_csv"]
