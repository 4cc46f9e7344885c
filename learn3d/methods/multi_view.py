"""placeholder"""

from dataclasses import dataclass


@dataclass(frozen=True)
class MultiViewSettings:
    """Kato et al. 2018."""

    @property
    def image_size(self):
        return 64
