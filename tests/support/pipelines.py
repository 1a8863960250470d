"""Process a source up to its last row."""

from typing import Any

from polysight.pipeline import Pipeline
from polysight.process import SampleUse
from polysight.settings import Settings
from polysight.store import Source


def make_pipeline(source: Source, live: bool = False, samples: SampleUse = "none", **settings: Any) -> Pipeline:
    """Return a pipeline with all rows of a source; `settings` are those of :class:`polysight.settings.Settings`."""
    pipeline = Pipeline(source, Settings(**settings), live=live, samples=samples)
    for row in source.rows():
        pipeline.add_row(row)
    return pipeline
