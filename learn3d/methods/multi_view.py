"""placeholder"""

from dataclasses import dataclass


@dataclass(frozen=True)
class MultiViewSettings:
    """Kato et al. 2018."""
