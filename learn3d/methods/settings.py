"""Base classes for the settings of methods; a run asks them instead of knowing any method."""

from __future__ import annotations

from learn3d.networks import ENCODERS, EncoderName, GeneratorName, SymmetryOption
from learn3d.settings import Positive, checked


@checked
class MethodSettings:
    """Questions of a run to its method's settings. A subclass overrides the answers that differ."""

    @property
    def image_size(self) -> int:
        """Side of the images that the encoder takes, in pixels."""
        raise NotImplementedError

    @property
    def reads_view_ids(self) -> bool:
        """Whether training depends on the view classes."""
        return False

    @property
    def wants_mirror_plane(self) -> bool:
        """Whether the mirror plane of the training data must be known before the networks are built."""
        return False

    @property
    def varies_over_run(self) -> str | None:
        """Name of the setting whose value depends on the number of iterations, None if there is none."""
        return None

    def check_run(self, *, iterations: int, batch_size: int) -> None:
        """Raise ValueError if the settings do not fit a run of this length and batch size."""

    def for_iterations(self, iterations: int) -> MethodSettings:
        """The same settings for a run of this length: phases of the training keep their share of it."""
        return self


@checked
class MeshSettings(MethodSettings):
    """Networks from images to meshes."""

    encoder: EncoderName = "conv"
    """Network from images to codes. conv: three convolutions on 64-pixel RGB and mask. conv-light: half the channels,
    and a fourth convolution (1x1) to 32 channels. conv-small: a fifteenth of the weights. conv-centred: a tenth, for
    images in which every object is scaled to one size (cameras at unknown distances). conv-relu: conv with a ReLU on
    the code (Kato et al. 2018). resnet18: on 224-pixel RGB."""
    generator: GeneratorName = "sphere"
    """Network from codes to vertices. sphere: 642 free vertices. sphere-small: the same from half the weights. bounded:
    that of Kato et al. 2018. cube-conv, cube-fc: 1352 vertices of a cube's surface, from convolutions or from linear
    layers (Kato and Harada 2019)."""
    symmetry: SymmetryOption = None
    """Vertical plane at which shapes are mirrored: x (x = 0), z (z = 0), or the azimuth in degrees of a camera that
    looks along it (0 is x = 0). auto: the plane at which the training masks mirror each other, if they do. Shapes are
    not mirrored if it is None."""
    learning_rate: Positive = 1e-4
    """Adam's learning rate, the same for all networks."""

    @property
    def image_size(self) -> int:
        return ENCODERS[self.encoder].image_size

    @property
    def wants_mirror_plane(self) -> bool:
        return self.symmetry == "auto"
