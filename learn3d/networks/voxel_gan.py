"""PrGAN's networks (Gadelha et al. 2017): voxel generator, projection, silhouette discriminator,
inverse encoder.

Layers, sizes and initial weights are those of the published TensorFlow code: weights of fully
connected layers from N(0, 0.1), of convolutions from N(0, 0.02), biases 0. TensorFlow's momentum
of 0.9 in batch norms is torch's 0.1.

The published code rotates the 64^3 volume to the view by trilinear resampling and sums along the
depth. For a fixed view that is a linear map from voxels to pixels. Here it is a sparse matrix,
five times as fast as `grid_sample` forward and backward on one core (40 ms for a batch of 16
instead of 200).
"""

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

import nmr

SHAPE_CODE = 200  # entries of z for the shape; one more entry decides the view
SILHOUETTE_SIZE = 64
TAU = 0.5  # factor of the density in the projection; a full voxel has density 1 / TAU and lets exp(-1) of light pass
GENERATOR_CHANNELS = (128, 64, 32, 1)
DISCRIMINATOR_CHANNELS = (128, 256, 512, 1024)


class DoublingConvolution(nn.ConvTranspose3d):
    """[B, C, n, n, n] -> [B, C', 2n, 2n, 2n]: a transposed 4^3 convolution of stride 2."""

    def __init__(self, before: int, after: int) -> None:
        super().__init__(before, after, 4, stride=2, padding=1)

    def forward(self, features: Tensor) -> Tensor:
        # torch takes four times as long
        if self.out_channels == 1 and features.device.type == "cpu":
            return _Double.apply(features, self.weight, self.bias)
        return super().forward(features)


