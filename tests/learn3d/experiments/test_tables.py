"""The tables: figures of the paper, rows, presets."""

from __future__ import annotations

import runpy

import numpy as np
import pytest

from learn3d.experiments import published
from learn3d.experiments.experiment import describe_tables
from learn3d.experiments.tables import TABLES
from learn3d.presets import METHODS


@pytest.mark.parametrize("name", ["KATO", "PRGAN", "KAR", "ABLATION", "MMD", "PASCAL"])
def test_printed_means_agree_with_the_printed_rows(name: str) -> None:
    for label, row in getattr(published, name).items():
        if row.mean is not None:
            assert np.mean(list(row.values.values())) == pytest.approx(row.mean, abs=0.001), label


def test_a_method_of_ones_own_leaves_the_tables_alone(monkeypatch) -> None:
    monkeypatch.setitem(METHODS, "mine", "plus-kato")
    assert runpy.run_module("learn3d.experiments.tables")["TABLES"].keys() == TABLES.keys()


def test_tables_take_rows_of_the_paper_and_share_runs() -> None:
    of_the_paper = {"kato", "prgan", "kar", "ablation", "bins", "mmd", "multi-view", "pascal"}
    assert set(TABLES) == of_the_paper | {"plus", "plus-single", "precision"}
    variants: dict[str, object] = {}
    for table in TABLES.values():
        assert table.baseline in [row.label for row in table.rows]
        quoted = [row.label for row in table.rows if row.published is not None]
        assert table.name not in of_the_paper or [row.label for row in table.rows if row.label != "Plus"] == quoted
        for variant in table.variants:
            assert variants.setdefault(variant.name, variant) == variant, "one name, two meanings"
    assert len(TABLES["bins"].rows) == 7
    assert TABLES["kar"].rows[2].variant in TABLES["bins"].variants


def test_the_list_has_every_table_with_its_rows() -> None:
    """What `tools/experiment.py --list` prints."""
    lines = describe_tables().splitlines()
    for table in TABLES.values():
        start = lines.index(f"{table.name}: {table.title}") + 2
        for line, row in zip(lines[start:], table.rows, strict=False):
            assert line.startswith(f"  {row.label}: {row.variant.name if row.variant else 'quoted'}"), line
            assert "not in this version" not in line
    assert "  w/o prior: without-prior, preset peng2020-kato, lambda_prior=0" in describe_tables()
