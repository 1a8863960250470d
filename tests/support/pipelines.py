"""Process a source up to its last row."""

from __future__ import annotations

from typing import Any

from polysight.pipeline import Pipeline
from polysight.store import Source


def pipeline_of(source: Source, **choices: Any) -> Pipeline:
    """A pipeline to which all rows of a source were added; `choices` as :class:`polysight.process.Choices`."""
    pipeline = Pipeline(source, **choices)
    for row in source.rows():
        pipeline.add_row(row)
    return pipeline
