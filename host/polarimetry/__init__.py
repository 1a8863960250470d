"""Polarimetry: from the two images to the material's reflection and permittivity."""

from host.polarimetry.calibrate import (
    Calibrated,
    axial_ratio_from_known,
    calibrate,
    calibrate_by_reference,
    correct_leakage,
    multilook_ratio,
    ratio,
    smooth,
)
from host.polarimetry.fresnel import (
    brewster_angle_rad,
    fresnel,
    multilayer,
    permittivity_from_ratio,
    ratio_from_permittivity,
)
from host.polarimetry.incidence import effective_incidence_map, incidence_map, specular_incidence_rad

__all__ = [
    "Calibrated",
    "axial_ratio_from_known",
    "brewster_angle_rad",
    "calibrate",
    "calibrate_by_reference",
    "correct_leakage",
    "effective_incidence_map",
    "fresnel",
    "incidence_map",
    "multilayer",
    "multilook_ratio",
    "permittivity_from_ratio",
    "ratio",
    "ratio_from_permittivity",
    "smooth",
    "specular_incidence_rad",
]
