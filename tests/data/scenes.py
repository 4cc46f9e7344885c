"""Small meshes for tests, and batches of them in every layout."""

import torch


def random_soup(seed, batch=2, num_faces=12, dtype=torch.float64, size=0.5):
    """Random triangles in renderer space, some partly off the screen: vertices ``[B, V, 3]``, faces ``[F, 3]``."""
    g = torch.Generator().manual_seed(seed)
    centre = torch.rand(batch, num_faces, 1, 3, generator=g) * 2 - 1
    corners = centre + size * torch.randn(batch, num_faces, 3, 3, generator=g)
    corners[..., 2] = 1 + torch.rand(batch, num_faces, 3, generator=g)
    return corners.reshape(batch, -1, 3).to(dtype), torch.arange(num_faces * 3).view(-1, 3)


def different_soups(dtype=torch.float32, sizes=(12, 1, 0, 25)):
    """Meshes ``[(vertices [V, 3], faces [F, 3]), ...]`` of different sizes, one of them empty; corners are shared."""
    meshes = []
    for n, num_faces in enumerate(sizes):
        vertices, _ = random_soup(n, 1, num_faces, dtype)
        g = torch.Generator().manual_seed(n)
        faces = torch.randint(0, max(3 * num_faces, 1), (num_faces, 3), generator=g)
        meshes.append((vertices[0], faces))
    return meshes


def pack(meshes):
    """vertices ``[N, 3]``, faces ``[M, 3]``, starts ``[B + 1, 2]`` of a list of meshes."""
    sizes = torch.tensor([[0, 0]] + [[len(vertices), len(faces)] for vertices, faces in meshes])
    vertices, faces = zip(*meshes, strict=True)
    return torch.cat(vertices), torch.cat(faces), sizes.cumsum(0)


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
