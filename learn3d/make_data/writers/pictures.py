"""Pictures on the disk, and backgrounds that look like those of photographs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image


def write_png(path: Path, image: np.ndarray) -> None:
    """Write uint8 [H, W] (grey), [H, W, 3] or [H, W, 4]; folders on the way are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path, compress_level=4)


def photo_background(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """Something out of focus behind an object: colours that change slowly, blotches and noise. uint8 [H, W, 3]."""
    corners = rng.uniform(40, 230, (2, 2, 3))
    blotches = rng.normal(0, 25, (8, 8, 1))
    grain = rng.normal(0, 4, (height, width, 1))
    smooth = _enlarge(corners, height, width) + _enlarge(np.repeat(blotches, 3, axis=2), height, width)
    return (smooth + grain).clip(0, 255).astype(np.uint8)


def _enlarge(small: np.ndarray, height: int, width: int) -> np.ndarray:
    """Bilinear: [h, w, 3] -> float32 [H, W, 3]."""
    channels = [Image.fromarray(small[..., c].astype(np.float32)) for c in range(3)]
    return np.stack([np.asarray(c.resize((width, height), Image.Resampling.BILINEAR)) for c in channels], axis=-1)
