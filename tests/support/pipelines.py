"""Process a source up to its last row."""

from __future__ import annotations

from typing import Any

from polysight.host.pipeline import Pipeline
from polysight.host.store import Source


def pipeline_of(source: Source, **choices: Any) -> Pipeline:
    """A pipeline to which all rows of a source were added; `choices` as :class:`polysight.host.process.Choices`."""
    pipeline = Pipeline(source, **choices)
    for row in source.rows():
        pipeline.add_row(row)
    return pipeline
