"""The items of the paper by key: which can be made here, by which function, and which not yet."""

from __future__ import annotations

from collections.abc import Callable

from polysight.host.reproduce.classification import fig18, fig20
from polysight.host.reproduce.fresnel_figures import fig3, fig16
from polysight.host.reproduce.front_on import fig4
from polysight.host.reproduce.images import fig13, fig14, fig19
from polysight.host.reproduce.item import Item, Run
from polysight.host.reproduce.location import fig17
from polysight.host.reproduce.permittivities import table2_item
from polysight.host.reproduce.receiver import fig9
from polysight.host.reproduce.sugar import fig21
from polysight.host.reproduce.sync_figures import fig12, fig15

TITLES: dict[str, str] = {
    "fig3": "Fresnel reflection of common materials",
    "fig4": "0 degrees against steep incidence",
    "fig9": "spectrogram and high-pass response",
    "fig12": "images before and after synchronisation",
    "fig13": "image of seven materials",
    "fig14": "phase of H, V and P",
    "fig15": "errors by stage of synchronisation",
    "fig16": "contrast across incidence angles",
    "fig17": "location independence",
    "fig18": "classification of solids, liquids and powders",
    "fig19": "qualitative images",
    "fig20": "H, V and P alone and together",
    "fig21": "concentration of sugar in water",
    "table2": "permittivity of 36 materials",
}
MAKERS: dict[str, Callable[[Run], Item]] = {
    "fig3": fig3,
    "fig16": fig16,
    "table2": table2_item,
    "fig18": fig18,
    "fig20": fig20,
    "fig21": fig21,
    "fig17": fig17,
    "fig19": fig19,
    "fig14": fig14,
    "fig13": fig13,
    "fig4": fig4,
    "fig12": fig12,
    "fig15": fig15,
    "fig9": fig9,
}
