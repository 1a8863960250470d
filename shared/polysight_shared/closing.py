"""Base class of objects that have to be closed, by `with` or by a call of `close`."""

from abc import ABC, abstractmethod
from typing import Self


class Closing(ABC):
    """An object that `with` closes at the end of its block: it calls the method `close`."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Release what the object holds; a subclass says what."""
