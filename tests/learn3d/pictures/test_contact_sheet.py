"""Contact sheets: a row for each object, named columns and splits."""

from __future__ import annotations

import numpy as np

from learn3d.pictures.contact_sheet import draw_sheet, make_row


def test_columns_and_splits_are_named():
    rgb, alpha = np.full((24, 64, 64, 3), 255, np.uint8), np.zeros((24, 64, 64), np.uint8)
    row = make_row(rgb, alpha, np.zeros((32, 32, 32), bool))
    assert len(row) == 10 and len(make_row(rgb[:3], alpha[:3], np.zeros((32, 32, 32), bool))) == 5
    sheet = draw_sheet({"train": [row] * 9, "val": [], "test": [row]}, 24)
    left = sheet.shape[1] - 10 * 68 - 4
    assert sheet.shape[0] == 18 + 7 * 68 + 4 and left > 10
    titles = [(sheet[:17, left + 68 * k : left + 68 * (k + 1)] < 100).any() for k in range(10)]
    names = [(sheet[22 + 68 * k : 86 + 68 * k, :left] < 100).any() for k in range(7)]
    assert titles == [True] * 10 and names == [True, *[False] * 5, True]


def test_voxels_do_not_touch_those_of_the_next_row():
    row = make_row(np.full((1, 64, 64, 3), 255, np.uint8), np.zeros((1, 64, 64), np.uint8), np.ones((32, 32, 32), bool))
    column = draw_sheet({"train": [row, row]}, 1)[22:, -36]
    assert (column[:64] == 0).all() and (column[64:68] > 0).all() and (column[68:132] == 0).all()
