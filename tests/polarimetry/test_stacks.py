"""Reflection of layers as the simulator makes it and as the host understands it: two derivations, one physics."""

import numpy as np

from polysight.host.polarimetry import multilayer
from polysight.simulators.scene import Layer, layered

F = 78.5e9


def test_a_stack_is_the_hosts_stack():
    """Two derivations, lines in series here and sums of echoes there, of the same reflection."""
    theta = np.radians(np.linspace(0, 75, 16))
    stack = [Layer((5.5, 0.05), 3.0), Layer((2.2, 0.3), 0.4), Layer((9.37, 18.0))]
    ours = layered(stack, F, theta)
    theirs = multilayer([x.epsilon for x in stack], [3e-3, 0.4e-3], F, theta)
    np.testing.assert_allclose(ours, theirs, rtol=1e-9)
