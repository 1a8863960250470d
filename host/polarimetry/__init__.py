"""From the two images to the material's reflection and permittivity.

`calibrate` references the images to metal in the scene, `PlaneReference` to a plate scanned on its own; leakage is
estimated from metal at two orientations. `incidence_choice` gives the angle, `fresnel` and `multilayer` the reflection
of a material, `permittivity_from_ratio` the material of a reflection (Eq. 2 and 3 of the paper).
"""

from polysight.host.polarimetry.calibrate import (
    Calibrated,
    Image,
    Mask,
    axial_ratio_from_known,
    calibrate,
    calibrate_by_reference,
    correct_leakage,
    multilook_ratio,
    ratio,
    smooth,
)
from polysight.host.polarimetry.fresnel import (
    brewster_angle_rad,
    fresnel,
    multilayer,
    permittivity_from_ratio,
    ratio_from_permittivity,
)
from polysight.host.polarimetry.incidence import (
    Incidence,
    IncidenceChoice,
    effective_incidence_map,
    incidence_choice,
    incidence_map,
    specular_incidence_rad,
)
from polysight.host.polarimetry.leakage import (
    Leakage,
    Standard,
    common_direction,
    estimate_axial_ratio,
    estimate_leakage,
    leakage_from_images,
    strips_wave,
)
from polysight.host.polarimetry.reference import PlaneReference, plane_reference

__all__ = [
    "Calibrated",
    "Image",
    "Incidence",
    "IncidenceChoice",
    "Leakage",
    "Mask",
    "PlaneReference",
    "Standard",
    "axial_ratio_from_known",
    "brewster_angle_rad",
    "calibrate",
    "calibrate_by_reference",
    "common_direction",
    "correct_leakage",
    "effective_incidence_map",
    "estimate_axial_ratio",
    "estimate_leakage",
    "fresnel",
    "incidence_choice",
    "incidence_map",
    "leakage_from_images",
    "multilayer",
    "multilook_ratio",
    "permittivity_from_ratio",
    "plane_reference",
    "ratio",
    "ratio_from_permittivity",
    "smooth",
    "specular_incidence_rad",
    "strips_wave",
]
