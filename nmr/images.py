"""The result of :func:`nmr.render`: several images."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from torch import Tensor

from ._validate import describe
from .fragments import Fragments

OUTPUTS = ("rgb", "alpha", "depth", "normals", "fragments")


class Images:
    """The outputs of :func:`render`, as attributes; unpacking gives them in the requested order.

    ``rgb [B, h, w, C]``, ``alpha [B, h, w]``, ``depth [B, h, w]``, ``normals [B, h, w, 3]``,
    ``fragments`` (:class:`Fragments`). Outputs that were not requested raise an AttributeError.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> camera = nmr.LookAt([0.0, 0.0, -3.0])
    >>> images = nmr.render(0.5 * vertices, faces, camera, outputs=("rgb", "depth"), image_size=64)
    >>> images.depth.shape
    torch.Size([1, 64, 64])
    >>> rgb, depth = images
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor
    normals: Tensor
    fragments: Fragments

    def __init__(self, outputs: dict[str, Tensor | Fragments]) -> None:
        # torch.compile cannot follow self.__dict__ in every torch
        object.__setattr__(self, "_names", tuple(outputs))
        for name, value in outputs.items():
            object.__setattr__(self, name, value)

    def __getattr__(self, name: str) -> Tensor | Fragments:
        if name.startswith("_"):  # copy and pickle ask before there are names
            raise AttributeError(f"Images has no attribute {name!r}")
        if name in OUTPUTS:
            raise AttributeError(
                f"{name} was not rendered; request it with outputs={(*self._names, name)}"
            )
        if name == "silhouette":
            raise AttributeError("Images has no attribute 'silhouette': it is the output alpha")
        raise AttributeError(f"Images has no attribute {name!r}; it has {', '.join(self._names)}")

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"Images cannot be changed, so {name} cannot be set")

    # Any: a type cannot tell which outputs there are
    def __iter__(self) -> Iterator[Any]:
        return iter([getattr(self, name) for name in self._names])

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, index: int) -> Any:
        return tuple(self)[index]

    def __repr__(self) -> str:
        return f"Images({', '.join(f'{name}: {describe(getattr(self, name))}' for name in self._names)})"
