"""The motion stage of a simulated rig: `python -m polysight_simulators.stage` serves it at a pseudo terminal.

The program runs the sketch compiled for this machine; where that is not possible, the stand-in in Python that is here:
`motion` makes the steps, `logic` carries out commands, `python_stage` holds the dialogue. Both make the same steps at
the same ticks and send the same lines.
"""

from polysight_simulators.stage.logic import count_steps_to_zero
from polysight_simulators.stage.motion import NS_PER_TICK, TICK_HZ
from polysight_simulators.stage.python_stage import PythonStage, Rig
