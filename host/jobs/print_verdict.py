"""What commands on saved products say before anything else: how far the result may be trusted."""

from __future__ import annotations

import sys

from polysight.host.products import SavedProducts
from polysight.host.verdict import NoResult

_REASONS = 3  # of a verdict, for the terminal


def print_verdict(products: SavedProducts, to_terminal: bool = True) -> int:
    """Print the verdict of products, if they have one; the exit status that it gives: 0, or that of NoResult."""
    verdict = products.verdict
    if verdict is None:
        return 0
    if to_terminal:
        sys.stdout.write("".join(f"{line}\n" for line in verdict.lines(_REASONS)))
    return 0 if verdict.usable else NoResult.exit_status
