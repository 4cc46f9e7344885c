"""Random triangles for tests, and results with several numbers of threads."""

import torch


def random_soup(seed, batch=2, num_faces=12, dtype=torch.float64, size=0.5):
    """Random triangles in renderer space, some partly off the screen: vertices ``[B, V, 3]``, faces ``[F, 3]``."""
    g = torch.Generator().manual_seed(seed)
    centre = torch.rand(batch, num_faces, 1, 3, generator=g) * 2 - 1
    corners = centre + size * torch.randn(batch, num_faces, 3, 3, generator=g)
    corners[..., 2] = 1 + torch.rand(batch, num_faces, 3, generator=g)
    return corners.reshape(batch, -1, 3).to(dtype), torch.arange(num_faces * 3).view(-1, 3)


def for_threads(counts, run):
    """The results of run() with each number of threads."""
    before = torch.get_num_threads()
    results = []
    try:
        for threads in counts:
            torch.set_num_threads(threads)
            results.append(run())
    finally:
        torch.set_num_threads(before)
    return results
