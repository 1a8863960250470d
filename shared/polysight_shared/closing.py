"""What has to be closed, by `with` or by a call."""

from abc import ABC, abstractmethod
from typing import Self


class Closing(ABC):
    """Base of what `with` closes at the end of its block, by its method `close`."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Close it."""