class _Double(torch.autograd.Function):
    """DoublingConvolution to one channel.

    Each cell becomes eight, so it is a convolution with eight output channels.

    Along an axis, cell 2i is w[3] x[i-1] + w[1] x[i], and cell 2i + 1 is w[2] x[i] + w[0] x[i+1].
    """

    @staticmethod
    def forward(ctx, features: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(features, weight)
        taps = torch.tensor([[3, 1], [2, 0]])
        n = features.shape[-1]
        for axis in (2, 4, 6):  # four weights become [2 cells, 2 neighbours]
            weight = weight.index_select(axis, taps.flatten()).unflatten(axis, (2, 2))
        kernel = weight[:, 0].permute(1, 3, 5, 0, 2, 4, 6).flatten(0, 2)
        cells = F.conv3d(features, kernel.contiguous(), bias.expand(8), padding=1)
        doubled = features.new_empty((len(features), 1, 2 * n, 2 * n, 2 * n))
        for number, (i, j, k) in enumerate(itertools.product((0, 1), repeat=3)):
            doubled[:, 0, i::2, j::2, k::2] = cells[:, number, i : i + n, j : j + n, k : k + n]
        return doubled

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
        stride, padding, dilation, output_padding = [2] * 3, [1] * 3, [1] * 3, [0] * 3
        return torch.ops.aten.convolution_backward(
            grad,
            *ctx.saved_tensors,
            [1],
            stride,
            padding,
            dilation,
            True,
            output_padding,
            1,
            ctx.needs_input_grad,
        )


class VoxelGenerator(nn.Module):
    """Shape code [B, 200] -> density float32 [B, 64, 64, 64] in [0, 1 / TAU], axes (x, y, z) of
    the object frame.

    A linear layer to `channels[0]` features on 4^3 cells, then doubling convolutions to the other
    channels and to one at 64^3; batch norm and ReLU after all but the last, which has a sigmoid.
    The published code has one channel already at 32^3, perhaps by mistake: its batch norm there
    is declared for 16.
    """

    def __init__(self, channels: Sequence[int] = GENERATOR_CHANNELS) -> None:
        super().__init__()
        self.first = nn.Linear(SHAPE_CODE, channels[0] * 4**3)
        layers: list[nn.Module] = []
        for before, after in itertools.pairwise((*channels, 1)):
            layers += [nn.BatchNorm3d(before), nn.ReLU(), DoublingConvolution(before, after)]
        self.layers = nn.Sequential(*layers)
        self.apply(_initialise)
        self.to(memory_format=torch.channels_last_3d)  # half the time on a CPU

    def forward(self, codes: Tensor) -> Tensor:
        features = self.first(codes).reshape(len(codes), -1, 4, 4, 4)
        return (
            torch.sigmoid(self.layers(features.to(memory_format=torch.channels_last_3d)))[:, 0]
            / TAU
        )


class SilhouetteDiscriminator(nn.Module):
    """Silhouettes [B, 64, 64] in [0, 1] -> logits [B]: positive for silhouettes of the data set.

    5x5 convolutions of stride 2 to four `channels`, batch norm and LeakyReLU(0.2) after each,
    then a linear layer.
    """

    def __init__(self, channels: Sequence[int] = DISCRIMINATOR_CHANNELS) -> None:
        super().__init__()
        self.first, *others = (
            nn.Sequential(
                nn.Conv2d(before, after, 5, stride=2, padding=2),
                nn.BatchNorm2d(after),
                nn.LeakyReLU(0.2),
            )
            for before, after in itertools.pairwise((1, *channels))
        )
        self.others = nn.Sequential(*others)
        self.last = nn.Linear(channels[-1] * (SILHOUETTE_SIZE // 16) ** 2, 1)
        self.apply(_initialise)
        self.to(memory_format=torch.channels_last)

    def forward(self, silhouettes: Tensor) -> Tensor:
        return self.last(self.others(self.first(silhouettes[:, None])).flatten(1))[:, 0]


class InverseEncoder(nn.Module):
    """Silhouettes [B, 64, 64] in [0, 1] -> z [B, 201]: the shape code, then the view's entry.

    4096-512-512-201, with LeakyReLU(0.2) after the first layer only and the output divided by
    201, as published.
    """

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(SILHOUETTE_SIZE**2, 512),
            nn.LeakyReLU(0.2),
            nn.Linear(512, 512),
            nn.Linear(512, SHAPE_CODE + 1),
        )
        self.apply(_initialise)

    def forward(self, silhouettes: Tensor) -> Tensor:
        return self.layers(silhouettes.flatten(1)) / (SHAPE_CODE + 1)


def _initialise(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.normal_(module.weight, std=0.1)
    elif isinstance(module, nn.ConvTranspose3d):
        nn.init.normal_(module.weight, std=0.02)
    elif isinstance(module, nn.Conv2d):
        nn.init.trunc_normal_(module.weight, std=0.02, a=-0.04, b=0.04)
    else:
        return
    nn.init.zeros_(module.bias)


@dataclass(frozen=True)
class ViewCircle:
    """K views at equal steps of azimuth, as in Kato's protocol: view k has azimuth -360 k / K
    degrees.

    Rays are parallel, as PrGAN's. The image covers `half_width` to each side of the origin, so
    that objects have the same size as in the data set's perspective images.
    """

    count: int = 24
    elevation_deg: float = 30.0
    distance: float = 2.732
    half_fov_deg: float = 15.0

    @property
    def half_width(self) -> float:
        """Half of the image's side, in units of the object frame: 0.732 for Kato's camera."""
        return self.distance * math.tan(math.radians(self.half_fov_deg))

    def azimuth_deg(self, view_ids: Tensor) -> Tensor:
        """Azimuths of the views `view_ids`, float32, in degrees."""
        return view_ids.float() * (-360.0 / self.count)

    def sample_points(self, azimuth_deg: float, size: int) -> Tensor:
        """Sample points on the rays of one view, float32 [size, size, D, 3] in the object frame;
        row 0 is the top.

        Samples are as far apart as pixels; D of them cover the diagonal of the unit cube.
        """
        eye = (
            nmr.cameras.points_from_angles(self.distance, self.elevation_deg, azimuth_deg)
            .double()
            .reshape(3)
        )
        z_axis = -F.normalize(eye, dim=0)
        x_axis = F.normalize(
            torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), z_axis), dim=0
        )
        y_axis = torch.linalg.cross(z_axis, x_axis)
        step = 2 * self.half_width / size
        across = (torch.arange(size, dtype=torch.float64) - (size - 1) / 2) * step
        samples = math.ceil(math.sqrt(3.0) / step)
        along = (torch.arange(samples, dtype=torch.float64) - (samples - 1) / 2) * step
        in_plane = across[None, :, None] * x_axis - across[:, None, None] * y_axis
        return (in_plane[:, :, None] + along[:, None] * z_axis).float()


def project(density: Tensor, view_ids: Tensor, views: ViewCircle, tau: float) -> Tensor:
    """Soft silhouettes P = 1 - exp(-tau * integral of the density along the ray), float32 [B, S,
    S], row 0 = top.

    density: float32 [B, S, S, S] at the voxel centres of the box [-0.5, 0.5]^3, axes (x, y, z) of
    the object frame, trilinear in between, zero outside. view_ids: int64 [B] in 0 .. K-1, on the
    CPU to avoid a copy. The integral is in voxels: a solid of density 1 and a thickness of n
    voxels gives 1 - exp(-tau n). Differentiable in the density.
    """
    size = density.shape[-1]
    # A quarter turn permutes the voxels, so a quarter of the views needs a matrix.
    quarter = views.count // 4 if views.count % 4 == 0 else views.count
    view_ids = view_ids.cpu()
    volumes = density.unbind()
    parts = []
    order = []
    for base in (view_ids % quarter).unique().tolist():
        members = (view_ids % quarter == base).nonzero()[:, 0]
        turned = [
            volumes[i].rot90(int(view_ids[i]) // quarter, (0, 2)).reshape(-1)
            for i in members.tolist()
        ]
        forward, backward = ray_table(views, base, size, density.device)
        parts.append(_Integrate.apply(torch.stack(turned, dim=1), *forward, *backward).T)
        order.append(members)
    thickness = torch.cat(parts)[torch.cat(order).argsort().to(density.device)]
    return 1 - torch.exp(-tau * thickness).reshape(-1, size, size)


# a sparse matrix by rows: columns int32, row starts int32, values float32
Table = tuple[Tensor, Tensor, Tensor]


@functools.lru_cache(maxsize=64)
def ray_table(
    views: ViewCircle, view_id: int, size: int, device: torch.device
) -> tuple[Table, Table]:
    """The linear map of one view as a sparse matrix [S^2 pixels, S^3 voxels], and its transpose."""
    points = views.sample_points(float(views.azimuth_deg(torch.tensor(view_id))), size)
    position = (points.movedim(3, 0) + 0.5) * size - 0.5  # in voxels; centres are whole numbers
    low = position.floor()
    corners = torch.cartesian_prod(*[torch.arange(2)] * 3).view(8, 3, 1, 1, 1)
    cells = low.int() + corners.int()  # [8, 3, size, size, D]: the voxels around each point
    shares = torch.where(corners == 1, position - low, 1 - (position - low)).prod(1)
    inside = (shares > 0) & ((cells >= 0) & (cells < size)).all(1)
    pixels = torch.arange(size**2).view(size, size, 1).expand_as(inside)[inside]
    voxels = ((cells[:, 0] * size + cells[:, 1]) * size + cells[:, 2])[inside]
    step = 2 * views.half_width  # distance of samples in voxels: (2 half_width / size) / (1 / size)
    indices = torch.stack([pixels, voxels])
    weights = shares[inside] * step
    with torch.sparse.check_sparse_tensor_invariants(False):  # older torch warns if nobody chooses
        matrix = torch.sparse_coo_tensor(indices, weights, (size**2, size**3)).coalesce()
        return _by_rows(matrix, device), _by_rows(matrix.t().coalesce(), device)


def _by_rows(matrix: Tensor, device: torch.device) -> Table:
    rows, columns = matrix.indices()
    starts = torch.searchsorted(rows, torch.arange(matrix.shape[0]))
    return columns.int().to(device), starts.int().to(device), matrix.values().to(device)


class _Integrate(torch.autograd.Function):
    """Sparse matrix times dense [columns, n], by `embedding_bag`, which is fast on every device."""

    @staticmethod
    def forward(ctx, dense: Tensor, *tables: Tensor) -> Tensor:
        ctx.save_for_backward(*tables[3:])
        return _multiply(tables[:3], dense)

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
        return _multiply(ctx.saved_tensors, grad.contiguous()), *(None,) * 6


def _multiply(table: Table, dense: Tensor) -> Tensor:
    columns, starts, values = table
    return F.embedding_bag(columns, dense, starts, mode="sum", per_sample_weights=values)
