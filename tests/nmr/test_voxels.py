import numpy as np
import pytest
import torch
from vectors import load_vector, vector_names

import nmr


@pytest.mark.parametrize("name", vector_names("vox_*"))
def test_published_voxels(name):
    v = load_vector(name)
    voxels = nmr.voxelize(
        torch.from_numpy(v["vertices"]), torch.from_numpy(v["faces"]), int(v["size"]), bool(v["normalize"])
    )
    assert np.array_equal(voxels.numpy(), v["voxels"].astype(bool))
