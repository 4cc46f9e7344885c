"""Options that many tests try: a test with an argument of such a name runs with every value."""

import pytest
import torch


def option(*values):
    return pytest.fixture(params=values)(lambda request: request.param)


dtype = option(torch.float32, torch.float64)
anti_aliasing = option(False, True)
fill_back = option(False, True)
packed = option(False, True)
per_image = option(False, True)
perspective = option(False, True)
smooth = option(False, True)
