"""The paper's tables and figures made again from simulation, each beside the published value."""
