"""Who owns which entries of a state vector."""

from __future__ import annotations


class Layout:
    """Named blocks of a state vector, in order: `Layout(position=3, velocity=3)["velocity"]` is `slice(3, 6)`."""

    def __init__(self, **sizes: int) -> None:
        self._slices: dict[str, slice] = {}
        self.size = 0
        for name, size in sizes.items():
            self._slices[name] = slice(self.size, self.size + size)
            self.size += size

    def __getitem__(self, name: str) -> slice:
        return self._slices[name]

    def __contains__(self, name: str) -> bool:
        return name in self._slices

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._slices)

    def extended(self, **sizes: int) -> Layout:
        """The same blocks followed by others."""
        return Layout(**{name: s.stop - s.start for name, s in self._slices.items()}, **sizes)
