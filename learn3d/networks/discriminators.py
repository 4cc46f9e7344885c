"""Discriminators."""

from __future__ import annotations

from torch import Tensor, nn

from learn3d.networks.encoders import CODE_SIZE


class PoseDiscriminator(nn.Module):
    """Shape code [B,512] -> logits [B,K] over the K discrete views."""

    def __init__(self, num_views: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(CODE_SIZE, 256),
            nn.ReLU(),
            nn.Linear(256, 128),
            nn.ReLU(),
            nn.Linear(128, num_views),
        )

    def forward(self, codes: Tensor) -> Tensor:
        return self.layers(codes)
