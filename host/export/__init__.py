"""Products for other programs: HDF5, MATLAB, PNG, CSV."""

from polysight.host.export.table import material_columns, write_csv
from polysight.host.report.read import SavedProducts, read_products

__all__ = ["SavedProducts", "material_columns", "read_products", "write_csv"]
